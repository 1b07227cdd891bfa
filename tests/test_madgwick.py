"""Madgwick's filter against its paper's matrices, its convergence rate, and turns whose end is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.algorithms import rotations
from caneflow.algorithms.inertial.initial_attitude import initial_attitude, level
from caneflow.algorithms.inertial.madgwick import Madgwick, MadgwickSettings, objective_gradient
from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, from_rotation_vector, multiply, rotate

PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000
STILL: Vector = (0.0, 0.0, 0.0)
UP: Vector = (0.0, 0.0, 9.80665)
FIELD: Vector = (0.0, 18.0, -45.0)  # uT, east north up: middle Europe

parts = st.floats(-1, 1)
quaternions = (
    st.tuples(parts, parts, parts, parts).filter(lambda q: sum(x * x for x in q) > 0.01).map(rotations.normalized)
)


def body(orientation: Quaternion, world: Vector) -> Vector:
    return rotate(conjugate(orientation), world)


def between(one: Quaternion, other: Quaternion) -> float:
    """The angle, rad, of the turn from one to the other."""
    w, x, y, z = multiply(conjugate(one), other)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def numerical_gradient(q: Quaternion, accel: Vector, mag: Vector | None) -> np.ndarray:
    """|f|^2 / 2 differentiated by differences, with f as in eq. 25 and 29: each a function of all four numbers."""
    reference = np.zeros(3)
    if mag is not None:
        east, north, vertical = rotate(q, _unit(mag))
        reference = np.array((0.0, math.hypot(east, north), vertical))

    def misfit(p: np.ndarray) -> float:
        w, x, y, z = p
        turned = np.array(  # R' with the squares as the paper has them: 1/2 - y^2 - z^2
            (
                (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
                (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
                (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
            )
        )
        f = turned @ (0, 0, 1) - _unit(accel)
        total = float(f @ f)
        if mag is not None:
            f = turned @ reference - _unit(mag)
            total += float(f @ f)
        return 0.5 * total

    steps = 1e-6 * np.eye(4)
    return np.array([(misfit(q + step) - misfit(q - step)) / 2e-6 for step in steps])


def _unit(vector: Vector) -> Vector:
    x, y, z = np.asarray(vector) / np.linalg.norm(vector)
    return float(x), float(y), float(z)


@given(q=quaternions, truth=quaternions, with_mag=st.booleans())
def test_the_step_is_the_gradient_of_the_papers_objective(q: Quaternion, truth: Quaternion, with_mag: bool) -> None:
    accel, mag = body(truth, UP), body(truth, FIELD) if with_mag else None
    assert objective_gradient(q, accel, mag) == pytest.approx(numerical_gradient(q, accel, mag), abs=1e-7)


@given(truth=quaternions)
def test_there_is_nothing_to_correct_where_the_attitude_is_right(truth: Quaternion) -> None:
    gradient = objective_gradient(truth, body(truth, UP), body(truth, FIELD))
    assert gradient == pytest.approx((0,) * 4, abs=1e-9)


def test_without_gain_a_turn_is_eulers_sum() -> None:
    """Adds dt/2 q * gyro and normalises: each step turns by 2 atan(w dt / 2), short of w dt by its cube / 12."""
    rate, steps = 1.0, 314
    madgwick = Madgwick(MadgwickSettings(gain=0.0))
    for k in range(steps + 1):
        orientation = madgwick.update(START_NS + k * PERIOD_NS, (0.0, 0.0, rate), UP).orientation
    w, _, _, z = orientation
    assert 2.0 * math.atan2(z, w) == pytest.approx(steps * 2.0 * math.atan(0.5 * rate * 0.01), abs=1e-9)


def test_an_inclination_error_falls_at_the_rate_of_the_gain() -> None:
    """A unit step in the quaternion turns by 2 rad, so at 2 beta rad/s, but for the part that points along q.

    For an error e about x the objective's gradient is 2 sin e across q and 8 sin^2(e/2) along it, by hand from
    eq. 25 and 26.
    """
    gain, error = 0.1, 0.5
    madgwick = Madgwick(MadgwickSettings(gain=gain))
    madgwick.update(START_NS, STILL, (0.0, 9.80665 * math.sin(error), 9.80665 * math.cos(error)))
    for k in range(1, 101):
        orientation = madgwick.update(START_NS + k * PERIOD_NS, STILL, UP).orientation
        error -= 0.01 * 2.0 * gain / math.hypot(1.0, 2.0 * math.tan(0.5 * error))
    assert math.acos(rotate(orientation, (0.0, 0.0, 1.0))[2]) == pytest.approx(error, rel=1e-3)
    for k in range(101, 401):
        orientation = madgwick.update(START_NS + k * PERIOD_NS, STILL, UP).orientation
    assert rotate(orientation, (0.0, 0.0, 1.0))[2] == pytest.approx(1.0, abs=1e-5)


def test_yaw_finds_magnetic_north() -> None:
    truth = from_rotation_vector((0.3, -0.5, 1.2))
    madgwick = Madgwick(MadgwickSettings(gain=0.1))
    wrong = multiply(rotations.from_yaw(0.4), initial_attitude(body(truth, UP), body(truth, FIELD)))
    madgwick.update(START_NS, STILL, body(wrong, UP), body(wrong, FIELD))
    for k in range(1, 1500):
        orientation = madgwick.update(START_NS + k * PERIOD_NS, STILL, body(truth, UP), body(truth, FIELD)).orientation
    assert rotate(orientation, body(truth, FIELD)) == pytest.approx(FIELD, abs=0.2)


def test_a_disturbed_field_turns_yaw_alone() -> None:
    """Eq. 45 and 46: the reference takes the dip from the reading."""
    madgwick = Madgwick(MadgwickSettings(gain=0.1))
    madgwick.update(START_NS, STILL, UP, FIELD)
    for k in range(1, 500):
        orientation = madgwick.update(START_NS + k * PERIOD_NS, STILL, UP, (12.0, 18.0, 20.0)).orientation
    assert rotate(orientation, (0.0, 0.0, 1.0))[2] == pytest.approx(1.0, abs=1e-6)
    assert abs(2.0 * math.atan2(orientation[3], orientation[0])) > 0.3


def test_the_bias_gain_finds_the_gyros_bias() -> None:
    bias = (0.02, -0.01, 0.015)
    madgwick = Madgwick(MadgwickSettings(gain=0.1, bias_gain=0.01))
    for k in range(6000):
        estimate = madgwick.update(START_NS + k * PERIOD_NS, bias, UP, FIELD)
    assert estimate.gyro_bias == pytest.approx(bias, abs=2e-3)


@given(yaw=st.floats(-3, 3), start=quaternions, truth=quaternions)
def test_a_world_turned_about_the_vertical_turns_the_step(yaw: float, start: Quaternion, truth: Quaternion) -> None:
    """Gravity does not know yaw: the whole estimate turns along, as the gyro's part (q * gyro) does anyway."""
    turn = rotations.from_yaw(yaw)
    step = objective_gradient(start, body(truth, UP), None)
    assert objective_gradient(multiply(turn, start), body(truth, UP), None) == pytest.approx(
        multiply(turn, step), abs=1e-9
    )


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0)])
def test_no_direction_is_no_start(vector: Vector) -> None:
    with pytest.raises(ValueError, match="does not tell what is up"):
        Madgwick(MadgwickSettings()).update(START_NS, STILL, vector)


