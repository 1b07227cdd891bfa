"""The whole cane live: both devices emulated from a recording, and the track held against the recording's replay.

Live stamps are times of reading: an IMU sample's is up to some ms after the chip had the values, a radar frame's is the
line under its arrivals. So the tracks are compared at the same times after the recording's beginning, which both
emulators are told, counted from where both have begun, and may be apart by what speed times such a delay, and a heading
that is a sample late, make on the way. On a busy machine some values of the chip are not read at all (the bytes of a
pseudo-terminal wait for a kernel thread), so the replay is of the values that were read, with the recording's stamps;
where they were nearly all, also of the recording as it is. A busy machine reads later than some ms, which the stamps
show: a heading that is so much late errs by so much of a turn, all along the way. What the flow itself makes of its
inputs has no such freedom: the live run's own recording gives the same track, byte for byte.
"""

import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Hashable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.messages import Imu, Pose, RadarFrame, Sample, numbered, sample_key
from caneflow.protocols.bno055 import ACCEL_STEP, GYRO_STEP, QUATERNION_STEP
from caneflow.recording import Recording, RecordingWriter
from tests.flows import caneflow_here, node_processes

ROOT = Path(__file__).parents[1]
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DEADLINE = 60.0  # s for anything that is waited for, beside the walk
LEAD = 3.0  # s that a chip takes to start, and a radar to be set up, before the recording begins ...
STARTS = 3.0  # ... and how many times as long as a command takes to say its help
APART, APART_OF_WAY = 0.08, 0.005  # m, and of the way walked: how far the tracks of the same values may be apart
READ_LATE, TURNING = 0.02, 2.0  # s, at most as a rule; rad/s, of a swinging cane
NEARLY_ALL, MISSING_APART_OF_WAY = 0.97, 0.02  # of the values read; with the others missing, of the way walked


class Track(NamedTuple):
    """Poses over time since the recording began."""

    times: NDArray[np.float64]  # shape (n,), s
    positions: NDArray[np.float64]  # shape (n, 2), m


