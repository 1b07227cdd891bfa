"""`caneflow emulate bno055` and the live driver as real processes over a real pseudo-terminal."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil
import pytest
import typer
from typer.testing import CliRunner

from caneflow.messages import Imu, numbered, sample_key
from caneflow.protocols.bno055 import ACCEL_STEP, GYRO_STEP, MAG_STEP, QUATERNION_STEP
from caneflow.recording import Recording, RecordingWriter
from tests.flows import node_processes
from tools.emulate import bno055

CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DEADLINE = 30.0  # s for anything that is waited for
SECONDS = 6.0
STAMP = 1_700_000_000_000_000_000  # ns

FLOW = """
flow: {flow}
nodes:
  imu: {{run: drivers.bno055, settings: {{port: {port}, calibration_file: {folder}/calibration.json}}}}
results: [imu/imu]
"""


def recorded(path: Path, *, orientation: bool = True) -> Path:
    """`SECONDS` of values that a BNO055 could have said, no two the same."""
    rng = np.random.default_rng(6)
    with RecordingWriter(path, flow="cane", source="simulated", rig={}) as writer:
        for seq in range(round(SECONDS * 100)):
            stamp = STAMP + seq * 10_000_000
            angle = 0.002 * seq
            quaternion = np.rint(np.array([np.cos(angle), 0.0, np.sin(angle), 0.0]) / QUATERNION_STEP) * QUATERNION_STEP
            imu = Imu(
                stamp=stamp,
                gyro=(rng.integers(-900, 900, 3) * GYRO_STEP).tolist(),
                accel=(rng.integers(-900, 900, 3) * ACCEL_STEP).tolist(),
                mag=(rng.integers(-900, 900, 3) * MAG_STEP).tolist(),
                orientation=quaternion.tolist() if orientation else None,
                linear_accel=(rng.integers(-900, 900, 3) * ACCEL_STEP).tolist(),
                calibration=(2, 3, 3, 3),
            )
            key = sample_key("cane", "imu", "imu")
            writer.write(key, Imu, numbered(imu, seq), stamp=stamp, seq=seq, log_time=stamp)
    return path


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("walk") / "walk.mcap")


@pytest.fixture
def start() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    started: list[subprocess.Popen[str]] = []

    def start(*args: object) -> "subprocess.Popen[str]":
        command = [*CANEFLOW, *map(str, args)]
        started.append(
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)  # ended below
        )
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_for(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, f"waited {DEADLINE} s for {what}"
        time.sleep(0.02)


def ended(process: "subprocess.Popen[str]", number: int) -> str:
    """What a process printed, when the signal has ended it."""
    process.send_signal(number)
    return process.communicate(timeout=DEADLINE)[0]


def values(sample: Imu) -> tuple[object, ...]:
    return sample.gyro, sample.accel, sample.mag, sample.orientation, sample.linear_accel, sample.calibration


def imu_samples(path: Path) -> list[Imu]:
    with Recording(path) as recording:
        decoded = [found.decoded() for found in recording.samples([("imu", "imu")])]
    return [sample for sample in decoded if isinstance(sample, Imu)]


def driver_of(launcher: int) -> psutil.Process:
    """The driver's process, once the launcher has started it."""
    found: list[psutil.Process] = []

    def there() -> bool:
        nodes = node_processes(launcher).values()
        found.extend(node for node in nodes if "caneflow.drivers.bno055" in " ".join(node.cmdline()))
        return bool(found)

    wait_for(there, "the driver")
    return found[0]


