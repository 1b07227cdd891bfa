"""A flow is operated by the command: listed, its log read, a node of it started again, ended; by its own user alone."""

import io
import json
import os
import pty
import re
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import msgspec
import psutil
import pytest

from caneflow.recording import Recording
from caneflow.runtime.dataflow.graph import Restart as Policy
from caneflow.runtime.hosts.attached.run_logs import KeptLog
from caneflow.runtime.hosts.launcher import requests, run_log
from caneflow.runtime.hosts.launcher.console import Console
from caneflow.runtime.hosts.launcher.private_folder import PrivateFolder
from caneflow.runtime.hosts.launcher.replay_progress import ReplayProgress
from caneflow.runtime.hosts.launcher.requests import Answer, Restart, RestartAsked
from caneflow.runtime.hosts.launcher.restarts import Again, How, Restarts
from caneflow.runtime.hosts.launcher.run_log import LoggedLine, RunLog
from caneflow.runtime.stages.merge import BEGIN, END
from tests.flows import CANEFLOW, Launched, as_stranger, caneflow_here, launchers, wait_for, write_walk

TICKER = '''
"""A live source that ticks at 50 Hz."""
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        print("begins \\x1b[31m")

    def samples(self):
        while True:
            time.sleep(0.02)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Ticker)
'''
ECHO = '''
"""Says again what it hears."""
import logging
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Echo(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        logging.getLogger(__name__).warning("is built")

    def handle(self, port, message):
        yield "imu", message

if __name__ == "__main__":
    run(Echo)
'''
FLOW = """
flow: {flow}
nodes:
  ticker: {{run: ./ticker.py}}
  echo: {{run: ./echo.py, inputs: {{imu: ticker/imu}}}}
results: [echo/imu]
"""
REPLAYED = """
flow: replayed
nodes:
  imu: {run: drivers.bno055}
  echo: {run: ./echo.py, inputs: {imu: imu/imu}}
results: [echo/imu]
"""

