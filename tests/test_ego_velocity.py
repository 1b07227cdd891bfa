"""Velocity from points with Doppler: exact without noise, robust with, honest about it, and a real loop closes."""

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.handheld_loop import recorded, walked
from caneflow.algorithms.radar.ego_motion import from_matrix, level_mounting, matrix_of
from caneflow.algorithms.radar.ego_velocity import EgoVelocitySettings, ego_velocity
from caneflow.algorithms.rotations import (
    Quaternion,
    conjugate,
    from_rotation_vector,
    from_yaw,
    multiply,
    normalized,
    rotate,
)
from caneflow.messages import GroundSpeed, Imu, MessageError, RadarPoints, Sample
from caneflow.physics import GRAVITY
from caneflow.testing import run_operator
from operators.ego_velocity import EgoVelocityOperator

Floats = NDArray[np.float64]

LOOP = Path(__file__).parents[1].parent / "shared" / "data" / "ti-handheld-loop" / "handheld_loop.npz"
LEVEL_RIG = {"boresight": [0.0, 1.0, 0.0]}
STEP, LIMIT = 0.125, 2.0  # m/s
FRAME_TIME = 0.0185  # s


def directions_of(random: np.random.Generator, count: int, widest: float = math.radians(55.0)) -> Floats:
    """Unit vectors about x."""
    azimuth, elevation = random.uniform(-widest, widest, (2, count))
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )


def fitted(places: Floats, doppler: Floats, **settings: Any) -> Any:
    return ego_velocity(
        places,
        doppler,
        doppler_step=STEP,
        doppler_limit=LIMIT,
        settings=EgoVelocitySettings(**settings),
        random=np.random.default_rng(5),
    )


def test_without_noise_the_velocity_is_exact_whatever_most_of_a_third_says() -> None:
    random = np.random.default_rng(1)
    velocity = np.array([0.9, -0.3, 0.1])
    directions = directions_of(random, 40)
    doppler = directions @ velocity
    doppler[:13] += 1.0  # people who walk
    found = fitted(directions * random.uniform(1.0, 6.0, (40, 1)), doppler)
    assert found.velocity == pytest.approx(velocity, abs=1e-9)
    assert found.agreeing == 27


def test_points_that_do_not_tell_are_no_velocity() -> None:
    random = np.random.default_rng(2)
    directions = directions_of(random, 40)
    assert fitted(directions[:7], directions[:7] @ [1.0, 0.0, 0.0]) is None  # too few
    assert fitted(directions, random.uniform(-LIMIT, LIMIT, 40), inlier=0.05) is None  # none agree
    flat = directions * [1.0, 1.0, 0.0]
    assert fitted(flat, flat @ [1.0, 0.0, 0.0]) is None  # nothing above or below: three unknowns, two of them seen
    assert fitted(directions, directions @ [1.98, 0.0, 0.0]) is None  # at the limit of unambiguous Doppler


def test_the_same_seed_gives_the_same_velocity_in_every_bit() -> None:
    random = np.random.default_rng(3)
    directions = directions_of(random, 30)
    doppler = directions @ [1.0, 0.2, 0.0] + random.normal(0.0, 0.1, 30)
    assert np.array_equal(fitted(directions, doppler).velocity, fitted(directions, doppler).velocity)


def frame(
    random: np.random.Generator, stamp: int, velocity: Floats, points: int = 40, outliers: float = 0.0, snr: bool = True
) -> RadarPoints:
    """Points as a TI radar gives them: directions that err by 2 and 5 deg, Doppler in bins; `velocity` in its frame."""
    azimuth, elevation = random.uniform(-math.radians(58.0), math.radians(58.0), (2, points))
    true = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    doppler = true @ velocity + random.normal(0.0, 0.02, points)
    moving = random.random(points) < outliers
    doppler[moving] += random.uniform(-1.5, 1.5, int(moving.sum()))
    azimuth += random.normal(0.0, math.radians(2.0), points)
    elevation += random.normal(0.0, math.radians(5.0), points)
    seen = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    return RadarPoints(
        stamp=stamp,
        position=(seen * random.uniform(0.5, 7.0, (points, 1))).astype(np.float32),
        doppler=(STEP * np.round(doppler / STEP)).astype(np.float32),
        snr=random.uniform(8.0, 30.0, points).astype(np.float32) if snr else None,
        frame_time=FRAME_TIME,
        doppler_step=STEP,
        doppler_limit=LIMIT,
    )