@pytest.mark.long  # real time at 100 Hz: a machine that is busy with other tests misses samples
def test_live_is_what_was_recorded_and_survives_the_cable(
    walk: Path, tmp_path: Path, start: Callable[..., "subprocess.Popen[str]"]
) -> None:
    port, out, file = tmp_path / "tty", tmp_path / "out.mcap", tmp_path / "flow.yaml"
    flow = "t" + re.sub(r"\W", "", tmp_path.name).lower()[-40:]
    file.write_text(FLOW.format(flow=flow, port=port, folder=tmp_path))
    emulator = start("emulate", "bno055", walk, "--port", port, "--overruns", 0.02, "--unplug", "2:1")
    wait_for(port.exists, "the port")
    flow_process = start("run", file, "--record", out)
    driver = driver_of(flow_process.pid)
    wait_for(lambda: not port.exists(), "the cable's end")
    before, since = sum(driver.cpu_times()[:2]), time.monotonic()
    wait_for(port.exists, "the cable")
    time.sleep(1.7)  # the chip and its fusion start, and there are samples again
    share = (sum(driver.cpu_times()[:2]) - before) / (time.monotonic() - since)
    printed = ended(flow_process, signal.SIGINT)
    said = ended(emulator, signal.SIGTERM)
    assert flow_process.returncode == 130, printed
    assert not port.is_symlink(), "the emulator takes its port away"
    assert "unplugged for 1 s" in said
    assert "plugged in again" in said

    place_of = {values(sample): place for place, sample in enumerate(imu_samples(walk))}
    got = imu_samples(out)
    places = [place_of[values(sample)] for sample in got]  # each is bit for bit a recorded one
    assert all(a < b for a, b in pairwise(places))
    steps = [(b.stamp - a.stamp) * 1e-9 for a, b in pairwise(got)]
    gap = max(steps)
    assert 1.0 < gap < 2.2, "a second without a cable, and less than a second to come back"
    cut = steps.index(gap) + 1
    missed = (places[cut - 1] - places[0] + 1 - cut) + (places[-1] - places[cut] + 1 - (len(got) - cut))
    assert missed < 0.1 * len(got), "few, though the machine is busy"
    lags = np.array([sample.stamp - STAMP - place * 10_000_000 for sample, place in zip(got, places, strict=True)])
    assert np.median(np.abs(lags - np.median(lags))) < 3e6, (
        "the stamps are the recording's, moved by one and the same time"
    )
    assert share < 0.15
    assert (tmp_path / "calibration.json").exists()
    assert "calibration saved" in printed
    assert "Traceback" not in printed


def test_doctor_looks_at_the_chip(walk: Path, tmp_path: Path, start: Callable[..., "subprocess.Popen[str]"]) -> None:
    port, file = tmp_path / "tty", tmp_path / "flow.yaml"
    file.write_text(FLOW.format(flow="doctored", port=port, folder=tmp_path))
    start("emulate", "bno055", walk, "--port", port)
    wait_for(port.exists, "the port")
    printed = start("doctor", "--devices", file, "--seconds", 0.5).communicate(timeout=DEADLINE)[0]
    assert f"imu: ok   BNO055 on {port}, software 3.11, idle, mode CONFIG" in printed
    assert re.search(r"imu: ok   46 bytes take \d+\.\d ms", printed)
    assert re.search(r"imu: (ok  |look) \d+\.\d Hz, jitter", printed)
    assert "imu: ok   calibration system 2, gyro 3, accelerometer 3, magnetometer 3 of 3" in printed
    # the recorded values are noise, so that gravity has no direction
    assert "one of the two is turned: see `axes`" in printed


def refused(*args: object) -> str:
    """The one line of an expected error."""
    app = typer.Typer()
    app.command()(bno055)
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code != 0
    return str(result.exception) if result.exit_code == 1 else result.output


def test_what_cannot_be_played_is_refused(walk: Path, tmp_path: Path) -> None:
    raw = recorded(tmp_path / "raw.mcap", orientation=False)
    occupied = tmp_path / "file"
    occupied.write_text("mine")
    assert "gave no orientation or no linear acceleration" in refused(raw)
    assert "no IMU belt/imu; there are imu/imu" in refused(walk, "--stream", "belt/imu")
    assert "is not an AT:FOR" in refused(walk, "--freeze", "3")
    assert "exists and is not an emulator's port" in refused(walk, "--port", occupied)
    assert occupied.read_text() == "mine"
