"""What a host does to a live flow: a full disk, a clock that is set, samples that never come. Real processes."""

import json
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from caneflow.messages import Imu, Pose, RadarFrame, numbered
from caneflow.recording import Recording, RecordingWriter, recover
from caneflow.recording.parts import LastSeconds, RotatingWriter, Rotation
from tests.flows import CANEFLOW, Launched, launchers, wait_for, write_walk

Launch = Callable[..., Launched]

SOURCE = '''
"""A live source: an IMU at rest and its speed, at 100 Hz of a clock of its own, faster than any real one."""
import time
from caneflow.messages import GroundSpeed, Imu
from caneflow.runtime import Source
from caneflow.runtime.node import run

class Clocked(Source):
    outputs = {"imu": Imu, "speed": GroundSpeed}

    def __init__(self, settings, context): ...

    def samples(self):
        for stamp in self.stamps():
            yield "imu", Imu(
                stamp=stamp, gyro=(0.0, 0.0, 0.0), linear_accel=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)
            )
            yield "speed", GroundSpeed(
                stamp=stamp, speed=1.0, quality=0.05, rays=12, valid=True,
                velocity=(1.0, 0.0), velocity_cov=(0.01, 0.0, 0.02),
            )
            time.sleep(0.001)  # what follows may be slower than the machine

    def stamps(self):
        stamp = 1_000_000_000_000
        {body}

if __name__ == "__main__":
    run(Clocked)
'''

STEP_BACK = """
        for number in range(1, 1001):
            stamp += 10_000_000
            yield stamp - (5_000_000_000 if number > 300 else 0)
"""
GAP = """
        for number in range(1, 601):
            stamp += {gap} if number == 301 else 10_000_000
            yield stamp
"""

FLOW = """
flow: {flow}
rig: {{boresight: [0, 1, 0], hand_height: 0.95, aperture: 0.87, pivot: [0, -0.3, 0]}}
nodes:
  cane: {{run: ./source.py}}
  fusion: {{run: operators.fusion, inputs: {{imu: cane/imu, speed: cane/speed}}, settings: {{method: {method}}}}}
results: [fusion/pose]
"""


@pytest.fixture
def launch() -> Iterator[Launch]:
    with launchers() as launch:
        yield launch


@pytest.fixture
def flow(tmp_path: Path) -> str:
    """A flow's name that no other test uses."""
    return "h" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]


def written(folder: Path, flow: str, body: str, method: str = "luenberger") -> Path:
    (folder / "source.py").write_text(SOURCE.replace("        {body}\n", body))
    file = folder / "dataflow.yaml"
    file.write_text(FLOW.format(flow=flow, method=method))
    return file


