"""Step and heading on swings whose number, size and direction are known."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import find_peaks

from caneflow.algorithms import rotations
from caneflow.algorithms.cane.dead_reckoning import PoseEstimate
from caneflow.algorithms.cane.step_heading import StepHeading, StepHeadingSettings
from caneflow.algorithms.imu_reading import ImuReading

Vector = rotations.Vector
PERIOD = 0.01  # s
START_NS = 1_700_000_000_000_000_000
STEP = 0.42  # m


@dataclass(frozen=True, kw_only=True)
class Swinging:
    """A cane swung about the vertical, at rest before and after: yaw is A cos(pi t / T) about `yaw`."""

    swings: int
    duration: float = 0.6  # s per swing
    amplitude: float = math.radians(20.0)
    yaw: float = math.radians(30.0)
    rest: float = 1.5  # s, before and after
    noise: float = 0.002  # rad/s, on each axis of the gyro

    def samples(self) -> tuple[list[float], list[Vector]]:
        """Yaw of the boresight (rad) and gyro (rad/s), level body."""
        t = np.arange(0.0, 2 * self.rest + self.swings * self.duration, PERIOD) - self.rest
        rate = math.pi / self.duration
        phase = rate * np.clip(t, 0.0, self.swings * self.duration)
        moving = (t >= 0) & (t <= self.swings * self.duration)
        yaws = self.yaw + self.amplitude * np.cos(phase)
        gyro = np.random.default_rng(8).normal(0.0, self.noise, (len(t), 3))
        gyro[:, 2] -= np.where(moving, self.amplitude * rate * np.sin(phase), 0.0)
        return yaws.tolist(), [(x, y, z) for x, y, z in gyro.tolist()]


def follow(swinging: Swinging, settings: StepHeadingSettings | None = None) -> tuple[StepHeading, PoseEstimate]:
    shs = StepHeading(settings or StepHeadingSettings(), boresight=(0.0, 1.0, 0.0), step_length=STEP)
    yaws, gyros = swinging.samples()
    for k, (yaw, gyro) in enumerate(zip(yaws, gyros, strict=True)):
        orientation = rotations.from_yaw(yaw - math.pi / 2)  # the boresight is the body's y
        estimate = shs.imu(START_NS + k * 10_000_000, ImuReading(gyro, orientation=orientation))
    return shs, estimate


@pytest.mark.parametrize("swings", [1, 2, 19, 40])
@pytest.mark.parametrize("duration", [0.5, 0.6, 0.8])
def test_each_swing_is_one_step_along_the_mean_yaw(swings: int, duration: float) -> None:
    shs, end = follow(Swinging(swings=swings, duration=duration))
    assert shs.steps == swings
    distance = STEP * swings
    # the mean yaw of a swing is off by what the rest before it, up to 0.45 s at one side, adds to the first
    expected = (distance * math.cos(math.radians(30)), distance * math.sin(math.radians(30)), 0.0)
    assert end.position == pytest.approx(expected, abs=0.01 * distance + 0.1)
    assert math.hypot(end.position[0], end.position[1]) == pytest.approx(distance, rel=0.01)
    assert end.velocity == (0.0, 0.0, 0.0), "at rest again"


def test_as_many_steps_as_scipy_finds_between_stationary_points() -> None:
    """The slow way of cane.md row 13, on an irregular swing, all samples at hand."""
    rng = np.random.default_rng(2)
    pieces, last = [], 1.0
    for _ in range(30):
        count = int(rng.integers(48, 90))
        ramp = 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / count)
        following = -last * rng.uniform(0.5, 1.2) / abs(last)
        pieces.append(math.radians(20) * (last + (following - last) * ramp))
        last = following
    yaw = np.concatenate(pieces)
    rates = np.gradient(yaw, PERIOD)
    norms = np.abs(rates)
    points, _ = find_peaks(-norms, height=-math.radians(25.0), distance=45)
    expected = sum(norms[a:b].max() > math.radians(40.0) for a, b in pairwise(points))

    shs = StepHeading(StepHeadingSettings(), boresight=(1.0, 0.0, 0.0), step_length=STEP)
    for k, (angle, rate) in enumerate(zip(yaw.tolist(), rates.tolist(), strict=True)):
        shs.imu(START_NS + k * 10_000_000, ImuReading((0.0, 0.0, rate), orientation=rotations.from_yaw(angle)))
    assert expected > 20
    # the first piece starts at a turning point that the one sees and the other does not
    assert abs(shs.steps - expected) <= 1


def test_while_walking_the_velocity_is_step_over_duration() -> None:
    swinging = Swinging(swings=6, duration=0.6, rest=1.5)
    shs = StepHeading(StepHeadingSettings(), boresight=(0.0, 1.0, 0.0), step_length=STEP)
    yaws, gyros = swinging.samples()
    speeds = []
    for k, (yaw, gyro) in enumerate(zip(yaws, gyros, strict=True)):
        orientation = rotations.from_yaw(yaw - math.pi / 2)
        velocity = shs.imu(START_NS + k * 10_000_000, ImuReading(gyro, orientation=orientation)).velocity
        speeds.append(math.hypot(velocity[0], velocity[1]))
    assert speeds[int((1.5 + 3.5 * 0.6) / PERIOD)] == pytest.approx(STEP / 0.6, rel=0.05)


def test_walking_without_swinging_gives_no_step() -> None:
    """What breaks the method in the paper's second experiment."""
    shs, end = follow(Swinging(swings=20, amplitude=math.radians(3.0)))
    assert shs.steps == 0
    assert end.position == (0.0, 0.0, 0.0)


