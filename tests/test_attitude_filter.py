"""The attitude filter against turns whose end is known, its low pass's formula, and what it must not believe."""

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from caneflow.algorithms import rotations
from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.gyro_bias import GyroBias, GyroBiasSettings, RestDetector
from caneflow.algorithms.inertial.initial_attitude import AttitudeEstimate, AttitudeMethod
from caneflow.algorithms.inertial.madgwick import Madgwick, MadgwickSettings
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    from_yaw,
    multiply,
    rotate,
)

Reading: TypeAlias = tuple[int, Vector, Vector | None, Vector | None]

PERIOD = 0.01  # s
PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000
STILL: Vector = (0.0, 0.0, 0.0)
GRAVITY = 9.80665
UP: Vector = (0.0, 0.0, GRAVITY)
FIELD: Vector = (0.0, 18.0, -45.0)  # uT, east north up: middle Europe
DEGREE = math.radians(1.0)


def body(orientation: Quaternion, world: Vector) -> Vector:
    return rotate(conjugate(orientation), world)


def between(one: Quaternion, other: Quaternion) -> float:
    """The angle, rad, of the turn from one to the other."""
    w, x, y, z = multiply(conjugate(one), other)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def inclination_error(estimate: Quaternion, truth: Quaternion) -> float:
    """The angle, rad, between where the two see up."""
    x, y, _ = rotate(estimate, body(truth, (0.0, 0.0, 1.0)))
    return math.asin(min(1.0, math.hypot(x, y)))


def yaw_error(estimate: Quaternion, truth: Quaternion) -> float:
    w, _, _, z = multiply(estimate, conjugate(truth))
    return rotations.wrapped(2.0 * math.atan2(z, w))


def sway(t: float) -> Quaternion:
    """A cane in a hand: +-40 deg about the vertical, a nod, a roll, none of them in step."""
    yaw = from_yaw(0.7 * math.sin(5.6 * t) + 0.2 * t)
    nod = from_rotation_vector((0.3 * math.sin(3.1 * t) - 0.6, 0.0, 0.0))
    roll = from_rotation_vector((0.0, 0.4 * math.sin(4.3 * t + 1.0), 0.0))
    return multiply(yaw, multiply(nod, roll))


def tumble(t: float) -> Quaternion:
    """Slowly through all attitudes."""
    pitch = from_rotation_vector((1.2 * math.sin(0.21 * t), 0.0, 0.0))
    return multiply(from_yaw(0.3 * t), multiply(pitch, from_rotation_vector((0.0, 0.37 * t, 0.0))))


def rate_of(motion: Callable[[float], Quaternion], t: float, interval: float = PERIOD) -> Vector:
    """rad/s, body: the mean over the interval before, as a gyro gives it that does not alias."""
    w, x, y, z = multiply(conjugate(motion(t - interval)), motion(t))
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / (sine * interval) if sine > 0.0 else 0.0
    return scale * x, scale * y, scale * z


def readings(
    motion: Callable[[float], Quaternion],
    seconds: float,
    *,
    bias: Vector = STILL,
    shaking: float = 0.0,
    field: Callable[[float], Vector] = lambda t: FIELD,
    start: float = 0.0,
) -> Iterator[Reading]:
    """What sensors without noise read; `shaking`: amplitude of a horizontal acceleration of 1 Hz, m/s^2."""
    for k in range(round(seconds / PERIOD)):
        t = start + k * PERIOD
        q = motion(t)
        p, r, s = rate_of(motion, t)
        force = shaking * math.sin(2.0 * math.pi * t), 0.5 * shaking * math.cos(2.0 * math.pi * t), GRAVITY
        gyro = p + bias[0], r + bias[1], s + bias[2]
        yield START_NS + round(t * 1e9), gyro, body(q, force), body(q, field(t))


