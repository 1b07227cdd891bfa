"""The observer against the matrix iteration, its poles, and paths whose end is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.algorithms import rotations
from caneflow.algorithms.cane.dead_reckoning import DelayCompensation, PoseEstimate
from caneflow.algorithms.cane.luenberger import (
    LuenbergerObserver,
    LuenbergerSettings,
    observer_eigenvalues,
    placed_gain,
)
from caneflow.algorithms.imu_reading import ImuReading

Vector = rotations.Vector
BORESIGHT: Vector = (0.0, 1.0, 0.0)
STILL: Vector = (0.0, 0.0, 0.0)
PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000


def held(yaw: float, pitch: float = 0.73, boresight: Vector = BORESIGHT) -> rotations.Quaternion:
    """An orientation whose boresight has this yaw and points `pitch` rad below the horizontal."""
    direction = (
        math.cos(pitch) * math.cos(yaw),
        math.cos(pitch) * math.sin(yaw),
        -math.sin(pitch),
    )
    axis = np.cross(boresight, direction)
    angle = math.atan2(float(np.linalg.norm(axis)), float(np.dot(boresight, direction)))
    x, y, z = (angle * axis / np.linalg.norm(axis)).tolist()
    return rotations.from_rotation_vector((x, y, z))


def body(orientation: rotations.Quaternion, world: Vector) -> Vector:
    return rotations.rotate(rotations.conjugate(orientation), world)


def walk(observer: LuenbergerObserver, samples: int, speed: float, orientation: rotations.Quaternion) -> PoseEstimate:
    """Steady walking: a speed with every IMU sample, no acceleration."""
    for k in range(samples):
        stamp = START_NS + k * PERIOD_NS
        observer.speed(stamp, speed, 0.05, True, 0.32)
        estimate = observer.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=STILL))
    return estimate


def matrix_iteration(
    stamps: list[int], accels: list[Vector], speeds: list[Vector | None], poles: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Eq. 9 as printed, 6 x 6, L from each interval; velocities and positions (n, 3)."""
    eye, zero = np.eye(3), np.zeros((3, 3))
    x, p = np.zeros(6), np.zeros(3)
    velocities, positions = [x[3:]], [p]
    for k in range(1, len(stamps)):
        dt = (stamps[k] - stamps[k - 1]) * 1e-9
        a = np.block([[eye, zero], [dt * eye, eye]])
        gain = a - np.diag([poles[0]] * 3 + [poles[1]] * 3)
        speed = speeds[k - 1]
        if speed is None:
            gain[3:] = 0.0  # row 10
        y = np.concatenate([accels[k - 1], speed if speed is not None else STILL])
        x = a @ x + gain @ (y - x)
        p = p + dt * x[3:]
        velocities.append(x[3:])
        positions.append(p)
    return np.array(velocities), np.array(positions)


@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_the_matrix_iteration_for_uneven_intervals_and_missing_speeds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 400
    stamps = (START_NS + np.cumsum(rng.integers(1_000_000, 40_000_000, count))).tolist()
    accels = [tuple(row) for row in rng.normal(0.0, 2.0, (count, 3)).tolist()]
    yaws = rng.uniform(-math.pi, math.pi, count).tolist()
    scalars = [None if rng.random() < 0.4 else float(rng.uniform(0, 1.5)) for _ in range(count)]
    observer = LuenbergerObserver(LuenbergerSettings(pole_acceleration=0.3, pole_velocity=0.8), boresight=BORESIGHT)

    got = []
    for stamp, accel, yaw, speed in zip(stamps, accels, yaws, scalars, strict=True):
        orientation = held(yaw)
        if speed is not None:
            observer.speed(stamp, speed, 0.1, True, None)
        got.append(
            observer.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=body(orientation, accel)))
        )

    speeds = [
        None if s is None else (s * math.cos(yaw), s * math.sin(yaw), 0.0) for s, yaw in zip(scalars, yaws, strict=True)
    ]
    velocities, positions = matrix_iteration(stamps, accels, speeds, (0.3, 0.8))
    assert np.array([e.velocity for e in got]) == pytest.approx(velocities, abs=1e-9)
    assert np.array([e.position for e in got]) == pytest.approx(positions, abs=1e-9)


