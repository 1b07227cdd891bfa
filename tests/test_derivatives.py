"""Derivatives that filters use, against differences; and signs of what turns about the sensors."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.cane.cane_filter import CaneFilter, CaneFilterSettings, _Pointing
from caneflow.algorithms.cane.heading_hypotheses import HeadingHypotheses, HeadingSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_tracking import Echo, RoomStart, StaticSensor
from caneflow.algorithms.rotations import conjugate, from_yaw, rotate

Floats = NDArray[np.float64]
STEP = 1e-5
SENSORS = {
    "south": StaticSensor(position=(4.0, -2.5), azimuth=1.3, k=2.0),
    "west": StaticSensor(position=(-2.5, 4.0), azimuth=0.2, k=0.5),
}
STATE = (5.0, 3.0, 0.7, -0.4, 0.1, 0.2, 1.5, -0.5)  # x y u v beta gamma b b, see room_ekf


class Looking(RoomEkf):
    """Keeps the derivative and the residual of what it is told, and believes none of it."""

    def _correct_robustly(self, h: Floats, residual: float, noise: float, spread: float = 0.0) -> None:
        self.seen = h, residual


def told(state: Floats, what: str, sensor: str) -> tuple[Floats, float]:
    """Derivative and residual of one kind of measurement at a state."""
    start = RoomStart(guess=(5.0, 3.0))
    looking: Any = Looking(replace(RoomEkfSettings(), use_heading=False), SENSORS, start)
    looking.state = state
    if what == "strength":
        looking._take_strength(sensor, -20.0)
    elif what == "range":
        looking._take_range(SENSORS[sensor], 4.0)
    else:
        echo = Echo(stamp_ns=1, valid=True, range_rate=0.3)
        looking.take_speed(sensor, echo)
    h, residual = looking.seen
    return h, residual


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("what", ["strength", "range", "speed"])
def test_what_a_sensor_would_see_changes_with_the_state_as_its_derivative_says(what: str, sensor: str) -> None:
    state = np.array(STATE)
    h, _ = told(state, what, sensor)
    for place in range(len(state)):
        higher, lower = state.copy(), state.copy()
        higher[place] += STEP
        lower[place] -= STEP
        change = (told(lower, what, sensor)[1] - told(higher, what, sensor)[1]) / (2 * STEP)
        assert h[place] == pytest.approx(change, abs=1e-6), f"state {place}"


def test_an_antenna_that_goes_round_the_imu_moves_nobody() -> None:
    """On the spot at 60 deg/s, the antenna 0.3 m right of the boresight: it goes at 0.31 m/s, the IMU at none."""
    antenna, rate = (0.3, 0.0, 0.0), math.radians(60)
    settings = CaneFilterSettings(hand_ahead=0.0)  # the hand stays where it is as well
    cane = CaneFilter(settings, boresight=(0.0, 1.0, 0.0), pivot=(0.0, 0.0, 0.0), antenna=antenna)
    estimate = None
    for index in range(600):
        stamp_ns = 10_000_000 * (index + 1)
        turning = index >= 100
        orientation = from_yaw(rate * max(index - 100, 0) * 0.01)
        gyro = (0.0, 0.0, rate if turning else 0.0)
        field = rotate(conjugate(orientation), (0.0, 20.0, -40.0))
        reading = ImuReading(gyro, (0.0, 0.0, 9.80665), field, orientation=orientation)
        estimate = cane.imu(stamp_ns, reading)
        forward = rate * antenna[0] if turning else 0.0  # omega x r, along the boresight
        cane.velocity(stamp_ns, (forward, 0.0), (1e-3, 0.0, 1e6), 0.0)
    assert estimate is not None
    assert math.hypot(*estimate.position[:2]) < 0.02


def test_tracks_made_again_from_knots_are_those_that_grew_step_by_step() -> None:
    """A knot's way is turned by the yaw of its middle: by that of its start it would be 5 cm off after 27 m."""
    hypotheses: Any = HeadingHypotheses(HeadingSettings(knot_interval=1.0, largest_bias=math.radians(0.3)))
    for step in range(600):
        yaw = 0.01 * step
        hypotheses.move(0.1, 0.01, 0.045 * math.cos(yaw), 0.045 * math.sin(yaw))
        if step % 10 == 9:
            hypotheses.field(0.0, from_chip=False)
            hypotheses.advance(0.0)
    biases, tracks = hypotheses._biases.copy(), hypotheses._tracks.copy()
    hypotheses._rebuild(hypotheses._knots)
    scales = len(biases) // len(np.unique(biases))
    for scale in range(scales):
        grew = np.interp(hypotheses._biases[scale::scales], biases[scale::scales], tracks[scale::scales])
        inside = np.abs(hypotheses._biases[scale::scales]) <= np.abs(biases).max()
        assert np.abs(hypotheses._tracks[scale::scales] - grew)[inside].max() < 0.02


@pytest.mark.parametrize("beta", [-0.1, 0.1])
def test_the_angle_between_where_a_cane_points_and_its_bearer_walks_is_learnt(beta: float) -> None:
    """A radar that sees both components at 1 m/s; a rule of the wrong sign would settle at a third of the angle."""
    cane: Any = CaneFilter(CaneFilterSettings(), boresight=(0.0, 1.0, 0.0), pivot=(0.0, 0.0, 0.0))
    bob = 0.5  # m/s^2, up and down: who walks does
    for index in range(3000):
        stamp_ns = 10_000_000 * (index + 1)
        up = bob * math.sin(0.12 * index)
        reading = ImuReading(
            (0.0, 0.0, 0.0), mag=(0.0, 20.0, -40.0), orientation=from_yaw(0.0), linear_accel=(0.0, 0.0, up)
        )
        cane.imu(stamp_ns, reading)
        cane.velocity(stamp_ns, (math.cos(beta), math.sin(beta)), (1e-4, 0.0, 1e-4), 0.0)
    assert cane._motion.pointing == pytest.approx(beta, abs=0.02)


@pytest.mark.parametrize("after", [0.05, 5.0, 3600.0])
def test_what_wanders_about_zero_stays_as_uncertain_as_it_is_when_nothing_is_seen(after: float) -> None:
    """The yaw's error and each sensor's error of strength are of first order: q = (1 - f^2) s^2 keeps s^2."""
    settings = RoomEkfSettings()
    tracker: Any = RoomEkf(settings, SENSORS, RoomStart(guess=(5.0, 3.0)))
    variances = [settings.yaw_error**2, *[settings.bias_error**2] * len(SENSORS)]
    places = [4, *(tracker._place[name] for name in SENSORS)]  # see STATE
    for place, variance in zip(places, variances, strict=True):
        tracker.covariance[place, place] = variance
    tracker._now_ns = 0
    _, covariance = tracker._predicted(round(after * 1e9), moving=False)
    assert covariance[places, places].tolist() == pytest.approx(variances)


def test_a_cane_that_turns_through_south_turns_by_what_it_turned() -> None:
    """Yaw goes from pi to -pi; the mean yaw follows at its rate, the mean square of the rate is that."""
    pointing: Any = _Pointing(memory=1.0)
    rate = 0.5  # rad/s
    for index in range(2000):
        yaw = math.remainder(rate * 0.01 * index, 2 * math.pi)
        assert index == 0 or pointing.update(0.01, yaw) == pytest.approx(rate * 0.01)
        pointing.update(0.0, yaw)
    assert pointing.rate == pytest.approx(rate, rel=1e-3)
    assert pointing.turning == pytest.approx(rate**2, rel=1e-3)