def last(method: AttitudeMethod, samples: Iterator[Reading]) -> AttitudeEstimate:
    for stamp_ns, gyro, accel, mag in samples:
        estimate = method.update(stamp_ns, gyro, accel, mag)
    return estimate


def make(**chosen: float) -> AttitudeFilter:
    return AttitudeFilter(AttitudeFilterSettings(**chosen))  # type: ignore[arg-type]  # one float setting so far


rates = st.tuples(*[st.floats(-10, 10)] * 3)


@given(rate=rates)
@settings(max_examples=30, deadline=None)
def test_a_constant_turn_is_integrated_exactly(rate: Vector) -> None:
    attitude = make()
    start = attitude.update(START_NS, rate, UP).orientation
    for k in range(1, 101):
        orientation = attitude.update(START_NS + k * PERIOD_NS, rate, None).orientation
    x, y, z = rate
    assert between(orientation, multiply(start, from_rotation_vector((x, y, z)))) < 1e-9


def test_a_turn_that_speeds_up_is_integrated_exactly() -> None:
    """A reading is the mean turn rate since the one before; stamps that jitter change nothing."""
    attitude = make()
    stamps = np.cumsum(np.random.default_rng(1).uniform(2e6, 2e7, 200)).astype(np.int64).tolist()
    before = 0.0
    for stamp in stamps:
        seconds = (stamp - stamps[0]) * 1e-9
        accel = UP if stamp == stamps[0] else None
        orientation = attitude.update(stamp, (0.0, 0.0, 1.5 * (seconds + before)), accel).orientation
        before = seconds
    assert yaw_error(orientation, from_yaw(1.5 * seconds**2)) == pytest.approx(0.0, abs=1e-9)


def test_a_wrong_start_converges_to_gravity() -> None:
    """The first reading errs by 30 degrees; the mean of n readings by 1/n of that, and less after the low pass."""
    attitude = make()
    attitude.update(START_NS, STILL, (0.5 * GRAVITY, 0.0, 0.866 * GRAVITY), None)
    errors = []
    for k in range(1, 2001):
        orientation = attitude.update(START_NS + k * PERIOD_NS, STILL, UP).orientation
        errors.append(inclination_error(orientation, rotations.IDENTITY))
    assert errors[99] < 2.0 * DEGREE
    assert errors[-1] < 0.02 * DEGREE


def test_shaking_tilts_by_what_the_low_pass_lets_through() -> None:
    """a/g / sqrt(1 + (w T)^4 / 4) for an acceleration a at w, T the inclination time: Butterworth, order 2."""
    amplitude, time = 2.0, 3.0
    attitude = make(inclination_time=time)
    held = from_rotation_vector((0.4, -0.3, 0.0))
    tilts = [
        rotate(attitude.update(s, g, a).orientation, body(held, (0.0, 0.0, 1.0)))[0]
        for s, g, a, _ in readings(lambda t: held, 60.0, shaking=amplitude)
    ]
    through = amplitude / GRAVITY / math.sqrt(1.0 + 0.25 * (2.0 * math.pi * time) ** 4)
    settled = np.array(tilts[3000:])
    assert 0.5 * np.ptp(settled) == pytest.approx(through, rel=0.1)


def test_yaw_follows_north_with_its_time_constant() -> None:
    """A turn of the field by 5 degrees about the vertical: 1 - 1/e of it after the time constant."""
    attitude = AttitudeFilter(AttitudeFilterSettings())
    settle, step, time = 200.0, 5.0 * DEGREE, 20.0
    tilted = from_rotation_vector((0.3, 0.2, 0.0))

    def field(t: float) -> Vector:
        return rotate(from_yaw(step), FIELD) if t >= settle else FIELD

    estimate = last(attitude, readings(lambda t: tilted, settle + time, field=field))
    assert not attitude.disturbed
    moved = yaw_error(estimate.orientation, tilted)
    assert -moved == pytest.approx(step * (1.0 - math.exp(-1.0)), rel=0.05)


