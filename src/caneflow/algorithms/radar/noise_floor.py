"""The noise under a short-time spectrum, learnt per bin while it runs, from the quieter part of what each bin has had.

A lower quartile needs a bin to be free for only a quarter of the time, and is the same share of the mean however much
the windows overlap: of a power that is exponentially distributed, ln(4/3). Amplifier noise that falls with frequency,
mains hum and other lines that were there from the start become part of it. A line that rises far out of a floor that is
known is a target: where it stands, the floor learns nothing until it has stood longer than anybody walks at one speed.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]

QUARTILE_OF_MEAN = 10.0 * np.log10(np.log(4.0 / 3.0))  # dB, the lower quartile of white noise, relative to its mean
LEAST_ROWS = 8  # before the floor counts as known: 1.1 s at the hop of 50 ms
# How far noise alone may stand over a floor that rests on so many rows: beyond 10 dB + SLACK + YOUTH / rows is the
# highest of 290 bins in one spectrum of 300 once there are 12 rows, and in one of 100 before (simulated)
SLACK = 1.0  # dB
YOUTH = 15.0  # dB
TARGET = 11.0  # dB over the floor, and the slack
LOBE = 2.0  # cells (1 / window) to either side of a line: the main lobe of a Hann window
MOST_TARGETS = 0.5  # of the bins; where more stand out, the noise itself has changed
NEIGHBOURS = 1.5  # cells to either side, whose median steadies what one bin has learnt
REFRESH = 4  # rows between two looks at the quartiles, once there are MANY
MANY = 32
LEAST_POWER = 1e-16  # of full scale: far below the last bit of any converter
HUNDREDTHS = 100.0  # of dB, as which the memory is kept: two bytes a value


class NoiseFloor:
    """The lower quartile of the last `memory` rows of each bin, relative to what it is of noise; a row is a spectrum.

    Args:
        memory: rows.
        spacing: spectra per row, so that rows hardly overlap.
        cell: bins between independent ones.
    """

    def __init__(self, memory: int, spacing: int, cell: float) -> None:
        self._memory = max(memory, LEAST_ROWS)
        self._spacing = spacing
        self._lobe = 2 * round(LOBE * cell) + 1  # bins
        self._neighbours = 2 * round(NEIGHBOURS * cell) + 1  # bins
        self._rows: NDArray[np.int16] | None = None  # (B, memory), hundredths of dB
        self._count = 0  # spectra
        self._floor: Floats | None = None  # (B,) dB
        self._standing: NDArray[np.int32] | None = None  # (B,), rows in a row that a target has stood there

    @property
    def slack(self) -> float:
        """By how many dB the floor may be too low in some bin; infinite while it is not known."""
        rows = min(-(-self._count // self._spacing), self._memory)
        return SLACK + YOUTH / rows if rows >= LEAST_ROWS else math.inf

    def update(self, power: Floats) -> Floats:
        """The floor, shape (B,), after one more spectrum of shape (B,)."""
        if self._count % self._spacing == 0:
            self._learn(power)
        self._count += 1
        assert self._floor is not None
        return np.asarray(10.0 ** (0.1 * self._floor), dtype=np.float64)

    def _learn(self, power: Floats) -> None:
        level = 10.0 * np.log10(np.maximum(power, LEAST_POWER))
        if self._rows is None or self._standing is None:
            self._rows = np.zeros((len(power), self._memory), dtype=np.int16)
            self._standing = np.zeros(len(power), dtype=np.int32)
        elif self._floor is not None and math.isfinite(self.slack):
            level = self._without_targets(level, self._floor, self._standing)
        row = self._count // self._spacing
        self._rows[:, row % self._memory] = np.rint(level * HUNDREDTHS)
        if row < MANY or row % REFRESH == 0:
            self._floor = self._found(self._rows[:, : min(row + 1, self._memory)])

    def _without_targets(self, level: Floats, floor: Floats, standing: NDArray[np.int32]) -> Floats:
        """The row with the floor's own quartile where a target stands, and has not for longer than the memory."""
        target = ndimage.maximum_filter1d(level - floor, self._lobe, mode="nearest") > TARGET + self.slack
        if target.mean() > MOST_TARGETS:
            target[:] = False
        standing += 1
        standing[~target] = 0
        return np.where(target & (standing <= self._memory), floor + QUARTILE_OF_MEAN, level)

    def _found(self, rows: NDArray[np.int16]) -> Floats:
        """Per bin, but not below what its neighbours have: a quartile of few rows is often far too low."""
        at = rows.shape[1] // 4
        quartile = np.partition(rows, at, axis=1)[:, at] / HUNDREDTHS - QUARTILE_OF_MEAN
        neighbours = ndimage.median_filter(quartile, size=self._neighbours, mode="nearest")
        return np.asarray(np.maximum(quartile, neighbours), dtype=np.float64)