def processes_of(flow: str) -> list[str]:
    """The command lines of whatever still runs of a flow."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        line = " ".join(process.info["cmdline"] or ())
        if f"/{flow}-" in line:
            found.append(line)
    return found


def poses(path: Path) -> list[Pose]:
    with Recording(path) as recording:
        found = [sample.decoded() for sample in recording.samples([("fusion", "pose")])]
    return [pose for pose in found if isinstance(pose, Pose)]


def test_a_clock_that_is_set_back_holds_the_flow_up_and_never_turns_it_back(
    launch: Launch, tmp_path: Path, flow: str
) -> None:
    """5 s back after 300 samples: what lies in the time that was before is not sent, and the run says how much."""
    file, out = written(tmp_path, flow, STEP_BACK, "best"), tmp_path / "out.mcap"
    launched = launch("run", file, "--record", out, log=tmp_path / "run.log")

    assert launched.ends() == 0, launched.said
    assert launched.said.count("not sent, time goes backwards") == 1
    assert "cane: 500 x imu, 500 x speed; 1000 refused" in launched.said
    with Recording(out) as recording:
        stamps = [sample.stamp for sample in recording.samples([("cane", "imu")])]
    assert [stamp - stamps[0] for stamp in stamps] == [10_000_000 * number for number in range(500)]
    found = poses(out)
    assert [pose.stamp for pose in found] == stamps
    assert found[-1].position[1] == pytest.approx(4.99, abs=0.2), "m, at 1 m/s"


@pytest.mark.parametrize(("method", "gap_s"), [("kalman", 3), ("best", 10)])
def test_over_a_gap_a_live_flow_says_that_it_does_not_know(
    launch: Launch, tmp_path: Path, flow: str, method: str, gap_s: int
) -> None:
    """The covariance opens by what a bearer may have walked meanwhile, and stays open: nothing tells where he is."""
    file, out = written(tmp_path, flow, GAP.format(gap=gap_s * 10**9), method), tmp_path / "out.mcap"
    launched = launch("run", file, "--record", out, log=tmp_path / "run.log")

    assert launched.ends() == 0, launched.said
    assert f"fusion | WARNING {flow}/cane/imu: nothing for {gap_s}.00 s before seq 300\n" in launched.said
    found = poses(out)
    assert len(found) == 600
    before, after, last = (variances(found[i]) for i in (299, 300, -1))
    for axis in (0, 1):
        assert after[axis] - before[axis] > (0.5 * gap_s) ** 2, "m^2: at 0.5 m/s at least"
        assert last[axis] >= 0.99 * after[axis]
    assert found[300].position[1] - found[299].position[1] == pytest.approx(gap_s, rel=0.1), "the velocity is held"


def variances(pose: Pose) -> list[float]:
    assert pose.covariance is not None
    return [float(pose.covariance[axis, axis]) for axis in range(3)]


TICKER = '''
"""A live source: an IMU that ticks at 100 Hz."""
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
            yield "imu", Imu(stamp=time.time_ns(), gyro=(0.0, 0.0, 0.0))

if __name__ == "__main__":
    run(Ticker)
'''

# What is on the disk goes with the namespace it was mounted in, so it is copied out.
ON_A_SMALL_DISK = 'mount -t tmpfs -o size=1m none "$0" && { "$@"; status=$?; cp -r "$0"/. "$0"/..; exit $status; }'


@pytest.fixture
def small_disk(tmp_path: Path) -> tuple[Path, list[str]]:
    """The place of a disk of 1 MB, and the command that runs another one with it."""
    disk = tmp_path / "disk"
    disk.mkdir()
    inside = ["unshare", "--mount", "sh", "-c", ON_A_SMALL_DISK, str(disk)]
    tried = shutil.which("unshare") and subprocess.run([*inside, "true"], capture_output=True, check=False)
    if not tried or b"mount" in tried.stderr or b"unshare" in tried.stderr:
        pytest.skip("a small disk needs `unshare` and the right to mount one")
    return disk, inside


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 600 radar frames of noise, 2 kB each, that no compression makes smaller."""
    path = tmp_path_factory.mktemp("noise") / "noise.mcap"
    rng = np.random.default_rng(1)
    with RecordingWriter(path, flow="elsewhere", source="simulated", rig={}) as writer:
        for seq in range(600):
            stamp = 10_000_000 * (seq + 1)
            frame = RadarFrame(
                stamp=stamp,
                scans=rng.integers(-(2**31), 2**31 - 1, (1, 480), dtype=np.int32),
                scan_period=0.01,
                range_start=0.5,
                range_step=0.009,
                carrier=4.3e9,
                bandwidth=1.7e9,
            )
            key = "elsewhere/radar/frame"
            writer.write(key, RadarFrame, numbered(frame, seq), stamp=stamp, seq=seq, log_time=stamp)
    return path