def test_a_sway_is_followed() -> None:
    attitude = make()
    errors = []
    for stamp, gyro, accel, mag in readings(sway, 60.0, shaking=1.5):
        orientation = attitude.update(stamp, gyro, accel, mag).orientation
        errors.append(between(orientation, sway((stamp - START_NS) * 1e-9)))
    assert max(errors[500:]) < 3.0 * DEGREE
    assert max(errors[3000:]) < 1.0 * DEGREE


def test_the_bias_is_learnt_at_rest_and_its_sd_is_honest() -> None:
    noise = np.random.default_rng(2)
    bias = (0.5 * DEGREE, -0.9 * DEGREE, 1.2 * DEGREE)
    misses = []
    for _ in range(10):
        attitude = make()
        for k in range(1500):
            p, q, r = (np.array(bias) + 0.1 * DEGREE * noise.standard_normal(3)).tolist()
            estimate = attitude.update(START_NS + k * PERIOD_NS, (p, q, r), UP)
        assert attitude.at_rest
        misses.append(np.subtract(estimate.gyro_bias, bias) / attitude.bias_sd)
    assert np.sqrt(np.mean(np.square(misses))) < 1.5
    assert estimate.gyro_bias == pytest.approx(bias, abs=0.15 * DEGREE)


def test_the_bias_is_learnt_in_motion() -> None:
    bias = (0.4 * DEGREE, -0.3 * DEGREE, 0.5 * DEGREE)
    attitude = make()
    estimate = last(attitude, readings(tumble, 120.0, bias=bias, shaking=0.5))
    assert not attitude.at_rest
    assert estimate.gyro_bias == pytest.approx(bias, abs=0.1 * DEGREE)


def test_without_magnetometer_the_bias_about_the_vertical_stays_unknown() -> None:
    attitude = make()
    for stamp, gyro, accel, _ in readings(lambda t: from_yaw(0.5 * t), 120.0, bias=(0, 0, 0.3 * DEGREE)):
        estimate = attitude.update(stamp, gyro, accel)
    assert attitude.bias_sd[2] == pytest.approx(0.5 * DEGREE, rel=0.01)
    assert max(attitude.bias_sd[:2]) < 0.2 * DEGREE
    assert estimate.gyro_bias[2] == pytest.approx(0.0, abs=0.01 * DEGREE)


def test_a_hand_that_sways_at_rest_is_no_bias() -> None:
    """Half a degree per second at 0.4 Hz, for two seconds: the gyro's own deviations tell that it is not a table."""
    attitude = make()

    def hand(t: float) -> Quaternion:
        return from_rotation_vector((0.0, 0.2 * DEGREE * math.sin(2.5 * t), 0.0))

    estimate = last(attitude, readings(hand, 2.2))
    assert attitude.at_rest
    assert np.abs(estimate.gyro_bias).max() < 0.15 * DEGREE


@pytest.mark.parametrize(("steady", "rests"), [(1.9, True), (2.1, False), (5.0, False)])
def test_a_steady_turn_is_rest_only_below_the_largest_bias(steady: float, rests: bool) -> None:
    detector = RestDetector(GyroBiasSettings())
    for _ in range(1000):
        detector.update((0.0, steady * DEGREE, 0.0), UP, PERIOD)
    assert detector.at_rest == rests


