"""Tools that stand still beside a flow: it goes on, loses nothing, and answers the others."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from caneflow.messages import RadarFrame, numbered, sample_key
from caneflow.recording import RecordingWriter
from caneflow.runtime.hosts.attached.attach import attached
from caneflow.runtime.hosts.launcher.congestion import (
    LAUNCHER_STARTS,
    NODE_STARTS,
    launcher_ids,
    node_id,
    node_ids,
    tool_links,
)
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.hosts.links.certificates import make_authority, make_certificate
from tests.flows import Launched, free_port, launchers, wait_for

Launch = Callable[..., Launched]
FRAMES = 1_000  # of 32 kB: several times what Zenoh and the kernel hold for a tool that takes nothing
FROZEN = 2  # tools

COUNTER = '''
"""Counts frames; slowly, until it is told to go."""
import time
from pathlib import Path
from caneflow.messages import Imu, RadarFrame
from caneflow.runtime import Operator
from caneflow.runtime.node import run

GO = Path(__file__).with_name("go")

class Counter(Operator):
    inputs = {"frame": RadarFrame}
    outputs = {"count": Imu}

    def __init__(self, settings, context):
        self.count = 0

    def handle(self, port, message):
        self.count += 1
        if not GO.exists():
            time.sleep(0.01)
        yield "count", Imu(stamp=message.stamp, gyro=(float(self.count), 0.0, 0.0))

if __name__ == "__main__":
    run(Counter)
'''

FLOW = """
flow: {flow}
{machines}
nodes:
  radar: {{run: drivers.p440{gateway}}}
  counter: {{run: ./counter.py, inputs: {{frame: radar/frame}}{phone}}}
results: [counter/count]
"""


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of large frames."""
    path = tmp_path_factory.mktemp("frames") / "frames.mcap"
    scans = np.zeros((1, 8_000), dtype=np.int32)
    with RecordingWriter(path, flow="elsewhere", source="simulated", rig={}) as writer:
        for seq in range(FRAMES):
            stamp = 1_000_000_000 + seq * 10_000_000
            frame = RadarFrame(
                stamp=stamp,
                scans=scans,
                scan_period=0.01,
                range_start=0.5,
                range_step=0.009149,
                carrier=4.3e9,
                bandwidth=1.7e9,
            )
            payload = numbered(frame, seq)
            writer.write(
                sample_key("elsewhere", "radar", "frame"), RadarFrame, payload, stamp=stamp, seq=seq, log_time=stamp
            )
    return path


def flow_in(folder: Path, *, machines: str = "", gateway: str = "", phone: str = "") -> tuple[str, Path]:
    """The name of a flow, and its file."""
    flow = f"z{time.time_ns()}"
    (folder / "counter.py").write_text(COUNTER)
    file = folder / "flow.yaml"
    file.write_text(FLOW.format(flow=flow, machines=machines, gateway=gateway, phone=phone))
    return flow, file


@contextmanager
def frozen_tools(launch: Launch, folder: Path, *where: object) -> Iterator[None]:
    """Tools that have heard something and stand still, as after Ctrl-Z."""
    tools = [launch("echo", *where, log=folder / f"echo{number}.log") for number in range(FROZEN)]
    try:
        for tool in tools:
            tool.wait_for("radar/frame")
            tool.process.send_signal(signal.SIGSTOP)
        yield
    finally:
        for tool in tools:
            tool.process.send_signal(signal.SIGCONT)


def wait_for_flow(flow: str, launchers: int = 1) -> None:
    wait_for(lambda: [found.flow for found in running_flows()].count(flow) == launchers, flow)


def assert_goes_on_to_its_end(folder: Path, flow: str, *launched: Launched) -> None:
    """Everybody else is answered, and the replay runs to its end and has lost nothing."""
    with attached(flow) as here:
        assert {node.node for node in here.status().nodes} == {"radar", "counter"}
    (folder / "go").touch()
    for each in launched:
        assert each.ends(20) == 0, each.said
    assert f"counter: {FRAMES} x count" in "".join(each.said for each in launched)


