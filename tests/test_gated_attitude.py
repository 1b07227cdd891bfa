"""Single wild readings do not reach an attitude filter, wherever they come; real jumps reach it in full."""

import math
from collections.abc import Iterable, Sequence
from functools import cache

import pytest

from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.gated_attitude import GatedAttitude
from caneflow.algorithms.inertial.initial_attitude import AttitudeMethod
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
from caneflow.physics import GRAVITY

START_NS = 1_700_000_000_000_000_000
RATE = 100  # Hz
DEGREE = math.radians(1.0)
FIELD: Vector = (0.0, 18.0, -45.0)  # uT
METHODS = ("attitude_filter", "madgwick")
Sample = tuple[int, Vector, Vector | None, Vector | None]


def bare(method: str) -> AttitudeMethod:
    if method == "madgwick":
        return Madgwick(MadgwickSettings())
    return AttitudeFilter(AttitudeFilterSettings())


def gated(method: str) -> GatedAttitude:
    return GatedAttitude(bare(method), GlitchSettings(), method)


def swung(t: float) -> Quaternion:
    """A cane in a hand: at rest for 2 s, then +-40 deg about the vertical, and a nod."""
    at = max(t - 2.0, 0.0)
    yaw = from_yaw(0.7 * math.sin(5.6 * at) + 0.2 * at)
    return multiply(yaw, from_rotation_vector((0.3 * math.sin(3.1 * at) - 0.6, 0.0, 0.0)))


def turn_rate(t: float) -> Vector:
    step = 1e-4
    w, x, y, z = multiply(conjugate(swung(t - step)), swung(t + step))
    scale = math.copysign(1.0, w) / step
    return scale * x, scale * y, scale * z


@cache
def walked(seconds: float, rate: int) -> Sequence[Sample]:
    samples: list[Sample] = []
    for k in range(round(seconds * rate)):
        t = k / rate
        back = conjugate(swung(t))
        sway = 1.0 if t > 2.0 else 0.0
        force = sway * math.sin(6.0 * t), sway * math.cos(6.0 * t), GRAVITY
        samples.append((START_NS + round(t * 1e9), turn_rate(t), rotate(back, force), rotate(back, FIELD)))
    return samples


def readings(seconds: float, rate: int = RATE) -> list[Sample]:
    return list(walked(seconds, rate))


def spoilt(sample: Sample, part: str, value: Vector) -> Sample:
    stamp, gyro, accel, mag = sample
    return (
        stamp,
        value if part == "gyro" else gyro,
        value if part == "accel" else accel,
        value if part == "mag" else mag,
    )


def last(method: GatedAttitude, samples: Iterable[Sample]) -> Quaternion:
    for sample in samples:
        estimate, _ = method.update(*sample)
    return estimate.orientation


@cache
def undisturbed(method: str, gap: int = 0, end: int = 0) -> Quaternion:
    """After 10 s that lack the samples from `gap` to `end`."""
    samples = readings(10.0)
    del samples[gap:end]
    return last(gated(method), samples)


def between(one: Quaternion, other: Quaternion) -> float:
    w, x, y, z = multiply(conjugate(one), other)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


WILD: list[tuple[str, Vector]] = [
    ("gyro", (0.0, 0.0, 35.7)),
    ("gyro", (-99.0, 0.0, 0.0)),
    ("accel", (-327.68, 0.0, 9.8)),
    ("accel", (0.0, 3999.0, 0.0)),
    ("accel", (0.0, 0.0, -60.0)),
    ("mag", (1e4, 0.0, 0.0)),
    ("mag", (0.0, -200.0, 30.0)),
]
PLACES = {
    "the first": [0],
    "the second": [1],
    "at rest": [120],
    "in motion": [600],
    "one a second": list(range(130, 1000, 100)),
    "two in a row": [600, 601],
    "three in a row": [600, 601, 602],
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("part", "value"), WILD)
def test_a_wild_reading_is_forgotten(method: str, place: str, part: str, value: Vector) -> None:
    samples = readings(10.0)
    for at in PLACES[place]:
        samples[at] = spoilt(samples[at], part, value)
    assert between(last(gated(method), samples), undisturbed(method)) < 0.3 * DEGREE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("part", "value"), WILD)