poles = st.floats(-0.999, 0.999)


@given(pole_acceleration=poles, pole_velocity=poles, interval=st.floats(0.001, 0.5))
def test_the_poles_are_the_eigenvalues_of_a_minus_lc(
    pole_acceleration: float, pole_velocity: float, interval: float
) -> None:
    gain = placed_gain(interval, pole_acceleration, pole_velocity)
    error = np.array([[1.0, 0.0], [interval, 1.0]]) - np.array(gain)
    expected = sorted([pole_acceleration, pole_velocity])
    assert sorted(np.linalg.eigvals(error).real) == pytest.approx(expected)
    assert sorted(value.real for value in observer_eigenvalues(gain, interval)) == pytest.approx(expected)


@given(entries=st.tuples(*[st.floats(-2, 2)] * 4), interval=st.floats(0.001, 0.5))
def test_eigenvalues_of_any_gain_agree_with_numpy(entries: tuple[float, float, float, float], interval: float) -> None:
    gain = (entries[0], entries[1]), (entries[2], entries[3])
    expected = np.linalg.eigvals(np.array([[1.0, 0.0], [interval, 1.0]]) - np.array(gain))
    got = observer_eigenvalues(gain, interval)
    # as products and sums, which do not care which of two close eigenvalues comes first
    assert sum(got) == pytest.approx(complex(expected.sum()), abs=1e-9)
    assert got[0] * got[1] == pytest.approx(complex(expected.prod()), abs=1e-9)


@pytest.mark.parametrize("pole", [1.0, -1.0, 1.5, math.nan, math.inf])
def test_a_pole_on_or_outside_the_unit_circle_is_refused_by_name(pole: float) -> None:
    with pytest.raises(ValueError, match=rf"pole_acceleration is {pole}; its magnitude must be below 1"):
        LuenbergerSettings(pole_acceleration=pole)
    with pytest.raises(ValueError, match=rf"pole_velocity is {pole}; its magnitude must be below 1"):
        LuenbergerSettings(pole_velocity=pole)


def test_a_gain_that_does_not_converge_is_refused_with_its_eigenvalues() -> None:
    with pytest.raises(ValueError, match=r"eigenvalues .*1\.02.* at 0\.01 s; all must lie inside"):
        LuenbergerSettings(gain=((0.5, 0.0), (0.01, -0.02)))


def test_an_explicit_gain_equals_the_poles_it_was_placed_for() -> None:
    by_gain = LuenbergerSettings(gain=placed_gain(0.01, 0.5, 0.95))
    ends = [
        walk(LuenbergerObserver(settings, boresight=BORESIGHT), 300, 0.7, held(0.4))
        for settings in (LuenbergerSettings(), by_gain)
    ]
    assert ends[0].position == pytest.approx(ends[1].position, abs=1e-12)


def test_a_constant_speed_is_approached_with_the_velocity_pole() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(pole_velocity=0.9), boresight=BORESIGHT)
    for steps in range(1, 40):
        speed = walk(
            LuenbergerObserver(LuenbergerSettings(pole_velocity=0.9), boresight=BORESIGHT),
            steps + 1,
            1.0,
            held(0.0),
        ).velocity[0]
        assert speed == pytest.approx(1.0 - 0.9**steps)
    assert walk(observer, 500, 1.0, held(0.0)).velocity == pytest.approx((1.0, 0.0, 0.0))