Caneflow = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def base() -> Iterator[Path]:
    """Where the runs of these tests and their logs lie."""
    with tempfile.TemporaryDirectory(prefix="c", dir="/tmp") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def caneflow(base: Path) -> Caneflow:
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        if words[0] in ("list", "logs", "status"):  # they look and start nothing
            with patch.dict(os.environ, XDG_RUNTIME_DIR=str(base)):
                return caneflow_here(*words)
        command = ["env", f"XDG_RUNTIME_DIR={base}", *CANEFLOW, *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    return run


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A live flow's file; its name is that of the folder."""
    flow = re.sub(r"\W", "", tmp_path.name).lower()
    (tmp_path / "ticker.py").write_text(TICKER)
    (tmp_path / "echo.py").write_text(ECHO)
    (tmp_path / "flow.yaml").write_text(FLOW.format(flow=flow))
    return tmp_path / "flow.yaml"


@pytest.fixture
def launch(base: Path, tmp_path: Path) -> Iterator[Callable[..., Launched]]:
    with launchers() as start:
        yield lambda *words: start(*words, log=tmp_path / "run.log", inside=["env", f"XDG_RUNTIME_DIR={base}"])


def kept(printed: str) -> list[LoggedLine]:
    """What `caneflow logs --json` printed."""
    return [msgspec.json.decode(line, type=LoggedLine) for line in printed.splitlines()]


def test_a_flow_is_operated_from_another_terminal(
    written: Path, launch: Callable[..., Launched], caneflow: Caneflow, tmp_path: Path
) -> None:
    flow = re.sub(r"\W", "", tmp_path.name).lower()
    launched = launch("run", written, "--record", tmp_path / "out.mcap")
    launched.wait_for(f"ready: 3 nodes; to look: caneflow view {flow}")

    about = {each["flow"]: each for each in json.loads(caneflow("list", "--json").stdout)}[flow]
    assert (about["replay"], about["nodes"], about["ready"]) == (False, 3, 3)

    before = json.loads(caneflow("status", flow, "--json").stdout)["nodes"]
    for node in ("echo", "recorder"):
        assert f"{flow}: {node} is ready again" in caneflow("restart", flow, node).stdout
    after = json.loads(caneflow("status", flow, "--json").stdout)["nodes"]
    assert [before[node]["pid"] != after[node]["pid"] for node in before] == [False, True, True]
    assert {node["restarts"] for node in after.values()} == {0}, "only failures are counted"
    assert [node["asked"] for node in after.values()] == [0, 1, 1]
    refused = caneflow("restart", flow, "ecko")
    said = "no node 'ecko'; did you mean 'echo'? there are ticker, echo, recorder"
    assert (refused.returncode, refused.stdout, refused.stderr) == (2, "", f"caneflow restart: {said}\n")

    built = caneflow("logs", flow, "--node", "echo", "--level", "warning").stdout.splitlines()
    assert [line.split()[1:] for line in built] == [["warning", "echo", "is", "built"]] * 2

    stopped = caneflow("stop", flow)
    assert (stopped.returncode, stopped.stderr) == (0, "")
    assert re.fullmatch(rf"{flow} \(pid \d+\) has ended; nothing was lost\n", stopped.stdout)
    assert launched.ends() == 130
    for part in ("out.mcap", "out_001.mcap"):
        with Recording(tmp_path / part) as recording:
            assert recording.complete
    again = caneflow("stop", flow)
    assert (again.returncode, again.stdout, len(again.stderr.splitlines())) == (2, "", 1)

    (line,) = kept(caneflow("logs", flow, "--json", "--grep", "begins").stdout)
    assert (line.node, line.level, line.text) == ("ticker", "info", r"begins \x1b[31m")
    ended = {each["flow"]: each for each in json.loads(caneflow("list", "--ended", "--json").stdout)}[flow]
    assert (ended["run"], ended["status"], ended["lost"]) == (1, 130, [])


def test_a_flow_goes_on_in_the_background_with_its_page(written: Path, caneflow: Caneflow, tmp_path: Path) -> None:
    """The pipe that the command writes to is free when it has ended: `subprocess.run` waits for that."""
    flow = re.sub(r"\W", "", tmp_path.name).lower()
    begun = caneflow("run", written, "--detach", "--view")
    assert begun.returncode == 0, begun.stderr
    assert re.match(rf"{flow} runs \(pid \d+\)\n", begun.stdout)
    pid = int(re.findall(r"\d+", begun.stdout.removeprefix(flow))[0])
    launcher = psutil.Process(pid)
    started = [launcher, *launcher.children(recursive=True)]

    def page() -> list[str]:
        return [each.text for each in kept(caneflow("logs", flow, "--node", "the page", "--json").stdout)]

    wait_for(page, "the page's address")
    assert page()[0].startswith("http://127.0.0.1:")
    assert caneflow("stop", flow).returncode == 0
    left = [each for each in started if each.is_running() and each.status() != psutil.STATUS_ZOMBIE]
    assert not left


def test_what_is_wrong_at_the_start_is_told_before_it_goes_to_the_background(written: Path, caneflow: Caneflow) -> None:
    (written.parent / "echo.py").write_text(ECHO.replace('logging.getLogger(__name__).warning("is built")', "1 / 0"))
    ended = caneflow("run", written, "--detach")
    assert (ended.returncode, "runs (pid" in ended.stdout) == (1, False)
    assert "ZeroDivisionError" in ended.stderr.splitlines()[-1]
    written.write_text(FLOW.replace("ticker/imu", "ticker/no"))
    ended = caneflow("run", written, "--detach")
    assert (ended.returncode, ended.stdout) == (2, "")


@pytest.mark.parametrize("more", [["--speed", "3"], ["--in-process"]], ids=" ".join)
def test_a_terminal_shows_how_far_a_replay_is(written: Path, tmp_path: Path, more: list[str]) -> None:
    written.write_text(REPLAYED)
    walk = write_walk(tmp_path / "walk.mcap", samples=300)
    terminal, inner = pty.openpty()
    command = [*CANEFLOW, "run", str(written), "--replay", str(walk), *more]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=inner, env={**os.environ, "TERM": "xterm"}) as run:
        os.close(inner)
        said = b""
        try:
            while some := os.read(terminal, 4096):
                said += some
        except OSError:  # the other end is closed
            pass
        out, _ = run.communicate(timeout=30)
    os.close(terminal)
    assert run.returncode == 0
    assert b"%" not in out
    shares = [int(share) for share in re.findall(rb"\r\x1b\[K *(\d+) % \[", said)]
    assert shares
    assert shares == sorted(shares)
    assert shares[-1] <= 100
    assert said.endswith(b"\r\x1b[K"), "the last line is free again"


# --- the parts ---------------------------------------------------------------------------------------------------


def test_a_log_is_private_bounded_and_without_control_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_log, "MOST_BYTES", 2_000)
    root = PrivateFolder.at(tmp_path / "root")
    with RunLog(root, "cane", replay=False) as log:
        for number in range(100):
            log.take("imu", f"WARNING {number}\x1b[2J\x9b\u202e")
        log.take("imu", "x" * 100_000)
        log.end(130, ("fusion: imu: 3 lost",))
    (folder,) = (tmp_path / "root" / run_log.LOGS).iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
    assert sum(path.stat().st_size for path in folder.glob("*.jsonl")) < 2 * 2_000 + run_log.LONGEST_LINE + 200
    about = msgspec.json.decode((folder / run_log.ABOUT).read_bytes(), type=run_log.LoggedRun)
    log_of_run = KeptLog(folder=folder, run=about)
    assert (log_of_run.running, about.status, about.lost) == (False, 130, ("fusion: imu: 3 lost",))
    *lines, longest = log_of_run.lines()
    assert [line.text for line in lines] == [
        rf"{number}\x1b[2J\x9b\u202e" for number in range(100 - len(lines), 100)
    ], "the last of them"
    assert {(line.node, line.level) for line in lines} == {("imu", "warning")}
    assert longest.text == "x" * run_log.LONGEST_LINE + "..."


