"""The MPU-9250's driver and operators.attitude as a running flow; the chip is an emulated one on its bus."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from caneflow.algorithms.rotations import Quaternion, conjugate, from_rotation_vector, rotate
from caneflow.messages import Imu
from caneflow.recording import Recording

DEADLINE = 60.0  # s
SECONDS = 3.0

# A program of one's own: the driver, with an emulated bus in the place of /dev/i2c-1 for as long as the motion lasts.
BELT = """
import time
from contextlib import contextmanager
from itertools import takewhile

import numpy as np

from caneflow.algorithms.rotations import conjugate, from_rotation_vector, rotate
from caneflow.drivers import mpu9250
from caneflow.protocols.mpu9250_emulator import Emulator, Faults, Motion
from caneflow.runtime.node import run

SECONDS = {seconds}
WITH = dict(refusals=0.02)
TURN = 0.8  # rad/s about the vertical
TILT = from_rotation_vector((0.3, -0.2, 0.0))


def motion():
    times = [0.001 * i for i in range(round(1000 * (SECONDS + 1)))]
    gyro, accel, mag = [], [], []
    noise = np.random.default_rng(5).normal(0.0, 0.01, (len(times), 3))  # rad/s: without, the values would stand still
    for t, noisy in zip(times, noise):
        turned = from_rotation_vector((0.0, 0.0, TURN * t))
        def body(v): return rotate(conjugate(TILT), rotate(conjugate(turned), v))
        gyro.append(tuple(np.array(rotate(conjugate(TILT), (0.0, 0.0, TURN))) + noisy))
        accel.append(body((0.0, 0.0, 9.80665)))
        mag.append(body((0.0, 18.0, -45.0)))
    return Motion(times=times, gyro=gyro, accel=accel, mag=mag)


class Belt(mpu9250.Mpu9250):
    def samples(self):
        chip = Emulator(motion(), Faults(**WITH), np.random.default_rng(2), now=time.monotonic())

        @contextmanager
        def opened_bus(number):
            yield lambda address, data, length: chip.transfer(address, data, length, time.monotonic())

        mpu9250.opened_bus = opened_bus
        began = time.monotonic()
        for item in super().samples():
            if time.monotonic() > began + SECONDS:
                return
            yield item


if __name__ == "__main__":
    run(Belt)
"""

FLOW = """
flow: {flow}
nodes:
  imu: {{run: ./belt.py, settings: {{axes: "+x+y+z"}}}}
  attitude: {{run: operators.attitude, inputs: {{imu: imu/imu}}}}
results: [attitude/imu]
"""


def in_the_world(orientation: Quaternion | None, direction: tuple[float, float, float]) -> tuple[float, float, float]:
    """Where `direction` points that, with the chip as it was at first, is one of the world's."""
    assert orientation is not None
    tilt = from_rotation_vector((0.3, -0.2, 0.0))
    return rotate(orientation, rotate(conjugate(tilt), direction))


def imu_samples(path: Path, node: str) -> list[Imu]:
    with Recording(path) as recording:
        decoded = [found.decoded() for found in recording.samples([(node, "imu")])]
    return [sample for sample in decoded if isinstance(sample, Imu)]


def test_a_flow_gets_orientations_from_the_belt(tmp_path: Path) -> None:
    (tmp_path / "belt.py").write_text(BELT.format(seconds=SECONDS))
    (tmp_path / "flow.yaml").write_text(FLOW.format(flow="t" + tmp_path.name.replace("_", "")[-30:]))
    out = tmp_path / "out.mcap"
    done = subprocess.run(
        [sys.executable, "-m", "caneflow.command", "run", tmp_path / "flow.yaml", "--record", out],
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    raw, turned = imu_samples(out, "imu"), imu_samples(out, "attitude")
    assert len(raw) == len(turned) > 30 * SECONDS, "every sample of the driver came through, and they came"
    assert [sample.stamp for sample in raw] == [sample.stamp for sample in turned]
    assert all(sample.orientation is None for sample in raw)
    late = [sample for sample in turned if sample.stamp > turned[0].stamp + 1e9]
    for sample in late:
        assert in_the_world(sample.orientation, (0.0, 0.0, 1.0)) == pytest.approx((0.0, 0.0, 1.0), abs=0.03)
    ahead = np.array([in_the_world(sample.orientation, (1.0, 0.0, 0.0)) for sample in late])
    headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    times = np.array([sample.stamp for sample in late]) * 1e-9
    assert np.polyfit(times - times[0], headings, 1)[0] == pytest.approx(0.8, abs=0.02), "rad/s, as the chip turns"
