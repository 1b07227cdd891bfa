"""Recordings whose stamps cannot be: they go back, or are not the samples' own. Told by `info`, refused by a run."""

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from caneflow import command
from caneflow.messages import Imu, numbered
from caneflow.messages.control import Counters, InputCounts
from caneflow.recording import Recording, RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.outcome import Outcome, note_losses
from caneflow.runtime.replayed import Replay

ROOT = Path(__file__).parents[1]
START, STEP = 10**13, 10_000_000  # ns
FLOW = "flow: cane\nnodes:\n  imu: {run: drivers.bno055}\n  mine: {run: operators.attitude, inputs: {imu: imu/imu}}\n"
FLOW += "results: [mine/imu]\n"


def write(path: Path, stamps: list[int], published: Callable[[int], int] = lambda stamp: stamp) -> Path:
    """A recording of an IMU with these stamps."""
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writing:
        for seq, stamp in enumerate(stamps):
            payload = numbered(Imu(stamp=stamp, gyro=(0.0, 0.0, 0.1), accel=(0.0, 0.0, 9.8)), seq)
            at = START + seq * STEP  # of reception: this clock was never set
            writing.write("cane/imu/imu", Imu, payload, stamp=published(stamp), seq=seq, log_time=at)
    return path


def jumping(by: int, count: int = 400) -> list[int]:
    """Stamps that go back by `by` ns half-way."""
    return [START + seq * STEP - (by + STEP if 2 * seq >= count else 0) for seq in range(count)]


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """The command, run in this process: its exit status and all that it said."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out + said.err

    return run


FAULTS = [
    (jumping(10**9), 0, "cane/imu/imu: time goes back by 1 s: sample 200 has stamp 10000990000000, after 10001"),
    (jumping(1), 0, "cane/imu/imu: time goes back by 1e-09 s: sample 200 "),
    (jumping(0), 0, "cane/imu/imu: time does not go on, nor back: sample 200 has stamp 10001990000000, after 1000199"),
    (jumping(5 * 10**9, 9), 0, "cane/imu/imu: time goes back by 5 s: sample 5 "),
    (jumping(-STEP), 1, "imu: sample 0 has stamp 10000000000000 and is recorded with publish_time 1000000000000"),
    (jumping(-STEP), -5 * 10**9, "stamp 10000000000000 and is recorded with publish_time 9995000000000, 5 s earlier"),
]  # fmt: skip


@pytest.mark.parametrize(("stamps", "off", "said"), FAULTS)
def test_such_a_recording_is_refused_before_the_start_and_named_by_info(
    caneflow: Callable[..., tuple[int, str]], tmp_path: Path, stamps: list[int], off: int, said: str
) -> None:
    path = write(tmp_path / "clock.mcap", stamps, lambda stamp: stamp + off)
    (tmp_path / "mine.yaml").write_text(FLOW)
    status, out = caneflow("run", tmp_path / "mine.yaml", "--replay", path, "--in-process")
    assert (status, out.count("\n")) == (2, 1)
    assert out.startswith(f"caneflow run: {path}: ")
    assert said in out
    for options in ([], ["--full"]):
        assert said in caneflow("info", path, *options)[1]
    about = json.loads(caneflow("info", path, "--json")[1])
    filed = [stamp + off for stamp in stamps]
    assert about["start"] == min(filed), "the smallest"
    assert about["duration"] == (max(filed) - min(filed)) / 1e9, "to the largest"


def test_both_hosts_say_the_same(caneflow: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    path = write(tmp_path / "clock.mcap", jumping(10**9))
    (tmp_path / "mine.yaml").write_text(FLOW)
    words = ["run", str(tmp_path / "mine.yaml"), "--replay", str(path)]
    processes = subprocess.run(
        [sys.executable, "-m", "caneflow.command", *words, "--speed", "max"], capture_output=True, text=True, cwd=ROOT
    )
    assert (processes.returncode, processes.stdout + processes.stderr) == caneflow(*words, "--in-process")


def test_the_part_before_can_be_replayed(tmp_path: Path) -> None:
    path = write(tmp_path / "clock.mcap", [START + 10**9, *jumping(-STEP)[101:], START])
    (tmp_path / "mine.yaml").write_text(FLOW)
    graph = load(tmp_path / "mine.yaml")
    deploy(graph, replay=Replay(recording=path, speed=math.inf, duration_s=2.9))
    with pytest.raises(DataflowError, match="time goes back by "):
        deploy(graph, replay=Replay(recording=path, speed=math.inf))


def test_streams_that_nobody_replays_may_be_as_they_are(tmp_path: Path) -> None:
    """An operator's recorded output is not what a replay brings."""
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writing:
        for seq in range(9):
            for key, stamp in (("cane/imu/imu", START + seq), ("cane/mine/imu", START - seq)):
                payload = numbered(Imu(stamp=stamp, gyro=(0, 0, 0)), seq)
                writing.write(key, Imu, payload, stamp=stamp, seq=seq, log_time=START)
    (tmp_path / "mine.yaml").write_text(FLOW)
    deploy(load(tmp_path / "mine.yaml"), replay=Replay(recording=path))
    with Recording(path) as recording:
        found = recording.examined()
    assert (found["imu", "imu"].stamps_back, found["mine", "imu"].stamps_back) == (0, 8)


def test_a_replay_that_loses_half_has_failed() -> None:
    counted = InputCounts(received=100, handled=49, refused=51)
    half = InputCounts(received=100, handled=50, refused=50)
    outcome = Outcome(
        counters={
            "mine": Counters(node="mine", inputs={"imu": counted, "other": half}, outputs={}),
            "imu": Counters(node="imu", inputs={}, outputs={"imu": 10}, unsent={"imu": 11}),
        }
    )
    note_losses(outcome)
    assert outcome.status == 1
    assert [failure.partition(";")[0] for failure in outcome.failures] == [
        "mine.imu: 51 of 100 samples refused",
        "imu/imu: 11 samples not sent",
    ]
