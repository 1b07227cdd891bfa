"""The Kalman filter against the textbook's matrices, the Riccati equation and the statistics it claims."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from caneflow.algorithms import rotations
from caneflow.algorithms.cane.kalman import (
    INITIAL_ACCELERATION,
    INITIAL_VELOCITY,
    AxisCovariance,
    KalmanFilter,
    KalmanSettings,
    SlowError,
)
from caneflow.algorithms.imu_reading import ImuReading

Vector = rotations.Vector
Floats = NDArray[np.float64]
STILL: Vector = (0.0, 0.0, 0.0)
PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000
PLAIN = KalmanSettings(heading_error=0.0, scale_error=0.0)  # the covariance of eq. 10 and nothing else


def forward(settings: KalmanSettings) -> KalmanFilter:
    """A filter whose boresight is the body's x, so that a level body at yaw psi looks along psi."""
    return KalmanFilter(settings, boresight=(1.0, 0.0, 0.0))


def textbook(
    stamps: Sequence[int], accels: Sequence[Vector], grounds: Sequence[Vector | None], settings: KalmanSettings
) -> tuple[list[Floats], list[Floats]]:
    """States (9,) and covariances (9, 9) of (a, v, p), predicted to each stamp, with full matrices.

    The gain's rows of p are zero (the paper only integrates p), which is why the Joseph form is needed.
    """
    eye, zero = np.eye(3), np.zeros((3, 3))
    x: Floats = np.zeros(9)
    p: Floats = np.diag(np.repeat([INITIAL_ACCELERATION**2, INITIAL_VELOCITY**2, 0.0], 3))
    states: list[Floats] = [x]
    covariances: list[Floats] = [p]
    for k in range(1, len(stamps)):
        c = np.hstack([np.eye(6), np.zeros((6, 3))])
        y = np.concatenate([accels[k - 1], grounds[k - 1] or STILL])
        r = np.diag([settings.acceleration_noise**2] * 3 + [settings.speed_noise**2] * 3)
        if grounds[k - 1] is None:
            c, y, r = c[:3], y[:3], r[:3, :3]
        gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
        gain[6:] = 0.0
        x = x + gain @ (y - c @ x)
        keep = np.eye(9) - gain @ c
        p = keep @ p @ keep.T + gain @ r @ gain.T

        t = (stamps[k] - stamps[k - 1]) * 1e-9
        f = np.block([[eye, zero, zero], [t * eye, eye, zero], [t * t * eye, t * eye, eye]])
        g = np.block([[eye, zero], [zero, eye], [zero, t * eye]])
        q = np.diag([settings.acceleration_walk**2 * t] * 3 + [settings.velocity_walk**2 * t] * 3)
        x = f @ x
        p = f @ p @ f.T + g @ q @ g.T
        states.append(x)
        covariances.append(p)
    return states, covariances


