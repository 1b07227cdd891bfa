"""The attitude operator: one sample out per sample in, with an orientation in the rig's world."""

import math

import msgspec
import numpy as np
import pytest

from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.rotations import Vector, conjugate, from_rotation_vector, from_yaw, multiply, rotate
from caneflow.messages import Imu, decode, numbered
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Refused
from operators.attitude import Attitude, AttitudeSettings, Method

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
UP: Vector = (0.0, 0.0, 9.80665)
FIELD: Vector = (0.0, 18.0, -45.0)
METHODS: tuple[Method, ...] = ("attitude_filter", "madgwick")


def operator(**chosen: object) -> Attitude:
    context = Context(node="attitude", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(0))
    return Attitude(AttitudeSettings(**chosen), context)  # type: ignore[arg-type]  # each test names its own


def still(k: int, **more: object) -> Imu:
    held = from_rotation_vector((0.3, -0.2, 0.7))
    return Imu(
        stamp=START_NS + k * PERIOD_NS,
        gyro=(0.0, 0.0, 0.0),
        accel=rotate(conjugate(held), UP),
        mag=rotate(conjugate(held), FIELD),
        calibration=(3, 3, 3, 3),
        **more,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_raw_sample_gets_its_orientation_and_keeps_all_else(method: Method) -> None:
    attitude = operator(method=method)
    for k in range(300):
        sample = still(k)
        ((port, out),) = attitude.handle("imu", sample)
    assert port == "imu"
    assert isinstance(out, Imu)
    assert (out.stamp, out.gyro, out.accel, out.mag) == (sample.stamp, sample.gyro, sample.accel, sample.mag)
    assert out.calibration == sample.calibration
    assert out.orientation == pytest.approx(from_rotation_vector((0.3, -0.2, 0.7)), abs=1e-3)
    assert out.linear_accel == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    assert decode(numbered(out, 0), Imu).orientation == out.orientation


@pytest.mark.parametrize("method", METHODS)
def test_north_may_lie_anywhere_in_the_world(method: Method) -> None:
    """With magnetic north along x, everything is a quarter turn clockwise of the default."""
    ((_, out),) = operator(method=method, magnetic_north=0.0).handle("imu", still(0))
    expected = multiply(from_yaw(-0.5 * math.pi), from_rotation_vector((0.3, -0.2, 0.7)))
    assert isinstance(out, Imu)
    assert out.orientation is not None
    assert rotate(out.orientation, (1, 0, 0)) == pytest.approx(rotate(expected, (1, 0, 0)), abs=1e-3)


def test_the_magnetometer_can_be_left_out() -> None:
    ((_, out),) = operator(magnetometer=False, magnetic_north=1.0).handle("imu", still(0))
    ((_, without),) = operator().handle("imu", still(0).__class__(stamp=START_NS, gyro=(0, 0, 0), accel=still(0).accel))
    assert isinstance(out, Imu)
    assert isinstance(without, Imu)
    assert out.orientation == pytest.approx(without.orientation)


def test_an_orientation_of_the_chip_is_replaced() -> None:
    attitude = operator()
    sample = still(0, orientation=(0.0, 1.0, 0.0, 0.0), linear_accel=(9.0, 9.0, 9.0))
    ((_, out),) = attitude.handle("imu", sample)
    assert isinstance(out, Imu)
    assert out.orientation == pytest.approx(from_rotation_vector((0.3, -0.2, 0.7)), abs=1e-3)
    assert out.linear_accel == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_wild_sample_changes_neither_attitude_nor_linear_acceleration(method: Method) -> None:
    attitude = operator(method=method)
    for k in range(60):
        sample = still(k)
        if k == 50:
            sample = msgspec.structs.replace(sample, gyro=(0, 90, 0), accel=(0.0, -4000.0, 0.0), mag=(9e3, 0.0, 0.0))
        ((_, out),) = attitude.handle("imu", sample)
        assert isinstance(out, Imu)
        assert out.orientation == pytest.approx(from_rotation_vector((0.3, -0.2, 0.7)), abs=1e-3)
        assert out.linear_accel == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
        assert (out.gyro, out.accel, out.mag) == (sample.gyro, sample.accel, sample.mag), "as the sensor said"


def test_how_much_is_wild_can_be_said() -> None:
    attitude = operator(glitches=GlitchSettings(acceleration=1e4))
    for k in range(60):
        ((_, out),) = attitude.handle(
            "imu", msgspec.structs.replace(still(k), accel=(0.0, 0.0, 9.8 + 50.0 * (k == 50)))
        )
        assert isinstance(out, Imu)
        assert out.linear_accel is not None
        assert out.linear_accel[2] == pytest.approx(50.0 * (k == 50), abs=0.1)


def test_a_sample_that_cannot_be_used_is_refused_and_the_next_one_goes_on() -> None:
    attitude = operator()
    with pytest.raises(Refused, match="no accel"):
        list(attitude.handle("imu", Imu(stamp=START_NS, gyro=(0, 0, 0))))
    assert len(list(attitude.handle("imu", still(1)))) == 1
    with pytest.raises(Refused, match="not after"):
        list(attitude.handle("imu", still(0)))
    ((_, out),) = attitude.handle("imu", Imu(stamp=START_NS + 5 * PERIOD_NS, gyro=(0, 0, 0)))
    assert isinstance(out, Imu)
    assert out.orientation is not None
    assert out.linear_accel is None
