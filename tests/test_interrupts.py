"""Ctrl-C ends every command with status 130: no verdict, no figure, no half file, no traceback, no process left."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from caneflow import command
from caneflow.recording import Recording
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.replays.evaluation import evaluated
from caneflow.runtime.replays.verification import verify
from tests.flows import CANEFLOW, write_walk
from tools.bench import benchmark

STOPS = '''
from caneflow.messages import Imu
from caneflow.runtime import Operator
from caneflow.runtime.node import run
class Stops(Operator):
    """Ctrl-C comes while it handles its hundredth sample."""
    inputs = {"imu": Imu}
    outputs = {"imu": Imu}
    def __init__(self, settings, context):
        self.count = 0
    def handle(self, port, message):
        self.count += 1
        if self.count == 100:
            raise KeyboardInterrupt
        yield "imu", message
if __name__ == "__main__":
    run(Stops)
'''
FLOW = """
flow: elsewhere
nodes:
  imu: { run: drivers.bno055 }
  radar: { run: drivers.p440 }
  mine: { run: ./stops.py, inputs: { imu: imu/imu } }
  ground_speed: { run: operators.ground_speed, inputs: { frame: radar/frame, imu: mine/imu } }
  fusion: { run: operators.fusion, inputs: { imu: mine/imu, speed: ground_speed/speed } }
results: [fusion/pose]
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap", samples=300)


@pytest.fixture
def flow(tmp_path: Path) -> Path:
    (tmp_path / "stops.py").write_text(STOPS)
    (tmp_path / "flow.yaml").write_text(FLOW)
    return tmp_path / "flow.yaml"


# --- a run in this process is the whole recording, or raises


def test_whoever_runs_a_part_of_a_recording_hears_of_it(
    flow: Path, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = tmp_path / "recorded.mcap"
    monkeypatch.setattr(
        sys, "argv", ["caneflow", *f"run {flow} --replay {walk} --in-process --record {recorded}".split()]
    )
    with pytest.raises(SystemExit) as end:
        command.main()
    assert end.value.code == 130
    with Recording(recorded) as recording:
        assert recording.complete, "a run that is ended has a sound recording of what there was"
        assert 90 < recording.streams["mine", "imu"].count < 100
    with pytest.raises(KeyboardInterrupt):
        verify(load(flow), recorded)
    with pytest.raises(KeyboardInterrupt):
        benchmark(load(flow), walk, 1)
    with pytest.raises(KeyboardInterrupt):
        list(evaluated(flow, [walk], ["luenberger"]))


# --- the command, while it imports and while it works


def test_ctrl_c_while_the_command_is_imported_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("print('importing', flush=True)\nimport time\ntime.sleep(60)\n")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    with subprocess.Popen(
        [*CANEFLOW, "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "importing\n"
        program.send_signal(signal.SIGINT)
        assert program.communicate(timeout=60) == ("", "")
    assert program.returncode == 130


@pytest.mark.parametrize(
    ("name", "held"), [("caneflow", {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}), ("mine", set())]
)
def test_the_command_holds_signals_from_its_first_import_on(tmp_path: Path, name: str, held: set[int]) -> None:
    """And no other program does that imports the library."""
    (tmp_path / name).write_text(
        "import caneflow, signal\nprint(*map(int, signal.pthread_sigmask(signal.SIG_BLOCK, ())))"
    )
    done = subprocess.run([sys.executable, tmp_path / name], capture_output=True, text=True, check=True)
    assert {int(number) for number in done.stdout.split()} == held


ENDS = [([signal.SIGINT], 130), ([signal.SIGINT] * 3, 130), ([signal.SIGTERM], -15), ([signal.SIGHUP], -1)]


@pytest.mark.parametrize(("signals", "status"), ENDS, ids=str)
def test_a_signal_during_the_work_leaves_nothing_behind(
    tmp_path: Path, signals: list[signal.Signals], status: int
) -> None:
    table = tmp_path / "table.csv"
    os.mkfifo(table)
    words = ["import", "imu-csv", table, "--columns", "time=t,gyro_x=x,gyro_y=y,gyro_z=z", "-o", tmp_path / "out.mcap"]
    with (
        subprocess.Popen(
            [*CANEFLOW, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as program,
        table.open("w") as rows,
    ):  # returns when the command reads
        rows.write("t,x,y,z\n" + "".join(f"{number},1,2,3\n" for number in range(10_000)))
        rows.flush()
        assert len(list(tmp_path.iterdir())) == 2, "the output lies beside, under a name of its own"
        for number in signals:
            program.send_signal(number)
        assert program.communicate(timeout=60) == ("", "")
    assert program.returncode == status
    assert list(tmp_path.iterdir()) == [table]


def test_a_signal_that_is_ignored_at_the_start_stays_ignored(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    os.mkfifo(table)
    words = ["import", "imu-csv", table, "--columns", "time=t,gyro_x=x,gyro_y=y,gyro_z=z", "-o", tmp_path / "out.mcap"]
    ignoring = ["sh", "-c", 'trap "" HUP INT; exec "$@"', "sh"]
    with subprocess.Popen([*ignoring, *CANEFLOW, *map(str, words)], stdout=subprocess.DEVNULL) as program:
        with table.open("w") as rows:
            rows.write("t,x,y,z\n0,1,2,3\n")
            rows.flush()
            program.send_signal(signal.SIGHUP)
            program.send_signal(signal.SIGINT)
            rows.write("1,1,2,3\n")
        assert program.wait(timeout=60) == 0
    with Recording(tmp_path / "out.mcap") as recording:
        assert recording.streams["imu", "imu"].count == 2


WORKERS = """
import os, sys, time
from pathlib import Path
from caneflow import interrupts
from caneflow.runtime.replays.workers import mapped

def work(item):
    Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(100)

if __name__ == "__main__":
    with interrupts.handled():
        interrupts.begin_work()
        try:
            list(mapped(work, [1, 2, 3, 4], 2))
        except KeyboardInterrupt:
            sys.exit(130)
"""


@pytest.mark.parametrize(
    ("whole_group", "number"), [(True, signal.SIGINT), (False, signal.SIGINT), (False, signal.SIGTERM)]
)
def test_workers_end_with_the_command_and_say_nothing(
    tmp_path: Path, whole_group: bool, number: signal.Signals
) -> None:
    """A terminal sends Ctrl-C to all processes, `kill` to one."""
    script, pids = tmp_path / "script.py", tmp_path / "pids"
    script.write_text(WORKERS)
    pids.mkdir()
    with subprocess.Popen(
        [sys.executable, script, pids],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as program:
        while len(workers := [int(each.name) for each in pids.iterdir()]) < 2:
            assert program.poll() is None
        (os.killpg if whole_group else os.kill)(program.pid, number)
        assert program.communicate(timeout=60) == ("", "")
    assert program.returncode == (130 if number == signal.SIGINT else -number)
    assert not [pid for pid in workers if psutil.pid_exists(pid)]
