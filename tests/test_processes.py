"""The real command with real processes over loopback Zenoh: started, replayed, recorded, killed, interrupted."""

import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import zenoh

from caneflow.messages import Imu, control_key, decode, numbered, sample_key
from caneflow.messages.control import Counters
from caneflow.recording import Recording
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.hosts.links.session import open_session
from tests.flows import BOTH_LINKS, caneflow, caneflow_here, node_processes, write_walk

ROOT = Path(__file__).parents[1]
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DEADLINE = 60.0  # s for anything that is waited for
LONG = pytest.mark.long

CANE = """
flow: {flow}
nodes:
  imu: {{run: drivers.bno055}}
  radar: {{run: drivers.p440}}
  ground_speed: {{run: operators.ground_speed, inputs: {{frame: radar/frame, imu: imu/imu}}}}
  fusion: {{run: operators.fusion, inputs: {{imu: imu/imu, speed: ground_speed/speed}}}}
results: [fusion/pose]
"""

TICKER = '''
"""A live source: an IMU that ticks at 100 Hz."""
import time
from caneflow.messages import Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Ticker(Source):
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        pass

    def samples(self):
        while True:
            time.sleep(0.01)
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Ticker)
'''

ECHO = '''
"""A live operator: hands each IMU sample on."""
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Echo(Operator):
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}

    def __init__(self, settings, context):
        pass

    def handle(self, port, message):
        yield "imu", Imu(stamp=message.stamp, gyro=message.gyro)

if __name__ == "__main__":
    run(Echo)
'''

LIVE = """
flow: {flow}
nodes:
  ticker: {{run: ./ticker.py}}
  echo: {{run: ./echo.py, inputs: {{imu: ticker/imu}}, restart: {{policy: on-failure, delay_s: 0.1}}}}
results: [echo/imu]
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """4 s of IMU samples and radar frames of noise: the graph runs on it, whatever it makes of it."""
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap")


@pytest.fixture
def flow(tmp_path: Path) -> str:
    """A flow's name that no other test uses."""
    return "t" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]


@pytest.fixture
def links() -> str:
    """How the processes of a flow are linked, unless a test asks for both ways."""
    return "unix"


@pytest.fixture
def cane(tmp_path: Path, flow: str, links: str) -> Path:
    path = tmp_path / "dataflow.yaml"
    path.write_text(f"links: {links}{CANE.format(flow=flow)}")
    return path


@pytest.fixture
def live(tmp_path: Path, flow: str, links: str) -> Path:
    (tmp_path / "ticker.py").write_text(TICKER)
    (tmp_path / "echo.py").write_text(ECHO)
    path = tmp_path / "live.yaml"
    path.write_text(f"links: {links}{LIVE.format(flow=flow)}")
    return path


