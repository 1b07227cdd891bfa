"""Real sensors: attitude against cameras (BROAD, trial 21), and a foot's walk that ends where it starts.

Both recordings are others' and lie beside the repository; without them the tests are skipped.
"""

import csv
import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import loadmat

from caneflow.algorithms.cane.naive_ins import NaiveIns, NaiveInsSettings
from caneflow.algorithms.cane.zero_velocity import StanceSettings, ZeroVelocity, ZeroVelocitySettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.initial_attitude import AttitudeMethod
from caneflow.algorithms.inertial.madgwick import Madgwick, MadgwickSettings
from caneflow.algorithms.rotations import Vector
from caneflow.protocols.imu_csv import ImuTable, Joined, Reading

DATA = Path(__file__).parents[1].parent / "shared" / "data"
BROAD = DATA / "broad-imu" / "21_undisturbed_fast_combined.mat"
GAIT = DATA / "gait-loop-imu" / "short_walk.csv"

Samples = list[Vector]


class Trial(NamedTuple):
    """A hand-moved sensor, seen by cameras."""

    stamps: list[int]  # ns
    gyro: Samples
    accel: Samples
    mag: Samples
    truth: NDArray[np.float64]  # (n, 4) quaternions; NaN where the cameras lost it
    moving: NDArray[np.bool_]  # which samples count


class Errors(NamedTuple):
    """RMS over the moving samples, degrees."""

    total: float
    heading: float
    inclination: float


@pytest.fixture(scope="module")
def trial() -> Trial:
    if not BROAD.exists():
        pytest.skip("the BROAD recording, shared/data/broad-imu, is not here")
    content = loadmat(BROAD, squeeze_me=True)
    stamps = np.round(np.arange(len(content["imu_gyr"])) / content["sampling_rate"] * 1e9).astype(np.int64)
    gyro, accel, mag = (list(map(tuple, content[f"imu_{name}"].tolist())) for name in ("gyr", "acc", "mag"))
    return Trial(stamps.tolist(), gyro, accel, mag, content["opt_quat"], content["movement"].astype(bool))


def orientations(method: AttitudeMethod, trial: Trial) -> NDArray[np.float64]:
    rows = zip(trial.stamps, trial.gyro, trial.accel, trial.mag, strict=True)
    return np.array([method.update(*row).orientation for row in rows])


def errors_of(estimates: NDArray[np.float64], trial: Trial) -> Errors:
    """BROAD's own metric: the error's rotation in the world, split into heading and inclination; no alignment."""
    w, x, y, z = estimates.T
    a, b, c, d = trial.truth.T
    # estimate times the inverse of the truth
    error_w, error_z = a * w + b * x + c * y + d * z, a * z - d * w - c * x + b * y
    seen = trial.moving & np.isfinite(error_w)
    norm = np.linalg.norm(trial.truth[seen], axis=1)
    error_w, error_z = error_w[seen] / norm, error_z[seen] / norm

    def rms(angles: NDArray[np.float64]) -> float:
        return math.degrees(math.sqrt(float(np.mean(np.square(angles)))))

    return Errors(
        rms(2.0 * np.arccos(np.clip(np.abs(error_w), 0, 1))),
        rms(2.0 * np.arctan(error_z / error_w)),
        rms(2.0 * np.arccos(np.clip(np.hypot(error_w, error_z), 0, 1))),
    )


@pytest.fixture(scope="module")
def own(trial: Trial) -> Errors:
    return errors_of(orientations(AttitudeFilter(AttitudeFilterSettings()), trial), trial)


@pytest.fixture(scope="module")
def madgwick(trial: Trial) -> Errors:
    return errors_of(orientations(Madgwick(MadgwickSettings()), trial), trial)


def test_the_metric_sees_a_turn_of_the_truth_as_that_turn(trial: Trial) -> None:
    """Two degrees about the vertical and one about east: total 2.24, split into the two."""
    half_z, half_x = math.radians(1.0), math.radians(0.5)
    w, x, y, z = trial.truth.T
    turned = np.stack((w - half_x * x, x + half_x * w, y - half_x * z, z + half_x * y), axis=1)
    w, x, y, z = turned.T
    turned = np.stack((w - half_z * z, x - half_z * y, y + half_z * x, z + half_z * w), axis=1)
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    assert errors_of(turned, trial) == pytest.approx((math.sqrt(5.0), 2.0, 1.0), abs=0.01)


