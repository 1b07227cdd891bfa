"""Holes in IMU or radar: what is published of the error covers it, while walking and at rest."""

from functools import cache

import numpy as np
import pytest

from caneflow.algorithms.inertial.imu_sample import heading_of
from caneflow.messages import Imu, Pose, RadarFrame, Sample
from caneflow.messages.rig import read_rig
from caneflow.runtime import Context
from caneflow.simulation.scenario import Walk, simulate_walk
from operators.fusion import Fusion, FusionSettings, Method
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings
from tests.test_operators_cane import samples_of

SEEDS = (1, 2, 3)
BORESIGHT = (0.0, 1.0, 0.0)
Inputs = list[tuple[str, Sample]]  # of the fusion, by port


@cache
def walk(seed: int) -> Walk:
    return simulate_walk("swing", seed=seed, duration=13.0)


def context(seed: int) -> Context:
    return Context(node="test", rig=read_rig(walk(seed).rig), ports={}, random=np.random.default_rng(0))


def with_holes(seed: int, lost: type[Sample], length: float) -> Inputs:
    """What the fusion hears of a walk that lacks the samples of a kind for `length` s, at rest, then every 5 s."""
    ground_speed = GroundSpeedOperator(GroundSpeedSettings(), context(seed))
    begins = int(walk(seed).stamps_ns[0])
    heard: Inputs = []
    for port, sample in samples_of(walk(seed)):
        at = (sample.stamp - begins) * 1e-9
        if isinstance(sample, lost) and (at - 1.0) % 5.0 < length and at >= 1.0:
            continue
        heard += [("speed", speed) for _, speed in ground_speed.handle(port, sample)]
        heard += [("imu", sample)] if isinstance(sample, Imu) else []
    return heard


def track(seed: int, heard: Inputs, method: Method) -> list[Pose]:
    fusion = Fusion(FusionSettings(method=method), context(seed))
    emitted = [each for port, sample in heard for _, each in fusion.handle(port, sample)]
    return [pose for pose in emitted if isinstance(pose, Pose)]


def last_error(seed: int, poses: list[Pose]) -> tuple[float, float]:
    """Of the last horizontal position (m), seen from the first pose, which the covariance is relative to."""
    made = walk(seed)
    began, way = tuple(made.orientation[0].tolist()), made.position[-1] - made.position[0]
    turn = complex(*heading_of(poses[0].orientation, BORESIGHT)) / complex(*heading_of(began, BORESIGHT))
    truth = turn * complex(way[0], way[1])
    moved = np.subtract(poses[-1].position, poses[0].position)
    return float(moved[0] - truth.real), float(moved[1] - truth.imag)


def squared_error(seed: int, poses: list[Pose]) -> float:
    """The same in units of its covariance (NEES): 2 is expected."""
    error, covariance = np.array(last_error(seed, poses)), poses[-1].covariance
    assert covariance is not None
    return float(error @ np.linalg.solve(np.asarray(covariance)[:2, :2], error))


@pytest.mark.parametrize(
    ("lost", "length"), [(Imu, 0.05), (Imu, 0.4), (Imu, 1.0), (RadarFrame, 0.4), (RadarFrame, 1.0)]
)
def test_the_covariance_covers_the_error_after_holes(lost: type[Sample], length: float) -> None:
    inputs = {seed: with_holes(seed, lost, length) for seed in SEEDS}
    methods: tuple[Method, ...] = ("best", "kalman")
    for method in methods:
        tracks = {seed: track(seed, heard, method) for seed, heard in inputs.items()}
        found = [squared_error(seed, poses) for seed, poses in tracks.items()]
        assert np.mean(found) < 4.0, f"{method}: {np.round(found, 1)}"
        if method == "best" and (lost, length) == (Imu, 0.4):
            # Before holes were bridged, these cost a metre on such walks.
            assert np.mean([np.hypot(*last_error(seed, poses)) for seed, poses in tracks.items()]) < 0.4


def test_the_covariance_opens_over_a_hole_and_the_more_the_longer_it_is() -> None:
    areas = []
    for length in (0.0, 0.2, 0.4, 1.0):
        covariance = track(1, with_holes(1, Imu, length), "best")[-1].covariance
        assert covariance is not None
        areas.append(float(np.linalg.det(np.asarray(covariance)[:2, :2])))
    assert areas == sorted(areas)
    assert areas[-1] > 2.0 * areas[0]
