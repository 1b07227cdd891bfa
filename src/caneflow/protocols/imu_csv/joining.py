"""Tables of one sensor each, joined by time: every reading of the gyro with the others at its time."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv.columns import VECTORS
from caneflow.protocols.imu_csv.table import ImuTable

Floats: TypeAlias = NDArray[np.float64]
Stamps: TypeAlias = NDArray[np.int64]
Vector: TypeAlias = tuple[float, float, float]

WIDEST = (
    0.25  # s between two readings, between which a third is interpolated; a compass is read 5 to 100 times a second
)
STEPS = 3  # nor further apart than so many of that sensor's own steps


class Reading(NamedTuple):
    """What was measured at one time."""

    stamp: int  # ns, 0 at the first
    gyro: Vector  # rad/s
    accel: Vector | None = None  # m/s^2
    mag: Vector | None = None  # uT
    orientation: tuple[float, float, float, float] | None = None  # unit quaternion, w x y z
    linear_accel: Vector | None = None  # m/s^2


class Joined:
    """The readings of one or more tables, at the times of the gyro's; `notes` says what was interpolated."""

    def __init__(self, tables: Sequence[ImuTable]) -> None:
        """Raises ProtocolError where no table has a gyro, or the times of two do not overlap."""
        self.notes: list[str] = []
        owner = next((table for table in tables if "gyro" in table.vectors), None)
        if owner is None:
            raise ProtocolError("no gyro in any of the tables; expected one")
        measured = np.isfinite(owner.vectors["gyro"][:, 0])
        self.stamps: Stamps = owner.stamps[measured]
        self.vectors: dict[str, Floats] = {"gyro": owner.vectors["gyro"][measured]}
        for table in tables:
            for name in table.vectors:
                if name not in self.vectors:
                    self.vectors[name] = self._at_the_gyros_times(name, table, measured if table is owner else None)

    def __len__(self) -> int:
        return len(self.stamps)

    def readings(self) -> Iterator[Reading]:
        """The readings in order; stamps strictly increase from 0."""
        if not len(self.stamps):
            return
        stamps = (self.stamps - self.stamps[0]).tolist()
        rows = {name: _rows(vectors) for name, vectors in self.vectors.items()}
        absent: list[None] = [None] * len(stamps)
        others = (rows.get(name, absent) for name in VECTORS if name != "gyro")
        for stamp, gyro, accel, mag, orientation, linear in zip(stamps, rows["gyro"], *others, strict=True):
            yield Reading(stamp, gyro, accel, mag, orientation, linear)

    def _at_the_gyros_times(self, name: str, table: ImuTable, measured: NDArray[np.bool_] | None) -> Floats:
        """A vector (n, axes) at each of the gyro's times: of the same row, or between the rows around it."""
        vectors = table.vectors[name]
        apart = np.isfinite(vectors[:, 0])
        if measured is None:
            found = np.full((len(self.stamps), vectors.shape[1]), np.nan)
        else:
            found, apart = vectors[measured], apart & ~measured
        if not apart.any():
            return found
        missing = ~np.isfinite(found[:, 0])
        if not missing.any():
            return found
        between = interpolated(table.stamps[apart], vectors[apart], self.stamps[missing])
        if name == "orientation":
            between /= np.linalg.norm(between, axis=1)[:, None]
        found[missing] = between
        count = int(np.isfinite(between[:, 0]).sum())
        if not count and measured is None:
            raise ProtocolError(f"{name}: its times do not overlap with the gyro's; expected one clock for all files")
        self.notes.append(f"{name}: {count} of {len(self.stamps)} interpolated between readings of other times")
        return found


def interpolated(stamps: Stamps, vectors: Floats, at: Stamps) -> Floats:
    """`vectors` (n, k), measured at `stamps` (n,) ns, linearly between its neighbours at each of `at` (m,) -> (m, k).

    NaN outside, and between neighbours further apart than WIDEST or STEPS usual steps. Quaternions are first turned
    into the half of their predecessor.
    """
    if len(stamps) < 2:
        return np.full((len(at), vectors.shape[1]), np.nan)
    if vectors.shape[1] == 4:
        same_half = np.sign(np.einsum("ij,ij->i", vectors[1:], vectors[:-1]))
        vectors = vectors * np.cumprod(np.append(1.0, np.where(same_half < 0, -1.0, 1.0)))[:, None]
    after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    before = after - 1
    length = (stamps[after] - stamps[before]).astype(np.float64)
    share = (at - stamps[before]) / length
    widest = min(WIDEST * 1e9, STEPS * float(np.median(np.diff(stamps))))
    inside = (share >= 0) & (share <= 1) & (length <= max(widest, 1.0))
    value = vectors[before] + share[:, None] * (vectors[after] - vectors[before])
    return np.where(inside[:, None], value, np.nan)


def _rows(vectors: Floats) -> list[tuple[float, ...] | None]:
    known = np.isfinite(vectors[:, 0]).tolist()
    return [tuple(vector) if there else None for vector, there in zip(vectors.tolist(), known, strict=True)]
