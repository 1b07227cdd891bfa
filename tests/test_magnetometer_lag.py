"""A magnetometer that answers late shows in how its field sways while the body turns; it is read as if it did not."""

import math

import numpy as np
import pytest

from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.magnetometer_lag import LARGEST_LAG, MagnetometerLag
from caneflow.algorithms.rotations import Vector, rotate
from tests.test_attitude_filter import DEGREE, FIELD, PERIOD, START_NS, UP, body, rate_of, sway, yaw_error


def learnt(lag: float, *, noise: float = 0.0, seconds: float = 120.0) -> float:
    """What is learnt of a lag (s) in a sway, from readings with white noise of `noise` uT."""
    found, random = MagnetometerLag(), np.random.default_rng(1)
    for k in range(round(seconds / PERIOD)):
        t = k * PERIOD
        x, y, z = body(sway(t - lag), FIELD)
        a, b, c = random.normal(0.0, noise, 3).tolist()
        found.learn(rotate(sway(t), (x + a, y + b, z + c)), rotate(sway(t), rate_of(sway, t)), PERIOD)
    return found.lag


@pytest.mark.parametrize("lag", [0.0, 0.005, 0.015, -0.004])
def test_a_lag_is_found(lag: float) -> None:
    """To within half a sample: a turn rate is that of the interval before."""
    assert learnt(lag) == pytest.approx(lag, abs=1.5e-3)
    assert learnt(lag, noise=1.0) == pytest.approx(lag, abs=2e-3)


def test_who_does_not_turn_learns_nothing_and_nothing_is_believed_beyond_the_bound() -> None:
    found = MagnetometerLag()
    for k in range(1000):
        found.learn((0.1 * math.sin(0.1 * k), 18.0, -45.0), (0.0, 0.0, 0.0), PERIOD)
    assert found.lag == 0.0
    assert learnt(0.2) == pytest.approx(LARGEST_LAG)


def test_a_reading_without_its_lag_is_the_field_of_now() -> None:
    found = MagnetometerLag()
    found.lag = 0.015
    rate: Vector = (1.0, -6.0, 3.0)

    x, y, z = found.taken_off(FIELD, rate)
    expected = rotate((1.0, -0.5 * 0.015, 0.5 * 0.015 * 6.0, -0.5 * 0.015 * 3.0), FIELD)  # a small turn back
    np.testing.assert_allclose((x, y, z), expected, atol=0.3)
    assert math.hypot(x, y, z) == pytest.approx(math.hypot(*FIELD))


def test_the_attitude_of_a_sway_is_as_good_as_without_the_lag() -> None:
    """15 ms at up to 260 degrees/s are 4 degrees, and would be 3 of heading where the field dips."""

    def worst(lag: float) -> float:
        attitude = AttitudeFilter(AttitudeFilterSettings())
        errors = []
        for k in range(6000):
            t = k * PERIOD
            readings = rate_of(sway, t), body(sway(t), UP), body(sway(t - lag), FIELD)
            estimate = attitude.update(START_NS + round(t * 1e9), *readings)
            errors.append(abs(yaw_error(estimate.orientation, sway(t))))
        return max(errors[3000:])

    assert worst(0.015) < worst(0.0) + 0.3 * DEGREE