@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_the_textbook_for_uneven_intervals_and_missing_speeds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 300
    stamps = (START_NS + np.cumsum(rng.integers(1_000_000, 60_000_000, count))).tolist()
    accels = [tuple(row) for row in rng.normal(0.0, 2.0, (count, 3)).tolist()]
    yaws = rng.uniform(-math.pi, math.pi, count).tolist()
    speeds = [None if rng.random() < 0.4 else float(rng.uniform(0, 1.5)) for _ in range(count)]
    grounds = [
        None if s is None else (s * math.cos(yaw), s * math.sin(yaw), 0.0) for s, yaw in zip(speeds, yaws, strict=True)
    ]
    states, covariances = textbook(stamps, accels, grounds, PLAIN)

    kalman = forward(PLAIN)
    for k in range(count):
        orientation = rotations.from_yaw(yaws[k])
        speed = speeds[k]
        if speed is not None:
            kalman.speed(stamps[k], speed, 0.1, True, None)
        body = rotations.rotate(rotations.conjugate(orientation), accels[k])
        estimate = kalman.imu(stamps[k], ImuReading(STILL, orientation=orientation, linear_accel=body))
        assert [*kalman.acceleration, *estimate.velocity, *estimate.position] == pytest.approx(
            states[k].tolist(), abs=1e-9
        )
        assert estimate.covariance is not None
        expected = covariances[k][np.ix_([6, 7, 8, 3, 4, 5], [6, 7, 8, 3, 4, 5])]
        assert estimate.covariance == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_covariance_stays_symmetric_and_positive_definite_through_a_walk() -> None:
    rng = np.random.default_rng(5)
    kalman = forward(KalmanSettings(noise_from_quality=True))
    stamp = START_NS
    for k in range(4000):
        stamp += int(rng.choice([10_000_000, 10_000_000, 50_000_000, 2_000_000_000], p=[0.5, 0.3, 0.199, 0.001]))
        if rng.random() < 0.7:
            kalman.speed(stamp, float(rng.uniform(0, 1.5)), float(rng.exponential(0.1)), rng.random() < 0.9, 0.3)
        x, y, z = rng.normal(0.0, 3.0, 3).tolist()
        covariance = kalman.imu(
            stamp, ImuReading(STILL, orientation=rotations.from_yaw(0.002 * k), linear_accel=(x, y, z))
        ).covariance
        assert covariance is not None
        assert (covariance == covariance.T).all()
        smallest, *_, largest = np.linalg.eigvalsh(covariance)
        # The start is the origin by definition, and one step later the error of the position is that of the velocity
        # times the interval: until then three of the variances are 0, to the last digit.
        assert smallest > (0 if k > 1 else -np.finfo(float).eps * largest)
        assert np.linalg.eigvalsh(kalman.axis_covariance)[0] > -1e-15


def riccati(settings: KalmanSettings, period: float) -> tuple[Floats, Floats]:
    """Steady covariance (2, 2) before a correction, and the gain (2, 2) from innovation to next prediction."""
    a = np.array([[1.0, 0.0], [period, 1.0]])
    q = np.diag([settings.acceleration_walk**2 * period, settings.velocity_walk**2 * period])
    r = np.diag([settings.acceleration_noise**2, settings.speed_noise**2])
    p = solve_discrete_are(a.T, np.eye(2), q, r)
    return p, a @ p @ np.linalg.inv(p + r)