@pytest.mark.parametrize("options", [[], ["--rotate", "300kB"]])
def test_in_a_replay_a_disk_that_fills_up_ends_the_run_with_one_line_and_a_file_that_can_be_read(
    launch: Launch, tmp_path: Path, flow: str, small_disk: tuple[Path, list[str]], options: list[str], noise: Path
) -> None:
    disk, inside = small_disk
    file = tmp_path / "dataflow.yaml"
    file.write_text(f"flow: {flow}\nnodes:\n  radar: {{run: drivers.p440}}\nresults: [radar/frame]\n")
    command = ["run", file, "--replay", noise, "--speed", "4", "--record", disk / "out.mcap", *options]
    launched = launch(*command, log=tmp_path / "run.log", inside=inside)

    assert launched.ends() == 1, launched.said
    assert "Traceback" not in launched.said
    (line,) = [line for line in launched.said.splitlines() if line.startswith("caneflow run: ")]
    assert re.search(r"recorder ended .*/disk/out.*\.mcap: No space left on device; the recording ends here", line)
    assert line.endswith("what was written before can be read; make room, or record on another disk")
    parts = sorted(tmp_path.glob("out*.mcap"))
    assert len(parts) >= (2 if options else 1)
    seqs = []
    for part in parts:
        with Recording(part) as recording:
            seqs += [sample.seq for sample in recording.samples()]
    assert seqs == list(range(len(seqs)))
    assert len(seqs) > 400, "2 kB each, on 1 MB"
    assert not processes_of(flow)


def test_live_the_flow_goes_on_while_its_disk_is_full_and_the_recording_when_there_is_room(
    launch: Launch, tmp_path: Path, flow: str, small_disk: tuple[Path, list[str]]
) -> None:
    """Full from the start, then with room, then full again."""
    disk, inside = small_disk
    (tmp_path / "ticker.py").write_text(TICKER)
    file = tmp_path / "dataflow.yaml"
    file.write_text(f"flow: {flow}\nnodes:\n  ticker: {{run: ./ticker.py}}\nresults: [ticker/imu]\n")
    filled = 'cat /dev/zero > "$0"/filler; exec "$@"'
    inside = [*inside[:-1], str(disk), "sh", "-c", filled, str(disk)]
    launched = launch("run", file, "--record", disk / "out.mcap", log=tmp_path / "run.log", inside=inside)

    launched.wait_for("No space left on device")
    launched.wait_for("THE FLOW GOES ON WITHOUT ITS RECORDING")
    on_disk = Path(f"/proc/{launched.process.pid}/root") / disk.relative_to("/")
    before = sent(flow)
    assert before["state"] in ("waiting", "starting")
    assert "No space left on device" in before["said"]
    (on_disk / "filler").unlink()
    launched.wait_for("recorder | is there again, after")
    part = on_disk / "out_001.mcap"
    wait_for(lambda: part.stat().st_size > 10_000, "samples on the disk")
    with suppress(OSError), (on_disk / "filler").open("wb", buffering=0) as filler:
        while True:
            filler.write(bytes(4096))
    wait_for(lambda: launched.said.count("THE FLOW GOES ON WITHOUT ITS RECORDING") == 2, "a full disk")
    after = sent(flow)
    assert after["ticker"] > before["ticker"], "it went on"
    (run,) = psutil.Process(launched.process.pid).children()  # of the shell
    run.send_signal(signal.SIGINT)
    assert launched.ends() == 130, launched.said
    last = launched.said.splitlines()[-1]
    assert re.fullmatch(r"caneflow run: recorder: the recording is incomplete: .*No space left on device.*", last)
    assert "Traceback" not in launched.said

    assert sorted(path.name for path in tmp_path.glob("out*")) == ["out_001.mcap"], "one that holds nothing is removed"
    with Recording(tmp_path / "out_001.mcap") as recording:
        seqs = [sample.seq for sample in recording.samples()]
    assert seqs == list(range(len(seqs))), "what came before there was room was asked for"
    recovered = recover(tmp_path / "out_001.mcap", tmp_path / "sound.mcap")
    assert sum(recovered.messages.values()) == len(seqs)


def sent(flow: str) -> dict[str, Any]:
    """What `status` says: the samples that the ticker has sent; state and last line of the recorder."""
    status = subprocess.run([*CANEFLOW, "status", flow, "--json"], capture_output=True, check=True, timeout=60)
    nodes = json.loads(status.stdout)["nodes"]
    recorder = nodes["recorder"]
    return {"ticker": nodes["ticker"]["sent"]["imu"], "state": recorder["state"], "said": recorder["said"]}