def test_the_last_logs_are_kept_and_those_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_log, "MOST_RUNS", 3)
    root = PrivateFolder.at(tmp_path / "root")
    with RunLog(root, "a", replay=False):
        for flow in ("b", "c", "d", "e"):
            with RunLog(root, flow, replay=True):
                pass
        left = {path.name[0] for path in (tmp_path / "root" / run_log.LOGS).iterdir()}
    assert left == {"a", "c", "d", "e"}, "the last three, and the one that goes on"


def test_a_log_that_grows_is_followed_through_its_rotation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_log, "MOST_BYTES", 1_000)
    root = PrivateFolder.at(tmp_path / "root")
    with RunLog(root, "cane", replay=False) as log:
        log.take("imu", "0")
        (folder,) = (tmp_path / "root" / run_log.LOGS).iterdir()
        about = run_log.LoggedRun("cane", os.getpid(), replay=False, started=run_log.now())
        heard: list[LoggedLine] = []
        for line in KeptLog(folder=folder, run=about).lines(follow=True):
            heard.append(line)
            if len(heard) < 40:
                log.take("imu", str(len(heard)))
            else:
                log.end(0, ())
    assert [line.text for line in heard] == [str(number) for number in range(40)]


def test_another_user_asks_for_nothing(tmp_path: Path) -> None:
    """Even where the folder was opened to everybody by mistake: the kernel says who asks."""
    folder = PrivateFolder.at(Path(tempfile.mkdtemp(prefix="c", dir="/tmp")))
    asked: list[RestartAsked] = []
    path = folder.path / requests.SOCKET

    def ask() -> bytes:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.settimeout(10)
            link.connect(str(path))
            link.send(msgspec.json.encode(Restart("imu")))
            return link.recv(requests.LONGEST)

    def answered(request: RestartAsked) -> None:
        asked.append(request)
        request.answer(Answer(pid=4711))

    try:
        with requests.requests(folder, answered):
            assert json.loads(ask()) == {"pid": 4711}
            folder.path.chmod(0o777)
            path.chmod(0o777)
            assert as_stranger(ask) in ("b''", "BrokenPipeError", "ConnectionResetError")
    finally:
        path.unlink()
        folder.path.rmdir()
    assert [request.node for request in asked] == ["imu"]


def test_what_was_asked_for_does_not_count_as_a_failure() -> None:
    policy = Policy(policy="on-failure", max_restarts=2, window_s=60.0, delay_s=0.1, max_delay_s=1.0)
    restarts = Restarts(policy, replay=False)
    for now in (0.0, 1.0, 2.0, 3.0):
        restarts.ready(now)
        restarts.asked(now + 0.5)
    assert restarts.counted == 0
    assert isinstance(restarts.ended(4.0, None, How.FAULT), Again)
    restarts.ready(5.0)
    restarts.asked(50.0)  # the failure before is still not 60 s of being up ago
    restarts.ready(51.0)
    assert isinstance(restarts.ended(100.0, None, How.FAULT), Again)
    assert restarts.counted == 2


def test_a_replay_is_as_far_as_its_slowest_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[float, float | None]] = []
    monkeypatch.setattr("caneflow.runtime.hosts.launcher.replay_progress.TELL_PERIOD", 0.0)
    second = 1_000_000_000
    progress = ReplayProgress(10 * second, 20 * second, lambda *far: told.append(far))
    for handled in ([BEGIN, 15 * second], [9 * second, END], [12 * second, 15 * second], [25 * second], [END, END]):
        progress.look(handled)
    assert told == [(0.0, 10.0), (2.0, 10.0), (10.0, 10.0)]


def test_without_a_terminal_there_is_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr("caneflow.runtime.hosts.launcher.console.time.monotonic", lambda: clock[0])
    stream = io.StringIO()
    with Console("cane", stream=stream) as shown:
        shown.settled()
        for second in range(1, 26):
            clock[0] = 100.0 + second
            shown.played(2.0 * second, 100.0)
        shown.line("imu", "\x1b[2J")
    assert stream.getvalue().splitlines() == [
        "caneflow |  20 % 20.0 of 100.0 s, 2 x real time, 40 s left",
        "caneflow |  40 % 40.0 of 100.0 s, 2 x real time, 30 s left",
        r"imu | \x1b[2J",
    ]
