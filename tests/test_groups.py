"""Several nodes in one process: the same bytes as in one each, exact after a kill, still nodes to the outside."""

import signal
from collections.abc import Mapping
from pathlib import Path

import pytest

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, decode
from caneflow.messages.control import FlowStatus
from caneflow.recording import Recording
from caneflow.runtime.dataflow.loading import examine, load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.asking import restarted
from caneflow.runtime.hosts.attached.attach import attached, launchers_of, statuses
from caneflow.runtime.replays.verification import verify
from caneflow.runtime.stages.journal import Brought, Journal
from tests.flows import NODES, caneflow, caneflow_here, launchers, node_processes, results, wait_for, write_walk

DEVICE = """
import itertools, time
from caneflow.messages import Imu
from caneflow.runtime import Quiet, Source, run

class Device(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        for number in itertools.count():
            time.sleep(0.01)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(float(number), 0.0, 0.0))

if __name__ == "__main__":
    run(Device)
"""
SUM = """
from caneflow.messages import Imu
from caneflow.runtime import Operator, run

class Sum(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        self.total = 0.0

    def handle(self, port, message):
        self.total += message.gyro[0]
        yield "imu", Imu(stamp=message.stamp, gyro=(self.total, 0.0, 0.0))

if __name__ == "__main__":
    run(Sum)
"""


def grouped(path: Path, processes: Mapping[str, str], flow: str = "grouped") -> Path:
    """The cane's dataflow.yaml; `processes`: by node the one that it shares. `flow`: a name that no other test runs."""
    shared = {name: f", process: {process}" for name, process in processes.items()}
    nodes = "\n".join(f"  {name}: {{{node}{shared.get(name, '')}}}" for name, node in NODES.items())
    path.write_text(f"flow: {flow}\nnodes:\n{nodes}\nresults: [fusion/pose]\n")
    return path


@pytest.mark.parametrize(
    "processes",
    [
        dict.fromkeys(NODES, "recorder"),
        {"imu": "a", "ground_speed": "a", "radar": "b", "fusion": "b"},
    ],
    ids=["all and the recorder", "two that read each other"],
)
def test_a_group_computes_the_same_bytes(tmp_path: Path, processes: Mapping[str, str]) -> None:
    walk, flow = write_walk(tmp_path / "walk.mcap", 200), grouped(tmp_path / "flow.yaml", processes)
    found = {}
    for options in ("--in-process", "--speed=max"):
        out = tmp_path / f"{options}.mcap"
        run = caneflow_here if options == "--in-process" else caneflow
        done = run("run", flow, "--replay", walk, options, "--record", out)
        assert done.returncode == 0, done.stderr
        found[options] = results(out)
    assert len(found["--in-process"]["fusion/pose"]) == 200
    assert found["--speed=max"] == found["--in-process"]


def test_a_live_group_that_is_killed_goes_on_exactly_and_is_still_nodes(tmp_path: Path) -> None:
    (tmp_path / "device.py").write_text(DEVICE)
    (tmp_path / "sum.py").write_text(SUM)
    flow, out = tmp_path / "flow.yaml", tmp_path / "out.mcap"
    flow.write_text(
        "flow: summed\nnodes:\n"
        "  device: {run: device.py, process: both}\n"
        "  sum: {run: sum.py, process: both, inputs: {imu: device/imu}}\n"
        "results: [sum/imu]\n"
    )
    with launchers() as launch:
        launched = launch("run", flow, "--record", out, log=tmp_path / "log")
        launched.wait_for("ready: 3 nodes")
        process = node_processes(launched.process.pid)["both"]
        snapshot = Path(" ".join(process.cmdline()).split()[-1]).with_name("both.snapshot")
        wait_for(snapshot.exists, "a snapshot")
        wait_for(lambda: len(journal(snapshot)) > 2000, "samples after it")
        process.kill()
        launched.wait_for("goes on from its snapshot")
        with attached("summed") as there:
            (status,) = statuses(there.session, "summed")
            before = recorded(status)  # up to the kill, or less
            wait_for(lambda: recorded(*statuses(there.session, "summed")) > before + 200, "samples after the kill")
        processes = {node.node: node.process for node in status.nodes}
        assert processes == {"device": "both", "sum": "both", "recorder": ""}
        launched.process.send_signal(signal.SIGINT)
        assert launched.ends() == 130, launched.said
    with Recording(out) as recording:
        brought = [decode(each.payload, Imu) for each in recording.samples([("device", "imu")])]
        sums = [decode(each.payload, Imu) for each in recording.samples([("sum", "imu")])]
    assert [each.seq for each in brought] == list(range(len(brought)))
    assert sum(each.gyro[0] == 0.0 for each in brought) == 2, "the device began again"
    total = 0.0
    for message, told in zip(brought, sums, strict=False):
        total += message.gyro[0]
        assert (told.seq, told.stamp, told.gyro[0]) == (message.seq, message.stamp, total)
    assert len(brought) - 1 <= len(sums) <= len(brought)


