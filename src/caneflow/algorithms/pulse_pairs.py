"""Pulse pairs: how far the phase of the returns turns from scan to scan, in every range cell.

The sum of x(t) conj(x(t - T)) over a few scans and over one cell of range has the mean Doppler in its phase and, by its
length against the power, how much the scans are alike (Zrnic, IEEE Trans. AES 13(4), 1977).
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.moving_returns import MovingReturns, RadarParameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class PulsePairs:
    """Sums over the window and over one range cell each, for K cells."""

    pairs: NDArray[np.complex128]  # shape (K,), of x(t) conj(x(t - T))
    power: Floats  # shape (K,), of the mean of |x(t)|^2 and |x(t - T)|^2
    ranges: Floats  # shape (K,) m, of the cells' middles


class PulsePairWindow:
    """Pulse pairs of the newest scans; its state is the last scan and one row of sums per pair."""

    def __init__(self, *, window: int, cell: float) -> None:
        """For sums over `window` pairs of scans and over cells of `cell` m."""
        self._window, self._cell = window, cell
        self._stamps_ns: deque[int] = deque(maxlen=window + 1)
        self._bins = 1  # of a cell
        self._ranges: Floats = np.zeros(0)
        self._last: NDArray[Any] = np.zeros(0, np.complex64)
        self._last_power: NDArray[Any] = np.zeros(0)
        self._pairs = np.zeros((window, 0), np.complex128)
        self._power = np.zeros((window, 0))
        self._next = 0

    def push(self, returns: MovingReturns) -> None:
        """Take the scans of one more frame."""
        if returns.restarted:
            self._start_anew(returns.scans.shape[1], returns.parameters)
        for scan, stamp_ns in zip(returns.scans, returns.stamps_ns, strict=True):
            self._push(scan, stamp_ns)

    def interval_ns(self) -> tuple[int, int] | None:
        """Stamps of the oldest and the newest scan in the sums; None while there are too few."""
        if len(self._stamps_ns) <= self._window:
            return None
        return self._stamps_ns[0], self._stamps_ns[-1]

    def sums(self, nearest: float = 0.0, farthest: float = np.inf) -> PulsePairs:
        """The sums over the whole window, for cells between two ranges (m)."""
        first, last = np.searchsorted(self._ranges, (nearest, farthest)).tolist()
        return PulsePairs(
            pairs=self._pairs[:, first:last].sum(axis=0),
            power=self._power[:, first:last].sum(axis=0),
            ranges=self._ranges[first:last],
        )

    def _push(self, scan: NDArray[np.complex64], stamp_ns: int) -> None:
        conjugate = scan.conj()
        power = self._in_cells((scan * conjugate).real)
        if self._stamps_ns:
            row = self._next
            np.conjugate(self._in_cells(self._last * conjugate), out=self._pairs[row])
            np.multiply(power + self._last_power, 0.5, out=self._power[row])
            self._next = (row + 1) % self._window
        self._last, self._last_power = scan, power
        self._stamps_ns.append(stamp_ns)

    def _in_cells(self, values: NDArray[Any]) -> NDArray[Any]:
        """Sums of `values`, shape (M,), over the bins of each cell, shape (K,)."""
        count = len(self._ranges)
        summed: NDArray[Any] = values[: count * self._bins].reshape(count, self._bins).sum(axis=1)
        return summed

    def _start_anew(self, bins: int, parameters: RadarParameters) -> None:
        self._bins = max(1, min(bins, round(self._cell / parameters.range_step)))
        count = bins // self._bins
        middles = self._bins * np.arange(count, dtype=np.float64) + 0.5 * (self._bins - 1)
        self._ranges = np.asarray(parameters.range_start + parameters.range_step * middles, dtype=np.float64)
        self._pairs = np.zeros((self._window, count), np.complex128)
        self._power = np.zeros((self._window, count))
        self._next = 0
        self._stamps_ns.clear()
