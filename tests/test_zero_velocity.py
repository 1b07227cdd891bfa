"""The foot's strapdown on a walk made by formulas: exact without noise, honest with it, drifting without stances."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.cane.zero_velocity import StanceDetector, StanceSettings, ZeroVelocity, ZeroVelocitySettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    from_yaw,
    multiply,
    rotate,
)
from caneflow.messages import Imu, Pose
from caneflow.messages.rig import read_rig
from caneflow.runtime import Context, Refused
from operators.fusion import Fusion, FusionSettings

RATE = 200.0  # Hz
PERIOD_NS = 5_000_000
START_NS = 1_700_000_000_000_000_000
GRAVITY = 9.80665
STILL: Vector = (0.0, 0.0, 0.0)
UP: Vector = (0.0, 0.0, GRAVITY)
DEGREE = math.radians(1.0)
REST = 2.0  # s before the first step
STEP = 1.1  # s, half of it stance
STRIDE = 1.2  # m
TURN = 0.3  # rad per step


def smooth(x: float) -> float:
    """From 0 to 1 with velocity and acceleration 0 at both ends."""
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def foot(t: float) -> tuple[np.ndarray, Quaternion]:
    """Where the foot is and how it is turned: it swings for half of each step, and turns while it does."""
    steps, phase = divmod(max(t - REST, 0.0), STEP)
    swing = smooth(phase / (0.5 * STEP))
    position = np.zeros(3)
    for k in range(int(steps)):
        position += STRIDE * np.array((math.cos(k * TURN), math.sin(k * TURN), 0.0))
    heading = steps * TURN
    position += swing * STRIDE * np.array((math.cos(heading), math.sin(heading), 0.0))
    lifted = 16.0 * (swing * (1.0 - swing)) ** 2
    position[2] += 0.12 * lifted
    pitch = from_rotation_vector((0.0, 0.9 * lifted, 0.0))
    return position, multiply(from_yaw(heading + TURN * swing), pitch)


def readings(steps: int) -> Iterator[tuple[int, Vector, Vector]]:
    """Gyro and accelerometer without noise, by differences over 0.2 ms; stands at the end."""
    h = 1e-4
    for k in range(round((REST + steps * STEP) * RATE) - 2):
        t = k / RATE
        (before, q0), (now, q), (after, q1) = foot(t - h), foot(t), foot(t + h)
        w, x, y, z = multiply(conjugate(q0), q1)
        gyro = (x * math.copysign(1 / h, w), y * math.copysign(1 / h, w), z * math.copysign(1 / h, w))
        a, b, c = ((before - 2.0 * now + after) / h**2).tolist()
        yield START_NS + k * PERIOD_NS, gyro, rotate(conjugate(q), (a, b, c + GRAVITY))


def walked(
    method: DeadReckoning,
    samples: list[tuple[int, Vector, Vector]],
    *,
    bias: tuple[Vector, Vector] = (STILL, STILL),
    noise: np.random.Generator | None = None,
) -> PoseEstimate:
    """The estimate at the end; noise of 0.02 deg/s and 0.02 m/s^2 per sqrt(Hz) where there is a generator."""
    for stamp, gyro, accel in samples:
        g, a = np.add(gyro, bias[0]), np.add(accel, bias[1])
        if noise is not None:
            g = g + 0.02 * DEGREE * math.sqrt(RATE) * noise.standard_normal(3)
            a = a + 0.02 * math.sqrt(RATE) * noise.standard_normal(3)
        (p, q, r), (x, y, z) = g.tolist(), a.tolist()
        estimate = method.imu(stamp, ImuReading((p, q, r), (x, y, z)))
    return estimate


@pytest.fixture(scope="module")
def walk() -> list[tuple[int, Vector, Vector]]:
    return list(readings(15))


def end(steps: int) -> np.ndarray:
    return foot(REST + steps * STEP - 3 / RATE)[0]


def test_without_noise_the_walk_is_found(walk: list[tuple[int, Vector, Vector]]) -> None:
    estimate = walked(ZeroVelocity(ZeroVelocitySettings()), walk)
    assert np.subtract(estimate.position, end(15)) == pytest.approx((0.0,) * 3, abs=0.02)
    assert estimate.velocity == pytest.approx(STILL, abs=0.01)


def test_with_noise_and_biases_the_error_is_small_and_within_the_covariance(
    walk: list[tuple[int, Vector, Vector]],
) -> None:
    """Six walks: NEES of the position, 3 degrees of freedom each; 4.8 is the 95 % quantile of the mean.

    This foot stands quite still, a real one rolls: so the covariance may be too large here, but not without bound.
    """
    noise = np.random.default_rng(4)
    nees, errors = [], []
    for _ in range(6):
        gyro_bias, accel_bias = 0.3 * DEGREE * noise.standard_normal(3), 0.05 * noise.standard_normal(3)
        bias = tuple(gyro_bias.tolist()), tuple(accel_bias.tolist())
        estimate = walked(ZeroVelocity(ZeroVelocitySettings()), walk, bias=bias, noise=noise)
        assert estimate.covariance is not None
        error = np.subtract(estimate.position, end(15))
        nees.append(error @ np.linalg.solve(estimate.covariance[:3, :3], error))
        errors.append(float(np.linalg.norm(error)))
    assert np.mean(errors) < 0.3
    assert 0.1 < np.mean(nees) < 4.8


def test_without_stances_it_is_a_strapdown_that_drifts(walk: list[tuple[int, Vector, Vector]]) -> None:
    never = ZeroVelocitySettings(stance=StanceSettings(accel=1e-6, gyro=1e-6))
    bias = (STILL, (0.05, 0.0, 0.0))
    drifted = np.linalg.norm(np.subtract(walked(ZeroVelocity(never), walk, bias=bias).position, end(15)))
    held = np.linalg.norm(np.subtract(walked(ZeroVelocity(ZeroVelocitySettings()), walk, bias=bias).position, end(15)))
    assert drifted > 5.0
    assert held < 0.3


def test_it_stands_in_the_stances_and_only_there(walk: list[tuple[int, Vector, Vector]]) -> None:
    method = ZeroVelocity(ZeroVelocitySettings())
    late = []
    for stamp, gyro, accel in walk:
        method.imu(stamp, ImuReading(gyro, accel))
        t = (stamp - START_NS) * 1e-9 - REST
        if t < 0.0:
            continue
        in_swing = t % STEP / STEP
        if 0.1 < in_swing < 0.4:
            assert not method.standing
        late.append(method.standing == (in_swing > 0.5))
    assert np.mean(late) > 0.8


def test_a_long_rest_teaches_the_gyros_bias() -> None:
    bias = (0.2 * DEGREE, -0.3 * DEGREE, 0.4 * DEGREE)
    method = ZeroVelocity(ZeroVelocitySettings())
    for k in range(2000):
        method.imu(START_NS + k * PERIOD_NS, ImuReading(bias, UP))
    assert method.gyro_bias == pytest.approx(bias, abs=0.02 * DEGREE)


@pytest.mark.parametrize(
    ("gyro", "shake", "stands"),
    [(16.9, 0.0, True), (17.1, 0.0, False), (0.0, 1.69, True), (0.0, 1.71, False), (12.1, 1.21, False)],
)
def test_the_threshold_is_where_the_settings_say(gyro: float, shake: float, stands: bool) -> None:
    """A turn alone, a force alone (along gravity, up and down in turn), and both at 0.71 of their own."""
    detector = StanceDetector(StanceSettings(window=0.095))
    for k in range(40):
        force = GRAVITY + (shake if k % 2 else -shake)
        standing = detector.update(START_NS + k * PERIOD_NS, (0.0, gyro * DEGREE, 0.0), (0.0, 0.0, force))
    assert standing == stands


triples = st.tuples(*[st.floats(-20, 20)] * 3)


@given(window=st.lists(st.tuples(triples, triples), min_size=9, max_size=9))
@settings(deadline=None)
def test_the_statistic_is_shoes(window: list[tuple[Vector, Vector]]) -> None:
    """Skog 2010, eq. 12, with the square of the threshold's equivalents for noise and threshold."""
    detector = StanceDetector(StanceSettings(window=0.04))
    for k, (gyro, accel) in enumerate(window):
        detector.update(START_NS + k * PERIOD_NS, gyro, accel)
    w, a = np.array([g for g, _ in window]), np.array([a for _, a in window])
    mean = a.mean(axis=0)
    norm = np.linalg.norm(mean)
    if norm < 1e-9:
        return
    off = a - GRAVITY * mean / norm
    expected = np.mean((off**2).sum(axis=1) / 1.7**2 + (w**2).sum(axis=1) / math.radians(17.0) ** 2)
    assert detector.statistic() == pytest.approx(expected, rel=1e-6)


