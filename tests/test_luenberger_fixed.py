"""The observer in whole numbers: against exact fractions, the float observer, and at the ends of its formats."""

import math
from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from caneflow.algorithms.cane import luenberger_fixed
from caneflow.algorithms.cane.luenberger import Gain, LuenbergerObserver, LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import (
    ACCELERATION,
    LARGEST,
    POSITION,
    UNIT,
    VELOCITY,
    FixedLuenbergerObserver,
    fixed,
    observer_constants,
    product,
    quotient,
    rotated,
)
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import IDENTITY, Quaternion, Vector, from_yaw, multiply, normalized, rotate
from caneflow.messages import GroundSpeed, Imu, Pose, Sample, decode
from caneflow.messages.rig import Rig
from caneflow.recording import Recording
from caneflow.runtime import Context
from operators.fusion import Fusion, FusionSettings
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings

WALKS = Path(__file__).parents[1].parent / "shared" / "data" / "walks"
BORESIGHT: Vector = (0.0, 1.0, 0.0)
STILL: Vector = (0.0, 0.0, 0.0)
PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000

numbers = st.integers(-LARGEST, LARGEST)


# --- numbers --------------------------------------------------------------------------------------------------------


@given(value=st.floats(allow_nan=False, allow_infinity=False), fraction=st.sampled_from([16, 20, 22, 25, 28, 30, 31]))
@example(value=5e-324, fraction=22)
@example(value=-0.0, fraction=22)
@example(value=0.5 * 2.0**-22, fraction=22)
@example(value=-1.5 * 2.0**-22, fraction=22)
@example(value=LARGEST / 2.0**22, fraction=22)
def test_a_double_is_rounded_half_away_from_zero_and_cut(value: float, fraction: int) -> None:
    scaled = abs(Fraction(value)) * 2**fraction
    magnitude = math.floor(scaled + Fraction(1, 2))
    expected = min(magnitude, LARGEST) * (-1 if value < 0 else 1)
    assert fixed(value, fraction) == (expected, magnitude > LARGEST)


@given(a=numbers, b=numbers, shift=st.integers(1, 40))
def test_a_product_is_rounded_half_up(a: int, b: int, shift: int) -> None:
    assert product(a, b, shift) == math.floor(Fraction(a * b, 2**shift) + Fraction(1, 2))


@given(a=st.integers(-(2**61), 2**61), b=st.integers(1, LARGEST))
def test_a_quotient_is_rounded_half_away_from_zero(a: int, b: int) -> None:
    expected = math.floor(abs(Fraction(a, b)) + Fraction(1, 2))
    assert quotient(a, b) == (expected if a >= 0 else -expected)


unit_parts = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


@given(parts=unit_parts, vector=st.tuples(*[st.floats(-256, 256)] * 3))
def test_a_rotation_agrees_with_floats_to_two_steps(parts: Quaternion, vector: Vector) -> None:
    q = normalized(parts)
    w, x, y, z = (fixed(each, UNIT)[0] for each in q)
    a, b, c = (fixed(each, ACCELERATION)[0] for each in vector)
    got = rotated((w, x, y, z), (a, b, c))
    # the quaternion's own rounding turns 443 m/s^2 by up to 2 ** -30 or so in each part
    error = 2.0**-ACCELERATION * 2 + 443 * 6 * 2.0**-UNIT
    assert [each / 2**ACCELERATION for each in got] == pytest.approx(rotate(q, vector), abs=error)


@given(parts=unit_parts, vector=st.tuples(*[st.integers(-(2**30), 2**30)] * 3))
def test_no_sum_of_a_rotation_leaves_64_bits(parts: Quaternion, vector: tuple[int, int, int]) -> None:
    w, x, y, z = (fixed(each * 1.0019, UNIT)[0] for each in normalized(parts))  # the longest that is let in
    a, b, c = vector
    tx, ty, tz = (2 * (y * c - z * b)) >> UNIT, (2 * (z * a - x * c)) >> UNIT, (2 * (x * b - y * a)) >> UNIT
    sums = [w * tx, w * tx + y * tz, w * tx + y * tz - z * ty, w * ty + z * tx, w * tz + x * ty, y * c - z * b]
    assert max(map(abs, sums)) < 2**63 - 2**30
    assert max(map(abs, rotated((w, x, y, z), vector))) + luenberger_fixed.GRAVITY_FIXED <= LARGEST


# --- the observer ---------------------------------------------------------------------------------------------------


def both(settings: LuenbergerSettings | None = None) -> tuple[FixedLuenbergerObserver, LuenbergerObserver]:
    settings = settings or LuenbergerSettings()
    return (
        FixedLuenbergerObserver(settings, boresight=BORESIGHT),
        LuenbergerObserver(settings, boresight=BORESIGHT),
    )