def test_a_disk_that_is_full_is_one_line_of_a_tool(tmp_path: Path, small_disk: tuple[Path, list[str]]) -> None:
    disk, inside = small_disk
    walk = write_walk(tmp_path / "walk.mcap", samples=4000)
    assert walk.stat().st_size > 2**20
    command = [*CANEFLOW, "recover", str(walk), "--output", str(disk / "again.mcap")]
    ended = subprocess.run([*inside, *command], capture_output=True, text=True, check=False, timeout=60)
    said = f"caneflow recover: {disk}/again.mcap: No space left on device\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", said)


@pytest.mark.parametrize("allowed", [8, 48])
def test_too_few_open_files_are_one_line_before_anything_starts(tmp_path: Path, flow: str, allowed: int) -> None:
    file = written(tmp_path, flow, GAP.format(gap=10_000_000))
    limited = ["sh", "-c", f'ulimit -n {allowed} && exec "$@"', "sh", *CANEFLOW, "run", str(file)]
    ended = subprocess.run(limited, capture_output=True, text=True, check=False, timeout=60)
    said = (
        f"caneflow run: {allowed} files may be open at a time, a flow of 2 nodes needs 60; "
        "allow more with `ulimit -n 1024`\n"
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", said)
    assert not processes_of(flow)


@pytest.mark.parametrize("limit", ["ulimit -n 60", "ulimit -S -n 20"])
def test_as_many_open_files_as_it_asks_for_are_enough(launch: Launch, tmp_path: Path, flow: str, limit: str) -> None:
    """A soft limit that is too low is raised to the hard one by itself."""
    file = written(tmp_path, flow, GAP.format(gap=10_000_000))
    launched = launch("run", file, log=tmp_path / "run.log", inside=["sh", "-c", f'{limit} && exec "$@"', "sh"])
    assert launched.ends() == 0, launched.said


def test_an_export_to_a_full_disk_is_one_line(tmp_path: Path, small_disk: tuple[Path, list[str]]) -> None:
    disk, inside = small_disk
    walk = write_walk(tmp_path / "walk.mcap", samples=10_000)
    options = ["--format", "csv", "--stream", "imu/imu", "--output", str(disk / "imu.csv")]
    command = [*CANEFLOW, "export", str(walk), *options]
    ended = subprocess.run([*inside, *command], capture_output=True, text=True, check=False, timeout=60)
    said = f"caneflow export: {disk}/imu.csv: cannot be written: No space left on device\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", said)


KEY, SECOND = "cane/imu/imu", 10**9
HOUR = 3600 * SECOND


def written_with_the_clock_set_back(writer: RecordingWriter | RotatingWriter | LastSeconds) -> None:
    """1 s, then the host's clock goes back by an hour, then 3 s more; at 100 Hz. Stamps go on."""
    for seq in range(400):
        log_time = 2 * HOUR + seq * SECOND // 100 - (HOUR if seq >= 100 else 0)
        imu = Imu(stamp=seq, gyro=(0.0, 0.0, 0.0))
        writer.write(KEY, Imu, numbered(imu, seq), stamp=seq, seq=seq, log_time=log_time)


def opener(path: Path, number: int) -> RecordingWriter:
    return RecordingWriter(path, flow="cane", source="live", rig={}, part=number)


def test_a_recorder_whose_clock_is_set_back_still_loses_a_second_at_most(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    with opener(path, 0) as writer:
        written_with_the_clock_set_back(writer)
        with Recording(path) as recording:  # what a kill would leave now
            assert recording.streams["imu", "imu"].count >= 300


def test_parts_go_on_and_memory_stays_bounded_when_the_clock_is_set_back(tmp_path: Path) -> None:
    with closing(RotatingWriter(tmp_path / "parts.mcap", Rotation(span_s=1), opener)) as parts:
        written_with_the_clock_set_back(parts)
    assert len(list(tmp_path.glob("parts_*.mcap"))) == 3

    last = LastSeconds(tmp_path / "last.mcap", 1.0, opener)
    written_with_the_clock_set_back(last)
    assert 100 <= last.snapshot().samples <= 101
