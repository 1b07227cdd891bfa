"""Single wild readings and ground speeds, in every method of the fusion: forgotten, and named in the pose's status."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import get_args

import msgspec
import numpy as np
import pytest

from caneflow.algorithms.radar.ground_velocity import UNOBSERVED
from caneflow.algorithms.rotations import from_rotation_vector, from_yaw, multiply
from caneflow.messages import GroundSpeed, Imu, Pose, Sample, encode, with_number
from caneflow.messages.rig import read_rig
from caneflow.runtime import Context, Refused
from caneflow.simulation.scenario import Walk, simulate_walk
from operators.fusion import Fusion, FusionSettings, Method
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings
from tests.test_operators_cane import samples_of

METHODS: tuple[Method, ...] = tuple(
    each for each in get_args(Method) if each != "zero_velocity"
)  # a cane is not a foot
EACH_SECOND = tuple(range(250, 800, 100))
BEGINNING = (0, 1)
REST = (100, 101)  # the walk begins with 2 s of rest
IN_A_ROW = (600, 601, 602)


@cache
def walk() -> Walk:
    return simulate_walk("swing", seed=7, duration=9.0)


def context() -> Context:
    return Context(node="test", rig=read_rig(walk().rig), ports={}, random=np.random.default_rng(0))


@cache
def undisturbed() -> tuple[Sample, ...]:
    """IMU samples and ground speeds, in event time."""
    operator = GroundSpeedOperator(GroundSpeedSettings(), context())
    made: list[Sample] = []
    for port, message in samples_of(walk()):
        made += [sample for _, sample in operator.handle(port, message)]
        made += [message] if isinstance(message, Imu) else []
    return tuple(made)


def poses(method: Method, samples: Sequence[Sample]) -> list[Pose]:
    operator = Fusion(FusionSettings(method=method), context())
    found = [operator.handle("imu" if isinstance(each, Imu) else "speed", each) for each in samples]
    return [pose for emitted in found for _, pose in emitted if isinstance(pose, Pose)]


def error(track: Sequence[Pose]) -> float:
    """Of the last position, relative to the first, m."""
    truth = walk().position
    moved = np.subtract(track[-1].position, track[0].position) - (truth[len(track) - 1] - truth[0])
    return float(np.hypot(*moved[:2]))


@cache
def undisturbed_error(method: Method) -> float:
    return error(poses(method, undisturbed()))


Change = Callable[[Imu | GroundSpeed], Sample]


def spoilt(kind: type[Sample], change: Change, at: Sequence[int]) -> list[Sample]:
    """Every sample, those of a kind with these indices changed."""
    seen, changed = 0, []
    for each in undisturbed():
        if isinstance(each, kind):
            assert isinstance(each, Imu | GroundSpeed)
            changed.append(change(each) if seen in at else each)
            seen += 1
        else:
            changed.append(each)
    return changed


def replaced(**fields: object) -> Change:
    return lambda sample: msgspec.structs.replace(sample, **fields)


def turned(by: tuple[float, float, float]) -> Change:
    def change(sample: Imu | GroundSpeed) -> Sample:
        assert isinstance(sample, Imu)
        assert sample.orientation is not None
        return msgspec.structs.replace(sample, orientation=multiply(from_rotation_vector(by), sample.orientation))

    return change


WILD_READINGS = {
    "gyro": replaced(gyro=(0.0, 0.0, 35.7)),
    "gyro, largest": replaced(gyro=(-100.0, 100.0, -100.0)),
    "linear_accel": replaced(linear_accel=(-327.68, 0.0, 0.0)),
    "linear_accel, largest": replaced(linear_accel=(0.0, 4000.0, 4000.0)),
    "orientation, 20 degrees": turned((0.0, 0.0, math.radians(20.0))),
    "orientation, upside down": turned((math.pi, 0.0, 0.0)),
    "mag": replaced(mag=(0.0, -900.0, 0.0)),
}
WILD_SPEEDS = {
    "speed": replaced(speed=30.0, quality=0.0, valid=True),
    "speed, backwards": replaced(speed=-100.0, quality=0.0, valid=True),
    "velocity": replaced(velocity=(20.0, 0.0), velocity_cov=(1e-9, 0.0, 1e6), velocity_delay=0.02),
    "velocity, to the left": replaced(velocity=(0.5, -20.0), velocity_cov=(1e-3, 0.0, 1e-9), velocity_delay=0.02),
    "velocity_cov": replaced(velocity=(0.5, 0.0), velocity_cov=(1e-3, 0.0, 0.0), velocity_delay=0.02),
    "delay": replaced(delay=60.0, velocity=(0.5, 0.0), velocity_cov=(1e-3, 0.0, 1e6), velocity_delay=60.0),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wild", WILD_READINGS)
def test_a_wild_reading_does_not_last(method: Method, wild: str) -> None:
    bar = 1.2 * undisturbed_error(method) + 0.05
    for first in BEGINNING if method == "best" else BEGINNING[:1]:  # what is held is held before any method
        at = (first, *REST, *EACH_SECOND, *IN_A_ROW)
        assert error(poses(method, spoilt(Imu, WILD_READINGS[wild], at))) < bar, f"at {first}"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wild", WILD_SPEEDS)
def test_a_wild_speed_does_not_last(method: Method, wild: str) -> None:
    bar = 1.2 * undisturbed_error(method) + 0.05
    at = (0, *REST, *EACH_SECOND)
    assert error(poses(method, spoilt(GroundSpeed, WILD_SPEEDS[wild], at))) < bar


Claim = Callable[[float, float], tuple[float, float, float]]
EXACT: dict[str, Claim] = {
    "all of it": lambda xx, yy: (0.0, 0.0, 0.0),
    "a tiny one": lambda xx, yy: (1e-30, 0.0, 1e-30),
    "singular": lambda xx, yy: (xx, math.sqrt(xx * 1e-12), 1e-12),
    "forward": lambda xx, yy: (0.0, 0.0, yy),
    "sideways": lambda xx, yy: (xx, 0.0, 0.0),
}


@pytest.mark.parametrize("phase", [0, 10])
@pytest.mark.parametrize("exact", EXACT)
def test_velocities_that_claim_to_be_exact_do_not_outweigh_the_others(exact: str, phase: int) -> None:
    """One a second, and three in a row every three seconds."""

    def claim(sample: Imu | GroundSpeed) -> Sample:
        assert isinstance(sample, GroundSpeed)
        assert sample.velocity_cov is not None
        xx, _, yy = sample.velocity_cov
        return msgspec.structs.replace(sample, velocity_cov=EXACT[exact](xx, yy))

    speeds = [each for each in undisturbed() if isinstance(each, GroundSpeed)]
    seen = [
        index
        for index, each in enumerate(speeds)
        if each.velocity_cov is not None and each.velocity_cov[0] < UNOBSERVED and each.velocity != (0.0, 0.0)
    ]
    in_a_row = [index for first in range(phase, len(seen), 60) for index in seen[first : first + 3]]
    bar = undisturbed_error("best") + 0.02
    for at in (seen[phase::20], in_a_row):
        assert error(poses("best", spoilt(GroundSpeed, claim, at))) < bar


@pytest.mark.parametrize("method", METHODS)
def test_nothing_of_an_undisturbed_walk_is_held(method: Method) -> None:
    assert {pose.status for pose in poses(method, undisturbed())} == {None}


def test_what_was_held_is_said_in_the_status_of_that_pose_alone() -> None:
    wild = msgspec.structs.replace
    samples = [
        wild(each, gyro=(35.7, 0.0, 0.0), mag=(900.0, 0.0, 0.0))
        if isinstance(each, Imu) and each.stamp == walk().stamps_ns[500]
        else wild(each, speed=30.0)
        if isinstance(each, GroundSpeed) and each.stamp == walk().stamps_ns[800]
        else each
        for each in undisturbed()
    ]
    said = {index: pose.status for index, pose in enumerate(poses("kalman", samples)) if pose.status}
    assert said == {500: "held:gyro held:mag", 800: "held:speed"}


def test_a_covariance_stays_as_it_is_while_readings_are_held() -> None:
    good = poses("best", undisturbed())[-1].covariance
    held = poses("best", spoilt(Imu, WILD_READINGS["gyro"], EACH_SECOND))[-1].covariance
    assert good is not None
    assert held is not None
    np.testing.assert_allclose(np.diag(held), np.diag(good), rtol=0.02)


def test_what_lasts_is_believed() -> None:
    """A chip that has found north again turns all that follows: for `luenberger` the way as well."""
    north = spoilt(Imu, turned((0.0, 0.0, math.radians(40.0))), range(400, 2000))
    statuses = [pose.status for pose in poses("luenberger", north)]
    assert [index for index, status in enumerate(statuses) if status] == [400, 401, 402]
    assert poses("luenberger", north)[-1].orientation == north_of(undisturbed())


def north_of(samples: Sequence[Sample]) -> tuple[float, float, float, float]:
    last = [each for each in samples if isinstance(each, Imu)][-1].orientation
    assert last is not None
    return multiply(from_yaw(math.radians(40.0)), last)


@pytest.mark.parametrize("method", METHODS)
def test_a_refused_sample_changes_nothing(method: Method) -> None:
    imu = [each for each in undisturbed() if isinstance(each, Imu)][:50]
    clean, other = (Fusion(FusionSettings(method=method), context()) for _ in range(2))
    for each in imu:
        ((_, expected),) = clean.handle("imu", each)
        for bad in (
            msgspec.structs.replace(imu[0], gyro=(35.7, 0.0, 0.0), mag=(900.0, 0.0, 0.0)),
            msgspec.structs.replace(each, orientation=None, gyro=(35.7, 0.0, 0.0)),
        ):
            if each is not imu[0]:
                with pytest.raises(Refused):
                    other.handle("imu", bad)
        ((_, found),) = other.handle("imu", each)
        assert encode(with_number(found, 0)) == encode(with_number(expected, 0))