def test_a_replay_beside_frozen_tools_goes_on(launch: Launch, frames: Path, tmp_path: Path) -> None:
    flow, file = flow_in(tmp_path)
    run = launch("run", file, "--replay", frames, "--speed", "max", log=tmp_path / "run.log")
    wait_for_flow(flow)
    with frozen_tools(launch, tmp_path, flow):
        assert_goes_on_to_its_end(tmp_path, flow, run)


def test_a_replay_on_two_machines_beside_frozen_observers_goes_on(launch: Launch, frames: Path, tmp_path: Path) -> None:
    keys, port = tmp_path / "keys", free_port()
    make_authority(keys)
    for machine in ("gateway", "phone"):
        make_certificate(keys, machine)
    make_certificate(keys, "laptop", observer=True)
    machines = f"machines:\n  gateway: {{listen: [tcp/127.0.0.1:{port}]}}\n  phone: {{connect: [tcp/127.0.0.1:{port}]}}"
    flow, file = flow_in(tmp_path, machines=machines, gateway=", machine: gateway", phone=", machine: phone")
    replay = ("run", file, "--replay", frames, "--speed", "max", "--machine")
    parts = [launch(*replay, machine, log=tmp_path / f"{machine}.log") for machine in ("gateway", "phone")]
    wait_for_flow(flow, launchers=2)
    with frozen_tools(launch, tmp_path, flow, "--at", f"tls/127.0.0.1:{port}", "--keys", keys):
        assert_goes_on_to_its_end(tmp_path, flow, *parts)


def test_ids_of_sessions_are_different_and_known_beforehand() -> None:
    nodes = {node: node_ids("5f", node) for node in ("imu", "radar")}
    machines = {machine: launcher_ids("cane", machine) for machine in ("gateway", "phone")}
    ids = [each for known in (*nodes.values(), *machines.values()) for each in known]

    assert len(set(ids)) == 2 * NODE_STARTS + 2 * LAUNCHER_STARTS
    assert {len(each) for each in ids} == {32}
    assert not any(each.startswith("0") for each in ids)  # which Zenoh refuses
    assert [node_id("5f", "imu", start) in nodes["imu"] for start in (0, 1, NODE_STARTS, 10_000)] == [True] * 4
    assert not set(node_ids("60", "imu")) & set(nodes["imu"]), "each run has its own"


@pytest.mark.parametrize(("replay", "samples"), [(True, "block"), (False, "drop")])
def test_only_what_goes_to_the_flow_itself_may_wait(replay: bool, samples: str) -> None:
    rules = tool_links("cane", ["tls", "tcp"], ["c1", "c2"], replay=replay)["qos/network"]
    told = {rule["id"]: rule["overwrite"]["congestion_control"] for rule in rules}

    assert told == {"to tools": "drop", "own samples": samples, "own words": "block"}
    assert rules[0]["link_protocols"] == ["tcp", "tls"]
    assert "zids" not in rules[0]
    assert [rule["zids"] for rule in rules[1:]] == [["c1", "c2"]] * 2
    assert not any("link_protocols" in rule for rule in rules[1:])


def test_a_link_to_a_router_loses_nothing_whatever_its_protocol() -> None:
    def told(*protocols: str) -> list[tuple[str, list[str], str]]:
        rules = tool_links("cane", protocols, ["c1"], replay=True, router="tcp")["qos/network"]
        return [
            (rule["id"], rule["link_protocols"], rule["overwrite"]["congestion_control"])
            for rule in rules
            if "link_protocols" in rule
        ]

    router = ("samples to a router", ["tcp"], "block")
    assert told("unixsock-stream") == [("to tools", ["unixsock-stream"], "drop"), router]
    assert told("tcp") == [router]