def test_attitude_against_cameras(own: Errors) -> None:
    """Measured: 3.56 in total, 3.05 heading, 1.85 inclination."""
    assert own.total < 4.0
    assert own.heading < 3.5
    assert own.inclination < 2.1


def test_it_is_better_than_madgwicks(own: Errors, madgwick: Errors) -> None:
    """Measured for Madgwick's own gain: 7.42, 6.08, 4.25."""
    assert own.total < 0.7 * madgwick.total
    assert own.heading < 0.7 * madgwick.heading
    assert own.inclination < 0.7 * madgwick.inclination
    assert madgwick.total < 9.0


def test_it_is_not_worse_than_a_kept_library(own: Errors, trial: Trial) -> None:
    """Measured for vqf 2.1.2 with its defaults: 4.08, 3.70, 1.72."""
    vqf = pytest.importorskip("vqf", reason="the reference filter is not installed: pip install vqf")
    period = (trial.stamps[-1] - trial.stamps[0]) * 1e-9 / (len(trial.stamps) - 1)
    reference = vqf.VQF(period).updateBatch(*(np.array(part) for part in (trial.gyro, trial.accel, trial.mag)))
    theirs = errors_of(reference["quat9D"], trial)
    assert own.total < 1.2 * theirs.total
    assert own.heading < 1.2 * theirs.heading
    assert own.inclination < 1.2 * theirs.inclination


@pytest.fixture(scope="module")
def steps() -> list[Reading]:
    if not GAIT.exists():
        pytest.skip("the foot's recording, shared/data/gait-loop-imu, is not here")
    columns = {"time": "Time"}
    for axis in "xyz":
        columns[f"gyro_{axis}"] = f"Gyroscope {axis.upper()}"
        columns[f"accel_{axis}"] = f"Accelerometer {axis.upper()}"
    with GAIT.open(newline="") as lines:
        rows = ImuTable(lines, columns=columns, units={})
    assert rows.units["gyro"].unit == "deg/s"
    assert rows.units["accel"].unit == "g"
    assert rows.notes == ["205 rows written twice, taken once (first in line 4)"]
    assert str(rows.refusals) == "no row left out"
    return list(Joined([rows]).readings())


def test_the_rows_that_the_importer_leaves_out_are_repetitions(steps: list[Reading]) -> None:
    """Each is, to the last digit, the row before it: a logger that wrote a reading twice."""
    with GAIT.open(newline="") as lines:
        rows = list(csv.reader(lines))[1:]
    assert sum(one == other for one, other in pairwise(rows)) == 205
    assert len(rows) - 205 == len(steps)


def end_error(settings: ZeroVelocitySettings, steps: list[Reading]) -> tuple[float, float]:
    """How far, m, it ends from where it began, and how long, m, the walk was."""
    method = ZeroVelocity(settings)
    track = np.array([method.imu(step.stamp, ImuReading(step.gyro, step.accel)).position for step in steps])
    length = float(np.linalg.norm(np.diff(track[::10], axis=0), axis=1).sum())
    return float(np.linalg.norm(track[-1] - track[0])), length


def test_zero_velocity_closes_the_loop(steps: list[Reading]) -> None:
    """Measured: 0.20 m, nearly all of it height, after 26 m; nothing in the settings is from this walk."""
    error, length = end_error(ZeroVelocitySettings(), steps)
    assert error < 0.3
    assert 23.0 < length < 28.0


@pytest.mark.long
def test_the_loop_closes_with_other_thresholds_too(steps: list[Reading]) -> None:
    """Half as much again: 0.26 m, so that the default is not a lucky choice."""
    stance = StanceSettings(accel=1.5 * 1.7, gyro=math.radians(1.5 * 17.0))
    error, _ = end_error(ZeroVelocitySettings(stance=stance), steps)
    assert error < 0.4


def test_without_zero_velocity_the_walk_drifts_away(steps: list[Reading]) -> None:
    """Measured: 35 m with the attitude filter's orientation."""
    attitude, naive = AttitudeFilter(AttitudeFilterSettings()), NaiveIns(NaiveInsSettings())
    for step in steps:
        orientation = attitude.update(step.stamp, step.gyro, step.accel).orientation
        pose = naive.imu(step.stamp, ImuReading(step.gyro, step.accel, orientation=orientation))
    assert math.hypot(*pose.position) > 10.0