def test_the_covariance_stays_one(walk: list[tuple[int, Vector, Vector]]) -> None:
    method = ZeroVelocity(ZeroVelocitySettings())
    for k, (stamp, gyro, accel) in enumerate(walk):
        covariance = method.imu(stamp, ImuReading(gyro, accel)).covariance
        if k % 100 == 0:
            assert covariance is not None
            assert covariance == pytest.approx(covariance.T)
            assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_over_a_gap_it_stays_and_says_that_it_does_not_know() -> None:
    method = ZeroVelocity(ZeroVelocitySettings())
    for k in range(100):
        before = method.imu(START_NS + k * PERIOD_NS, ImuReading(STILL, UP))
    after = method.imu(START_NS + 100 * PERIOD_NS + 2_000_000_000, ImuReading(STILL, UP))
    assert method.gaps == 1
    assert after.position == before.position
    assert after.covariance is not None
    assert math.sqrt(after.covariance[0, 0]) > 2.0


def test_what_cannot_be_used_is_refused() -> None:
    method = ZeroVelocity(ZeroVelocitySettings())
    with pytest.raises(ValueError, match="no accel"):
        method.imu(START_NS, ImuReading(STILL))
    with pytest.raises(ValueError, match="does not tell what is up"):
        method.imu(START_NS, ImuReading(STILL, STILL))
    method.imu(START_NS, ImuReading(STILL, UP))
    with pytest.raises(ValueError, match="not after"):
        method.imu(START_NS, ImuReading(STILL, UP))