def restless(count: int, seed: int) -> Iterator[tuple[int, Quaternion, Vector, float | None]]:
    """Stamp, orientation, linear acceleration and speed (or none): no walk, but never a jump; gaps included."""
    rng = np.random.default_rng(seed)
    stamp = START_NS
    tilt = normalized((0.9, -0.4, 0.05, 0.0))
    for k in range(count):
        stamp += 700_000_000 if k % 300 == 299 else int(rng.integers(1_000_000, 30_000_000))
        x, y, z = rng.normal(0.0, 1.0, 3).tolist()
        yield stamp, multiply(from_yaw(0.004 * k), tilt), (x, y, z), float(rng.uniform(0, 0.9)) if k % 3 else None


GAIN = ((0.4, 0.1), (0.012, 0.06))


@pytest.mark.parametrize(
    "settings",
    [
        LuenbergerSettings(),
        LuenbergerSettings(pole_acceleration=-0.3, pole_velocity=0.8),
        LuenbergerSettings(gain=GAIN),
        LuenbergerSettings(compensate_delay="heading"),
    ],
)
def test_agrees_with_the_float_observer_for_uneven_intervals_gaps_and_missing_speeds(
    settings: LuenbergerSettings,
) -> None:
    in_whole_numbers, in_floats = both(settings)
    for stamp, orientation, acceleration, speed in restless(650, seed=4):
        for observer in (in_whole_numbers, in_floats):
            if speed is not None:
                observer.speed(stamp, speed, 0.1, True, 0.13)
        got = in_whole_numbers.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=acceleration))
        expected = in_floats.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=acceleration))
        assert got.velocity == pytest.approx(expected.velocity, abs=2e-6)
        assert got.position == pytest.approx(expected.position, abs=1e-4)
        assert not in_whole_numbers.saturated
    assert in_whole_numbers.gaps == in_floats.gaps == 2


def test_specific_force_serves_where_the_chip_gives_no_linear_acceleration() -> None:
    whole, floats = both()
    for k in range(50):
        stamp = START_NS + k * PERIOD_NS
        got = whole.imu(stamp, ImuReading(STILL, (0.3, -0.2, 9.9), orientation=IDENTITY))
        expected = floats.imu(stamp, ImuReading(STILL, (0.3, -0.2, 9.9), orientation=IDENTITY))
    assert got.velocity == pytest.approx(expected.velocity, abs=1e-6)


def test_a_position_loses_nothing_to_rounding() -> None:
    """It is the sum of velocity times interval but for its own last bit, however many samples there were."""
    whole, _ = both()
    exact = Fraction(0)
    for k in range(2000):
        stamp = START_NS + k * PERIOD_NS
        whole.speed(stamp, 1 / 3, 0.1, True, None)
        pose = whole.imu(stamp, ImuReading(STILL, orientation=from_yaw(1.0), linear_accel=STILL))
        exact += Fraction(pose.velocity[0]) * PERIOD_NS / 10**9 if k else 0
    assert abs(exact) > 1
    # the interval is right to 2 ** -32 s, each step to 2 ** -37 m
    assert abs(float(exact - Fraction(pose.position[0]))) < 2.0**-POSITION + 2000 * (2.0**-32 + 2.0**-37)


def test_poses_are_whole_numbers_of_steps() -> None:
    whole, _ = both()
    for stamp, orientation, acceleration, speed in restless(50, seed=1):
        whole.speed(stamp, speed or 0.0, 0.1, speed is not None, None)
        pose = whole.imu(stamp, ImuReading(STILL, orientation=orientation, linear_accel=acceleration))
        acceleration_state, velocity, position = whole.states
        assert [each * 2**VELOCITY for each in pose.velocity] == list(velocity)
        assert [each * 2**POSITION for each in pose.position] == list(position)
        assert max(map(abs, acceleration_state)) <= LARGEST


def test_what_leaves_its_format_stays_at_the_end_of_it_and_is_flagged() -> None:
    whole, _ = both()
    whole.imu(START_NS, ImuReading(STILL, orientation=IDENTITY, linear_accel=(1e300, 0.0, 0.0)))
    assert whole.saturated, "an acceleration beyond 256 m/s^2"
    whole.imu(START_NS + PERIOD_NS, ImuReading(STILL, orientation=IDENTITY, linear_accel=STILL))
    assert not whole.saturated, "the flag is of one sample"
    for k in range(2, 200):
        pose = whole.imu(
            START_NS + k * PERIOD_NS, ImuReading(STILL, orientation=IDENTITY, linear_accel=(256.0, 0.0, -256.0))
        )
    assert whole.saturated
    assert pose.velocity[0] == LARGEST / 2**VELOCITY
    assert pose.velocity[2] == -LARGEST / 2**VELOCITY
    for k in range(100):
        pose = whole.imu(START_NS + (k + 1) * 10**12, ImuReading(STILL, orientation=IDENTITY, linear_accel=STILL))
    assert pose.position[0] == LARGEST / 2**POSITION
    whole.speed(START_NS + 101 * 10**12, -1e9, 0.1, True, -1e9)
    whole.imu(START_NS + 102 * 10**12, ImuReading(STILL, orientation=IDENTITY, linear_accel=STILL))
    assert whole.saturated, "a speed beyond 32 m/s, a delay beyond 8 s"


