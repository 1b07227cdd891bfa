"""Who reaches a flow that runs on one machine: this user by its sockets; others by the door that the file opens."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from caneflow.messages import Imu, control_key, encode, numbered, sample_key
from caneflow.messages.control import Counters, Progress
from caneflow.runtime.dataflow.loading import examine
from caneflow.runtime.hosts.attached.attach import ANY, statuses
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, running_flows
from caneflow.runtime.hosts.links.session import open_session
from tests.flows import CANEFLOW, Launched, as_stranger, free_port, launchers, node_processes, wait_for

TICKER = '''
"""An IMU that ticks at 100 Hz."""
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def samples(self):
        while True:
            time.sleep(0.01)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.5))

if __name__ == "__main__":
    run(Ticker)
'''
ECHO = '''
"""Repeats an IMU."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Echo(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context): ...

    def handle(self, port, message):
        yield "imu", Imu(stamp=message.stamp, gyro=message.gyro)

if __name__ == "__main__":
    run(Echo)
'''
NODES = """
nodes:
  ticker: {run: ./ticker.py}
  echo: {run: ./echo.py, inputs: {imu: ticker/imu}}
results: [echo/imu]
"""
FORGED = numbered(Imu(stamp=1, gyro=(9.0, 9.0, 9.0)), 0)


def write_flow(folder: Path, flow: str, head: str = "") -> Path:
    (folder / "ticker.py").write_text(TICKER)
    (folder / "echo.py").write_text(ECHO)
    file = folder / "flow.yaml"
    file.write_text(f"flow: {flow}\n{head}{NODES}")
    return file


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder for runs whose name is short enough for sockets."""
    folder = Path(tempfile.mkdtemp(prefix="cf", dir="/tmp"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


class Target:
    """A flow that runs, with a door for those who only read."""

    def __init__(self, flow: str, launched: Launched, door: str) -> None:
        self.flow, self.launched, self.door = flow, launched, door
        wait_for(lambda: self.found, "the flow's address")
        self.inside = self.found[0].endpoint
        self.folder = Path(self.inside.partition("/")[2]).parent

    @property
    def found(self) -> list[RunningFlow]:
        return [each for each in running_flows() if each.pid == self.launched.process.pid]

    def client(self, endpoint: str) -> zenoh.Session:
        return open_session(mode="client", connect=[endpoint])


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    folder, flow = tmp_path_factory.mktemp("target"), f"local{time.time_ns()}"
    door = f"tcp/127.0.0.1:{free_port()}"
    file = write_flow(folder, flow, f"insecure: true\nmachines: {{here: {{listen: [{door}]}}}}\n")
    with launchers() as launch:
        yield Target(flow, launch("run", file, log=folder / "log"), door)


class Heard:
    """What a session hears from others."""

    def __init__(self, session: zenoh.Session, *keys: str) -> None:
        self.payloads: dict[str, list[bytes]] = {}
        self._lock = threading.Lock()

        def note(sample: zenoh.Sample) -> None:
            with self._lock:
                self.payloads.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())

        handler = zenoh.handlers.Callback(note, indirect=False)
        self._held = [session.declare_subscriber(key, handler) for key in keys]

    def all(self) -> set[bytes]:
        with self._lock:
            return {payload for payloads in self.payloads.values() for payload in payloads}


def dial(path: Path) -> str:
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(str(path))
        return "linked"


def test_another_user_can_dial_no_socket_of_the_flow(target: Target) -> None:
    wait_for(lambda: (target.folder / "1").exists(), "the ticker's socket")
    sockets = [target.folder / name for name in ("0", "1")]
    assert [dial(path) for path in sockets] == ["linked"] * 2
    assert [as_stranger(lambda path=path: dial(path)) for path in sockets] == ["PermissionError"] * 2  # type: ignore[misc]  # a lambda's default
    assert as_stranger(lambda: (target.folder / "flow.json").read_bytes()) == "PermissionError"
    assert as_stranger(lambda: list(target.folder.iterdir())) == "PermissionError"
    assert as_stranger(lambda: (target.folder / "echo.json").read_bytes()) == "PermissionError"


def test_no_process_of_the_flow_listens_on_a_port_but_at_the_door(target: Target) -> None:
    wait_for(lambda: len(node_processes(target.launched.process.pid)) == 2, "both nodes")
    processes = node_processes(target.launched.process.pid)
    wait_for(lambda: all(each.net_connections(kind="unix") for each in processes.values()), "their links")
    assert [each.net_connections(kind="inet") for each in processes.values()] == [[], []]


def test_who_comes_by_the_door_reads_everything_and_may_ask(target: Target) -> None:
    with target.client(target.door) as session:
        heard = Heard(session, f"{target.flow}/**", control_key(target.flow, "**"))
        wanted = {sample_key(target.flow, "echo", "imu"), control_key(target.flow, "counters", "echo")}
        wait_for(lambda: wanted <= heard.payloads.keys(), f"{wanted} at the door")
        for name in (target.flow, ANY):
            assert [status.flow for status in statuses(session, name)] == [target.flow]


def forgeries(flow: str) -> dict[str, bytes]:
    """By key what someone would say to spoil the flow or to end it."""
    over = {node: encode(Counters(node=node, inputs={}, outputs={}, ended=True)) for node in ("ticker", "echo")}
    gone = {node: encode(Progress(node=node, handled=2**63 - 1, ports={})) for node in ("ticker", "echo")}
    return {
        **{control_key(flow, "counters", node): payload for node, payload in over.items()},
        **{control_key(flow, word, node): gone[node] for word in ("progress", "marks") for node in gone},
        **{control_key(flow, word): b"\x90" for word in ("start", "end", "window", "late")},
        sample_key(flow, "ticker", "imu"): FORGED,
        sample_key(flow, "echo", "imu"): FORGED,
    }


def test_who_comes_by_the_door_can_forge_nothing(target: Target) -> None:
    """The same said by the flow's own user, over a socket, is heard: what is asked here is not empty."""
    flow, forged = target.flow, forgeries(target.flow)
    with target.client(target.door) as stranger, target.client(target.inside) as inside:
        heard = Heard(inside, f"{flow}/**", control_key(flow, "**"))
        wait_for(lambda: heard.payloads.get(sample_key(flow, "echo", "imu")), "what the flow says")
        token = stranger.liveliness().declare_token(control_key(flow, "ready", "nobody"))
        for _ in range(20):
            for key, payload in forged.items():
                stranger.put(key, payload)
        assert statuses(stranger, flow), "answered after all that was said before on this link"
        assert not set(forged.values()) & heard.all()
        ready = inside.liveliness().get(control_key(flow, "ready", "*"), timeout=1.0)
        assert control_key(flow, "ready", "nobody") not in {str(reply.ok.key_expr) for reply in ready if reply.ok}
        del token
        before = len(heard.payloads[sample_key(flow, "echo", "imu")])
        wait_for(lambda: len(heard.payloads[sample_key(flow, "echo", "imu")]) > before + 50, "samples after it")
        (status,) = statuses(inside, flow)
        (edge,) = status.edges
        assert (edge.decode, edge.repeated, edge.wire) == (0, 0, 0)
        harmless = control_key(flow, "late")
        wait_for(lambda: inside.put(harmless, b"own") or b"own" in heard.all(), "what this user says")
    assert target.launched.process.poll() is None


def caneflow(*args: object, **more: str) -> "subprocess.CompletedProcess[str]":
    command = [*CANEFLOW, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env={**os.environ, **more})


def test_a_folder_too_long_for_sockets_is_one_line_and_status_2(tmp_path: Path, short: Path) -> None:
    long = short / ("x" * 80)
    file = write_flow(tmp_path, "long")
    done = caneflow("run", file, XDG_RUNTIME_DIR=str(long))
    assert (done.returncode, done.stdout) == (2, "")
    assert "too long for Unix sockets" in done.stderr
    assert "set XDG_RUNTIME_DIR to a shorter folder" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list((long / f"caneflow-{os.getuid()}").iterdir()), "nothing is left"


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch, short: Path) -> Iterator[Callable[..., Launched]]:
    """Start launchers whose runs are in `short`."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(short))
    with launchers() as launch:
        yield launch


@pytest.mark.parametrize("what", ["the folder", "what is in it"])
def test_a_removed_folder_is_said_once_and_a_node_that_then_ends_ends_the_flow(
    tmp_path: Path, short: Path, launch: Callable[..., Launched], what: str
) -> None:
    flow = f"removed{time.time_ns()}"
    file = write_flow(tmp_path, flow)
    file.write_text(f"flow: {flow}\nnodes: {{ticker: {{run: ./ticker.py}}}}\nresults: [ticker/imu]\n")
    launched = launch("run", file, log=tmp_path / "log")
    wait_for(lambda: [each for each in running_flows() if each.flow == flow], "the flow's address")
    target = Target(flow, launched, "")
    with target.client(target.inside) as session:
        heard = Heard(session, f"{flow}/**")
        key = sample_key(flow, "ticker", "imu")
        wait_for(lambda: len(heard.payloads.get(key, ())) > 10, "samples")
        processes = node_processes(launched.process.pid)
        for path in target.folder.iterdir():
            path.unlink()
        if what == "the folder":
            shutil.rmtree(short / f"caneflow-{os.getuid()}")
        launched.wait_for(f"{target.folder} was removed: the flow goes on, but tools cannot attach")
        before = len(heard.payloads[key])
        wait_for(lambda: len(heard.payloads[key]) > before + 50, "samples by the links that are there")
    assert caneflow("status", flow).returncode == 2
    os.kill(processes["ticker"].pid, signal.SIGKILL)
    assert launched.ends(30) == 1
    assert launched.said.count("was removed: the flow goes on") == 1
    assert f"caneflow run: ticker cannot be started: the run's folder {target.folder}, where" in launched.said
    assert "Traceback" not in launched.said


def test_an_only_machine_that_listens_beyond_this_computer_needs_keys(tmp_path: Path) -> None:
    head = "machines: {here: {listen: [tcp/0.0.0.0:7447]}}\n"
    done = caneflow("run", write_flow(tmp_path, "open", head))
    assert done.returncode == 2
    assert "here: no keys for tcp/0.0.0.0:7447 in" in done.stderr


@pytest.mark.parametrize(("links", "rights"), [("unix", "reads everything"), ("tcp", "reads and writes everything")])
def test_what_a_door_in_the_clear_allows_is_a_warning(tmp_path: Path, links: str, rights: str) -> None:
    head = f"links: {links}\ninsecure: true\nmachines: {{here: {{listen: [tcp/0.0.0.0:7447]}}}}\n"
    (warning,) = examine(write_flow(tmp_path, "open", head))[1]
    assert str(warning).endswith(f"whoever reaches them {rights}")