Walked = tuple[dict[str, list[Sample]], Floats]


@cache
def curved_walk(seed: int, outliers: float, antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Walked:
    """20 s of a curve with two rests, the head swung by 15 deg: messages, and the antenna's true velocity per frame."""
    random = np.random.default_rng(seed)
    boresight_left = matrix_of(level_mounting((0.0, 1.0, 0.0)))  # radar frame to body

    def speed(time: float) -> float:
        return 0.0 if time < 2.0 or 9.0 < time < 11.0 else 0.9 + 0.25 * math.sin(2 * math.pi * 1.8 * time)

    def attitude(time: float) -> Quaternion:
        yaw = 0.3 * time + math.radians(15.0) * math.sin(2 * math.pi * 0.9 * time)
        return multiply(from_yaw(yaw), from_rotation_vector((-0.4 + 0.05 * math.sin(3.0 * time), 0.0, 0.0)))

    def velocity(time: float) -> Floats:
        walked = 0.3 * time + 0.5 * math.pi  # the boresight is y: a quarter turn from x
        return np.array([speed(time) * math.cos(walked), speed(time) * math.sin(walked), 0.08 * math.sin(11.0 * time)])

    def gyro(time: float) -> tuple[float, float, float]:
        before, after = attitude(time - 1e-4), attitude(time + 1e-4)
        _, x, y, z = multiply(conjugate(before), after)
        return 2.0 * x / 2e-4, 2.0 * y / 2e-4, 2.0 * z / 2e-4

    imu, points, truth = list[Sample](), list[Sample](), []
    for index in range(2000):
        time = 0.01 * index
        force = (velocity(time + 1e-3) - velocity(time - 1e-3)) / 2e-3 + [0.0, 0.0, GRAVITY]
        felt = np.array(rotate(conjugate(attitude(time)), tuple(force.tolist())))
        felt += random.normal(0.05, 0.05, 3)
        imu.append(
            Imu(
                stamp=round(time * 1e9),
                gyro=gyro(time),
                orientation=normalized(attitude(time)),
                accel=tuple(felt.tolist()),
            )
        )
    for index in range(3, 198):
        time = 0.1 * index + 0.0037
        middle = time - 0.5 * FRAME_TIME
        to_world = matrix_of(attitude(middle))
        moved = velocity(middle) + to_world @ np.cross(gyro(middle), antenna)
        points.append(
            frame(
                random, round(time * 1e9), (to_world @ boresight_left).T @ moved, outliers=random.uniform(0, outliers)
            )
        )
        x, y, _ = to_world @ [0.0, 1.0, 0.0]
        along = np.array([x, y]) / math.hypot(x, y)
        truth.append([moved[:2] @ along, moved[:2] @ [-along[1], along[0]], moved[2]])
    return {"imu": imu, "points": points}, np.array(truth)


def speeds_of(
    inputs: Mapping[str, list[Sample]], rig: Mapping[str, Any] = LEVEL_RIG, **settings: Any
) -> list[GroundSpeed]:
    return run_operator(EgoVelocityOperator, inputs, rig=rig, settings=settings)["speed"]  # type: ignore[return-value]


def test_a_curved_walk_with_rests_a_swing_and_a_third_of_outliers() -> None:
    """The bars of the reference: 0.035 along, 0.045 to the left, bias 0.02 m/s, 90 % observed; and it is honest."""
    errors, nees, observed, total = [], [], 0, 0
    for seed in range(3):
        inputs, truth = curved_walk(seed, 0.35)
        for said, true in zip(speeds_of(inputs), truth, strict=True):
            total += 1
            if said.velocity_cov is None or said.velocity is None or said.velocity_cov[0] > 1e3:
                continue
            observed += 1
            error = np.array(said.velocity) - true[:2]
            xx, xy, yy = said.velocity_cov
            nees.append(error @ np.linalg.solve([[xx, xy], [xy, yy]], error) / 2.0)
            errors.append([*error, said.vertical - true[2], abs(error[0]) > 4.0 * math.sqrt(xx) + 0.01])
    along, left, up, wrong = np.array(errors).T
    assert observed > 0.97 * total
    assert max(abs(along.mean()), abs(left.mean())) < 0.015
    assert along.std() < 0.03
    assert left.std() < 0.04
    assert up.std() < 0.08
    assert wrong.mean() < 0.01
    assert 0.3 < np.mean(nees) < 1.5


def test_what_is_told_is_the_antennas_velocity_also_away_from_the_imu() -> None:
    """As everywhere in GroundSpeed: fusion takes the lever arm off."""
    antenna = (0.1, 0.6, 0.0)
    inputs, truth = curved_walk(4, 0.0, antenna)
    said = speeds_of(inputs, {**LEVEL_RIG, "antenna": antenna})
    seen = [each.valid for each in said]
    assert np.mean(seen) > 0.95
    error = np.array([each.velocity for each in said])[seen] - truth[seen, :2]
    assert abs(error.mean(axis=0)).max() < 0.015
    assert error.std(axis=0).max() < 0.04


def test_a_wild_frame_is_refused_and_what_lasts_is_believed() -> None:
    inputs, truth = curved_walk(0, 0.0)
    random = np.random.default_rng(9)
    points = list(inputs["points"])
    for index in (60, *range(150, len(points))):  # one frame, and then for good, on another planet
        points[index] = frame(random, points[index].stamp, np.array([-1.2, 0.8, 0.0]))
    said = speeds_of({**inputs, "points": points})
    assert not said[60].valid
    assert [each.valid for each in said[150:152]] == [False, True]
    assert said[61].valid
    assert said[61].velocity == pytest.approx(truth[61, :2], abs=0.1)


def test_no_points_no_attitude_and_no_words_beyond_the_bounds() -> None:
    none = np.zeros((0, 3), np.float32)
    empty = RadarPoints(
        stamp=10**9, position=none, doppler=none[:, 0], frame_time=0.02, doppler_step=0.1, doppler_limit=2.0
    )
    (said,) = speeds_of({"points": [empty], "imu": []})
    assert (said.valid, said.velocity, said.quality) == (False, (0.0, 0.0), math.inf)
    handled = run_operator(EgoVelocityOperator, {"imu": [Imu(stamp=1, gyro=(0, 0, 0))]}, rig=LEVEL_RIG)
    assert handled.refused["imu"] == 1


@pytest.mark.parametrize("boresight", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, -0.6, -0.8), (-1.0, 0.0, 0.0)])
def test_the_default_mounting_has_x_on_the_boresight_and_y_level(boresight: tuple[float, float, float]) -> None:
    turned = level_mounting(boresight)
    assert rotate(turned, (1.0, 0.0, 0.0)) == pytest.approx(boresight, abs=1e-12)
    left, up = rotate(turned, (0.0, 1.0, 0.0)), rotate(turned, (0.0, 0.0, 1.0))
    assert left[2] == pytest.approx(0.0, abs=1e-12)
    assert up[2] > 0.0
    assert math.hypot(*turned) == pytest.approx(1.0)


def test_a_matrix_gives_back_its_rotation() -> None:
    for vector in ((0.1, 0.2, -0.3), (3.1, 0.0, 0.1), (0.0, 3.1, 0.2), (0.1, 0.0, -3.1)):
        turned = from_rotation_vector(vector)
        again = from_matrix(matrix_of(turned))
        assert abs(sum(a * b for a, b in zip(turned, again, strict=True))) == pytest.approx(1.0)


def test_a_boresight_along_the_bodys_z_needs_an_orientation() -> None:
    with pytest.raises(MessageError, match=r"rig\.radar_orientation is not known"):
        speeds_of({"points": [], "imu": []}, {"boresight": [0.0, 0.0, -1.0]})


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_a_real_loop_held_in_the_hand_closes(seed: int) -> None:
    """23 m of an IWR6843 and an IMU; gyro yaw, and the velocities integrated, end where they began."""
    if not LOOP.exists():
        pytest.skip("../shared/data/ti-handheld-loop is not here")
    imu, points, rig = recorded(LOOP)
    loop = walked(imu, points, rig, seed=seed)
    assert loop.observed > 0.9 * len(points)
    assert 21.0 < loop.path < 26.0
    assert loop.end_to_start < 0.15
