"""Naive inertial navigation against the closed forms of constant acceleration."""

import math

import numpy as np
import pytest

from caneflow.algorithms import rotations
from caneflow.algorithms.cane.naive_ins import NaiveIns, NaiveInsSettings
from caneflow.algorithms.imu_reading import ImuReading

Vector = rotations.Vector
STILL: Vector = (0.0, 0.0, 0.0)
START_NS = 1_700_000_000_000_000_000


def test_a_constant_acceleration_gives_half_a_t_squared_at_any_intervals() -> None:
    rng = np.random.default_rng(1)
    # one of the intervals is a gap: naive means that it is integrated like any other
    intervals = [0, *rng.integers(1_000_000, 40_000_000, 300).tolist(), 900_000_000]
    ins, stamp = NaiveIns(NaiveInsSettings()), START_NS
    for interval in intervals:
        stamp += interval
        end = ins.imu(stamp, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=(0.07, -0.3, 0.01)))
    t = (stamp - START_NS) * 1e-9
    assert end.velocity == pytest.approx((0.07 * t, -0.3 * t, 0.01 * t))
    assert end.position == pytest.approx((0.035 * t * t, -0.15 * t * t, 0.005 * t * t))
    assert end.covariance is None
    assert ins.gaps == 1


def test_the_acceleration_is_turned_into_the_world() -> None:
    """Body x at a yaw of 90 degrees is world y; body z of a cane on its back points down."""
    on_its_back = rotations.multiply(
        rotations.from_yaw(math.pi / 2), rotations.from_rotation_vector((math.pi, 0.0, 0.0))
    )
    ins = NaiveIns(NaiveInsSettings())
    for k in range(101):
        end = ins.imu(
            START_NS + k * 10_000_000, ImuReading(STILL, orientation=on_its_back, linear_accel=(1.0, 0.0, 2.0))
        )
    assert end.position == pytest.approx((0.0, 0.5, -1.0), abs=1e-9)
    assert end.orientation == on_its_back


def test_a_sine_of_motion_comes_back() -> None:
    """The motion sin(t), from its acceleration -sin(t) and the velocity 1 that naive navigation cannot know."""
    ins = NaiveIns(NaiveInsSettings())
    for k in range(1001):
        t = 0.01 * k
        end = ins.imu(
            START_NS + k * 10_000_000,
            ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=(-math.sin(t), 0.0, 0.0)),
        )
        assert end.position[0] == pytest.approx(math.sin(t) - t, abs=1e-3)


def test_the_radar_is_not_used() -> None:
    ins = NaiveIns(NaiveInsSettings())
    for k in range(100):
        ins.speed(START_NS + k * 10_000_000, 1.0, 0.01, True, 0.3)
        end = ins.imu(START_NS + k * 10_000_000, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    assert end.position == STILL


def test_accel_less_gravity_serves_where_the_chip_gives_no_linear_acceleration() -> None:
    ins = NaiveIns(NaiveInsSettings())
    for k in range(101):
        end = ins.imu(START_NS + k * 10_000_000, ImuReading(STILL, (0.0, 0.0, 9.80665), orientation=rotations.IDENTITY))
    assert end.position == pytest.approx(STILL, abs=1e-12)


def test_what_is_missing_is_named() -> None:
    ins = NaiveIns(NaiveInsSettings())
    with pytest.raises(ValueError, match=r"naive_ins: the imu sample has no orientation; it needs"):
        ins.imu(START_NS, ImuReading(STILL, STILL, linear_accel=STILL))
    with pytest.raises(ValueError, match="neither linear_accel nor accel"):
        ins.imu(START_NS, ImuReading(STILL, orientation=rotations.IDENTITY))