def test_a_swing_whose_peak_is_too_slow_is_none() -> None:
    peak = math.radians(20.0) * math.pi / 0.6
    settings = StepHeadingSettings(swing_rate=1.05 * peak)
    assert follow(Swinging(swings=10), settings)[0].steps == 0
    settings = StepHeadingSettings(swing_rate=0.95 * peak)
    assert follow(Swinging(swings=10), settings)[0].steps == 10


@pytest.mark.parametrize("duration", [0.3, 0.43])
def test_swings_that_follow_too_fast_are_taken_together(duration: float) -> None:
    shs, _ = follow(Swinging(swings=20, duration=duration))
    # 10 pairs, or 9 between two single ones, by where the rest's own last stationary point lies
    assert shs.steps in (10, 11)


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match=r"swing_rate is 0\.3 rad/s; it must be above stationary_rate"):
        StepHeadingSettings(swing_rate=0.3)


def test_a_gap_is_counted_and_a_missing_orientation_named() -> None:
    shs = StepHeading(StepHeadingSettings(), boresight=(0.0, 1.0, 0.0), step_length=STEP)
    for k in range(2):
        shs.imu(START_NS + k * 700_000_000, ImuReading((0.0, 0.0, 0.0), orientation=rotations.IDENTITY))
    assert shs.gaps == 1
    with pytest.raises(ValueError, match=r"shs: the imu sample has no orientation"):
        shs.imu(START_NS + 2_000_000_000, ImuReading((0.0, 0.0, 0.0)))


def pocketed(*, strides: int, stride: float, bobs: int, seed: int = 1) -> StepHeading:
    """A phone on a thigh: quickly forward, slowly back, once per stride of so many s; `bobs` of 2 m/s^2 in each."""
    shs = StepHeading(StepHeadingSettings(), boresight=(0.0, 1.0, 0.0), step_length=STEP)
    random = np.random.default_rng(seed)
    count = round((2.0 + strides * stride) / PERIOD)
    impacts = random.normal(0.0, 1.0, count)
    for k in range(count):
        t = max(k * PERIOD - 2.0, 0.0)
        phase = t / stride % 1.0
        forward, back = math.radians(200.0), math.radians(35.0)  # rad/s; the slow way back is not a swing
        rate = forward * math.sin(2.0 * math.pi * phase) if phase < 0.5 else -back * math.sin(2.0 * math.pi * phase)
        force = 9.80665 + (2.0 * math.sin(2.0 * math.pi * bobs * t / stride) + impacts[k] if t > 0.0 else 0.0)
        shs.imu(
            START_NS + k * 10_000_000, ImuReading((rate, 0.0, 0.0), (0.0, 0.0, force), orientation=rotations.IDENTITY)
        )
    return shs


@pytest.mark.parametrize("stride", [1.0, 1.1, 1.3])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_phone_that_swings_once_per_stride_is_told_by_two_bobs_in_each(stride: float, seed: int) -> None:
    shs = pocketed(strides=60, stride=stride, bobs=2, seed=seed)
    assert shs.steps == pytest.approx(120, rel=0.1)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_bob_to_a_swing_is_a_step(seed: int) -> None:
    assert pocketed(strides=60, stride=0.9, bobs=1, seed=seed).steps == pytest.approx(60, abs=2)
