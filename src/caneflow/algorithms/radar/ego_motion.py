"""Velocities of a radar, one after the other: the last one, and what the accelerometer felt since, say where to look.

A guess that is far from that must win by several points (`ego_velocity`), and a velocity that is far from it is not
believed at once. The prediction is not part of the result, so that errors of one frame do not reach the next.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Final, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.inertial.attitude_history import LONGEST_STEP_NS, AttitudeHistory
from caneflow.algorithms.quantities import Acceleration, Factor, Time
from caneflow.algorithms.radar.ego_velocity import EgoVelocity, EgoVelocitySettings, Prior, ego_velocity, usable
from caneflow.algorithms.rotations import Quaternion, Vector, multiply, normalized, rotate
from caneflow.physics import GRAVITY

Floats = NDArray[np.float64]

_LEVEL: Final = 0.1  # length of the boresight's horizontal projection below which it has no direction: 84 deg down


@dataclass(frozen=True, kw_only=True)
class EgoMotionSettings:
    """How one velocity leads to the next."""

    points: EgoVelocitySettings = field(default_factory=EgoVelocitySettings)
    acceleration_error: Acceleration = 0.5  # m/s^2, sd of the accelerometer's in R0: 3 deg of tilt
    unknown_acceleration: Acceleration = 4.0  # m/s^2, sd without an accelerometer: a hand that swings
    gate: Factor = 4.0  # standard deviations from the prediction, beyond which a velocity is not believed at once
    most_held: Annotated[int, Ge(0), Le(1000)] = 1  # frames in a row; what lasts longer is believed
    longest_gap: Time = 1.0  # s, after which the last velocity says nothing


@dataclass(frozen=True, kw_only=True)
class RadarMounting:
    """Where the radar sits on the body."""

    to_body: Quaternion  # radar frame to body frame
    boresight: Vector  # body frame, along whose horizontal projection a velocity is told
    antenna: Vector  # m, from the IMU, body frame


class AntennaVelocity(NamedTuple):
    """Velocity of the antenna over ground: along the boresight's horizontal projection, to its left, up."""

    velocity: Floats  # (3,) m/s
    covariance: Floats  # (3, 3)
    points: int  # that agree


def level_mounting(boresight: Vector) -> Quaternion:
    """Radar frame to body frame, x on `boresight` (a unit vector) and y horizontal while the body's z points up.

    Raises:
        ValueError: a boresight along the body's z has no left.
    """
    x, y, z = boresight
    across = math.hypot(x, y)
    if across < 1e-3:
        raise ValueError("the boresight is the body's z axis, so that nothing says where left is")
    left = (-y / across, x / across, 0.0)
    up = (y * left[2] - z * left[1], z * left[0] - x * left[2], x * left[1] - y * left[0])
    return from_matrix(np.array([boresight, left, up]).T)


def from_matrix(matrix: Floats) -> Quaternion:
    """The unit quaternion of a rotation matrix, (3, 3); by its largest component, which is never near 0."""
    m = matrix.tolist()
    squares = [
        1.0 + m[0][0] + m[1][1] + m[2][2],
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
    ]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2]
    rows = ((squares[0], x, y, z), (x, squares[1], xy, xz), (y, xy, squares[2], yz), (z, xz, yz, squares[3]))
    return normalized(rows[squares.index(max(squares))])


