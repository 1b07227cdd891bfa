"""A map by radars that stand or are carried: every scan adds its whole range profile, as evidence, to the cells.

A radar without a beam knows how far, and not where. Thresholded detections draw arcs that cross anywhere; profiles as
they are add up where something stands (additive log-odds, as in `occupancy_grid`). Counts of 1/16 nat, whole numbers.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

UNIT: Final = 16  # counts of a nat
LEAST, MOST = -1.0, 3.0  # nat, that one scan can say of a cell

Counts = NDArray[np.int32]
Floats = NDArray[np.float64]


class Peak(NamedTuple):
    """A cell that stands out."""

    x: float  # m
    y: float
    counts: int


class ProfileMap:
    """Cells of `cell` m from (x0, y0) on, `shape` of them."""

    def __init__(self, x0: float, y0: float, cell: float, shape: tuple[int, int]) -> None:
        self.x: Floats = x0 + (np.arange(shape[0], dtype=np.float64) + 0.5) * cell
        self.y: Floats = y0 + (np.arange(shape[1], dtype=np.float64) + 0.5) * cell
        self.counts: Counts = np.zeros(shape, np.int32)

    def clear(self) -> None:
        """Forget everything."""
        self.counts[:] = 0

    def add(
        self, place: tuple[float, float], evidence: Counts, range_start: float, range_step: float, height: float = 0.0
    ) -> None:
        """Add one scan's `evidence` (bins,) seen from `place` (m), `height` m above what is mapped.

        Bin 0 is `range_start` m from there, the next `range_step` m farther.
        """
        across = (self.x[:, None] - place[0]) ** 2 + (self.y[None, :] - place[1]) ** 2
        bins = np.rint((np.sqrt(across + height * height) - range_start) / range_step).astype(np.int64)
        inside = (bins >= 0) & (bins < len(evidence))
        self.counts += np.where(inside, evidence[bins.clip(0, len(evidence) - 1)], 0)

    def peaks(self, number: int, apart: float) -> list[Peak]:
        """The `number` cells with most counts, at least `apart` m from each other, the first first."""
        left, found = self.counts.astype(np.int64), []
        for _ in range(number):
            i, j = divmod(int(left.argmax()), left.shape[1])
            found.append(Peak(float(self.x[i]), float(self.y[j]), int(left[i, j])))
            near = np.hypot(self.x[:, None] - self.x[i], self.y[None, :] - self.y[j]) < apart
            left[near] = np.iinfo(np.int64).min
        return found


def standing_evidence(scan: NDArray[np.complex128], smooth: int = 9) -> Counts:
    """What a scan (bins,) says of what stands there: its power over the scan's median, smoothed over `smooth` bins."""
    window = np.hanning(smooth + 2)[1:-1]
    power = np.convolve(np.abs(scan) ** 2, window / window.sum(), "same")
    said = 0.5 * np.log(np.maximum(power, 1e-300) / np.maximum(np.median(power), 1e-300))
    counts: Counts = np.rint(UNIT * said.clip(LEAST, MOST)).astype(np.int32)
    return counts


def leading_evidence(moving: Floats, range_step: float, spread: float = 0.15) -> Counts:
    """What the envelope of what moves (bins,) says of its near side: where it rises, `spread` m (> 0) about it.

    A body is deep, and echoes by way of the walls come later: the first rise is the one that means a place.
    """
    highest = np.maximum.accumulate(moving)
    rise = np.gradient(highest / max(float(highest[-1]), 1e-300))
    half = max(int(spread / range_step), 1)
    counts: Counts = np.rint(UNIT * np.convolve(rise, np.hanning(2 * half + 1), "same")).astype(np.int32)
    return counts