class Running:
    """A flow that was started and goes on."""

    def __init__(self, flow: str, *args: object) -> None:
        self.flow = flow
        self.process = subprocess.Popen(
            [*CANEFLOW, *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def end(self, number: int) -> tuple[int, str]:
        """Send a signal; the exit status and everything that was printed."""
        self.process.send_signal(number)
        output, _ = self.process.communicate(timeout=DEADLINE)
        return self.process.returncode, output

    def nodes(self) -> list[psutil.Process]:
        """The processes of the flow's nodes."""
        return list(node_processes(self.process.pid).values())

    def node(self, name: str) -> psutil.Process:
        return node_processes(self.process.pid)[name]

    def session(self) -> zenoh.Session:
        """A client of the flow, as the tools are."""

        def listens() -> bool:
            assert self.process.poll() is None, self.process.communicate()[0]
            return any(found.pid == self.process.pid for found in running_flows())

        wait_for(listens, "the flow's address")
        found = next(found for found in running_flows() if found.pid == self.process.pid)
        return open_session(mode="client", connect=[found.endpoint])


@pytest.fixture
def start(flow: str) -> Iterator[Callable[..., Running]]:
    started: list[Running] = []

    def start(*args: object) -> Running:
        started.append(Running(flow, *args))
        return started[-1]

    yield start
    for running in started:
        if running.process.poll() is None:
            running.process.kill()
        running.process.wait()
        wait_for(lambda running=running: not running.nodes(), "the end of all nodes")  # type: ignore[misc]  # bound now
        assert running.process.stdout is not None
        running.process.stdout.close()


def wait_for(condition: Callable[[], object], what: str, deadline: float = DEADLINE) -> None:
    end = time.monotonic() + deadline
    while not condition():
        assert time.monotonic() < end, f"waited {deadline} s for {what}"
        time.sleep(0.02)


def results(path: Path) -> dict[str, list[bytes]]:
    """The payloads of what operators published, by node/port."""
    with Recording(path) as recording:
        out: dict[str, list[bytes]] = {}
        for sample in recording.samples():
            if sample.node in ("ground_speed", "fusion"):
                out.setdefault(f"{sample.node}/{sample.port}", []).append(sample.payload)
        return out


def counters(session: zenoh.Session, flow: str, node: str) -> "Iterator[Counters]":
    """The node's counters as it publishes them, once a second."""
    with session.declare_subscriber(control_key(flow, "counters", node)) as subscriber:
        end = time.monotonic() + DEADLINE
        while time.monotonic() < end:
            sample = subscriber.try_recv()
            if sample is None:
                time.sleep(0.02)
            else:
                yield decode(sample.payload.to_bytes(), Counters)
    pytest.fail(f"{node} did not count up to what was waited for in {DEADLINE:g} s")


def test_every_host_and_speed_gives_the_same_bytes(cane: Path, walk: Path, tmp_path: Path) -> None:
    outputs = {}
    for name, how, options in [
        ("max", caneflow, ["--speed", "max"]),
        ("paced", caneflow, ["--speed", "2"]),
        ("in_process", caneflow_here, ["--in-process"]),
    ]:
        out = tmp_path / f"{name}.mcap"
        done = how("run", cane, "--replay", walk, *options, "--record", out)
        assert done.returncode == 0, done.stderr
        outputs[name] = results(out)
    assert {stream: len(payloads) for stream, payloads in outputs["max"].items()} == {
        "ground_speed/speed": 400,
        "fusion/pose": 400,
    }
    assert outputs["paced"] == outputs["max"]
    assert outputs["in_process"] == outputs["max"]


def test_a_replay_keeps_the_recorded_spacing(cane: Path, walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    done = caneflow("run", cane, "--replay", walk, "--speed", "2", "--start", "1", "--duration", "2", "--record", out)
    assert done.returncode == 0, done.stderr
    with Recording(out) as recording:
        times = {
            key: np.array([(sample.stamp, sample.log_time) for sample in recording.samples([key])]) * 1e-9
            for key in (("imu", "imu"), ("fusion", "pose"))
        }
        first = next(recording.samples([("imu", "imu")]))
    assert first.stamp == 2_000_000_000
    assert first.seq == 0  # a run counts again
    for stream, of_stream in times.items():
        assert len(of_stream) == 200, stream
        # A busy machine holds some samples up, never all of them: those that came soonest tell the pace.
        soonest = (of_stream[:, 1] - of_stream[:, 0] / 2).reshape(2, 100).min(axis=1)
        assert soonest[1] - soonest[0] == pytest.approx(0.0, abs=0.3), "s; 0.5 at half or at full speed"


def test_a_loop_goes_on_with_stamps_and_numbers(
    cane: Path, walk: Path, tmp_path: Path, start: Callable[..., Running]
) -> None:
    out = tmp_path / "out.mcap"
    running = start("run", cane, "--replay", walk, "--speed", "20", "--loop", "--record", out)
    with running.session() as session:
        for counted in counters(session, running.flow, "fusion"):
            if counted.outputs["pose"] > 900:
                break
    status, output = running.end(signal.SIGINT)
    assert status == 130, output
    with Recording(out) as recording:
        assert recording.complete, output
        poses = [(s.seq, s.stamp) for s in recording.samples([("fusion", "pose")])]
    assert [seq for seq, _ in poses] == list(range(len(poses)))
    spacing = {b - a for (_, a), (_, b) in itertools.pairwise(poses)}
    assert spacing == {10_000_000}, "the next turn begins one sample after the last"


@pytest.mark.parametrize(
    ("links", "number"), [("unix", signal.SIGINT), ("tcp", signal.SIGINT), ("unix", signal.SIGHUP)]
)
def test_ctrl_c_and_a_lost_terminal_end_everything_in_order(
    live: Path, tmp_path: Path, start: Callable[..., Running], number: int
) -> None:
    out = tmp_path / "out.mcap"
    running = start("run", live, "--record", out)
    with running.session() as session:
        next(counters(session, running.flow, "echo"))
    nodes = running.nodes()
    assert len(nodes) == 3
    status, output = running.end(number)
    assert status == 130, output
    assert "killed" not in output
    assert not any(node.is_running() for node in nodes)
    with Recording(out) as recording:
        assert recording.complete
        counts = {stream: found.count for stream, found in recording.streams.items()}
    assert counts["ticker", "imu"] >= counts["echo", "imu"] > 0


def test_under_nohup_a_lost_terminal_ends_nothing(live: Path, tmp_path: Path) -> None:
    """`nohup` ignores the signal; and nobody reads what the flow says."""
    out = tmp_path / "out.mcap"
    command = ["sh", "-c", 'trap "" HUP && exec "$@"', "sh", *CANEFLOW, "run", str(live), "--record", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        try:
            wait_for(lambda: out.exists() and len(node_processes(process.pid)) == 3, "all nodes, and the recording")
            process.stdout.close()
            process.send_signal(signal.SIGHUP)
            node_processes(process.pid)["echo"].kill()  # that is two lines for nobody
            grown = out.stat().st_size + 5_000
            wait_for(lambda: out.stat().st_size > grown or process.poll() is not None, "further samples")
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE) == 130
        finally:
            process.kill()
    with Recording(out) as recording:
        assert recording.complete
        assert recording.streams["echo", "imu"].count > 0


def test_a_run_whose_reader_has_gone_goes_on_to_its_end(cane: Path, walk: Path, tmp_path: Path) -> None:
    """As in `caneflow run ... 2>&1 | head -1`."""
    out = tmp_path / "out.mcap"
    command = [*CANEFLOW, "run", str(cane), "--replay", str(walk), "--speed", "max", "--record", str(out)]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(command, stdout=writing, stderr=writing, timeout=DEADLINE, check=False)
    finally:
        os.close(writing)
    assert done.returncode == 0
    with Recording(out) as recording:
        assert recording.complete
        assert recording.streams["fusion", "pose"].count == 400


def test_what_is_for_its_output_alone_ends_with_its_reader(
    walk: Path, live: Path, start: Callable[..., Running]
) -> None:
    running = start("run", live)
    with running.session() as session:
        next(counters(session, running.flow, "echo"))
    reading, writing = os.pipe()
    os.close(reading)
    tools = [
        subprocess.Popen([*CANEFLOW, *words], stdout=writing, stderr=subprocess.PIPE, text=True)
        for words in (["info", str(walk)], ["echo", running.flow], ["hz", running.flow])
    ]
    os.close(writing)
    for tool in tools:
        _, said = tool.communicate(timeout=DEADLINE)
        assert (tool.returncode, said) == (0, ""), tool.args
    assert running.end(signal.SIGINT)[0] == 130


@pytest.mark.parametrize(("links", "wait_for_ready"), [("unix", True), ("tcp", True), ("unix", False)])
def test_a_killed_launcher_leaves_no_process(live: Path, start: Callable[..., Running], wait_for_ready: bool) -> None:
    running = start("run", live)
    if wait_for_ready:
        with running.session() as session:
            next(counters(session, running.flow, "echo"))
    wait_for(lambda: len(running.nodes()) == 2, "two nodes")
    running.process.kill()
    running.process.wait()
    wait_for(lambda: not running.nodes(), "the end of all nodes")


@BOTH_LINKS
def test_a_killed_node_of_a_live_run_comes_back_and_misses_nothing(live: Path, start: Callable[..., Running]) -> None:
    running = start("run", live)
    with running.session() as session:
        before = next(counters(session, running.flow, "echo"))
        victim = running.node("echo")
        victim.kill()
        after = next(
            counted
            for counted in counters(session, running.flow, "echo")
            if counted.outputs["imu"] > before.outputs["imu"] + 100  # 1 s
        )
    assert after.inputs["imu"].lost == 0, "its writer keeps what has not been confirmed"
    assert running.node("echo").pid != victim.pid
    status, output = running.end(signal.SIGINT)
    assert status == 130
    assert "echo | ended with killed by SIGKILL; restart 1 of" in output


@BOTH_LINKS
def test_a_node_that_fails_for_good_ends_the_run(live: Path, tmp_path: Path) -> None:
    (tmp_path / "echo.py").write_text(ECHO.replace("yield", "raise RuntimeError('no more') #"))
    live.write_text(
        live.read_text().replace(
            "policy: on-failure, delay_s: 0.1", "policy: on-failure, max_restarts: 1, delay_s: 0.1"
        )
    )
    done = caneflow("run", live)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    last = done.stderr.splitlines()[-1]
    assert re.fullmatch(r"caneflow run: echo ended with status 1 after 1 restart: .*: RuntimeError: no more", last)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("raise RuntimeError('a bug')", "RuntimeError: a bug"),
        ("raise IndexError('a bug')", "IndexError: a bug"),
        ("raise SystemExit(3)", "SystemExit: 3"),
    ],
)
def test_in_a_replay_the_second_fault_at_one_sample_ends_the_run(
    live: Path, tmp_path: Path, walk: Path, fault: str, error: str
) -> None:
    live.write_text(live.read_text().replace("ticker/imu", "imu/imu").replace("ticker", "imu"))
    live.write_text(live.read_text().replace("./imu.py", "drivers.bno055"))
    (tmp_path / "echo.py").write_text(ECHO.replace("yield", f"if message.seq == 250: {fault}\n        yield"))
    done = caneflow("run", live, "--replay", walk, "--speed", "max")
    assert done.returncode == 1, done.stderr
    assert done.stderr.count("Traceback") == (0 if "Exit" in fault else 1)
    assert done.stderr.count("restart 1 of 10") == 1
    assert "restart 2" not in done.stderr
    why = r"given up, it was the second time at the same sample \(imu seq 250\)"
    last = done.stderr.splitlines()[-1]
    assert re.fullmatch(rf"caneflow run: echo ended with status \d after 1 restart: {why}: {error}", last)


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("        pass", "        import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("        pass", "        context.rig.required('pivot')", "AttributeError: .*"),
        ('if __name__ == "__main__":', 'if __name__ == "__main__":\n    1 / 0', "ZeroDivisionError: division by zero"),
    ],
)
def test_what_a_restart_would_not_mend_is_not_tried_again(
    live: Path, tmp_path: Path, old: str, new: str, error: str
) -> None:
    (tmp_path / "echo.py").write_text(ECHO.replace(old, new))
    done = caneflow("run", live)
    assert done.returncode == 1, done.stderr
    assert (done.stderr.count("Traceback"), done.stderr.count("; restart ")) == (1, 0)
    last = done.stderr.splitlines()[-1]
    assert re.fullmatch(f"caneflow run: echo ended with status 1: a restart would not mend it: {error}", last)