@pytest.fixture
def start() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    started: list[subprocess.Popen[str]] = []

    def start(*args: object) -> "subprocess.Popen[str]":
        command = [*CANEFLOW, *map(str, args)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.terminate()  # a launcher ends its nodes
        process.communicate(timeout=DEADLINE)


def run_to_its_end(*args: object) -> str:
    done = subprocess.run(
        [*CANEFLOW, *map(str, args)], capture_output=True, text=True, timeout=3 * DEADLINE, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def said_here(*args: object) -> str:
    done = caneflow_here(*args)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def lines_until(process: "subprocess.Popen[str]", *patterns: str) -> str:
    """What the process prints until each pattern has been in a line."""
    assert process.stdout is not None
    missing, lines = set(patterns), []
    for line in process.stdout:
        lines.append(line)
        missing -= {pattern for pattern in missing if re.search(pattern, line)}
        if not missing:
            return "".join(lines)
    raise AssertionError(f"{missing} did not come: {''.join(lines)}")


def track(path: Path, begin: int) -> Track:
    with Recording(path) as recording:
        poses = [found.decoded() for found in recording.samples([("fusion", "pose")])]
    stamped = [(pose.stamp - begin, pose.position[:2]) for pose in poses if isinstance(pose, Pose)]
    return Track(np.array([t for t, _ in stamped]) * 1e-9, np.array([position for _, position in stamped]))


def said_by_chip(sample: Imu) -> Hashable:
    """What the chip can say of a sample: its counts, no two times the same on a walk."""
    assert sample.linear_accel is not None
    assert sample.orientation is not None
    return (
        tuple(round(value / GYRO_STEP) for value in sample.gyro),
        tuple(round(value / ACCEL_STEP) for value in sample.linear_accel),
        tuple(round(value / QUATERNION_STEP) for value in sample.orientation),
    )


def said(path: Path) -> list[tuple[Hashable, Sample]]:
    """What both devices said in a recording, in order of the stamps, with what tells one sample from the others."""
    with Recording(path) as recording:
        decoded = [found.decoded() for found in recording.samples([("imu", "imu"), ("radar", "frame")])]
    return [
        (said_by_chip(sample) if isinstance(sample, Imu) else sample.scans.tobytes(), sample)
        for sample in decoded
        if isinstance(sample, Imu | RadarFrame)
    ]


def heard_part(walk: Path, live: Path, out: Path) -> dict[type[Sample], float]:
    """Write to `out` what of `walk` was heard live, stamps as they were; how much of each that is."""
    recorded, came = said(walk), said(live)
    heard = {key for key, _ in came}
    places = {key: place for place, (key, _) in enumerate(recorded)}
    for kind in (Imu, RadarFrame):
        order = [places[key] for key, sample in came if isinstance(sample, kind)]  # each is a recorded one
        assert all(a < b for a, b in pairwise(order)), "in the order of the recording, none twice"
    with Recording(walk) as recording:
        rig = recording.rig
    counts: dict[type[Sample], int] = {Imu: 0, RadarFrame: 0}
    with RecordingWriter(out, flow="cane", source="simulated", rig=rig) as writer:
        for key, sample in recorded:
            if key not in heard:
                continue
            kind = Imu if isinstance(sample, Imu) else RadarFrame
            name = sample_key("cane", "imu", "imu") if kind is Imu else sample_key("cane", "radar", "frame")
            seq = counts[kind]
            writer.write(name, kind, numbered(sample, seq), stamp=sample.stamp, seq=seq, log_time=sample.stamp)
            counts[kind] += 1
    return {kind: count / (len(recorded) / 2) for kind, count in counts.items()}


def read_late(walk: Path, live: Path) -> float:
    """How much later than the soonest one in twenty values was read, s."""
    stamps = {key: sample.stamp for key, sample in said(walk)}
    delays = [sample.stamp - stamps[key] for key, sample in said(live) if isinstance(sample, Imu)]
    return float(np.quantile(delays, 0.95) - min(delays)) * 1e-9


def apart(live: Track, replayed: Track) -> tuple[float, float]:
    """The largest distance between the tracks from where both have begun, and the way walked; m."""
    t0, t1 = max(live.times[0], replayed.times[0]), min(live.times[-1], replayed.times[-1])
    times = np.arange(t0, t1, 0.01)

    def way(of: Track) -> NDArray[np.float64]:
        at = np.column_stack([np.interp(times, of.times, of.positions[:, axis]) for axis in (0, 1)])
        return np.asarray(at - at[0])

    walked = float(np.linalg.norm(np.diff(way(replayed), axis=0), axis=1).sum())
    return float(np.linalg.norm(way(live) - way(replayed), axis=1).max()), walked


class Desk(NamedTuple):
    """A recording, and a flow to play it to."""

    walk: Path
    begin: int  # ns, stamp of the recording's beginning
    flow: Path
    rig: tuple[object, ...]  # options that give a live run the recording's rig


@pytest.fixture
def desk(tmp_path: Path) -> Callable[[int], Desk]:
    def make(seconds: int) -> Desk:
        walk, rig, flow = (tmp_path / name for name in ("walk.mcap", "rig.yaml", "dataflow.yaml"))
        said_here("simulate", "walk", "--seed", 1, "--duration", seconds, "-o", walk)
        with Recording(walk) as recording:
            span = recording.span()
            rig.write_text(str(recording.rig))
        assert span is not None
        name = "t" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]
        flow.write_text((ROOT / "dataflow.yaml").read_text().replace("flow: cane", f"flow: {name}"))
        return Desk(walk, span[0], flow, ("--rig", rig))

    return make


class Lived(NamedTuple):
    """What became of a live run."""

    begin: int  # ns, when the recording began to be played
    shares: dict[str, float]  # of a core, by driver
    said: str  # by the flow


def live(
    start: Callable[..., "subprocess.Popen[str]"],
    desk: Desk,
    out: Path,
    chip_faults: tuple[str, ...] = (),
    radar_faults: tuple[str, ...] = (),
) -> Lived:
    """Play the recording as both devices to the flow, and record that."""
    port, radar_port = out.with_name("tty"), _free_udp_port()
    devices = {"imu.port": port, "imu.start_timeout_s": DEADLINE, "radar.host": "127.0.0.1", "radar.port": radar_port}
    chosen = [part for key, value in devices.items() for part in ("--set", f"{key}={value}")]
    running = start("run", desk.flow, *desk.rig, *chosen, "--record", out)
    printed_first = lines_until(running, r"imu \|.*tries again", r"radar \|.*asking on")  # both drivers are up
    before, since = _cpu_times(running.pid), time.monotonic()
    run_to_its_end("emulate", "p440", "--help")
    lead = LEAD + STARTS * (time.monotonic() - since)
    begin = time.time() + lead
    emulators = [
        start("emulate", "bno055", desk.walk, "--port", port, "--begin", begin, *chip_faults),
        start("emulate", "p440", desk.walk, "--port", radar_port, "--begin", begin, *radar_faults),
    ]
    for emulator in emulators:
        printed = emulator.communicate(timeout=2 * DEADLINE)[0]
        assert emulator.returncode == 0, printed
        assert "the recording is over" in printed
    took = time.monotonic() - since
    shares = {driver: (cpu - before[driver]) / took for driver, cpu in _cpu_times(running.pid).items()}
    running.send_signal(signal.SIGINT)
    printed = printed_first + running.communicate(timeout=DEADLINE)[0]
    assert running.returncode == 130, printed
    assert "Traceback" not in printed
    return Lived(round(begin * 1e9), shares, printed)


def _cpu_times(launcher: int) -> dict[str, float]:
    """Processor time (s) of each driver."""
    times = {}
    for node in node_processes(launcher).values():
        found = re.search(r"caneflow\.drivers\.(\w+)", " ".join(node.cmdline()))
        if found:
            times[found[1]] = sum(node.cpu_times()[:2])
    return times


@pytest.mark.timeout(400)  # a busy machine is not a failure
@pytest.mark.parametrize("seconds", [9, pytest.param(60, marks=pytest.mark.long)])
def test_live_gives_the_track_of_the_replay(
    seconds: int, desk: Callable[[int], Desk], tmp_path: Path, start: Callable[..., "subprocess.Popen[str]"]
) -> None:
    given = desk(seconds)
    out, heard, replayed = (tmp_path / name for name in ("live.mcap", "heard.mcap", "replayed.mcap"))
    lived = live(start, given, out)
    of_imu, of_radar = heard_part(given.walk, out, heard).values()
    assert of_imu > 0.5
    assert of_radar > 0.8
    replay = ("--in-process", "--record", replayed, "--overwrite")
    said_here("run", given.flow, *given.rig, "--replay", heard, *replay)
    distance, walked = apart(track(out, lived.begin), track(replayed, given.begin))
    assert walked > 0.3 * seconds
    late = max(read_late(given.walk, out) - READ_LATE, 0.0) * TURNING
    assert distance < APART + (APART_OF_WAY + late) * walked, f"{late} rad late"
    if min(of_imu, of_radar) > NEARLY_ALL:
        said_here("run", given.flow, *given.rig, "--replay", given.walk, *replay)
        distance, walked = apart(track(out, lived.begin), track(replayed, given.begin))
        assert distance < APART + (MISSING_APART_OF_WAY + late) * walked, f"{late} rad late"
    assert "samples equal in every byte" in said_here("verify", given.flow, out)


@pytest.mark.long
@pytest.mark.timeout(400)
def test_a_minute_with_faults(
    desk: Callable[[int], Desk], tmp_path: Path, start: Callable[..., "subprocess.Popen[str]"]
) -> None:
    """5 % overruns, 2 % of the datagrams lost, both devices unplugged for 3 s: dropped, counted, gone on with."""
    given, out = desk(60), tmp_path / "live.mcap"
    lived = live(start, given, out, ("--overruns", "5%", "--unplug", "20:3"), ("--loss", "2%", "--unplug", "40:3"))
    with Recording(out) as recording:
        stamps: dict[str, list[float]] = {"imu": [], "frame": [], "speed": [], "pose": []}
        for found in recording.samples():
            if found.port in stamps:
                stamps[found.port].append((found.stamp - lived.begin) * 1e-9)
    for port, (at, lasts) in {"imu": (20.0, 3.0), "frame": (40.0, 3.0)}.items():
        steps = np.diff(stamps[port])
        gap = int(steps.argmax())
        assert stamps[port][gap] == pytest.approx(at, abs=0.1)
        assert lasts < steps[gap] < lasts + 1.0, "data within a second of the return, and the gap is visible"
    assert 0.95 * 5700 < len(stamps["frame"]) < 0.99 * 5700, "2 % of the scans, of one datagram each, are dropped"
    assert len(stamps["speed"]) == len(stamps["frame"]), "the speed goes on"
    assert re.search(r"radar \|.* scans lost, ", lived.said)
    assert re.search(r"imu \|.* overruns", lived.said)
    assert max(lived.shares.values()) < 0.15, lived.shares


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