@pytest.mark.parametrize("boresight", [BORESIGHT, (1.0, 0.0, 0.0), (0.0, 0.6, -0.8)])
@pytest.mark.parametrize("yaw_deg", [30.0, -110.0])
def test_an_open_path_leads_along_the_boresights_yaw_also_without_a_rest(boresight: Vector, yaw_deg: float) -> None:
    yaw, speed, samples = math.radians(yaw_deg), 0.8, 1001
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=boresight)
    end = walk(observer, samples, speed, held(yaw, boresight=boresight))
    # 10 s of walking less what the observer takes to get going: speed Ts p / (1 - p)
    distance = speed * 10.0 - speed * 0.01 * 0.95 / 0.05
    expected = (distance * math.cos(yaw), distance * math.sin(yaw), 0.0)
    assert end.position == pytest.approx(expected, abs=1e-6)


def test_an_accelerometer_bias_leaks_in_as_bias_times_interval_over_one_minus_pole() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    orientation = held(0.0)
    for k in range(1000):
        stamp = START_NS + k * PERIOD_NS
        observer.speed(stamp, 0.5, 0.05, True, None)
        end = observer.imu(
            stamp, ImuReading(STILL, orientation=orientation, linear_accel=body(orientation, (0.07, 0.0, 0.0)))
        )
    assert end.velocity[0] - 0.5 == pytest.approx(0.07 * 0.01 / (1 - 0.95), rel=1e-6)


def test_a_rest_is_a_measurement_of_zero_on_all_three_axes() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    orientation = held(1.0)
    for k in range(50):  # no speed yet: the acceleration is integrated
        moving = observer.imu(
            START_NS + k * PERIOD_NS,
            ImuReading(STILL, orientation=orientation, linear_accel=body(orientation, (1.0, -1.0, 0.5))),
        )
    assert moving.velocity == pytest.approx((0.48, -0.48, 0.24), abs=0.01)
    for k in range(50, 400):
        observer.speed(START_NS + k * PERIOD_NS, 0.0, 0.0, True, 0.32)
        resting = observer.imu(START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=orientation, linear_accel=STILL))
    assert resting.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


def test_a_speed_that_is_not_valid_changes_nothing() -> None:
    observers = [LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT) for _ in range(2)]
    for k in range(100):
        stamp = START_NS + k * PERIOD_NS
        observers[0].speed(stamp, 0.0, math.inf, False, 0.32)
        ends = [
            observer.imu(stamp, ImuReading(STILL, orientation=held(0.2), linear_accel=(0.3, 0.0, 0.0)))
            for observer in observers
        ]
        assert ends[0] == ends[1]


def test_the_order_of_two_samples_with_one_stamp_does_not_matter() -> None:
    observers = [LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT) for _ in range(2)]
    rng = np.random.default_rng(3)
    for k in range(200):
        stamp, speed, orientation = START_NS + k * PERIOD_NS, float(rng.uniform(0, 1)), held(0.01 * k)
        observers[0].speed(stamp, speed, 0.1, True, 0.32)
        ends = [
            observer.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=STILL))
            for observer in observers
        ]
        observers[1].speed(stamp, speed, 0.1, True, 0.32)
        assert ends[0] == ends[1]


def test_a_gap_is_counted_and_crossed_with_the_last_velocity() -> None:
    """A jerk of 5 m/s^2 just before the gap must not be held for two seconds."""
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    orientation = held(0.0)
    for k in range(500):
        stamp = START_NS + k * PERIOD_NS
        observer.speed(stamp, 0.6, 0.05, True, None)
        jerk = body(orientation, (5.0, 0.0, 0.0)) if k >= 490 else STILL
        before = observer.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=jerk))
    assert observer.gaps == 0
    assert observer.acceleration[0] == pytest.approx(5.0, abs=0.02)
    after = observer.imu(stamp + 2_000_000_000, ImuReading(STILL, orientation=orientation, linear_accel=STILL))
    assert observer.gaps == 1
    corrected = 0.95 * before.velocity[0] + 0.05 * 0.6  # by the last speed, as ever
    assert after.velocity[0] == pytest.approx(corrected)
    assert after.position[0] - before.position[0] == pytest.approx(2.0 * corrected)


