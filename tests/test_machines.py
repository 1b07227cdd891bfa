"""One flow on several machines: each launcher starts its part, and the result is that of one machine, bit for bit."""

import itertools
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from caneflow.runtime.dataflow.loading import examine
from tests.flows import (
    BOTH_LINKS,
    CANEFLOW,
    NODES,
    Launched,
    caneflow_here,
    free_port,
    launchers,
    results,
    spread_cane,
    wait_for,
    write_walk,
)
from tests.networks import Network

Launch = Callable[..., Launched]

SPLIT = {"imu": "gateway", "radar": "gateway", "ground_speed": "gateway", "fusion": "phone"}
# Every way to spread the four nodes over two machines that leaves none of them empty.
SPLITS = [
    dict(zip(NODES, places, strict=True))
    for places in itertools.product(("gateway", "phone"), repeat=len(NODES))
    if len(set(places)) == 2
]


def spelled(split: dict[str, str]) -> str:
    sides = ["+".join(node for node in split if split[node] == side) for side in ("gateway", "phone")]
    return " | ".join(sides)


@pytest.fixture
def flow(tmp_path: Path) -> str:
    """A flow's name that no other test uses."""
    return "m" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap")


@pytest.fixture(scope="module")
def undisturbed(walk: Path) -> dict[str, list[bytes]]:
    """What one machine makes of the walk."""
    out = walk.with_name("undisturbed.mcap")
    file = walk.with_name("one.yaml")
    file.write_text(spread_cane("one", "  here: {}\n", dict.fromkeys(NODES, "here")))
    done = caneflow_here("run", file, "--replay", walk, "--in-process", "--record", out)
    assert done.returncode == 0, done.stderr
    return results(out)


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


@pytest.fixture
def network() -> Iterator[Network]:
    """Two hosts in namespaces."""
    network = Network(("gateway", "phone"))
    try:
        with network.up():
            yield network
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no network namespaces or TUN devices for this user: {error}")


def run(*args: object) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*CANEFLOW, *map(str, args)], capture_output=True, text=True, timeout=90, check=False)


def on_loopback(flow: str, tmp_path: Path, split: dict[str, str]) -> Path:
    """The phone listens on an address of its own, and the gateway dials it."""
    port = free_port("127.0.0.2")
    machines = f"  gateway: {{connect: [tcp/127.0.0.2:{port}]}}\n  phone: {{listen: [tcp/127.0.0.2:{port}]}}\n"
    path = tmp_path / "dataflow.yaml"
    path.write_text(spread_cane(flow, machines, split))
    return path


@BOTH_LINKS
def test_two_launchers_give_the_bytes_of_one(
    flow: str, tmp_path: Path, walk: Path, undisturbed: dict[str, list[bytes]], launch: Launch, links: str
) -> None:
    file = on_loopback(flow, tmp_path, SPLIT)
    file.write_text(f"links: {links}\n{file.read_text()}")
    replay = ("--replay", walk, "--speed", "max")
    phone = launch("run", file, "--machine", "phone", *replay, "--record", tmp_path / "p.mcap", log=tmp_path / "p.log")
    gateway = launch("run", file, "--machine", "gateway", *replay, "--record", tmp_path / "g.mcap", log=tmp_path / "g")

    assert gateway.ends() == 0, gateway.said
    assert phone.ends() == 0, phone.said
    assert results(tmp_path / "p.mcap") == undisturbed
    assert results(tmp_path / "g.mcap") == undisturbed


@pytest.mark.parametrize(
    "split",
    [split if i == 1 else pytest.param(split, marks=pytest.mark.long) for i, split in enumerate(SPLITS)],
    ids=spelled,
)
def test_two_hosts_give_the_bytes_of_one_however_the_stages_are_split(
    flow: str,
    tmp_path: Path,
    walk: Path,
    undisturbed: dict[str, list[bytes]],
    launch: Launch,
    network: Network,
    split: dict[str, str],
) -> None:
    machines = (
        f"  gateway: {{listen: [tcp/{network.address('gateway')}:7447]}}\n"
        f"  phone: {{connect: [tcp/{network.address('gateway')}:7447]}}\n"
    )
    file = tmp_path / "dataflow.yaml"
    file.write_text(spread_cane(flow, machines, split, more="insecure: true\n"))
    launched = {
        machine: launch(
            *("run", file, "--machine", machine, "--replay", walk, "--speed", "max"),
            *(("--record", tmp_path / "out.mcap") if machine == "phone" else ()),
            log=tmp_path / f"{machine}.log",
            inside=network.command(machine),
        )
        for machine in ("gateway", "phone")
    }

    for each in launched.values():
        assert each.ends() == 0, each.said
    assert results(tmp_path / "out.mcap") == undisturbed
    assert network.carried > 50, "the samples went over the network, many in one packet"