def test_and_so_is_the_first_one_after_a_gap(method: str, part: str, value: Vector) -> None:
    """Nothing tells the turn rate at the end of the gap; that of the next reading takes its place."""
    samples = readings(10.0)
    del samples[590:602]
    samples[590] = spoilt(samples[590], part, value)
    assert between(last(gated(method), samples), undisturbed(method, 590, 602)) < 1.0 * DEGREE


@pytest.mark.parametrize("part", ["gyro", "accel", "mag"])
def test_a_bare_filter_is_thrown_off_by_what_the_gate_holds(part: str) -> None:
    """Otherwise the tests above would show nothing."""
    value = dict([("gyro", (-99.0, 0.0, 0.0)), ("accel", (0.0, 3999.0, 0.0)), ("mag", (1e4, 0.0, 0.0))])[part]
    samples = readings(7.0)
    filters = bare("madgwick" if part == "mag" else "attitude_filter"), bare("attitude_filter")
    worst = 0.0
    for at, sample in enumerate(samples):
        given = spoilt(sample, part, value) if at % 100 == 30 else sample
        spoiled = filters[0].update(*given).orientation
        worst = max(worst, between(spoiled, swung((sample[0] - START_NS) * 1e-9)))
    assert worst > (0.3 if part == "mag" else 5.0) * DEGREE


@pytest.mark.parametrize("method", METHODS)
def test_a_real_jump_that_lasts_reaches_the_filter_in_full(method: str) -> None:
    """A push of 25 m/s^2 for 0.1 s and a turn at 8 rad/s from one sample to the next: as if there were no gate."""
    samples = readings(8.0)
    for at in range(500, 510):
        stamp, gyro, accel, mag = samples[at]
        assert accel is not None
        samples[at] = stamp, (gyro[0], gyro[1], gyro[2] + 8.0), (accel[0] + 25.0, accel[1], accel[2]), mag
    plain, method_of = bare(method), gated(method)
    for at, sample in enumerate(samples):
        expected = plain.update(*sample)
        estimate, _ = method_of.update(*sample)
        assert method_of.held == ("gyro", "accel") or not 500 <= at < 503
        assert estimate == expected or method_of.held


def test_the_accepted_force_is_the_one_before() -> None:
    method = gated("attitude_filter")
    samples = readings(1.0)
    for sample in samples[:50]:
        method.update(*sample)
    _, force = method.update(*spoilt(samples[50], "accel", (0.0, 0.0, 500.0)))
    assert force == samples[49][2]
    assert method.held == ("accel",)


def test_a_slow_magnetometer_has_a_gate_too() -> None:
    samples = [(s, g, a, m if k % 10 == 0 else None) for k, (s, g, a, m) in enumerate(readings(10.0))]
    undisturbed = last(gated("madgwick"), samples)
    samples[600] = spoilt(samples[600], "mag", (-900.0, 0.0, 0.0))
    assert between(last(gated("madgwick"), samples), undisturbed) < 0.1 * DEGREE


def test_what_cannot_be_used_is_refused_and_changes_nothing() -> None:
    method, other = gated("attitude_filter"), gated("attitude_filter")
    samples = readings(3.0)
    stamp, gyro, accel, mag = samples[0]
    with pytest.raises(ValueError, match="no accel"):
        method.update(stamp, gyro, None, mag)
    with pytest.raises(ValueError, match="what is up"):
        method.update(stamp, gyro, (0.0, 0.0, 0.0), mag)
    for sample in samples[:200]:
        method.update(*sample)
        with pytest.raises(ValueError, match="not after"):
            method.update(sample[0], (50.0, 0.0, 0.0), accel, mag)
    assert last(method, samples[200:]) == last(other, samples)