@pytest.mark.parametrize("gain", [None, GAIN, ((0.1, -3.9), (0.05, 0.9))])
def test_states_stay_in_32_bits_whatever_comes(gain: Gain | None) -> None:
    rng = np.random.default_rng(8)
    whole = FixedLuenbergerObserver(LuenbergerSettings(gain=gain), boresight=BORESIGHT)
    stamp, flags = 0, 0
    for _ in range(500):
        stamp += int(2.0 ** rng.uniform(0, 45))
        speed, delay, *vector = (rng.normal(0, 1, 5) * 10.0 ** rng.integers(-8, 10, 5)).tolist()
        x, y, z, w = rng.normal(0, 1, 4).tolist()
        whole.speed(stamp, speed, 0.0, bool(rng.random() < 0.5), delay)
        whole.imu(
            stamp,
            ImuReading(STILL, orientation=normalized((w, x, y, z)), linear_accel=(vector[0], vector[1], vector[2])),
        )
        assert all(abs(each) <= LARGEST for state in whole.states for each in state)
        flags += whole.saturated
    assert flags > 50


def test_what_is_missing_or_wrong_is_said() -> None:
    whole, _ = both()
    with pytest.raises(ValueError, match="luenberger_fixed: the imu sample has no orientation"):
        whole.imu(START_NS, ImuReading(STILL, linear_accel=STILL))
    with pytest.raises(ValueError, match="neither linear_accel nor accel"):
        whole.imu(START_NS, ImuReading(STILL, orientation=IDENTITY))
    with pytest.raises(ValueError, match="its norm is not 1"):
        whole.imu(START_NS, ImuReading(STILL, orientation=(1.1, 0.0, 0.0, 0.0), linear_accel=STILL))
    whole.imu(START_NS, ImuReading(STILL, orientation=IDENTITY, linear_accel=STILL))
    with pytest.raises(ValueError, match="is not after the one before"):
        whole.imu(START_NS, ImuReading(STILL, orientation=IDENTITY, linear_accel=STILL))
    with pytest.raises(ValueError, match="compensate_delay is motion; in fixed point there are none and heading"):
        observer_constants(LuenbergerSettings(compensate_delay="motion"), BORESIGHT)
    with pytest.raises(ValueError, match="each entry is below 4"):
        observer_constants(LuenbergerSettings(gain=((0.5, 4.5), (0.01, 0.05))), BORESIGHT)
    with pytest.raises(ValueError, match="compensate_delay is motion"):
        FusionSettings(method="luenberger_fixed", luenberger=LuenbergerSettings(compensate_delay="motion"))


def test_constants_are_told_apart_by_their_digest() -> None:
    settings = [
        LuenbergerSettings(),
        LuenbergerSettings(pole_velocity=0.94),
        LuenbergerSettings(compensate_delay="heading"),
        LuenbergerSettings(gain=((0.5, 0.0), (0.01, 0.05))),
    ]
    digests = {observer_constants(each, BORESIGHT).digest for each in settings}
    digests.add(observer_constants(settings[0], (1.0, 0.0, 0.0)).digest)
    assert len(digests) == 5


# --- a whole walk ---------------------------------------------------------------------------------------------------


@cache
def shared_walk(name: str) -> tuple[Sample, ...]:
    """IMU samples and the ground speeds that the project makes of the frames, in event time; skips if not here."""
    path = WALKS / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{name}.mcap is not here; it comes with the shared recordings")
    operator = GroundSpeedOperator(GroundSpeedSettings(), context())
    walk: list[Sample] = []
    with Recording(path) as recording:
        for each in recording.samples([("radar", "frame"), ("imu", "imu")]):
            assert each.kind
            message = decode(each.payload, each.kind)
            speeds = [speed for _, speed in operator.handle(each.port, message)]
            walk += [message, *speeds] if isinstance(message, Imu) else speeds
    return tuple(walk)


def context() -> Context:
    rig = Rig(hand_height=0.95, aperture=0.87, pivot=(0.0, -0.3, 0.0), step_length=0.42)
    return Context(node="test", rig=rig, ports={}, random=np.random.default_rng(0))


def test_within_5_mm_of_the_float_observer_over_a_whole_walk() -> None:
    nodes = [Fusion(FusionSettings(method=method), context()) for method in ("luenberger_fixed", "luenberger")]
    worst, count = 0.0, 0
    for message in shared_walk("swing_1"):
        port = "imu" if isinstance(message, Imu) else "speed"
        poses = [pose for node in nodes for _, pose in node.handle(port, message) if isinstance(pose, Pose)]
        if poses:
            worst, count = max(worst, math.dist(poses[0].position, poses[1].position)), count + 1
    assert count > 5200
    assert worst < 1e-4, "5 mm are asked for; it is some micrometres"
    assert any(isinstance(message, GroundSpeed) and message.valid for message in shared_walk("swing_1"))
