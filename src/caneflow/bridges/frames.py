"""The frames of REP 103 and REP 105 for a rig: odom, base_footprint, base_link, imu_link, radar_link.

`base_link` lies at the origin of the IMU: x along the radar's boresight, z as near to the body's z as possible,
y = z cross x. So its yaw is the yaw of the boresight. `imu_link` is the body frame of the messages.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, from_yaw, multiply, rotate
from caneflow.messages.rig import Rig

ODOM, MAP = "odom", "map"
FOOTPRINT, BASE, IMU, RADAR = "base_footprint", "base_link", "imu_link", "radar_link"
VERTICAL = 1e-6  # a boresight whose z is this near to 1 has no horizontal part to speak of


class Transform(NamedTuple):
    """Where a frame is in its parent: its origin (m), and the rotation of its vectors into those of the parent."""

    parent: str
    child: str
    translation: Vector
    rotation: Quaternion


@dataclass(frozen=True)
class Frames:
    """How the frames of one rig lie to each other."""

    world: str  # the name of R0
    mounting: Quaternion  # turns vectors of base_link into those of the body
    antenna: Vector  # m, in base_link

    def fixed(self) -> list[Transform]:
        """What is bolted on: the IMU and the radar's antenna in base_link."""
        return [
            Transform(BASE, IMU, (0.0, 0.0, 0.0), conjugate(self.mounting)),
            Transform(BASE, RADAR, self.antenna, (1.0, 0.0, 0.0, 0.0)),
        ]

    def moving(self, position: Vector, orientation: Quaternion) -> list[Transform]:
        """Of a pose (m; body to world): world -> base_footprint, level, and from there -> base_link."""
        turn = self.base(orientation)
        x, y, z = position
        ahead = rotate(turn, (1.0, 0.0, 0.0))
        level = from_yaw(math.atan2(ahead[1], ahead[0]))
        return [
            Transform(self.world, FOOTPRINT, (x, y, 0.0), level),
            Transform(FOOTPRINT, BASE, (0.0, 0.0, z), multiply(conjugate(level), turn)),
        ]

    def base(self, orientation: Quaternion) -> Quaternion:
        """The rotation of base_link into the world, of a body with `orientation`."""
        return multiply(orientation, self.mounting)


def frames_of(rig: Rig, world: str | None = None) -> Frames:
    """The frames of `rig`; the world is `odom`, which drifts without jumps, or for the sensors of a room `map`."""
    mounting = _mounting(rig.boresight)
    named = world or (MAP if rig.sensors else ODOM)
    return Frames(named, mounting, rotate(conjugate(mounting), rig.antenna))


def _mounting(boresight: Vector) -> Quaternion:
    x = np.array(boresight) / np.linalg.norm(boresight)
    up = np.array([0.0, 0.0, 1.0] if abs(x[2]) < 1 - VERTICAL else [1.0, 0.0, 0.0])
    z = up - (up @ x) * x
    z /= np.linalg.norm(z)
    return quaternion_of(np.stack([x, np.cross(z, x), z], axis=1))


def quaternion_of(matrix: np.ndarray) -> Quaternion:
    """The rotation (3, 3) as a quaternion, by its largest component, so that none is divided by nearly nothing."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]  # four times those of w, x, y, z
    largest = max(range(4), key=squares.__getitem__)
    rows = [
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    ]
    w, x, y, z = rows[largest]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm


def matrix_of(rotation: Quaternion) -> np.ndarray:
    """The rotation as a matrix (3, 3)."""
    w, x, y, z = rotation
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )
