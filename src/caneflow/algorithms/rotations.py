"""Quaternions `[w, x, y, z]` that turn body vectors into world vectors, for one sample at a time.

Plain Python floats, not arrays: for four numbers numpy's call overhead is ten times the arithmetic.
World: z up. Yaw counter-clockwise about z from x; pitch positive when the boresight points down (wire.md).
"""

import math
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def rotate(orientation: Quaternion, vector: Vector) -> Vector:
    """The world vector for a body `vector`: q v q*, written out (unit quaternion assumed)."""
    w, x, y, z = orientation
    a, b, c = vector
    # t = 2 (q_vec x v);  v' = v + w t + q_vec x t
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * tx + y * tz - z * ty,
        b + w * ty + z * tx - x * tz,
        c + w * tz + x * ty - y * tx,
    )


def conjugate(orientation: Quaternion) -> Quaternion:
    """The inverse rotation: world vectors into body vectors."""
    w, x, y, z = orientation
    return w, -x, -y, -z


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """The rotation `right` first, then `left` (Hamilton product)."""
    a, b, c, d = left
    w, x, y, z = right
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def normalized(orientation: Quaternion) -> Quaternion:
    """The same rotation as a unit quaternion; raises ValueError for a quaternion of (nearly) no length."""
    w, x, y, z = orientation
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm < 1e-9:
        raise ValueError(f"a quaternion of norm {norm:.3g} is not a rotation")
    return w / norm, x / norm, y / norm, z / norm


def from_rotation_vector(vector: Vector) -> Quaternion:
    """The rotation by |vector| rad about `vector` (exponential map)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    # sin(a/2)/a, by its series where the quotient loses digits
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), scale * x, scale * y, scale * z


def from_yaw(yaw: float) -> Quaternion:
    """The rotation by `yaw` rad about the world's z."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


def yaw_of(vector: Vector) -> float:
    """Yaw (rad, -pi..pi) of a world vector's horizontal projection."""
    return math.atan2(vector[1], vector[0])


def depression_of(vector: Vector) -> float:
    """How far (rad, -pi/2..pi/2) a world vector points below the horizontal; positive down."""
    return math.atan2(-vector[2], math.hypot(vector[0], vector[1]))


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
