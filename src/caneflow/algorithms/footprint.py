"""Where the radar's beam meets flat ground: antenna height, rays of the aperture, range rows (paper IV.B, fig. 7)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.rotations import Quaternion, Vector, depression_of, rotate


@dataclass(frozen=True, kw_only=True)
class CaneGeometry:
    """What is bolted on: wire.md, 'The rig'."""

    hand_height: float  # m, of the hand above the ground
    aperture: float  # rad, full -3 dB angle of the beam (delta)
    pivot: Vector  # m, from the sensors to the hand, body frame
    boresight: Vector = (0.0, 1.0, 0.0)  # unit vector of the beam's axis, body frame
    antenna: Vector = (0.0, 0.0, 0.0)  # m, from the IMU to the antenna, body frame


def antenna_height(geometry: CaneGeometry, orientation: Quaternion) -> float:
    """Height (m) of the antenna above the ground, the hand being at its nominal height (cane.md row 5)."""
    from_hand = tuple(a - p for a, p in zip(geometry.antenna, geometry.pivot, strict=True))
    return geometry.hand_height + rotate(orientation, (from_hand[0], from_hand[1], from_hand[2]))[2]


def pitch(geometry: CaneGeometry, orientation: Quaternion) -> float:
    """How far (rad) the boresight points below the horizontal: alpha0."""
    return depression_of(rotate(orientation, geometry.boresight))


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """The rays that meet the ground inside the recorded ranges; steepest last."""

    rows: NDArray[np.intp]  # shape (K,), the range bin of each
    cosines: NDArray[np.float64]  # shape (K,), cos of the angle to the ground at that bin's range


def rays_on_ground(
    offsets: NDArray[np.float64],
    *,
    height: float,  # m, of the antenna
    axis: float,  # rad, alpha0
    half_width: float,  # rad, to either side of the axis
    shallowest: float,  # rad
    steepest: float,  # rad
    range_start: float,  # m
    range_step: float,  # m
    bins: int,
) -> Rays:
    """Rays at angles `axis + half_width * offsets`, for `offsets` spread over -1..1, shape (K,).

    Angles that leave shallowest..steepest narrow the fan, so that the rays stay distinct. A ray's angle is that of the
    centre of its range bin, not the one asked for: a bin's rounding would cost up to 2 % of speed at steep angles.
    Rays beyond the recorded ranges are left out; there are none at all if the beam misses the ground.
    """
    low, high = max(axis - half_width, shallowest), min(axis + half_width, steepest)
    if not (low < high and height > 0):
        return Rays(rows=np.empty(0, dtype=np.intp), cosines=np.empty(0))
    sines = np.sin((low + high) / 2 + (high - low) / 2 * offsets)
    rows = np.rint((height / sines - range_start) / range_step).astype(np.intp)
    sines = np.minimum(height / (range_start + rows * range_step), math.sin(steepest))
    cosines = np.sqrt(1 - sines * sines)
    if rows[0] < bins and rows[-1] >= 0:  # ranges shrink with the angle: the ends decide for all
        return Rays(rows=rows, cosines=cosines)
    inside = (rows >= 0) & (rows < bins)
    return Rays(rows=rows[inside], cosines=cosines[inside])