def fused(samples: list[tuple[int, Vector, Vector]]) -> list[Pose]:
    """By `operators.fusion`, from raw readings alone."""
    context = Context(node="fusion", rig=read_rig({}), ports={"imu": Imu}, random=np.random.default_rng(0))
    operator = Fusion(FusionSettings(method="zero_velocity"), context)
    found = [operator.handle("imu", Imu(stamp=stamp, gyro=gyro, accel=accel)) for stamp, gyro, accel in samples]
    return [pose for emitted in found for _, pose in emitted if isinstance(pose, Pose)]


def test_it_is_a_method_of_the_fusion(walk: list[tuple[int, Vector, Vector]]) -> None:
    track = fused(walk[:1500])
    assert len(track) == 1500
    assert track[-1].position == walked(ZeroVelocity(ZeroVelocitySettings()), walk[:1500]).position
    assert {pose.status for pose in track} == {None}  # a heel strike is not held


def test_which_refuses_a_sample_without_the_specific_force(walk: list[tuple[int, Vector, Vector]]) -> None:
    context = Context(node="fusion", rig=read_rig({}), ports={"imu": Imu}, random=np.random.default_rng(0))
    operator = Fusion(FusionSettings(method="zero_velocity"), context)
    with pytest.raises(Refused, match="no accel"):
        operator.handle("imu", Imu(stamp=1, gyro=STILL, linear_accel=STILL))


@pytest.mark.parametrize("wild", [(STILL, (327.67, 0.0, 0.0)), ((0.0, -34.9, 0.0), STILL)])
@pytest.mark.parametrize(
    ("at", "bar"),
    [
        pytest.param(range(300, 1500, 200), 0.05, id="one a second"),
        pytest.param(range(1, 2), 0.05, id="near the start"),
        pytest.param(range(701, 704), 0.10, id="three in a row amid a swing"),
    ],
)
def test_wild_readings_are_forgotten(
    walk: list[tuple[int, Vector, Vector]], wild: tuple[Vector, Vector], at: range, bar: float
) -> None:
    """Full scale of a BNO055; m from the end of the walk without. 15 ms of a swing held are 7 cm."""
    whole = walk[:1500]
    spoilt = list(whole)
    for index in at:
        stamp, (p, q, r), (x, y, z) = whole[index]
        (dp, dq, dr), (dx, dy, dz) = wild
        spoilt[index] = stamp, (p + dp, q + dq, r + dr), (x + dx, y + dy, z + dz)
    assert math.dist(fused(spoilt)[-1].position, fused(whole)[-1].position) < bar