class EgoMotion:
    """Takes IMU samples and frames of points as they come; its state is the last velocity and what was felt since."""

    def __init__(self, settings: EgoMotionSettings, mounting: RadarMounting) -> None:
        self._settings, self._mounting = settings, mounting
        self._attitudes = AttitudeHistory()
        self._gyro: Vector = (0.0, 0.0, 0.0)
        self._imu_ns: int | None = None  # stamp of the last sample
        self._gained = np.zeros(3)  # m/s in R0, by the accelerometer since the last velocity
        self._unfelt = 0.0  # s since then without an accelerometer
        self._last_ns: int | None = None  # of the last velocity that was believed
        self._last = Prior(np.zeros(3), np.zeros((3, 3)))  # R0, of the IMU's origin
        self._held = 0  # frames in a row

    def imu(self, stamp_ns: int, orientation: Quaternion, gyro: Vector, accel: Vector | None) -> None:
        """An attitude (body to R0), a turn rate (rad/s), and a specific force (m/s^2, body) where there is one."""
        elapsed_ns = stamp_ns - self._imu_ns if self._imu_ns is not None else 0
        self._attitudes.add(stamp_ns, orientation, gyro)
        self._imu_ns, self._gyro = stamp_ns, gyro
        if accel is None or elapsed_ns > LONGEST_STEP_NS:
            self._unfelt += elapsed_ns * 1e-9
            return
        x, y, z = rotate(orientation, accel)
        self._gained += np.array([x, y, z - GRAVITY]) * (elapsed_ns * 1e-9)

    def update(
        self,
        middle_ns: int,
        position: NDArray[np.floating],
        doppler: NDArray[np.floating],
        snr: NDArray[np.floating] | None,
        *,
        doppler_step: float,
        doppler_limit: float,
        random: np.random.Generator,
    ) -> AntennaVelocity | None:
        """The velocity in the middle of a frame, at `middle_ns`; points as in `ego_velocity`.

        None where there is no attitude, where the points do not tell, and where what they tell is not believed yet.
        """
        settings = self._settings
        orientation = self._attitudes.near(middle_ns)
        if orientation is None:
            return None
        to_world = matrix_of(multiply(orientation, self._mounting.to_body))
        lever = np.array(rotate(orientation, _cross(self._gyro, self._mounting.antenna)))
        known = self._known(middle_ns)
        places = position.astype(np.float64)
        kept = usable(places, None if snr is None else snr.astype(np.float64), settings.points)
        found = ego_velocity(
            places[kept],
            doppler[kept].astype(np.float64),
            doppler_step=doppler_step,
            doppler_limit=doppler_limit,
            settings=settings.points,
            random=random,
            prior=None if known is None else _seen_from(known, to_world, lever),
        )
        if found is None:
            return None
        world = Prior(to_world @ found.velocity - lever, to_world @ found.covariance @ to_world.T)
        if known is not None and self._is_wild(known, world):
            return None
        self._held = 0
        self._last, self._last_ns = world, middle_ns
        self._gained, self._unfelt = np.zeros(3), 0.0
        return self._over_ground(found, orientation, to_world)

    def _known(self, at_ns: int) -> Prior | None:
        """Where the IMU's velocity (R0) should be by now; None where nothing says so."""
        if self._last_ns is None:
            return None
        elapsed = (at_ns - self._last_ns) * 1e-9
        if not 0.0 <= elapsed <= self._settings.longest_gap:
            return None
        unfelt = min(self._unfelt, elapsed)
        error = self._settings.acceleration_error * (elapsed - unfelt) + self._settings.unknown_acceleration * unfelt
        covariance = self._last.covariance + error * error * np.eye(3)
        return Prior(self._last.velocity + self._gained, covariance)

    def _is_wild(self, known: Prior, found: Prior) -> bool:
        """Whether a velocity is too far from where it should be, and was not so in the frames before."""
        apart = found.velocity - known.velocity
        square = float(apart @ np.linalg.solve(known.covariance + found.covariance, apart))
        if square <= self._settings.gate**2 or self._held >= self._settings.most_held:
            return False
        self._held += 1
        return True

    def _over_ground(self, found: EgoVelocity, orientation: Quaternion, to_world: Floats) -> AntennaVelocity | None:
        x, y, _ = rotate(orientation, self._mounting.boresight)
        along = math.hypot(x, y)
        if along < _LEVEL:
            return None
        ahead = np.array([[x / along, y / along, 0.0], [-y / along, x / along, 0.0], [0.0, 0.0, 1.0]]) @ to_world
        return AntennaVelocity(ahead @ found.velocity, ahead @ found.covariance @ ahead.T, found.agreeing)


def matrix_of(orientation: Quaternion) -> Floats:
    """The rotation as a matrix, (3, 3)."""
    columns = [rotate(orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    return np.array(columns).T


def _seen_from(known: Prior, to_world: Floats, lever: Floats) -> Prior:
    """The antenna's velocity in the radar frame, from that of the IMU in R0."""
    return Prior(to_world.T @ (known.velocity + lever), to_world.T @ known.covariance @ to_world)


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