def test_half_a_second_is_not_a_gap_yet() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    for k in range(3):
        observer.imu(START_NS + k * 500_000_000, ImuReading(STILL, orientation=held(0.0), linear_accel=STILL))
    assert observer.gaps == 0


def turning(compensation: DelayCompensation, delay: float) -> PoseEstimate:
    """Walking at 1 m/s with 0.5 rad/s of yaw rate, the speed lagging by `delay`; the estimate after 8 s."""
    settings = LuenbergerSettings(compensate_delay=compensation, pole_velocity=0.0)
    observer = LuenbergerObserver(settings, boresight=BORESIGHT)
    for k in range(801):
        stamp, yaw = START_NS + k * PERIOD_NS, 0.5 * 0.01 * k
        observer.speed(stamp, 1.0, 0.05, True, delay)
        orientation = held(yaw)
        centripetal = body(orientation, (-0.5 * math.sin(yaw), 0.5 * math.cos(yaw), 0.0))
        estimate = observer.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=centripetal))
    return estimate


def test_delay_compensation_takes_the_heading_of_the_values_time() -> None:
    yaws = {name: rotations.yaw_of(turning(name, 0.32).velocity) for name in ("none", "heading", "motion")}
    assert yaws["none"] == pytest.approx(rotations.wrapped(4.0), abs=0.01)
    assert yaws["heading"] == pytest.approx(rotations.wrapped(4.0 - 0.5 * 0.32), abs=0.01)
    # the velocity gained since turns it on to now again
    assert yaws["motion"] == pytest.approx(rotations.wrapped(4.0), abs=0.01)


def test_delay_compensation_by_motion_follows_an_acceleration() -> None:
    """Speed a t, seen 0.3 s late: without compensation 0.3 a is missing, with it nothing."""
    lag = {}
    for name in ("none", "motion"):
        observer = LuenbergerObserver(LuenbergerSettings(compensate_delay=name), boresight=BORESIGHT)
        orientation = held(0.0)
        for k in range(400):
            stamp = START_NS + k * PERIOD_NS
            observer.speed(stamp, max(0.0, 0.01 * k - 0.3), 0.05, True, 0.3)
            end = observer.imu(
                stamp, ImuReading(STILL, orientation=orientation, linear_accel=body(orientation, (1.0, 0.0, 0.0)))
            )
        lag[name] = 3.99 - end.velocity[0]
    assert lag["none"] == pytest.approx(0.3, abs=0.01)
    assert lag["motion"] == pytest.approx(0.0, abs=0.01)


def test_accel_and_gravity_stand_in_for_the_chips_linear_acceleration() -> None:
    orientation = held(0.3)
    world = (0.4, -0.2, 0.1)
    ends = []
    for given_by_chip in (True, False):
        observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
        for k in range(100):
            linear = body(orientation, world)
            specific = body(orientation, (world[0], world[1], world[2] + 9.80665))
            end = observer.imu(
                START_NS + k * PERIOD_NS,
                ImuReading(
                    STILL,
                    None if given_by_chip else specific,
                    orientation=orientation,
                    linear_accel=linear if given_by_chip else None,
                ),
            )
        ends.append(end)
    assert ends[0].position == pytest.approx(ends[1].position, abs=1e-9)


def test_what_is_missing_is_named() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    with pytest.raises(ValueError, match=r"luenberger: the imu sample has no orientation; it needs"):
        observer.imu(START_NS, ImuReading(STILL, STILL, linear_accel=STILL))
    with pytest.raises(ValueError, match=r"luenberger: .* neither linear_accel nor accel"):
        observer.imu(START_NS, ImuReading(STILL, orientation=held(0.0)))


def test_time_that_does_not_go_on_is_refused() -> None:
    observer = LuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)
    observer.imu(START_NS, ImuReading(STILL, orientation=held(0.0), linear_accel=STILL))
    with pytest.raises(ValueError, match="is not after the one before"):
        observer.imu(START_NS, ImuReading(STILL, orientation=held(0.0), linear_accel=STILL))
