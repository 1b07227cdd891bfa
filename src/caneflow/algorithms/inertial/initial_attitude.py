"""Attitude from one reading: the accelerometer tells what is up, the magnetometer where magnetic north is.

World: x east, y magnetic north, z up. An attitude that no magnetometer told has a yaw that means nothing.
"""

import math
from typing import NamedTuple, Protocol

from caneflow.algorithms.rotations import Quaternion, Vector, from_yaw, multiply, rotate, yaw_of

NORTH_YAW = 0.5 * math.pi  # rad, yaw of y
SHORTEST_VECTOR = 1e-9  # m/s^2 or uT; below, there is no direction


class AttitudeEstimate(NamedTuple):
    """How the body is turned at the stamp of the sample that asked."""

    orientation: Quaternion  # w x y z, body to world
    gyro_bias: Vector  # rad/s, body; what the filter takes off the gyro
    spread: float = 0.0  # rad, sd of what is still unknown since a hole in the samples


class AttitudeMethod(Protocol):
    """The shape of every attitude filter: raw readings in, one estimate per reading out."""

    @property
    def gaps(self) -> int:
        """How many intervals between samples were too long to integrate over."""

    def update(self, stamp_ns: int, gyro: Vector, accel: Vector | None, mag: Vector | None = None) -> AttitudeEstimate:
        """The estimate at `stamp_ns`: rad/s, specific force in m/s^2, uT (any scale), all in the body frame."""


def level(up: Vector) -> Quaternion:
    """The shortest rotation that turns `up` (body, any length) to z.

    Raises ValueError for a vector of (nearly) no length.
    """
    x, y, z = up
    norm = math.sqrt(x * x + y * y + z * z)
    if not norm > SHORTEST_VECTOR:  # written so that NaN is refused
        raise ValueError(f"a specific force of {norm:.3g} m/s^2 does not tell what is up")
    # half-way quaternion (|up| + up.z, up x z), normalised; the sum written so that it keeps its digits
    w = norm + z if z > 0.0 else (x * x + y * y) / (norm - z)
    length = math.sqrt(w * w + x * x + y * y)
    if length < 1e-150 + 1e-15 * norm:  # upside down: every horizontal axis is as short
        return 0.0, 1.0, 0.0, 0.0
    return w / length, y / length, -x / length, 0.0


def initial_attitude(accel: Vector, mag: Vector | None = None) -> Quaternion:
    """Body to world from a specific force at rest and, where there is one, a magnetic field.

    Without `mag`, or with one that is vertical, the shortest rotation that is level. Raises ValueError for a
    specific force of no length.
    """
    tilt = level(accel)
    if mag is None:
        return tilt
    north = rotate(tilt, mag)
    if math.hypot(north[0], north[1]) < SHORTEST_VECTOR:
        return tilt
    return multiply(from_yaw(NORTH_YAW - yaw_of(north)), tilt)


def required_start(accel: Vector | None, method: str) -> Vector:
    """The accelerometer's reading, or a ValueError that says why there must be one at the start."""
    if accel is None:
        raise ValueError(f"{method}: the first imu sample has no accel; without it nothing tells what is up")
    return accel