def test_a_killed_recorder_or_a_lost_folder_ends_no_live_flow(
    live: Path, tmp_path: Path, start: Callable[..., Running]
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    out, again, last = folder / "out.mcap", folder / "out_001.mcap", folder / "out_002.mcap"
    running = start("run", live, "--record", out)
    wait_for(lambda: out.exists() and out.stat().st_size > 10_000, "the first part")
    echo, ticker = running.node("echo"), running.node("ticker")
    running.node("recorder").kill()
    wait_for(lambda: again.exists() and again.stat().st_size > 10_000, "the second part")
    folder.rename(tmp_path / "elsewhere")
    wait_for(lambda: "recorder" not in node_processes(running.process.pid), "the end of a recorder without a folder")
    folder.mkdir()
    (folder / "out_001.mcap").write_text("of someone else")
    wait_for(lambda: last.exists() and last.stat().st_size > 10_000, "the third part")
    assert (running.node("echo").pid, running.node("ticker").pid) == (echo.pid, ticker.pid)
    status, output = running.end(signal.SIGINT)
    assert status == 130, output
    assert "incomplete" not in output, "it records at the end"
    assert output.count("THE FLOW GOES ON WITHOUT ITS RECORDING") == 2
    assert output.count("recorder | is there again, after") == 2
    assert again.read_text() == "of someone else"

    seqs, runs = list[int](), set[str]()
    for number, part in enumerate((tmp_path / "elsewhere/out.mcap", tmp_path / "elsewhere/out_001.mcap", last)):
        with Recording(part) as recording:
            runs.add(recording.metadata["run"])
            assert recording.metadata.get("part", "0") == str(number)
            seqs.append(-1)
            for sample in recording.samples([("echo", "imu")]):
                assert sample.seq == seqs[-1] + 1 or seqs[-1] == -1, f"{part}: complete in itself"
                seqs.append(sample.seq)
    assert len(runs) == 1
    assert not re.search(r"recorder: .*lost", output), "what the parts before hold is not counted as lost"


def test_a_node_that_hangs_before_it_is_ready_is_named(
    live: Path, tmp_path: Path, start: Callable[..., Running]
) -> None:
    (tmp_path / "echo.py").write_text(
        ECHO.replace('if __name__ == "__main__":', 'if __name__ == "__main__":\n    import time; time.sleep(1000)')
    )
    live.write_text(
        live.read_text().replace("restart: {policy: on-failure, delay_s: 0.1}", "restart: never, ready_timeout_s: 2")
    )
    done = caneflow("run", live)
    assert done.returncode == 1
    pid = re.search(r"echo not ready after 2 s \(pid (\d+) killed\)", done.stderr)
    assert pid
    assert not psutil.pid_exists(int(pid[1]))


def test_a_missing_program_is_found_before_anything_starts(live: Path, tmp_path: Path) -> None:
    (tmp_path / "echo.py").unlink()
    done = caneflow_here("run", live)
    assert done.returncode == 2
    assert re.search(r"live\.yaml:5:\d+: nodes\.echo\.run: no Python file '.*echo\.py'", done.stderr)
    assert "Traceback" not in done.stderr


@BOTH_LINKS
def test_a_recording_cut_short_is_replayed_up_to_the_cut(cane: Path, walk: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(walk.read_bytes()[: walk.stat().st_size * 2 // 3])
    out = tmp_path / "out.mcap"
    done = caneflow("run", cane, "--replay", cut, "--speed", "max", "--record", out)
    assert done.returncode == 0, done.stderr
    with Recording(cut) as given, Recording(out) as got:
        frames = given.streams["radar", "frame"].count
        assert 0 < frames < 400
        assert got.streams["ground_speed", "speed"].count == frames


def test_two_flows_side_by_side_do_not_hear_each_other(cane: Path, walk: Path, tmp_path: Path) -> None:
    # The same file twice, so even the keys are the same.
    both = [
        subprocess.Popen(
            [
                *CANEFLOW,
                "run",
                str(cane),
                "--replay",
                str(walk),
                "--speed",
                "max",
                "--record",
                str(tmp_path / name),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name in ("a.mcap", "b.mcap")
    ]
    for process in both:
        output, _ = process.communicate(timeout=90)
        assert process.returncode == 0, output
    a, b = results(tmp_path / "a.mcap"), results(tmp_path / "b.mcap")
    assert a == b
    assert len(a["fusion/pose"]) == 400


def test_hostile_samples_are_refused_counted_and_named_once(live: Path, start: Callable[..., Running]) -> None:
    running = start("run", live)
    good = numbered(Imu(stamp=1, gyro=(0.0, 0.0, 0.0)), 0)
    key = sample_key(running.flow, "ticker", "imu")
    with running.session() as session:
        next(counters(session, running.flow, "echo"))
        for payload in (good[:-3], good + b"x", b"", b"\xc1", np.random.default_rng(1).bytes(200), good, good):
            session.put(key, payload)
        session.put(key, good, encoding=zenoh.Encoding("application/msgpack").with_schema("caneflow.Pose/1"))
        for counted in counters(session, running.flow, "echo"):
            troubles = counted.inputs["imu"].refused + counted.inputs["imu"].repeated
            if troubles >= 8:
                break
        before = counted.outputs["imu"]
        for counted in counters(session, running.flow, "echo"):
            if counted.outputs["imu"] > before + 20:
                break  # the process lives on
        assert counted.inputs["imu"].lost == 0
    status, output = running.end(signal.SIGINT)
    assert status == 130
    assert output.count("a caneflow.Pose/1 came; the port takes caneflow.Imu/1") == 1
    assert output.count("came again") == 1
    assert "Traceback" not in output


def test_an_unfit_recording_is_refused_in_one_line(cane: Path, walk: Path, tmp_path: Path) -> None:
    text = cane.read_text()
    cane.write_text(
        text.replace("imu: {run: drivers.bno055}", "belt: {run: drivers.bno055}").replace("imu/imu", "belt/imu")
    )
    done = caneflow_here("run", cane, "--replay", walk)
    assert done.returncode == 2
    assert "no stream belt/imu; it holds imu/imu, radar/frame" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    cane.write_text(text)
    done = caneflow_here("run", cane, "--replay", tmp_path / "nowhere.mcap")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


LAGGING = '''
"""A live source whose samples reach the graph 0.3 s after they were taken, and for a while now and then 0.9 s; 160."""
import collections
import time
from caneflow.messages import GroundSpeed
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Lagging(Source):
    outputs = {"speed": GroundSpeed}

    def __init__(self, settings, context):
        pass

    def samples(self):
        waiting = collections.deque()
        number = 0
        while True:
            time.sleep(0.01)
            now = time.time_ns()
            if number < 160:
                waiting.append((now, now + (900 if number % 100 < 30 else 300) * 1_000_000))
            number += 1
            while waiting and waiting[0][1] <= now:
                stamp, _ = waiting.popleft()
                yield "speed", GroundSpeed(stamp=stamp, speed=1.0, quality=0.0, rays=1, valid=True)

if __name__ == "__main__":
    run(Lagging)
'''

JOIN = '''
"""Says for each IMU sample how many speeds came before it: an order that depends on what is late."""
from caneflow.messages import GroundSpeed, Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run

class Join(Operator):
    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"count": GroundSpeed}

    def __init__(self, settings, context):
        self.speeds = 0

    def handle(self, port, message):
        if port == "speed":
            self.speeds += 1
        else:
            yield "count", GroundSpeed(stamp=message.stamp, speed=0.0, quality=0.0, rays=self.speeds, valid=True)

if __name__ == "__main__":
    run(Join)
'''


def test_a_live_run_goes_on_without_what_lags_and_its_recording_knows(
    tmp_path: Path, flow: str, start: Callable[..., Running]
) -> None:
    for name, text in {"ticker": TICKER, "lagging": LAGGING, "join": JOIN}.items():
        (tmp_path / f"{name}.py").write_text(text)
    file = tmp_path / "late.yaml"
    file.write_text(
        f"flow: {flow}\n"
        "nodes:\n"
        "  ticker: {run: ./ticker.py}\n"
        "  lagging: {run: ./lagging.py}\n"
        "  join: {run: ./join.py, inputs: {imu: ticker/imu, speed: {from: lagging/speed, max_lag_ms: 500}}}\n"
        "results: [join/count]\n"
    )
    out = tmp_path / "out.mcap"
    running = start("run", file, "--record", out)
    with running.session() as session:
        for counted in counters(session, running.flow, "join"):
            speeds = counted.inputs["speed"]
            if speeds.late + speeds.handled == 160:  # none is on its way when the flow is ended
                break
    assert min(speeds.late, speeds.handled) > 20
    status, output = running.end(signal.SIGINT)
    assert status == 130, output
    with Recording(out) as recording:
        assert recording.control[control_key(flow, "late")] > 20
    done = caneflow_here("verify", file, out)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "samples equal in every byte" in done.stdout


WRITES = """
from pathlib import Path
from caneflow.runtime import Sink
from caneflow.runtime.node import run

class Writes(Sink):
    def __init__(self, settings, context):
        Path(__file__).with_suffix(".txt").open("x").close()

    def take(self, key, message, payload, time): ...
    def idle(self, time): ...
    def finish(self): ...

if __name__ == "__main__":
    run(Writes)
"""


def test_verify_writes_nothing(cane: Path, walk: Path, tmp_path: Path) -> None:
    """A sink of the graph has no output to compare, and what it wrote in the run is not written again."""
    (tmp_path / "writes.py").write_text(WRITES)
    cane.write_text(
        cane.read_text().replace("nodes:\n", "nodes:\n  writes: {run: ./writes.py, inputs: {pose: fusion/pose}}\n")
    )
    out, written = tmp_path / "out.mcap", tmp_path / "writes.txt"
    done = caneflow_here("run", cane, "--replay", walk, "--in-process", "--record", out)
    assert done.returncode == 0, done.stderr
    written.unlink()
    done = caneflow_here("verify", cane, out)
    assert done.returncode == 0, done.stderr
    assert not written.exists()


def test_verify_names_the_first_difference(cane: Path, walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    done = caneflow_here("run", cane, "--replay", walk, "--in-process", "--record", out)
    assert done.returncode == 0, done.stderr
    other = ["--set", "fusion.luenberger.pole_acceleration=0.500001"]
    done = caneflow_here("verify", cane, out, *other)
    assert done.returncode == 1
    assert "ground_speed/speed: 400 of 400 samples equal in every byte" in done.stdout
    assert re.search(
        r"fusion/pose: differs at seq \d+ \(stamp \d+\): (position|velocity) was \(.*\), is \(", done.stdout
    )
    done = caneflow_here("verify", cane, out, *other, "--tolerance", "0.01")
    assert done.returncode == 0, done.stdout
    assert "within the tolerance (largest " in done.stdout
    done = caneflow_here("verify", cane, walk)
    assert done.returncode == 2
    assert "holds no output of" in done.stderr


@pytest.mark.parametrize(
    "victim", [pytest.param("ground_speed", marks=LONG), "fusion", pytest.param("imu", marks=LONG)]
)
def test_a_killed_node_goes_on_as_if_nothing_had_happened(
    cane: Path, walk: Path, tmp_path: Path, start: Callable[..., Running], victim: str
) -> None:
    out = tmp_path / "out.mcap"
    running = start("run", cane, "--replay", walk, "--speed", "0.5", "--record", out)
    with running.session() as session:
        for counted in counters(session, running.flow, "fusion"):
            if counted.outputs["pose"] > 60:
                break
        running.node(victim).kill()
        for counted in counters(session, running.flow, "fusion"):
            if counted.inputs["imu"].handled > 60 and counted.outputs["pose"] > 200:
                break
    output, _ = running.process.communicate(timeout=60)
    assert running.process.returncode == 0, output
    assert f"{victim} | ended with killed by SIGKILL; restart 1 of" in output
    undisturbed = tmp_path / "undisturbed.mcap"
    assert caneflow_here("run", cane, "--replay", walk, "--in-process", "--record", undisturbed).returncode == 0
    assert results(out) == results(undisturbed)
