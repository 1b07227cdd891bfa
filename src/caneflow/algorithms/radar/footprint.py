"""Where the radar's beam meets flat ground: antenna height, rays of the aperture, range bins (paper fig. 7)."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.radar.range_doppler import range_of_bin
from caneflow.algorithms.rotations import Quaternion, Vector, depression_of, rotate


@dataclass(frozen=True, kw_only=True)
class CaneGeometry:
    """What is bolted on: wire.md, 'The rig'."""

    hand_height: float  # m, of the hand above the ground
    aperture: float  # rad, full -3 dB angle of the beam (delta)
    pivot: Vector  # m, from the sensors to the hand, body frame
    boresight: Vector = (0.0, 1.0, 0.0)  # unit vector of the beam's axis, body frame
    antenna: Vector = (0.0, 0.0, 0.0)  # m, from the IMU to the antenna, body frame
    aperture_across: float | None = None  # rad, full -3 dB angle across the cane; None: as `aperture`


def antenna_height(geometry: CaneGeometry, orientation: Quaternion) -> float:
    """Height (m) of the antenna above the ground, the hand being at its nominal height (cane.md row 5)."""
    (ax, ay, az), (px, py, pz) = geometry.antenna, geometry.pivot
    return geometry.hand_height + rotate(orientation, (ax - px, ay - py, az - pz))[2]


def pitch(geometry: CaneGeometry, orientation: Quaternion) -> float:
    """How far (rad) the boresight points below the horizontal: alpha0."""
    return depression_of(rotate(orientation, geometry.boresight))


@dataclass(frozen=True, kw_only=True)
class Fan:
    """Which rays to cast."""

    rays: int  # K
    half_width: float  # rad, to either side of the axis
    shallowest: float  # rad, to the ground
    steepest: float  # rad


class Rays(NamedTuple):
    """The rays that meet the ground inside the recorded ranges; empty if there are none."""

    rows: NDArray[np.intp]  # shape (K + 2,), growing range bins: ray i is row i + 1, between its neighbours
    cosines: list[float]  # K, cos of a ray's angle to the ground


NO_RAYS = Rays(rows=np.empty(0, dtype=np.intp), cosines=[])


class RayCaster:
    """Rays of one fan, for scans of one shape.

    Rays are spread evenly in range, not in angle: every cell of range resolution is then looked at equally often,
    and the estimate varies less by a fifth. One row more at either end gives every ray two neighbours.
    """

    def __init__(self, fan: Fan, *, bins: int, range_start: float, range_step: float) -> None:
        """For scans of `bins` range bins from `range_start` m on, every `range_step` m."""
        self._fan = fan
        self._start, self._step = range_start, range_step
        self._nearest, self._farthest = range_start, range_start + (bins - 1) * range_step
        self._shares = np.linspace(0.0, 1.0, fan.rays + 2)
        self._steepest = math.sin(fan.steepest) ** 2
        ranges = range_of_bin(np.arange(bins), start=range_start, step=range_step)
        with np.errstate(divide="ignore"):  # no ray has range 0
            self._inverse_squares: list[float] = (1.0 / ranges**2).tolist()  # 1/m^2, of each bin

    def cast(self, *, height: float, axis: float) -> Rays:
        """The rays of an antenna at `height` m whose beam points `axis` rad (alpha0) below the horizontal.

        None if half of the fan or more leaves the sensible angles, or half of its ground the recorded ranges.
        """
        fan = self._fan
        low, high = max(axis - fan.half_width, fan.shallowest), min(axis + fan.half_width, fan.steepest)
        if high - low < fan.half_width or height <= 0:
            return NO_RAYS
        near, far = height / math.sin(high), height / math.sin(low)
        first, last = max(near, self._nearest), min(far, self._farthest)
        if last - first < 0.5 * (far - near):
            return NO_RAYS
        scaled = self._shares * ((last - first) / self._step)
        scaled += (first - self._start) / self._step + 0.5
        rows = scaled.astype(np.intp)
        # A ray's angle is that of its bin's centre: rounding would cost up to 2 % of speed at steep angles.
        # Plain Python: for a handful of numbers, numpy's calls cost more.
        square, steepest, inverse, root = height * height, self._steepest, self._inverse_squares, math.sqrt
        bins = rows.tolist()[1:-1]
        if square * inverse[bins[0]] <= steepest:  # the nearest ray is the steepest
            return Rays(rows=rows, cosines=[root(1.0 - square * inverse[row]) for row in bins])
        return Rays(rows=rows, cosines=[root(1.0 - min(square * inverse[row], steepest)) for row in bins])
