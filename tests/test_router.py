"""Machines that have no link with each other and dial a Zenoh router which was there before."""

import json
import shutil
import subprocess
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
from tests.flows import CANEFLOW, Launched, free_port, launchers, results, spread_cane, wait_for, write_walk

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
    walk = write_walk(tmp_path / "walk.mcap")
    alone = tmp_path / "alone.mcap"
    done = launch("run", file, "--replay", walk, "--in-process", "--record", alone, log=tmp_path / "alone.log")
    assert done.ends() == 0, done.said
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
    command = [*CANEFLOW, "keys", "router", str(file), "--keys", str(file.parent / "keys")]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return zenoh.Config.from_json5(said.replace("[::]", "127.0.0.1"))


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
