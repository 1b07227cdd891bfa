"""Yaw by the gyro beside a chip whose yaw is pulled, and the bias of the level axes."""

import math

import pytest

from caneflow.algorithms.inertial.gyro_yaw import GyroYaw
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    from_yaw,
    multiply,
    rotate,
)

PITCHED = from_rotation_vector((-0.7, 0.0, 0.0))


def held(yaw: float, nod: float = 0.0) -> Quaternion:
    return multiply(from_yaw(yaw), multiply(from_rotation_vector((nod, 0.0, 0.0)), PITCHED))


def body_rate(before: Quaternion, after: Quaternion, interval: float) -> Vector:
    w, x, y, z = multiply(conjugate(before), after)
    return 2 * x / w / interval, 2 * y / w / interval, 2 * z / w / interval


def test_offset_is_what_the_magnetic_field_pulled_the_chip() -> None:
    """The cane swings and nods; the chip's yaw is pulled by 8 deg on the way."""
    yaw = GyroYaw()
    true, chip = held(0.3), held(0.3)
    rate: Vector = (0.0, 0.0, 0.0)
    yaw.update(0.0, chip, rate, math.cos(0.3), math.sin(0.3))
    for step in range(1, 2001):
        t = step * 0.01
        swing = 0.3 + 0.3 * math.sin(3 * t)
        before, true = true, held(swing, 0.05 * math.sin(5 * t))
        pulled = math.radians(8) * min(t / 15, 1.0)
        chip = multiply(from_yaw(pulled), true)
        midway = body_rate(before, true, 0.01)
        # what the gyro reads at the sample is what makes the trapezium exact
        rate = (2 * midway[0] - rate[0], 2 * midway[1] - rate[1], 2 * midway[2] - rate[2])
        yaw.update(0.01, chip, rate, math.cos(swing + pulled), math.sin(swing + pulled))
    assert yaw.offset == pytest.approx(-math.radians(8), abs=math.radians(0.05))


def test_level_axes_show_their_bias() -> None:
    yaw = GyroYaw()
    orientation = held(0.0)  # boresight's yaw is 90 deg: along is y0, across is -x0
    level = rotate(conjugate(orientation), (-0.002, 0.001, 0.0))
    for step in range(1001):
        yaw.update(0.01 if step else 0.0, orientation, level, 0.0, 1.0)
    biases = yaw.level_biases()
    assert biases is not None
    across, across_sd, along, along_sd = biases
    assert (across, along) == pytest.approx((0.002, 0.001), rel=1e-6)
    assert 0.0 < across_sd < along_sd < 0.002
    assert yaw.offset == pytest.approx(0.0, abs=1e-9)


def test_over_a_gap_the_chips_yaw_holds() -> None:
    yaw = GyroYaw()
    yaw.update(0.0, held(0.0), (0.0, 0.0, 0.0), 0.0, 1.0)
    yaw.update(0.0, held(1.0), (0.0, 0.0, 0.0), 0.0, 1.0)
    assert yaw.offset == 0.0
    assert yaw.level_biases() is None


@pytest.mark.parametrize("wild", ["gyro", "orientation"])
@pytest.mark.parametrize("interval", [0.0, 0.01])
def test_a_wild_sample_at_the_start_or_after_a_gap_turns_nothing(wild: str, interval: float) -> None:
    yaw = GyroYaw()
    if interval == 0.0:  # after a gap
        yaw.update(0.0, held(0.0), (0.0, 0.0, 0.0), 0.0, 1.0)
    gyro: Vector = (0.0, 35.7, 35.7) if wild == "gyro" else (0.0, 0.0, 0.0)
    yaw.update(0.0, held(0.4) if wild == "orientation" else held(0.0), gyro, 0.0, 1.0)
    for _ in range(3):
        yaw.update(0.01, held(0.0), (0.0, 0.0, 0.0), 0.0, 1.0)
    assert yaw.offset == 0.0
    assert yaw.level_biases() is None