def test_the_bias_filter_is_the_kalman_filter() -> None:
    """Against the same in matrices, for rows and corrections drawn at random."""
    random = np.random.default_rng(3)
    chosen = GyroBiasSettings(largest=10.0)
    bias, (x, p) = GyroBias(chosen), (np.zeros(3), chosen.initial**2 * np.eye(3))
    for _ in range(200):
        h = random.uniform(-1, 1, (3, 4))
        tilt, turn = random.normal(0, 1e-3, 2), float(random.normal(0, 1e-3))
        first, second, third = (tuple(row) for row in h.tolist())
        bias.corrected((tilt[0], tilt[1]), (first, second), turn, third, 0.1)
        p = p + chosen.walk**2 * 0.1 * np.eye(3)
        np.fill_diagonal(p, np.minimum(np.diag(p), chosen.initial**2))
        for row, angle, sd in zip(
            h, (*tilt, turn), (chosen.tilt_noise, chosen.tilt_noise, chosen.heading_noise), strict=True
        ):
            gain = p @ row[:3] / (row[:3] @ p @ row[:3] + sd**2 / 0.1)
            x = x + gain * (row[3] - angle / 0.1 - row[:3] @ x)
            p = (np.eye(3) - np.outer(gain, row[:3])) @ p
    assert bias.bias == pytest.approx(x.tolist(), rel=1e-6)
    assert bias.sd == pytest.approx(np.sqrt(np.diag(p)).tolist(), rel=1e-6)


def magnet(t: float) -> Vector:
    """A field that a magnet turns by 63 degrees and strengthens, for ten seconds."""
    return (35.0, 18.0, -45.0) if 40.0 <= t < 50.0 else FIELD


def test_a_magnet_is_not_believed() -> None:
    attitude, madgwick = make(), Madgwick(MadgwickSettings())
    worst, worst_madgwick = 0.0, 0.0
    for stamp, gyro, accel, mag in readings(sway, 60.0, field=magnet):
        truth = sway((stamp - START_NS) * 1e-9)
        error = yaw_error(attitude.update(stamp, gyro, accel, mag).orientation, truth)
        error_madgwick = yaw_error(madgwick.update(stamp, gyro, accel, mag).orientation, truth)
        if stamp >= START_NS + 40_000_000_000:
            worst, worst_madgwick = max(worst, abs(error)), max(worst_madgwick, abs(error_madgwick))
        if stamp == START_NS + 45_000_000_000:
            assert attitude.disturbed
    assert not attitude.disturbed
    assert worst < 2.0 * DEGREE
    assert worst_madgwick > 20.0 * DEGREE


def test_inclination_does_not_know_the_magnetometer() -> None:
    with_mag, without = make(), make()
    for stamp, gyro, accel, mag in readings(sway, 20.0, field=lambda t: (90.0 * math.sin(t), 5.0, 30.0)):
        one = with_mag.update(stamp, gyro, accel, mag).orientation
        other = without.update(stamp, gyro, accel).orientation
    assert rotate(conjugate(one), (0, 0, 1))[:2] == pytest.approx(
        rotate(conjugate(other), (0, 0, 1))[:2], abs=0.2 * DEGREE
    )


def test_a_walk_that_began_beside_a_magnet_finds_north() -> None:
    """The other field becomes the undisturbed one when it stays while the body turns."""
    attitude = make()
    estimate = last(attitude, readings(sway, 150.0, field=lambda t: (35.0, 18.0, -45.0) if t < 10.0 else FIELD))
    assert not attitude.disturbed
    assert yaw_error(estimate.orientation, sway(150.0 - PERIOD)) == pytest.approx(0.0, abs=5.0 * DEGREE)


@given(yaw=st.floats(-3, 3))
@settings(max_examples=10, deadline=None)
def test_the_same_turns_towards_another_side_of_the_world_are_the_same_estimate_turned(yaw: float) -> None:
    """North stays where it is, so the magnetometer reads something else."""
    turn, tilt = from_yaw(yaw), from_rotation_vector((0.5, -0.3, 0.0))

    def motion(t: float) -> Quaternion:
        return multiply(from_yaw(0.8 * t), tilt)

    one = last(make(), readings(motion, 3.0))
    other = last(make(), readings(lambda t: multiply(turn, motion(t)), 3.0))
    assert between(multiply(turn, one.orientation), other.orientation) < 1e-6
    assert other.gyro_bias == pytest.approx(one.gyro_bias, abs=1e-9)