def test_a_group_with_the_recorder_ends_its_sources_before_an_operator_outside(tmp_path: Path) -> None:
    (tmp_path / "device.py").write_text(DEVICE)
    (tmp_path / "sum.py").write_text(SUM)
    flow, out = tmp_path / "flow.yaml", tmp_path / "out.mcap"
    flow.write_text(
        "flow: apart\nnodes:\n"
        "  device: {run: device.py, process: recorder}\n"
        "  sum: {run: sum.py, inputs: {imu: device/imu}}\n"
        "results: [sum/imu]\n"
    )
    with launchers() as launch:
        launched = launch("run", flow, "--record", out, log=tmp_path / "log")
        launched.wait_for("ready: 3 nodes")
        with attached("apart") as there:
            wait_for(lambda: recorded(*statuses(there.session, "apart")) > 50, "samples")
        launched.process.send_signal(signal.SIGINT)
        assert launched.ends() == 130, launched.said
    with Recording(out) as recording:
        streams = {name: [each.seq for each in recording.samples([(name, "imu")])] for name in ("device", "sum")}
    assert len(streams["device"]) > 50
    assert streams["sum"] == streams["device"], "what the device brought last was handled before the operator ended"


def test_in_a_replay_the_process_of_the_recorder_is_never_started_again(tmp_path: Path) -> None:
    walk = write_walk(tmp_path / "walk.mcap", 1000)
    flow = grouped(tmp_path / "flow.yaml", dict.fromkeys(NODES, "recorder"), "recorded")
    with launchers() as launch:
        launched = launch("run", flow, "--replay", walk, "--record", tmp_path / "out.mcap", log=tmp_path / "log")
        launched.wait_for("ready: 5 nodes")
        with pytest.raises(CaneflowError, match="fusion: not started again: the recording of a replay is its result"):
            restarted(launchers_of("recorded"), "fusion")
        node_processes(launched.process.pid)["recorder"].kill()
        assert launched.ends() == 1, launched.said
        assert "killed by SIGKILL: not started again: the recording of a replay is its result" in launched.said


def test_a_group_in_a_replay_that_is_asked_to_restart_computes_the_same_bytes(tmp_path: Path) -> None:
    walk, flow = (
        write_walk(tmp_path / "walk.mcap", 250),
        grouped(tmp_path / "flow.yaml", dict.fromkeys(NODES, "cane"), "asked"),
    )
    alone, out = tmp_path / "alone.mcap", tmp_path / "out.mcap"
    done = caneflow_here("run", flow, "--replay", walk, "--in-process", "--record", alone)
    assert done.returncode == 0, done.stderr
    with launchers() as launch:
        slowly = ("--speed", 0.4)  # the command must be through before the replay is
        launched = launch("run", flow, "--replay", walk, *slowly, "--record", out, log=tmp_path / "log")
        launched.wait_for("ready: 5 nodes")
        before = node_processes(launched.process.pid)
        again = restarted(launchers_of("asked"), "fusion")
        after = node_processes(launched.process.pid)
        assert launched.ends() == 0, launched.said
    assert after.keys() == before.keys() == {"cane", "recorder"}
    assert after["cane"].pid == again.pid != before["cane"].pid, "it restarts as one"
    assert after["recorder"].pid == before["recorder"].pid
    assert results(out) == results(alone)


def recorded(status: FlowStatus) -> int:
    (edge,) = (edge for edge in status.edges if edge.reader == "recorder.device/imu")
    return edge.handled


def journal(snapshot: Path) -> bytes:
    """What the journal holds since the snapshot; a process begins a file with its first sample."""
    files = sorted(snapshot.parent.glob("both.journal.*"), key=lambda path: int(path.suffix[1:]))
    try:
        return files[-1].read_bytes() if files else b""
    except FileNotFoundError:  # the next snapshot was kept meanwhile
        return b""


def said(path: Path) -> list[str]:
    return [str(problem).removeprefix(f"{path}:") for problem in examine(path)[1] if not problem.warning]