def test_a_first_sample_without_accelerometer_is_refused_and_a_later_one_goes_on_by_gyro() -> None:
    madgwick = Madgwick(MadgwickSettings())
    with pytest.raises(ValueError, match="no accel"):
        madgwick.update(START_NS, STILL, None)
    madgwick.update(START_NS, STILL, UP)
    orientation = madgwick.update(START_NS + PERIOD_NS, (1.0, 0.0, 0.0), None).orientation
    assert between((1.0, 0.0, 0.0, 0.0), orientation) == pytest.approx(0.01, abs=1e-6)


def test_time_that_does_not_go_on_is_refused_and_a_gap_is_not_integrated() -> None:
    madgwick = Madgwick(MadgwickSettings())
    madgwick.update(START_NS, STILL, UP)
    with pytest.raises(ValueError, match="not after"):
        madgwick.update(START_NS, STILL, UP)
    orientation = madgwick.update(START_NS + 700_000_000, (1.0, 0.0, 0.0), UP).orientation
    assert madgwick.gaps == 1
    assert between((1.0, 0.0, 0.0, 0.0), orientation) == pytest.approx(0.0, abs=1e-9)


@given(q=quaternions)
def test_level_turns_a_specific_force_up_by_the_shortest_way(q: Quaternion) -> None:
    force = body(q, UP)
    tilt = level(force)
    assert rotate(tilt, force) == pytest.approx(UP, abs=1e-6)
    shortest = math.acos(max(-1.0, min(1.0, force[2] / 9.80665)))
    assert between((1.0, 0.0, 0.0, 0.0), tilt) == pytest.approx(shortest, abs=1e-5)


@given(q=quaternions)
def test_the_initial_attitude_has_gravity_up_and_the_field_north(q: Quaternion) -> None:
    start = initial_attitude(body(q, UP), body(q, FIELD))
    assert rotate(start, body(q, UP)) == pytest.approx(UP, abs=1e-6)
    assert rotate(start, body(q, FIELD)) == pytest.approx(FIELD, abs=1e-5)
    assert between(q, start) == pytest.approx(0.0, abs=1e-5)
