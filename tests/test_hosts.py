"""One graph, two hosts: streams that end early, never start, lag, or are filtered give the same bytes in both."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from caneflow.messages import Imu, decode, numbered, sample_key
from caneflow.recording import Recording, RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from tests.flows import NODES, caneflow, caneflow_here, spread_cane

TICK = 10_000_000  # ns

STREAM = '''
"""Stands for a device: one IMU stream."""
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Stream(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        yield from ()

if __name__ == "__main__":
    run(Stream)
'''

EVERY_FIFTH = '''
"""A filter: hands every fifth sample on."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class EveryFifth(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        self.seen = 0

    def handle(self, port, message):
        self.seen += 1
        if self.seen % 5 == 0:
            yield "imu", Imu(stamp=message.stamp, gyro=message.gyro)

if __name__ == "__main__":
    run(EveryFifth)
'''

ORDER = '''
"""Says in which order things came, and a random number each time: gyro = (port, seq, random)."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Order(Operator):
    inputs = {"a": Imu, "b": Imu, "c": Imu, "d": Imu}
    optional_inputs = frozenset("abcd")
    outputs = {"seen": Imu}

    def __init__(self, settings, context):
        self.random = context.random
        self.last = -1

    def handle(self, port, message):
        # Stamps of one output strictly increase: equal ones are told apart by a nanosecond.
        self.last = max(message.stamp, self.last + 1)
        yield "seen", Imu(stamp=self.last, gyro=("abcd".index(port), float(message.seq), self.random.normal()))

    def finish(self):
        yield "seen", Imu(stamp=self.last + 1, gyro=(-1.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Order)
'''

FLOW = """
flow: order
seed: 5
nodes:
  a: {run: ./stream.py}
  b: {run: ./stream.py}
  c: {run: ./stream.py}
  d: {run: ./stream.py}
  fifth: {run: ./every_fifth.py, inputs: {imu: d/imu}}
  order: {run: ./order.py, inputs: {a: a/imu, b: b/imu, c: c/imu, d: fifth/imu}}