@given(scale=st.floats(1e-3, 1e3))
@settings(max_examples=10, deadline=None)
def test_the_magnetometers_unit_does_not_matter(scale: float) -> None:
    one = last(make(), readings(sway, 3.0, field=magnet))
    other = last(make(), readings(sway, 3.0, field=lambda t: tuple(scale * x for x in magnet(t))))  # type: ignore[arg-type,return-value]
    assert between(one.orientation, other.orientation) < 1e-9


@given(mounting=rates)
@settings(max_examples=10, deadline=None)
def test_how_the_sensor_is_mounted_does_not_matter(mounting: Vector) -> None:
    mounted = from_rotation_vector(mounting)
    one = last(make(), readings(sway, 3.0, shaking=1.0))
    other = last(make(), readings(lambda t: multiply(sway(t), mounted), 3.0, shaking=1.0))
    assert between(multiply(one.orientation, mounted), other.orientation) < 1e-6


wild = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


@given(
    samples=st.lists(
        st.tuples(st.integers(1, 10**9), wild, st.none() | wild, st.none() | wild), min_size=1, max_size=20
    )
)
@example(  # a first field of next to nothing, beside which any other deviates beyond all numbers
    samples=[(1, (0.0, 0.0, 594.0), None, (0.0, 1e-109, 0.0))]
    + [(1600, (0.0, 656.0, 344.0), None, None)] * 4
    + [(1, (0.0, 0.0, 0.0), None, (0.0, 0.0, 1.0))]
)
@settings(max_examples=50, deadline=None)
def test_whatever_is_read_the_estimate_is_a_rotation(
    samples: list[tuple[int, Vector, Vector | None, Vector | None]],
) -> None:
    attitude, stamp = make(), START_NS
    attitude.update(stamp, STILL, UP)
    for elapsed, gyro, accel, mag in samples:
        stamp += elapsed
        orientation, bias, _ = attitude.update(stamp, gyro, accel, mag)
        assert sum(x * x for x in orientation) == pytest.approx(1.0, abs=1e-9)
        assert all(abs(x) <= 2.0 * DEGREE + 1e-12 for x in bias)


def test_free_fall_does_not_tell_what_is_up() -> None:
    attitude = make()
    held = from_rotation_vector((0.4, 0.0, 0.0))
    before = last(attitude, readings(lambda t: held, 10.0))
    for k in range(100):
        estimate = attitude.update(START_NS + 10_000_000_000 + k * PERIOD_NS, STILL, STILL)
    assert between(estimate.orientation, before.orientation) < 0.1 * DEGREE


def test_after_a_gap_the_attitude_starts_anew() -> None:
    attitude = make()
    last(attitude, readings(lambda t: rotations.IDENTITY, 5.0))
    turned = from_rotation_vector((0.5, -0.4, 2.0))
    estimate = last(attitude, readings(lambda t: turned, 0.02, start=8.0))
    assert attitude.gaps == 1
    assert between(estimate.orientation, turned) < 0.1 * DEGREE


def test_a_slow_magnetometer_and_a_slow_accelerometer_are_used_when_they_come() -> None:
    attitude = make()
    for k, (stamp, gyro, accel, mag) in enumerate(readings(sway, 60.0, bias=(0.002, 0.0, 0.001))):
        estimate = attitude.update(stamp, gyro, accel if k % 3 == 0 else None, mag if k % 10 == 0 else None)
    assert between(estimate.orientation, sway(60.0 - PERIOD)) < 1.5 * DEGREE


def test_what_cannot_be_used_is_refused() -> None:
    attitude = make()
    with pytest.raises(ValueError, match="no accel"):
        attitude.update(START_NS, STILL, None, FIELD)
    attitude.update(START_NS, STILL, UP, FIELD)
    with pytest.raises(ValueError, match="not after"):
        attitude.update(START_NS, STILL, UP, FIELD)
    assert attitude.gaps == 0
