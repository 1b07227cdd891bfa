"""status, hz, echo and top on flows that really run: started by someone else, watched over Zenoh."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from caneflow import command
from caneflow.errors import CaneflowError
from caneflow.messages import Imu, numbered, sample_key
from caneflow.messages.control import Delays, EdgeStatus, FlowStatus, NodeStatus
from caneflow.recording import Recording
from caneflow.runtime.hosts.attached import attach
from caneflow.runtime.hosts.attached.attach import Attached, Heard, attached, parted
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, running_flows
from tools.echo import missed_told
from tools.status import lines as status_lines

CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DEADLINE = 30.0  # s for anything that is waited for
SECOND = 1_000_000_000  # ns
GYRO = (0.0, 0.0, 0.0)

Run = tuple[int, str, str]  # exit status, standard output, standard error

SOURCE = '''
"""Ticks on `tick` at 50 Hz; on `bad` it goes back in time twice; what comes on the others, a test puts there."""
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = dict.fromkeys(("tick", "bad", "gaps", "full", "other", "prompt", "tardy"), Imu)

    def __init__(self, settings, context):
        pass

    def samples(self):
        for stamp in (10, 20, 5, 20, 30):
            yield "bad", Imu(stamp=stamp, gyro=(0.0, 0.0, 0.0))
        while True:
            time.sleep(0.02)
            yield "tick", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.5))

if __name__ == "__main__":
    run(Ticker)
'''

JOIN = '''
"""Takes what comes on two ports."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Join(Operator):
    inputs = {"a": Imu, "b": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        pass

    def handle(self, port, message):
        if port == "a":
            yield "imu", Imu(stamp=message.stamp, gyro=message.gyro)

if __name__ == "__main__":
    run(Join)
'''

FLOW = """
flow: {flow}
links: {links}
nodes:
  source: {{run: ./source.py}}
  ticks:
    run: ./join.py
    inputs: {{a: source/tick, b: {{from: source/other, max_lag_ms: 50}}}}
  full: {{run: ./join.py, inputs: {{a: {{from: source/full, queue: fifo 3}}, b: source/other}}}}
  late: {{run: ./join.py, inputs: {{a: source/prompt, b: {{from: source/tardy, max_lag_ms: 100}}}}}}
  bad: {{run: ./join.py, inputs: {{a: source/bad, b: source/gaps}}}}
results: [ticks/imu, full/imu, late/imu, bad/imu]
"""


@pytest.fixture(scope="module")
def flow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The name of a flow that runs."""
    with running(tmp_path_factory.mktemp("flow"), "unix") as name:
        yield name


@pytest.fixture(scope="module")
def flow_over_tcp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The name of another one, whose nodes are linked by TCP."""
    with running(tmp_path_factory.mktemp("tcp"), "tcp") as name:
        yield name


@pytest.fixture(params=["flow", "flow_over_tcp"])
def either_flow(request: pytest.FixtureRequest) -> str:
    """The names of both, in turn."""
    name: str = request.getfixturevalue(request.param)
    return name


@contextmanager
def running(folder: Path, links: str) -> Iterator[str]:
    name = "t" + re.sub(r"\W", "", str(folder)).lower()[-40:]
    (folder / "source.py").write_text(SOURCE)
    (folder / "join.py").write_text(JOIN)
    (folder / "flow.yaml").write_text(FLOW.format(flow=name, links=links))
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [*CANEFLOW, "run", str(folder / "flow.yaml"), "--record", str(folder / "out.mcap"), "--record-last", "60s"],
            stdout=log,
            stderr=log,
        )
        try:
            wait_for(lambda: any(found.flow == name for found in running_flows()), "the flow's address")
            with attached(name) as here:
                wait_for(lambda: all(node.state == "ready" for node in here.status().nodes), "its nodes")
            yield name
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(DEADLINE) == 130, (folder / "log").read_text()


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """The command, run in this process."""

    def run(*arguments: object) -> Run:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    return run


def wait_for(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, f"waited {DEADLINE} s for {what}"
        time.sleep(0.05)


def edge_of(status: FlowStatus, reader: str) -> EdgeStatus:
    return next(edge for edge in status.edges if edge.reader == reader)


def lost(status: FlowStatus, reader: str) -> dict[str, int]:
    """What was lost on the way to `reader`, where there was anything."""
    edge = edge_of(status, reader)
    places = {place: getattr(edge, place) for place in ("sender", "wire", "decode", "queue", "late")}
    return {place: number for place, number in places.items() if number}


def put(here: Attached, port: str, seqs: range, *, first: int = SECOND) -> None:
    """Publish samples in the source's place, 1 ms apart."""
    for seq in seqs:
        payload = numbered(Imu(stamp=first + seq * 1_000_000, gyro=GYRO), seq)
        here.session.put(sample_key(here.flow, "source", port), payload)


def test_losses_are_counted_exactly_where_they_happen(flow: str) -> None:
    with attached(flow) as here:
        put(here, "gaps", range(3))
        for _ in range(4):
            here.session.put(sample_key(flow, "source", "gaps"), b"\xc1 no sample")
        put(here, "gaps", range(7, 9))  # 3 to 6 are the four that could not be read
        put(here, "gaps", range(14, 16))  # 9 to 13 never come
        put(here, "full", range(10))  # wait for `other`, of which nothing comes
        put(here, "prompt", range(3), first=2 * SECOND)
        wait_for(lambda: edge_of(here.status(), "late.a").handled == 3, "the three that did not wait forever")
        put(here, "tardy", range(6))  # all before the three
        expected = {
            "ticks.a": {},
            "bad.b": {"wire": 5, "decode": 4},
            "full.a": {"queue": 7},
            "late.b": {"late": 6},
            "bad.a": {"sender": 2},
        }
        wait_for(lambda: lost(here.status(), "bad.b").get("wire"), "what is given up after a second")
        wait_for(lambda: lost(here.status(), "late.b").get("late") == 6, "the six that come too late")
        status = here.status()
        assert {reader: lost(status, reader) for reader in expected} == expected
        gaps = edge_of(here.status(), "bad.b")
        assert (gaps.received, gaps.decode + gaps.handled + gaps.waiting + gaps.late) == (11, 11)
        assert edge_of(here.status(), "full.a").waiting == 3
        assert edge_of(here.status(), "bad.a").sent == 3


def test_status_as_json(caneflow: Callable[..., Run], either_flow: str) -> None:
    flow = either_flow
    with attached(flow) as here:  # rates take two counts
        wait_for(lambda: edge_of(here.status(), "ticks.a").rate, "a rate")
        wait_for(lambda: here.status().nodes[0].rates["tick"], "the writer's")
    status, out, err = caneflow("status", flow, "--json")
    assert (status, err) == (0, "")
    about = json.loads(out)
    assert (about["flow"], about["replay"]) == (flow, False)
    assert set(about["nodes"]) == {"source", "ticks", "full", "late", "bad", "recorder"}
    source = about["nodes"]["source"]
    assert source["state"] == "ready"
    assert source["memory"] > 10_000_000
    assert 20 < source["rates"]["tick"] < 51
    edge = next(edge for edge in about["edges"] if edge["reader"] == "ticks.a")
    assert edge["writer"] == "source/tick"
    assert edge["schema"] == "caneflow.Imu/1"
    assert 20 < edge["rate"] < 51
    delays = edge["delays"]
    assert 0 < delays["latency_p50"] <= delays["latency_p99"] < 5
    assert delays["latency_p50"] <= delays["age_p50"] < 5, "the stamp is taken before the sample is put"


def test_status_for_people(caneflow: Callable[..., Run], flow: str) -> None:
    status, out, _ = caneflow("status", flow)
    assert status == 0
    assert out.startswith(f"{flow}: live, on ")
    rows = {" ".join(line.split()[:3]): line for line in out.splitlines() if " > " in line}
    assert set(rows) >= {"source/tick > ticks.a", "source/bad > bad.a"}
    assert re.search(r"^source +ready +\d+ ", out, re.MULTILINE)


def test_status_of_a_cane_fits_a_terminal() -> None:
    delays = Delays(latency_p50=0.00123, latency_p99=0.01246, age_p50=0.00523, age_p99=0.0446, silent=0.04)
    edge = EdgeStatus(
        writer="ground_speed/speed", reader="fusion.speed", schema="", sent=0, received=0, handled=1_234_567,
        waiting=12, rate=100.5, sender=0, wire=3, decode=0, queue=12, late=0, repeated=0, delays=delays,
    )  # fmt: skip
    node = NodeStatus(
        node="ground_speed", program="", state="ready", pid=1_234_567, restarts=0, uptime=36_000.0, cpu=0.279,
        memory=70_000_000, sent={"speed": 1_234_567}, rates={"speed": 100.5}, counted=0.1, said="",
    )  # fmt: skip
    about = FlowStatus(
        flow="cane", version="0.1.0", host="gateway", pid=1, uptime=36_000.0, replay=False, clock=0, machine="",
        nodes=[node], edges=[edge],
    )  # fmt: skip
    shown = list(status_lines(about))
    assert max(map(len, shown)) <= 80, shown
    assert shown[-1].endswith("3 wire, 12 queue")


def test_hz_of_chosen_streams(caneflow: Callable[..., Run], either_flow: str) -> None:
    flow = either_flow
    status, out, _ = caneflow("hz", flow, "source/tick", "ticks/imu", "--seconds", "1", "--json")
    figures = json.loads(out)
    assert (status, set(figures)) == (0, {"source/tick", "ticks/imu"})
    tick = figures["source/tick"]
    assert 10 < tick["count"] <= 51
    assert tick["shortest"] <= 1 / tick["rate"] <= tick["longest"]
    assert (tick["missing"], tick["unreadable"]) == (0, 0)
    assert tick["stamped_rate"] == pytest.approx(tick["rate"], rel=0.3)


def test_hz_for_people(caneflow: Callable[..., Run], flow: str) -> None:
    status, out, _ = caneflow("hz", flow, "--seconds", "0.5")
    assert status == 0
    heads, units = (line.split() for line in out.splitlines()[:2])
    assert heads == ["stream", "count", "rate", "stamped", "steps", "jitter", "missing", "bad"]
    assert units == ["Hz", "Hz", "ms", "ms"]
    assert re.search(r"^source/tick +\d+ +\d+\.\d\d ", out, re.MULTILINE)


def test_echo_prints_samples_as_they_are_on_the_wire(caneflow: Callable[..., Run], either_flow: str) -> None:
    flow = either_flow
    status, out, _ = caneflow("echo", flow, "source/tick", "--count", 2)
    assert status == 0
    assert len(out.splitlines()) == 2
    assert re.fullmatch(r"source/tick  \d+  \d{10}\.\d{9}  gyro=\(0, 0, 0\.5\)", out.splitlines()[0])
    told = json.loads(caneflow("echo", f"{flow}/source/tick", "--count", 1, "--json")[1])
    assert (told["stream"], told["schema"], told["gyro"]) == ("source/tick", "caneflow.Imu/1", [0, 0, 0.5])


def test_echo_tells_what_it_missed_of_each_stream(capsys: pytest.CaptureFixture[str]) -> None:
    heard = [("a", seq) for seq in (5, 6, 9, 7, 10)] + [("b", seq) for seq in (100, 103)]
    with suppress(KeyboardInterrupt), missed_told() as missed:
        for port, seq in heard:
            payload = numbered(Imu(stamp=SECOND, gyro=GYRO), seq)
            missed.take(Heard(f"cane/imu/{port}", "caneflow.Imu/1", payload, 0))
        missed.take(Heard("cane/imu/a", "caneflow.Imu/1", b"no sample", 0))
        raise KeyboardInterrupt

    assert capsys.readouterr().err == "4 samples missed: they came faster than this command took them\n"


def test_echo_that_hears_nothing_says_what_to_try(caneflow: Callable[..., Run], flow: str) -> None:
    status, out, err = caneflow("echo", flow, "full/imu", "--seconds", 0.2)
    assert (status, out) == (2, "")
    assert err == f"caneflow echo: nothing came of full/imu in 0.2 s; `caneflow status {flow}` shows why\n"


def test_top(caneflow: Callable[..., Run], either_flow: str) -> None:
    flow = either_flow
    looks = [json.loads(line) for line in caneflow("top", flow, "--json", "--count", 2, "--every", 0.2)[1].splitlines()]
    assert len(looks) == 2
    assert looks[1]["memory"] == sum(node["memory"] for node in looks[1]["nodes"].values())
    shares = [node["cpu"] for node in looks[1]["nodes"].values()]
    assert shares == sorted(shares, reverse=True)
    assert caneflow("top", flow)[1].splitlines()[-1].startswith("together ")


def test_the_last_seconds_are_written_when_asked_for(caneflow: Callable[..., Run], flow: str) -> None:
    for number in (0, 1):
        status, out, err = caneflow("record", "--now", flow, "--json")
        assert (status, err) == (0, "")
        (written,) = json.loads(out)
        assert Path(written["path"]).name == f"out_00{number}.mcap"
        with Recording(written["path"]) as recording:
            assert recording.complete
            assert recording.flow == flow
            counts = {stream: found.count for stream, found in recording.streams.items()}
            assert sum(counts.values()) + sum(recording.control.values()) == written["samples"]
            ticks = [sample.seq for sample in recording.samples([("source", "tick")])]
        assert ticks == list(range(len(ticks))), "the flow is younger than a minute"
    assert re.fullmatch(r".*out_002\.mcap: \d+ samples, \d+\.\d s\n", caneflow("record", "--now", flow)[1])


def test_the_doctor_of_a_flow_that_is_well(caneflow: Callable[..., Run], either_flow: str) -> None:
    flow = either_flow
    status, out, err = caneflow("doctor", flow, "--json")
    found = json.loads(out)
    assert (status, err) == (0, ""), [finding for finding in found if finding["state"] == "bad"]
    links = {finding["node"]: finding["text"] for finding in found if "linked to" in finding["text"]}
    assert set(links) == {"source", "ticks", "full", "late", "bad", "recorder"}
    assert re.fullmatch(r"listens on (port|socket) \d+; linked to the launcher", links["source"])
    assert links["full"].endswith("; linked to the launcher, source")


def test_the_doctor_names_a_node_that_hangs(caneflow: Callable[..., Run], flow: str) -> None:
    with attached(flow) as here:
        victim = next(node for node in here.status().nodes if node.node == "ticks")
        os.kill(victim.pid, signal.SIGSTOP)
        try:
            wait_for(lambda: silence(here.status().nodes[1]) > 3.5, "three seconds of silence")
            status, out, _ = caneflow("doctor", flow)
        finally:
            os.kill(victim.pid, signal.SIGCONT)
        assert status == 1
        assert re.search(rf"^ticks: bad  has said nothing for \d s, pid {victim.pid} is there", out, re.MULTILINE)
        assert re.search(r"^ +try  is it stopped, or in a long computation\?", out, re.MULTILINE)
        wait_for(lambda: (here.status().nodes[1].counted or 9) < 2, "its counters")


def silence(node: NodeStatus) -> float:
    """S since a node said anything."""
    return node.uptime if node.counted is None else node.counted


def test_how_long_status_takes(benchmark: Any, flow: str) -> None:
    """From the shell's point of view; under 1 s is what people were promised."""
    ask = [*CANEFLOW, "status", flow, "--json"]
    done = benchmark.pedantic(subprocess.run, (ask,), {"capture_output": True, "check": True}, rounds=10)
    assert json.loads(done.stdout)["flow"] == flow


def test_words_of_a_command_line_name_a_flow_and_its_streams() -> None:
    assert parted([]) == (None, [])
    assert parted(["cane", "imu/imu"]) == ("cane", [("imu", "imu")])
    assert parted(["cane/imu/imu", "cane/fusion/pose"]) == ("cane", [("imu", "imu"), ("fusion", "pose")])
    for words in (["a/b/c/d"], ["/imu"], ["cane", "room"]):
        with pytest.raises(CaneflowError):
            parted(words)


RUNNING = [RunningFlow("cane", 1, "tcp/127.0.0.1:1"), RunningFlow("room", 2, "tcp/127.0.0.1:2")]


@pytest.mark.parametrize(
    ("running", "name", "said"),
    [
        ([], None, "no flow runs on this machine; start one with `caneflow run FILE`, or name another's: --at"),
        (RUNNING, None, "several flows run on this machine; name one of cane, room"),
        (RUNNING, "rom", "no flow 'rom' runs on this machine; did you mean 'room'?"),
        (RUNNING, "x", "no flow 'x' runs on this machine; there is cane, room"),
        (
            RUNNING[:1] * 2,
            "cane",
            "2 flows 'cane' run on this machine; choose by --at tcp/127.0.0.1:1 (pid 1), --at tcp/127.0.0.1:1 (pid 1)",
        ),
    ],
)
@pytest.mark.parametrize("word", ["status", "hz", "echo", "top"])  # the doctor has a finding of it
def test_a_flow_that_cannot_be_found_is_one_line(
    caneflow: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    word: str,
    running: list[RunningFlow],
    name: str | None,
    said: str,
) -> None:
    monkeypatch.setattr(attach, "running_flows", lambda: running)
    assert caneflow(word, *([name] if name else [])) == (2, "", f"caneflow {word}: {said}\n")
