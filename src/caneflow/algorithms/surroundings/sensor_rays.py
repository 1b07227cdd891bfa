"""Where the zones of a range sensor looked: from its place on the cane and the poses around the exposure's middle."""

import math
from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, multiply, normalized, rotate

LONGEST_STEP_NS = 100_000_000  # ns between two poses over which one in between may be computed
KEPT_NS = 300_000_000  # ns of poses that are kept: longer than any exposure's middle is late
DIRECTION_ONE = 1 << 14  # a direction's component of 1, as an integer

Floats = NDArray[np.float64]
Integers = NDArray[np.int32]


class Placed(NamedTuple):
    """A cane's sensors at one instant."""

    position: Vector  # m, R0, of the IMU's origin
    orientation: Quaternion  # body to world


def zone_directions(
    boresight: Vector, up: Vector, rows: int, columns: int, field: tuple[float, float]
) -> NDArray[np.float64]:
    """Unit vectors (rows * columns, 3) of the zones in the body frame, row by row, top row first, left to right.

    Zone (i, j) looks along cos e cos a boresight + cos e sin a left + sin e up, with left = up x boresight,
    e = field[0] (1/2 - (i + 1/2) / rows), a = field[1] (1/2 - (j + 1/2) / columns); angles in rad.
    """
    ahead, above = np.asarray(boresight, float), np.asarray(up, float)
    left = np.cross(above, ahead)
    e = field[0] * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None, None]
    a = field[1] * (0.5 - (np.arange(columns) + 0.5) / columns)[None, :, None]
    directions = np.cos(e) * np.cos(a) * ahead + np.cos(e) * np.sin(a) * left + np.sin(e) * above
    return np.ascontiguousarray(directions.reshape(rows * columns, 3))


def world_directions(orientation: Quaternion, directions: Floats) -> Integers:
    """Body directions (Z, 3) turned into the world, as integers: 16384 is 1."""
    rows = np.array([rotate(orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))])
    # A sum of three products in a fixed order: a matrix product may add up in the order of its processor.
    turned = directions[:, :1] * rows[0] + directions[:, 1:2] * rows[1] + directions[:, 2:] * rows[2]
    whole: Integers = np.rint(turned * DIRECTION_ONE).astype(np.int32)
    return whole


class PoseTrack:
    """The poses of the last moment, asked for by stamp."""

    def __init__(self) -> None:
        self._stamps: list[int] = []  # ns
        self._poses: list[Placed] = []

    def __bool__(self) -> bool:
        return bool(self._stamps)

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest pose."""
        return self._stamps[-1]

    def add(self, stamp_ns: int, pose: Placed) -> None:
        """Append a pose that is newer than the last."""
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        if self._stamps[0] < stamp_ns - 2 * KEPT_NS:
            old = bisect_left(self._stamps, stamp_ns - KEPT_NS)
            del self._stamps[:old], self._poses[:old]  # in one go now and then

    def clear(self) -> None:
        """Forget all of them."""
        self._stamps.clear()
        self._poses.clear()

    def at(self, stamp_ns: int) -> Placed | None:
        """The pose at `stamp_ns`, between its neighbours (position linear, orientation by slerp).

        None where there are no neighbours close enough; the newest pose holds for up to LONGEST_STEP_NS after it.
        """
        after = bisect_left(self._stamps, stamp_ns)
        if after == len(self._stamps):
            held = after > 0 and stamp_ns - self._stamps[-1] <= LONGEST_STEP_NS
            return self._poses[-1] if held else None
        newer_ns, newer = self._stamps[after], self._poses[after]
        if newer_ns == stamp_ns:
            return newer
        if after == 0 or newer_ns - self._stamps[after - 1] > LONGEST_STEP_NS:
            return None
        older_ns, older = self._stamps[after - 1], self._poses[after - 1]
        share = (stamp_ns - older_ns) / (newer_ns - older_ns)
        ax, ay, az = older.position
        bx, by, bz = newer.position
        position = (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
        return Placed(position, slerp(older.orientation, newer.orientation, share))


def slerp(older: Quaternion, newer: Quaternion, share: float) -> Quaternion:
    """The rotation that has gone the part `share` of the shorter way from `older` to `newer`, at constant rate."""
    w, x, y, z = multiply(conjugate(older), newer)
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-9:
        return older
    half = share * math.atan2(sine, w)
    scale = math.sin(half) / sine
    return normalized(multiply(older, (math.cos(half), scale * x, scale * y, scale * z)))
