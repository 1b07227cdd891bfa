"""Machines that have no link with each other and dial a Zenoh router which was there before."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from caneflow.messages import Imu, numbered, sample_key
from caneflow.runtime.dataflow.loading import examine
from caneflow.runtime.hosts.attached.attach import link_settings
from caneflow.runtime.hosts.links.certificates import make_authority, make_certificate
from caneflow.runtime.hosts.links.session import open_session
from tests.flows import (
    Launched,
    caneflow_here,
    free_port,
    launchers,
    results,
    spread_cane,
    wait_for,
    write_walk,
)

Launch = Callable[..., Launched]
SPLIT = {"imu": "gateway", "radar": "gateway", "ground_speed": "gateway", "fusion": "phone"}
MACHINES = "  gateway: {records: true}\n  phone: {records: true}\n"
SAMPLE = numbered(Imu(stamp=1, gyro=(0.0, 0.0, 0.0)), 0)


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "dataflow.yaml"
    router = f"router: tcp/127.0.0.1:{free_port()}\n"
    path.write_text(spread_cane(f"r{time.time_ns()}", MACHINES, SPLIT, more=router))
    return path


@contextmanager
def router(config: zenoh.Config) -> Iterator[zenoh.Session]:
    """A router in this process, which knows nothing of caneflow."""
    with zenoh.open(config) as session:
        yield session


def in_the_clear(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def endpoint_in(file: Path) -> str:
    graph = examine(file, ())[0]
    assert graph is not None
    assert graph.router is not None
    return graph.router


def replay_on_both(launch: Launch, file: Path, tmp_path: Path) -> None:
    """Replay a walk on both machines, and compare what each recorded with the run on one."""
    walk = write_walk(tmp_path / "walk.mcap", 150)
    alone = tmp_path / "alone.mcap"
    done = caneflow_here("run", file, "--replay", walk, "--in-process", "--record", alone)
    assert done.returncode == 0, done.stderr
    started = {
        machine: launch(
            *("run", file, "--machine", machine, "--replay", walk, "--speed", "max"),
            *("--record", tmp_path / f"{machine}.mcap"),
            log=tmp_path / f"{machine}.log",
        )
        for machine in ("gateway", "phone")
    }
    for machine, each in started.items():
        assert each.ends() == 0, each.said
        assert results(tmp_path / f"{machine}.mcap") == results(alone)


def test_two_machines_behind_a_router_give_the_bytes_of_one(launch: Launch, file: Path, tmp_path: Path) -> None:
    with router(in_the_clear(endpoint_in(file))):
        replay_on_both(launch, file, tmp_path)


@pytest.fixture
def keys(file: Path) -> Path:
    folder = file.parent / "keys"
    make_authority(folder)
    for name in ("gateway", "phone", "router"):
        make_certificate(folder, name)
    make_certificate(folder, "laptop", observer=True)
    return folder


def secured(file: Path) -> zenoh.Config:
    """The configuration that `caneflow keys router` prints, on this computer only."""
    done = caneflow_here("keys", "router", file, "--keys", file.parent / "keys")
    assert done.returncode == 0, done.stderr
    return zenoh.Config.from_json5(done.stdout.replace("[::]", "127.0.0.1"))


def test_the_same_with_keys(launch: Launch, file: Path, keys: Path, tmp_path: Path) -> None:
    with router(secured(file)):
        replay_on_both(launch, file, tmp_path)


def test_a_router_lets_a_machine_say_what_is_its_own_and_nothing_else(file: Path, keys: Path, tmp_path: Path) -> None:
    flow = file.read_text().split()[1]
    endpoint = "tls/" + endpoint_in(file).partition("/")[2]

    def session(name: str) -> zenoh.Session:
        """With the certificate of `name`, and of nobody else."""
        own = tmp_path / name
        own.mkdir()
        for each in (f"{name}.crt", f"{name}.key", "ca.crt"):
            shutil.copy(keys / each, own)
        return open_session(mode="client", connect=[endpoint], more=link_settings(endpoint, own))

    heard = list[str]()
    pose, imu = sample_key(flow, "fusion", "pose"), sample_key(flow, "imu", "imu")

    def note(sample: zenoh.Sample) -> None:
        heard.append(str(sample.key_expr))

    with router(secured(file)), session("phone") as phone, session("laptop") as laptop:
        held = laptop.declare_subscriber("**", zenoh.handlers.Callback(note, indirect=False))

        def said() -> bool:
            phone.put(imu, SAMPLE)  # the gateway's
            laptop.put(pose, b"an observer's")
            phone.put(pose, SAMPLE)
            return len(heard) > 3

        wait_for(said, "what the phone may say")
        del held
    assert set(heard) == {pose}


ALONE = """
flow: {flow}
router: {router}
machines: {{here: {{}}}}
nodes:
  imu: {{external: true, outputs: {{imu: Imu}}}}
  attitude: {{run: operators.attitude, inputs: {{imu: imu/imu}}}}