def test_a_machine_that_is_killed_in_a_replay_goes_on_where_it_was(
    flow: str, tmp_path: Path, walk: Path, undisturbed: dict[str, list[bytes]], launch: Launch
) -> None:
    file = on_loopback(flow, tmp_path, SPLIT)
    replay = ("--replay", walk, "--speed", "0.5")
    gateway = launch("run", file, "--machine", "gateway", *replay, "--record", tmp_path / "g.mcap", log=tmp_path / "g")
    phone = launch("run", file, "--machine", "phone", *replay, log=tmp_path / "p1.log")
    wait_for(lambda: snapshots(tmp_path), "a snapshot of fusion")
    phone.kill()
    gateway.wait_for("phone has left")
    phone = launch("run", file, "--machine", "phone", *replay, log=tmp_path / "p2.log")

    assert gateway.ends() == 0, gateway.said
    assert phone.ends() == 0, phone.said
    assert "fusion | INFO goes on from its snapshot" in phone.said
    assert results(tmp_path / "g.mcap") == undisturbed
    assert not snapshots(tmp_path), "left behind"


def snapshots(folder: Path) -> list[Path]:
    """Those of fusion on the phone, which outlive its launcher."""
    return list(folder.glob("state-*-phone/*/fusion.snapshot"))


@pytest.mark.long
def test_a_leader_that_begins_anew_ends_the_part_of_the_replay_before(
    flow: str, tmp_path: Path, walk: Path, launch: Launch
) -> None:
    file = on_loopback(flow, tmp_path, SPLIT)
    replay = ("--replay", walk, "--speed", "0.5")
    phone = launch("run", file, "--machine", "phone", *replay, log=tmp_path / "p.log")
    gateway = launch("run", file, "--machine", "gateway", *replay, log=tmp_path / "g1.log")
    wait_for(lambda: snapshots(tmp_path), "a snapshot of fusion")
    gateway.kill()
    phone.wait_for("gateway has left")
    launch("run", file, "--machine", "gateway", *replay, log=tmp_path / "g2.log")

    assert phone.ends() == 1
    assert "gateway has begun another replay" in phone.said


def test_a_node_that_fails_for_good_ends_the_run_on_every_machine(
    flow: str, tmp_path: Path, walk: Path, launch: Launch
) -> None:
    (tmp_path / "broken.py").write_text(BROKEN)
    file = on_loopback(flow, tmp_path, SPLIT)
    file.write_text(file.read_text().replace("run: operators.fusion", "run: ./broken.py, restart: never"))
    replay = ("--replay", walk, "--speed", "max")
    gateway = launch("run", file, "--machine", "gateway", *replay, log=tmp_path / "g.log")
    phone = launch("run", file, "--machine", "phone", *replay, log=tmp_path / "p.log")

    assert phone.ends() == 1
    assert gateway.ends() == 1
    assert "caneflow run: fusion ended with status 1: RuntimeError: broken" in phone.said
    assert "caneflow run: phone: fusion ended with status 1: RuntimeError: broken" in gateway.said


BROKEN = '''
"""Fails at its first sample."""
from caneflow.messages import GroundSpeed, Imu, Pose
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Broken(Operator):
    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose}

    def __init__(self, settings, context): ...

    def handle(self, port, message):
        raise RuntimeError("broken")

if __name__ == "__main__":
    run(Broken)
'''


def test_machines_with_different_files_do_not_start(flow: str, tmp_path: Path, walk: Path, launch: Launch) -> None:
    file = on_loopback(flow, tmp_path, SPLIT)
    other = tmp_path / "other.yaml"
    other.write_text("seed: 7\n" + file.read_text())
    gateway = launch("run", file, "--machine", "gateway", "--replay", walk, log=tmp_path / "g.log")
    phone = launch("run", other, "--machine", "phone", "--replay", walk, log=tmp_path / "p.log")

    assert phone.ends() == 2
    assert "gateway runs another flow, recording or version of caneflow" in phone.said
    gateway.wait_for("phone runs another flow")
    gateway.process.send_signal(signal.SIGINT)
    assert gateway.ends() == 130, "a newcomer with another file does not end what waits or runs"


def test_a_machine_is_named_and_known(flow: str, tmp_path: Path) -> None:
    file = on_loopback(flow, tmp_path, SPLIT)

    nameless = run("run", file)
    unknown = run("run", file, "--machine", "gatway")

    assert nameless.returncode == unknown.returncode == 2
    assert "runs on several machines; give --machine, one of gateway, phone" in nameless.stderr
    assert "--machine gatway: no such machine; did you mean 'gateway'? there are gateway, phone" in unknown.stderr


THREE = """\
flow: demo
machines:
  sensor: {%s}
  gateway: {%s}
  phone: {%s}
nodes:
  imu: {run: drivers.bno055, machine: sensor}
  radar: {run: drivers.p440, machine: gateway}
  ground_speed: {run: operators.ground_speed, machine: phone, inputs: {frame: radar/frame, imu: imu/imu}}
results: [ground_speed/speed]
"""


def test_the_machine_that_all_others_have_a_link_with_leads(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(THREE % ("connect: [tcp/phone.local:7]", "connect: [tcp/phone.local:7]", "listen: [tcp/0.0.0.0:7]"))

    graph, _ = examine(file)

    assert graph is not None
    assert graph.leader == "phone"


def test_a_flow_that_no_machine_can_lead_is_a_mistake(tmp_path: Path) -> None:
    file = tmp_path / "flow.yaml"
    file.write_text(
        "flow: demo\nmachines: {here: {}, there: {}}\nnodes:\n  imu: {run: drivers.bno055, machine: here}\n"
        "  radar: {run: drivers.p440, machine: there}\nresults: [imu/imu, radar/frame]\n"
    )

    (problem,) = examine(file)[1]

    assert "none of here, there has a link with every other one, so none can lead" in str(problem)