def settled(settings: KalmanSettings) -> KalmanFilter:
    kalman = forward(settings)
    for k in range(1000):
        kalman.speed(START_NS + k * PERIOD_NS, 0.0, 0.0, True, None)
        kalman.imu(START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    return kalman


@pytest.mark.parametrize(
    "settings",
    [KalmanSettings(), KalmanSettings(acceleration_walk=1.0, acceleration_noise=1.0, speed_noise=0.1)],
)
def test_the_steady_state_solves_the_riccati_equation(settings: KalmanSettings) -> None:
    covariance, gain = riccati(settings, 0.01)
    kalman = settled(settings)
    assert kalman.axis_covariance[:2, :2] == pytest.approx(covariance, rel=1e-6)

    # the gain's columns, seen from outside: the answer to one acceleration and to one speed of 1
    stamp = START_NS + 1000 * PERIOD_NS
    kalman.speed(stamp, 0.0, 0.0, True, None)
    kalman.imu(stamp, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=(1.0, 0.0, 0.0)))
    kalman.speed(stamp + PERIOD_NS, 0.0, 0.0, True, None)
    answer = kalman.imu(stamp + PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    assert (kalman.acceleration[0], answer.velocity[0]) == pytest.approx(gain[:, 0].tolist(), rel=1e-6)

    kalman = settled(settings)
    kalman.speed(stamp, 1.0, 0.0, True, None)
    kalman.imu(stamp, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    answer = kalman.imu(stamp + PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    assert (kalman.acceleration[0], answer.velocity[0]) == pytest.approx(gain[:, 1].tolist(), rel=1e-6)


def test_where_its_model_holds_the_errors_are_as_large_as_the_covariance_says() -> None:
    """Normalised squared error of position and velocity over 300 seeded runs: chi-square, 6 degrees of freedom."""
    rng = np.random.default_rng(11)
    t, samples, runs = 0.01, 60, 300
    total = 0.0
    for _ in range(runs):
        kalman = forward(PLAIN)
        a = rng.normal(0.0, INITIAL_ACCELERATION, 3)
        v = rng.normal(0.0, INITIAL_VELOCITY, 3)
        p = np.zeros(3)
        for k in range(samples):
            if k:
                v = v + t * a + rng.normal(0.0, PLAIN.velocity_walk * math.sqrt(t), 3)
                a = a + rng.normal(0.0, PLAIN.acceleration_walk * math.sqrt(t), 3)
                p = p + t * v
            # eq. 5 measures two axes and claims 0 for the third: here the third does not move
            ground = v + rng.normal(0.0, PLAIN.speed_noise, 3)
            yaw = math.atan2(ground[1], ground[0])
            kalman.speed(START_NS + k * PERIOD_NS, math.hypot(ground[0], ground[1]), 0.1, True, None)
            orientation = rotations.from_yaw(yaw)
            x, y, z = (a + rng.normal(0.0, PLAIN.acceleration_noise, 3)).tolist()
            body = rotations.rotate(rotations.conjugate(orientation), (x, y, z))
            estimate = kalman.imu(
                START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=orientation, linear_accel=body)
            )
        assert estimate.covariance is not None
        plane = [0, 1, 3, 4]
        error = np.concatenate([np.array(estimate.position) - p, np.array(estimate.velocity) - v])[plane]
        total += float(error @ np.linalg.solve(estimate.covariance[np.ix_(plane, plane)], error))
    # mean of 300 chi-squares with 4 degrees of freedom: 4 +- 0.16
    assert total / runs == pytest.approx(4.0, abs=0.65)


def test_a_heading_error_spreads_the_position_as_an_integrated_gauss_markov_process() -> None:
    """Straight at 0.7 m/s: sideways variance 2 (sd v tau)^2 (t / tau - 1 + exp(-t / tau))."""
    sd, tau, speed, duration = 0.17, 8.0, 0.7, 40.0
    slow = SlowError(sd, tau)
    for _ in range(4000):
        slow.advance(0.01, 0.0, speed)
    expected = 2 * (sd * speed * tau) ** 2 * (duration / tau - 1 + math.exp(-duration / tau))
    assert slow.yy == pytest.approx(expected, rel=2e-3)
    assert (slow.xx, slow.xy) == (0.0, 0.0)


def test_a_constant_scale_error_grows_with_the_distance_and_closes_with_the_loop() -> None:
    slow = SlowError(0.05, math.inf)
    for _ in range(1000):
        slow.advance(0.01, 0.6, 0.8)
    assert slow.xx == pytest.approx((0.05 * 6.0) ** 2)
    assert slow.xy == pytest.approx(0.05**2 * 6.0 * 8.0)
    for _ in range(1000):
        slow.advance(0.01, -0.6, -0.8)
    assert (slow.xx, slow.yy) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_slow_errors_agree_with_drawn_ones_on_a_curved_path() -> None:
    rng = np.random.default_rng(4)
    sd, tau, t, steps, runs = 0.2, 2.0, 0.05, 200, 4000
    slow = SlowError(sd, tau)
    decay = math.exp(-t / tau)
    error = rng.normal(0.0, sd, runs)
    position = np.zeros((runs, 2))
    for k in range(steps):
        direction = np.array([math.cos(0.02 * k), math.sin(0.02 * k)])
        slow.advance(t, float(direction[0]), float(direction[1]))
        if k:
            error = decay * error + rng.normal(0.0, sd * math.sqrt(1 - decay**2), runs)
        position += t * error[:, None] * direction
    drawn = np.cov(np.hstack([position, error[:, None] * direction]).T)
    xx, xy, yy = slow.velocity_terms()
    expected = np.array([[slow.xx, slow.xy], [slow.xy, slow.yy]])
    # 4000 draws: 2.2 % of a variance, one sd
    assert drawn[:2, :2] == pytest.approx(expected, abs=0.08 * max(slow.xx, slow.yy))
    assert drawn[2:, 2:] == pytest.approx(np.array([[xx, xy], [xy, yy]]), abs=0.08 * max(xx, yy))
    scale = math.sqrt(max(slow.xx, slow.yy) * max(xx, yy))
    assert drawn[:2, 2:].ravel() == pytest.approx(np.array(slow.cross_terms()), abs=0.08 * scale)


def test_the_slow_errors_are_in_the_covariance_that_is_given_out() -> None:
    """10 m along x: sideways by the heading, along by the scale, on top of eq. 10's own."""
    ends = []
    for settings in (PLAIN, KalmanSettings(heading_correlation=math.inf)):
        kalman = forward(settings)
        for k in range(1001):
            kalman.speed(START_NS + k * PERIOD_NS, 1.0, 0.05, True, None)
            end = kalman.imu(
                START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL)
            )
        assert end.covariance is not None
        ends.append(end.covariance)
    distance = end.position[0]
    added = np.diag(ends[1] - ends[0])
    assert added[:2] == pytest.approx([(0.05 * distance) ** 2, (0.17 * distance) ** 2])
    assert added[3:5] == pytest.approx([0.05**2, 0.17**2], rel=1e-3)
    assert added[[2, 5]] == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize(("quality", "noise"), [(0.1, 0.8), (0.0, 0.4), (0.02, 0.4)])
def test_noise_from_quality_is_its_scale_times_the_quality_above_the_floor(quality: float, noise: float) -> None:
    ends = []
    for settings in (KalmanSettings(noise_from_quality=True), KalmanSettings(speed_noise=noise)):
        kalman = forward(settings)
        for k in range(30):
            kalman.speed(START_NS + k * PERIOD_NS, 1.0, quality, True, None)
            end = kalman.imu(
                START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL)
            )
        ends.append(end.velocity)
    assert ends[0] == pytest.approx(ends[1])