def test_a_process_has_one_machine_one_policy_and_a_name_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "flow.yaml"
    path.write_text(
        "flow: f\n"
        "machines: {a: {listen: [tcp/0.0.0.0:7447]}, b: {connect: [tcp/a:7447]}}\n"
        "nodes:\n"
        "  imu: {run: drivers.bno055, machine: a, process: fusion}\n"
        "  radar: {run: drivers.p440, machine: b, process: fusion, restart: never}\n"
        "  ground_speed: {run: operators.ground_speed, machine: a, inputs: {frame: radar/frame, imu: imu/imu}}\n"
        "  fusion: {run: operators.fusion, machine: a, inputs: {imu: imu/imu, speed: ground_speed/speed}}\n"
        "  chip: {external: true, machine: a, process: fusion, outputs: {imu: Imu}}\n"
    )
    wrong = said(path)
    assert len(wrong) == 4
    assert any("imu.process: 'fusion' is a node outside it" in each for each in wrong)
    assert any("radar.process: is shared with imu, which runs on a, and radar on b" in each for each in wrong)
    assert any("radar.process: is shared with imu, which has another `restart`" in each for each in wrong)
    assert any("chip.process: an external node" in each for each in wrong)


def test_one_process_takes_all_nodes_but_the_recorder_or_says_why_not(tmp_path: Path) -> None:
    flow = grouped(tmp_path / "flow.yaml", {})
    plans = deploy(load(flow), record=tmp_path / "out.mcap", one_process=True).plans
    assert {plan.runs_in for name, plan in plans.items() if name != "recorder"} == {"grouped"}
    assert plans["recorder"].runs_in == "recorder"
    flow.write_text(flow.read_text().replace("drivers.bno055", "drivers.bno055, restart: never"))
    with pytest.raises(DataflowError, match=r"--one-process: .*imu.* have a `restart` each"):
        deploy(load(flow), one_process=True)


def test_a_journal_is_read_up_to_what_the_kill_tore(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "g.journal")
    brought = [Brought("imu", "imu", bytes([number]) * 5) for number in range(4)]
    journal.append(brought[0])
    second = journal.begin()
    for each in brought[1:]:
        journal.append(each)
    file = tmp_path / f"g.journal.{second}"
    file.write_bytes(file.read_bytes()[:-1])
    again = Journal(tmp_path / "g.journal")
    assert list(again.since(0)) == brought[:3]
    assert list(again.since(second)) == brought[1:3]
    again.append(brought[3])
    assert list(again.since(second)) == brought[1:], "the new process writes a file of its own"
    again.forget(second)
    assert list(again.since(0)) == brought[1:]


LATE = """
import time
from caneflow.messages import Imu
from caneflow.runtime import Quiet, Source, run

class Late(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        held = []
        while True:
            time.sleep(0.01)
            now = time.time_ns()
            held.append(Imu(stamp=now, gyro=(float(now % 1009), 0.0, 0.0)))
            if now // 250_000_000 % 2 == 0:
                yield from (("imu", sample) for sample in held)
                held = []

if __name__ == "__main__":
    run(Late)
"""
MIX = """
from caneflow.messages import Imu
from caneflow.runtime import Operator, run

class Mix(Operator):
    inputs = {"quick": Imu, "late": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        self.total = 0.0

    def handle(self, port, message):
        self.total = (self.total * 31.0 + message.gyro[0]) % 1000003.0
        if port == "quick":
            yield "imu", Imu(stamp=message.stamp, gyro=(self.total, 0.0, 0.0))

if __name__ == "__main__":
    run(Mix)
"""


def test_a_group_decides_after_a_kill_as_before_whom_it_did_not_wait_for(tmp_path: Path) -> None:
    for name, text in {"device": DEVICE, "late": LATE, "mix": MIX}.items():
        (tmp_path / f"{name}.py").write_text(text)
    flow, out = tmp_path / "flow.yaml", tmp_path / "out.mcap"
    flow.write_text(
        "flow: mixed\nnodes:\n"
        "  device: {run: device.py, process: both}\n"
        "  mix:\n"
        "    run: mix.py\n"
        "    process: both\n"
        "    inputs: {quick: device/imu, late: {from: late/imu, max_lag_ms: 60}}\n"
        "  late: {run: late.py}\n"
        "results: [mix/imu]\n"
    )
    with launchers() as launch:
        launched = launch("run", flow, "--record", out, log=tmp_path / "log")
        launched.wait_for("ready: 4 nodes")
        process = node_processes(launched.process.pid)["both"]
        snapshot = Path(" ".join(process.cmdline()).split()[-1]).with_name("both.snapshot")
        wait_for(snapshot.exists, "a snapshot")
        wait_for(lambda: b"left out" in journal(snapshot), "a decision after it")
        wait_for(lambda: len(journal(snapshot)) > 8000, "samples after it")
        process.kill()
        launched.wait_for("goes on from its snapshot")
        with attached("mixed") as there:
            before = recorded(*statuses(there.session, "mixed"))
            wait_for(lambda: recorded(*statuses(there.session, "mixed")) > before + 100, "samples after the kill")
        launched.process.send_signal(signal.SIGINT)
        assert launched.ends() == 130, launched.said
    (verdict,) = verify(load(flow), out).verdicts
    assert verdict.holds, f"{verdict.first}\n{launched.said}"
    assert verdict.recorded > 300
