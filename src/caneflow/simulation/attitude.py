"""Arrays of quaternions `[w, x, y, z]` that turn body vectors into world vectors.

The algorithms turn one sample at a time; a simulated walk turns fifty thousand at once.
World: z up. Yaw: of the body's y axis (the boresight) from x0, counter-clockwise. Pitch: boresight below the
horizontal, positive down (wire.md). Roll: about the boresight.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]

DEGREE = np.pi / 180.0  # rad


def from_angles(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """Quaternions of shape (n, 4) for yaw, pitch and roll of shape (n,), rad."""
    about_z = _about(2, yaw - 0.5 * np.pi)
    return multiply(multiply(about_z, _about(0, -pitch)), _about(1, roll))


def multiply(left: Floats, right: Floats) -> Floats:
    """The rotations `right` first, then `left` (Hamilton product), shape (n, 4)."""
    a, b, c, d = np.moveaxis(left, -1, 0)
    w, x, y, z = np.moveaxis(right, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def conjugate(orientation: Floats) -> Floats:
    """The inverse rotations, shape (n, 4)."""
    inverse: Floats = orientation * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def rotate(orientation: Floats, vector: ArrayLike) -> Floats:
    """World vectors of shape (n, 3) for body vectors of shape (n, 3) or (3,)."""
    v = np.asarray(vector, dtype=np.float64)
    scalar, axis = orientation[..., :1], orientation[..., 1:]
    t = 2.0 * np.cross(axis, v)
    return v + scalar * t + np.cross(axis, t)


def from_rotation_vector(vector: Floats) -> Floats:
    """Rotations by |vector| rad about `vector` (exponential map), (n, 3) to (n, 4)."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def to_rotation_vector(orientation: Floats) -> Floats:
    """Rotation vectors (rad) of the short way round, (n, 4) to (n, 3); inverse of `from_rotation_vector`."""
    short = orientation * np.where(orientation[..., :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(short[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, short[..., :1])
    # angle / sin(angle / 2) tends to 2 where the quotient is 0 / 0
    vector: Floats = short[..., 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    return vector


def yaw_of(orientation: Floats) -> Floats:
    """Yaw (rad, -pi..pi) of the body's y axis, (n, 4) to (n,)."""
    w, x, y, z = np.moveaxis(orientation, -1, 0)
    yaw: Floats = np.arctan2(1.0 - 2.0 * (x * x + z * z), 2.0 * (x * y - w * z))
    return yaw


def _about(axis: int, angle: Floats) -> Floats:
    """Rotations by `angle` (n,) about a coordinate axis, (n, 4)."""
    out = np.zeros((*np.shape(angle), 4))
    out[..., 0] = np.cos(0.5 * angle)
    out[..., 1 + axis] = np.sin(0.5 * angle)
    return out
