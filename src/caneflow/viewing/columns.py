"""What the page is told of a sample: a row of numbers by kind of message, in the units of the wire."""

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from caneflow.algorithms.rotations import Quaternion, Vector, depression_of, rotate, yaw_of
from caneflow.messages import Cue, DopplerTarget, GroundSpeed, Imu, Obstacles, Pose, Sample
from caneflow.messages.arrays import Array

Row: TypeAlias = tuple[float, ...]

NAN = math.nan
SIGMAS = 2.0  # of the ellipse: it holds the position in 86 % of the cases, if the estimator is honest
NO_ELLIPSE = (NAN, NAN, NAN)

SECTORS = ("left", "ahead", "right")
LEVELS = ("low", "waist", "head", "drop")
CUE_KINDS = ("none", "obstacle", "drop", "blind")  # a row has their number
PLACES = tuple(f"{sector}_{level}" for sector in SECTORS for level in LEVELS)

# What is not there, or not known, is NaN. The first columns are the wire's own numbers, unchanged.
COLUMNS: Mapping[type[Sample], tuple[str, ...]] = {
    Imu: ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z", "yaw", "pitch"),
    GroundSpeed: ("speed", "quality", "rays", "valid", "delay"),
    Pose: ("x", "y", "z", "vx", "vy", "vz", "yaw", "major", "minor", "turn"),
    DopplerTarget: ("range_rate", "signed", "amplitude", "snr", "valid", "range"),
    Obstacles: ("heading", "walking", *PLACES, *(f"known_{place}" for place in PLACES)),
    Cue: ("kind", "level", "distance", "azimuth", "urgency"),
}


def message_name(schema: str) -> str:
    """The message's name as the page has it: `Imu` for ours, `mine.Range` for a user's own."""
    return schema.removeprefix("caneflow.").partition("/")[0]


def row_of(message: Sample, boresight: Vector) -> Row:
    """The numbers of `message` in the order of COLUMNS; () for kinds of which only stamps are told.

    yaw and pitch (rad) are of the `boresight`, a body vector; major, minor (m) and turn (rad, counter-clockwise
    from x0) of the ellipse of SIGMAS standard deviations of the horizontal position.
    """
    make = _ROWS.get(type(message))
    return make(message, boresight) if make else ()


def ellipse(covariance: Array | None) -> tuple[float, float, float]:
    """Semi-axes (m) and direction (rad) of the ellipse of SIGMAS of a (6, 6) covariance's x and y; NaN for None."""
    if covariance is None:
        return NO_ELLIPSE
    xx, xy, yy = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    if not mean + half >= 0.0:
        return NO_ELLIPSE  # no covariance at all
    minor = math.sqrt(max(mean - half, 0.0))
    return SIGMAS * math.sqrt(mean + half), SIGMAS * minor, 0.5 * math.atan2(2.0 * xy, xx - yy)


def packed(rows: list[Row]) -> bytes:
    """Rows as little-endian float64, row after row."""
    return np.array(rows, dtype="<f8").tobytes()


def _imu(imu: Any, boresight: Vector) -> Row:
    accel = imu.accel if imu.accel is not None else imu.linear_accel
    return (*imu.gyro, *(accel or (NAN, NAN, NAN)), *_direction(imu.orientation, boresight))


def _direction(orientation: Quaternion | None, boresight: Vector) -> tuple[float, float]:
    if orientation is None:
        return NAN, NAN
    pointing = rotate(orientation, boresight)
    return yaw_of(pointing), depression_of(pointing)


def _speed(speed: Any, _: Vector) -> Row:
    delay = NAN if speed.delay is None else speed.delay
    return speed.speed, speed.quality, float(speed.rays), float(speed.valid), delay


def _pose(pose: Any, boresight: Vector) -> Row:
    yaw = _direction(pose.orientation, boresight)[0]
    return (*pose.position, *pose.velocity, yaw, *ellipse(pose.covariance))


def _target(target: Any, _: Vector) -> Row:
    distance = NAN if target.range is None else target.range
    return target.range_rate, float(target.signed), target.amplitude, target.snr, float(target.valid), distance


def _obstacles(obstacles: Any, _: Vector) -> Row:
    nearest, known = (each.reshape(-1).tolist() for each in (obstacles.nearest, obstacles.known))
    return obstacles.heading, float(obstacles.walking), *nearest, *known


def _cue(cue: Any, _: Vector) -> Row:
    level = NAN if cue.level is None else float(LEVELS.index(cue.level))
    told = (NAN if each is None else each for each in (cue.distance, cue.azimuth, cue.urgency))
    return float(CUE_KINDS.index(cue.kind)), level, *told


_ROWS: Mapping[type[Sample], Callable[[Any, Vector], Row]] = {
    Imu: _imu,
    GroundSpeed: _speed,
    Pose: _pose,
    DopplerTarget: _target,
    Obstacles: _obstacles,
    Cue: _cue,
}