def test_a_speed_of_no_quality_says_nothing() -> None:
    kalman = forward(KalmanSettings(noise_from_quality=True))
    for k in range(30):
        kalman.speed(START_NS + k * PERIOD_NS, 1.0, math.inf, True, None)
        end = kalman.imu(
            START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL)
        )
    assert end.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert end.covariance is not None
    assert np.isfinite(end.covariance).all()


def test_an_open_path_leads_along_the_boresights_yaw() -> None:
    yaw = math.radians(30.0)
    kalman = KalmanFilter(KalmanSettings(), boresight=(0.0, 1.0, 0.0))
    # body y at yaw 30 deg: the body's x lies a quarter turn to its right
    orientation = rotations.from_yaw(yaw - math.pi / 2)
    for k in range(1001):
        kalman.speed(START_NS + k * PERIOD_NS, 0.8, 0.05, True, 0.32)
        end = kalman.imu(START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=orientation, linear_accel=STILL))
    assert rotations.yaw_of(end.position) == pytest.approx(yaw)
    # the first samples lean on the initial velocity of 0
    assert math.hypot(end.position[0], end.position[1]) == pytest.approx(8.0, abs=0.1)


def test_a_gap_is_counted_crossed_with_the_last_velocity_and_admitted_in_the_covariance() -> None:
    kalman = settled(PLAIN)
    last = START_NS + 1000 * PERIOD_NS
    for k in range(300):
        kalman.speed(last + k * PERIOD_NS, 0.6, 0.05, True, None)
        before = kalman.imu(last + k * PERIOD_NS, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL))
    after = kalman.imu(
        last + 299 * PERIOD_NS + 2_000_000_000, ImuReading(STILL, orientation=rotations.IDENTITY, linear_accel=STILL)
    )
    assert kalman.gaps == 1
    assert after.position[0] - before.position[0] == pytest.approx(1.2, abs=0.01)
    assert before.covariance is not None
    assert after.covariance is not None
    grown = after.covariance[0, 0] - before.covariance[0, 0]
    assert grown == pytest.approx((2.0 * INITIAL_VELOCITY) ** 2)


def test_a_correction_never_adds_variance_and_needs_no_optimal_gain() -> None:
    axis = AxisCovariance()
    for _ in range(20):
        axis.predict(0.02, 0.5, 0.01)
    before = (axis.aa, axis.vv, axis.pp)
    axis.correct_velocity(0.2)
    axis.correct_acceleration(0.1)
    assert axis.aa < before[0]
    assert axis.vv < before[1]
    assert axis.pp == before[2], "the position is not corrected, so it knows no more than before"


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match=r"kalman: the imu sample has no orientation; it needs"):
        forward(PLAIN).imu(START_NS, ImuReading(STILL, STILL, linear_accel=STILL))