results: [attitude/imu]
"""


@contextmanager
def behind(endpoint: str, tls: dict[str, object] | None = None, mode: str = "client") -> Iterator[zenoh.Session]:
    """A program that knows only the router."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    if tls:
        config.insert_json5("transport/link/tls", json.dumps(tls))
    with zenoh.open(config) as session:
        yield session


def fed_and_heard(flow: str, feeder: zenoh.Session, listener: zenoh.Session) -> None:
    """What one program puts on the external node's key comes back to another as an attitude."""
    heard = list[str]()
    held = listener.declare_subscriber(f"{flow}/attitude/*", lambda sample: heard.append(str(sample.key_expr)))
    begin, seq = time.time_ns() - 10**10, 0

    def feed() -> bool:  # again and again, as it takes a moment until all know who reads what
        nonlocal seq
        imu = Imu(stamp=begin + seq * 10**7, gyro=(0.0, 0.0, 0.1), accel=(0.0, 0.0, 9.81))
        feeder.put(f"{flow}/imu/imu", numbered(imu, seq))
        feeder.put(f"{flow}/attitude/forged", numbered(imu, seq))
        seq += 1
        return heard.count(f"{flow}/attitude/imu") > 3

    wait_for(feed, "attitudes")
    assert held is not None, "one without a name would be gone"


def test_one_machine_dials_its_router_too_and_runs_without(launch: Launch, tmp_path: Path) -> None:
    flow, endpoint, file = f"r{time.time_ns()}", f"tcp/127.0.0.1:{free_port()}", tmp_path / "alone.yaml"
    file.write_text(ALONE.format(flow=flow, router=endpoint))
    running = launch("run", file, log=tmp_path / "log")
    running.wait_for(f"other programs attach at {endpoint} (mode client); every user of this machine can read there")
    running.wait_for("ready: ")  # there is no router yet
    with router(in_the_clear(endpoint)), behind(endpoint) as feeder, behind(endpoint, mode="peer") as listener:
        fed_and_heard(flow, feeder, listener)
    running.process.terminate()
    assert running.ends() == 130


def test_a_router_dials_a_machine_that_listens(launch: Launch, tmp_path: Path) -> None:
    flow, here, there = f"r{time.time_ns()}", f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "alone.yaml"
    file.write_text(ALONE.format(flow=flow, router="").replace("router: \n", ""))
    running = launch("run", file, "--listen", here, log=tmp_path / "log")
    running.wait_for("ready: ")
    config = in_the_clear(there)
    config.insert_json5("connect/endpoints", json.dumps([here]))
    with router(config), behind(there) as feeder, behind(there) as listener:
        fed_and_heard(flow, feeder, listener)
    running.process.terminate()
    assert running.ends() == 130


def test_one_machine_and_its_router_with_keys(launch: Launch, tmp_path: Path) -> None:
    flow, file, keys = f"r{time.time_ns()}", tmp_path / "alone.yaml", tmp_path / "keys"
    file.write_text(ALONE.format(flow=flow, router=f"tcp/127.0.0.1:{free_port()}"))
    make_authority(keys)
    for name in ("here", "router"):
        make_certificate(keys, name)
    make_certificate(keys, "laptop", observer=True)
    running = launch("run", file, log=tmp_path / "log")
    running.wait_for("who shows a certificate of this flow can read there")
    endpoint = "tls/" + endpoint_in(file).partition("/")[2]
    with (
        router(secured(file)),
        behind(endpoint, link_of(keys, "here")) as feeder,
        behind(endpoint, link_of(keys, "laptop")) as listener,
    ):
        fed_and_heard(flow, feeder, listener)
    running.process.terminate()
    assert running.ends() == 130


def link_of(keys: Path, name: str) -> dict[str, object]:
    """Zenoh's TLS with the certificate of `name`."""
    return {
        "root_ca_certificate": str(keys / "ca.crt"),
        "enable_mtls": True,
        "connect_certificate": str(keys / f"{name}.crt"),
        "connect_private_key": str(keys / f"{name}.key"),
        "verify_name_on_connect": False,
    }


def test_machines_behind_a_router_need_no_links(file: Path, tmp_path: Path) -> None:
    graph, problems = examine(file, ())[:2]
    assert not problems
    assert graph is not None
    assert graph.leader == "gateway"
    assert graph.machines["phone"].linked == ("gateway",)

    bad = tmp_path / "bad.yaml"
    bad.write_text(file.read_text().replace(endpoint_in(file), "tcp/127.0.0.1:99999"))
    said = [str(problem) for problem in examine(bad, ())[1]]
    assert any("router" in line and "has port 99999; ports are 1..65535" in line for line in said), said