results: [order/seen]
"""

Stamps = Mapping[str, list[int]]

CASES: dict[str, dict[str, list[int]]] = {
    "equal stamps": {name: [i * TICK for i in range(100)] for name in "abcd"},
    "ends early": {
        "a": [i * TICK for i in range(300)],
        "b": [i * TICK for i in range(20)],
        "c": [i * TICK + 3 for i in range(300)],
        "d": [i * TICK for i in range(40)],
    },
    "hardly starts": {  # a recording knows a stream by its samples: one at the very end
        "a": [i * TICK for i in range(200)],
        "b": [200 * TICK],
        "c": [0],
        "d": [i * TICK for i in range(200)],
    },
    "lags by seconds": {
        "a": [i * TICK for i in range(1200)],
        "b": [i * TICK for i in range(600, 1200)],
        "c": [i * 300 * TICK + 7 for i in range(4)],
        "d": [i * 11 * TICK for i in range(100)],
    },
}


@pytest.fixture
def flow(tmp_path: Path) -> Path:
    for name, text in {"stream": STREAM, "every_fifth": EVERY_FIFTH, "order": ORDER}.items():
        (tmp_path / f"{name}.py").write_text(text)
    path = tmp_path / "order.yaml"
    path.write_text(FLOW)
    return path


def recorded(path: Path, stamps: Stamps) -> Path:
    """A recording of the streams, received one whole stream after the other: reception says nothing."""
    with RecordingWriter(path, flow="order", source="simulated", rig={}) as writer:
        for node, of_node in stamps.items():
            for seq, stamp in enumerate(of_node):
                payload = numbered(Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0)), seq)
                key = sample_key("order", node, "imu")
                writer.write(key, Imu, payload, stamp=stamp, seq=seq, log_time=stamp)
    return path


def seen(flow: Path, recording: Path, out: Path, *options: str) -> list[bytes]:
    run = caneflow_here if "--in-process" in options else caneflow
    done = run("run", flow, "--replay", recording, "--record", out, *options)
    assert done.returncode == 0, done.stderr
    with Recording(out) as got:
        return [sample.payload for sample in got.samples([("order", "seen")])]


def expected(stamps: Stamps, start: int = 0) -> list[tuple[int, int]]:
    """The slow, obvious order: (port, seq) sorted by stamp, port; d thinned out; numbers from the start on."""
    kept = {name: [s for s in of_node if s >= start] for name, of_node in stamps.items()}
    kept["d"] = kept["d"][4::5]
    every = sorted((stamp, port, seq) for port, name in enumerate("abcd") for seq, stamp in enumerate(kept[name]))
    return [(port, seq) for _, port, seq in every]


def order_of(payloads: list[bytes]) -> list[tuple[int, int]]:
    gyros = [decode(payload, Imu).gyro for payload in payloads]
    assert gyros[-1] == (-1.0, 0.0, 0.0), "the operator was told of the end"
    return [(int(port), int(seq)) for port, seq, _ in gyros[:-1]]


@pytest.mark.parametrize("case", CASES)
def test_in_one_process_the_order_is_that_of_the_stamps(flow: Path, tmp_path: Path, case: str) -> None:
    recording = recorded(tmp_path / "in.mcap", CASES[case])
    got = seen(flow, recording, tmp_path / "out.mcap", "--in-process")
    assert order_of(got) == expected(CASES[case])


@pytest.mark.parametrize(("case", "links"), [("lags by seconds", "unix"), ("ends early", "tcp")])
def test_processes_give_the_same_bytes(flow: Path, tmp_path: Path, case: str, links: str) -> None:
    flow.write_text(f"links: {links}\n{flow.read_text()}")
    recording = recorded(tmp_path / "in.mcap", CASES[case])
    oracle = seen(flow, recording, tmp_path / "a.mcap", "--in-process")
    assert seen(flow, recording, tmp_path / "b.mcap", "--speed", "max") == oracle


def test_a_start_in_the_middle_is_the_same_in_both(flow: Path, tmp_path: Path) -> None:
    stamps = CASES["lags by seconds"]
    recording = recorded(tmp_path / "in.mcap", stamps)
    oracle = seen(flow, recording, tmp_path / "a.mcap", "--in-process", "--start", "5")
    assert order_of(oracle) == expected(stamps, start=5_000_000_000)
    assert seen(flow, recording, tmp_path / "b.mcap", "--speed", "max", "--start", "5") == oracle


def test_a_new_node_does_not_change_the_random_numbers_of_another(flow: Path, tmp_path: Path) -> None:
    recording = recorded(tmp_path / "in.mcap", CASES["equal stamps"])
    before = seen(flow, recording, tmp_path / "a.mcap", "--in-process")
    text = flow.read_text()
    flow.write_text(text.replace("results:", "  another: {run: ./order.py, inputs: {a: a/imu}}\nresults:"))
    assert seen(flow, recording, tmp_path / "b.mcap", "--in-process") == before
    flow.write_text(text.replace("seed: 5", "seed: 6"))
    assert seen(flow, recording, tmp_path / "c.mcap", "--in-process") != before


def test_a_node_left_out_ends_its_readers_inputs(flow: Path, tmp_path: Path) -> None:
    stamps = CASES["equal stamps"]
    recording = recorded(tmp_path / "in.mcap", stamps)
    got = seen(flow, recording, tmp_path / "out.mcap", "--in-process", "--without", "b")
    without = [(port, seq) for port, seq in expected(stamps) if port != 1]
    # With b gone the port order stays; only its samples are missing.
    assert order_of(got) == without


def test_only_what_a_reader_puts_in_order_with_other_streams_is_awaited(tmp_path: Path) -> None:
    file = tmp_path / "cane.yaml"
    file.write_text(spread_cane("cane", "  here: {}\n", dict.fromkeys(NODES, "here")))
    plans = deploy(load(file), record=tmp_path / "out.mcap").plans
    awaited = {out.key for plan in plans.values() for out in plan.outputs.values() if out.awaited}
    assert awaited == {"cane/imu/imu", "cane/radar/frame", "cane/ground_speed/speed"}
    assert plans["fusion"].outputs["pose"].readers == ("recorder",)


@pytest.mark.parametrize(
    ("fault", "lines", "words"),
    [
        ("raise KeyError('nothing')", 5, "KeyError: 'nothing'"),
        ("yield 'sean', message", 1, "emitted on port 'sean'; it has seen"),
    ],
)
def test_in_one_process_a_fault_of_an_operator_names_its_node_and_sample(
    flow: Path, tmp_path: Path, fault: str, lines: int, words: str
) -> None:
    """The operator's own lines of the traceback, and none of ours."""
    operator = tmp_path / "order.py"
    operator.write_text(
        ORDER.replace("        # Stamps of", f"        if message.seq == 7:\n            {fault}\n        # Stamps of")
    )
    recording = recorded(tmp_path / "in.mcap", CASES["equal stamps"])
    done = caneflow_here("run", flow, "--replay", recording, "--in-process")
    said = done.stderr.splitlines()
    assert done.returncode == 1
    assert said[-1] == f"caneflow run: order failed at a seq 7: {words}"
    assert len(said) == lines
    assert all("caneflow/runtime" not in line for line in said)


def test_a_recording_is_not_named_as_something_else(tmp_path: Path) -> None:
    done = caneflow_here(
        "run", "dataflow.yaml", "--replay", tmp_path / "walk.mcap", "--in-process", "--record", tmp_path / "out.txt"
    )
    assert done.returncode == 2
    assert done.stderr == f"caneflow run: --record: {tmp_path}/out.txt: a recording's name ends with .mcap\n"
