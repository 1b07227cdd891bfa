"""Pulse pairs: how far the phase of the returns turns from scan to scan, in every range cell.

The sum of x(t) conj(x(t - T)) over a few scans and over one cell of range has the mean Doppler in its phase and, by its
length against the power, how much the scans are alike (Zrnic, IEEE Trans. AES 13(4), 1977).

A mean over all that is in the cell: an antenna that sees all round has beside a target a ring of room that closes at
every rate from -v to v and draws the mean to 0. Over several scans the ring falls out of step, a target does not: the
pairs of several lags together tell it from the ring (`line_phase`; Lee, "poly pulse pair", Proc. 18th Conf. on Radar
Meteorology, 1978).
"""

import math
from bisect import bisect_left
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.radar.moving_returns import MovingReturns, RadarParameters
from caneflow.algorithms.radar.range_doppler import SlowTimeWindow

Floats = NDArray[np.float64]

_LINE_GRID: Final = 512  # phases that line_phase looks at


class PulsePairs(NamedTuple):
    """Sums over the window and over one range cell each, for K cells."""

    pairs: NDArray[np.complex128]  # shape (K,), of x(t) conj(x(t - lag T))
    power: Floats  # shape (K,), of the mean of |x(t)|^2 and |x(t - lag T)|^2
    ranges: Floats  # shape (K,) m, of the cells' middles
    first: int  # number of the first of them among the window's cells


def line_phase(pairs: NDArray[np.complexfloating]) -> float:
    """Phase from scan to scan (rad, -pi..pi) of the strongest line among the returns.

    `pairs`, shape (K,), are sums at lags 1 to K of one cell. The phase is that for which all of them, turned back by it
    once per lag, add up to the most: between the ends of a grid by a parabola.
    """
    spectrum = np.fft.fft(np.concatenate(([0.0], pairs)), _LINE_GRID).real
    peak = int(spectrum.argmax())
    before, top, after = (float(spectrum[(peak + off) % _LINE_GRID]) for off in (-1, 0, 1))
    bend = before - 2.0 * top + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return math.remainder(2.0 * math.pi * (peak + shift) / _LINE_GRID, 2.0 * math.pi)


class PulsePairWindow:
    """The newest scans; what is asked of them is worked out when it is asked for."""

    def __init__(self, *, window: int, cell: float, lag: int = 1, kept: int = 0) -> None:
        """For sums over `window` pairs of scans, `lag` scans apart, and over cells of `cell` m.

        As many scans are `kept` for those who look back farther, at least those of the window.
        """
        self._lag, self._cell = lag, cell
        self._length, self._kept = window + lag, max(kept, window + lag)
        self._count = 0  # of scans since all before were forgotten
        self._stamps_ns: deque[int] = deque(maxlen=window + lag)
        self._bins = 1  # of a cell
        self._ranges: Floats = np.zeros(0)
        self._range_list: list[float] = []  # the same
        self._scans = SlowTimeWindow(length=self._kept, bins=0)

    @property
    def cell_bins(self) -> int:
        """How many range bins are in a cell."""
        return self._bins

    def push(self, returns: MovingReturns) -> None:
        """Take the scans of one more frame."""
        if returns.restarted:
            self._start_anew(returns.scans.shape[1], returns.parameters)
        for scan in returns.scans:
            self._scans.push(scan)
        self._stamps_ns.extend(returns.stamps_ns)
        self._count += len(returns.scans)

    @property
    def is_filled(self) -> bool:
        """Whether there are as many scans as are kept."""
        return self._count >= self._kept

    def interval_ns(self) -> tuple[int, int] | None:
        """Stamps of the oldest and the newest scan in the sums; None while there are too few."""
        if len(self._stamps_ns) != self._stamps_ns.maxlen:
            return None
        return self._stamps_ns[0], self._stamps_ns[-1]

    def sums(self, nearest: float = 0.0, farthest: float = np.inf) -> PulsePairs:
        """The sums over the whole window, for cells between two ranges (m)."""
        # numpy's search costs ten times as much for two numbers
        first, last = bisect_left(self._range_list, nearest), bisect_left(self._range_list, farthest)
        # (window + lag, bins)
        scans = self._scans.view()[first * self._bins : last * self._bins, -self._length :].T
        newer, older = scans[self._lag :], scans[: -self._lag]
        power = scans.real**2 + scans.imag**2
        both = np.add.reduce(power[self._lag :]) + np.add.reduce(power[: -self._lag])
        pairs = np.add.reduce(newer * older.conj())
        return PulsePairs(
            pairs=self._in_cells(pairs, last - first).astype(np.complex128),
            power=self._in_cells(0.5 * both, last - first).astype(np.float64),
            ranges=self._ranges[first:last],
            first=first,
        )

    def scans(self, nearest: float, farthest: float) -> tuple[NDArray[np.complex64], Floats, int]:
        """The scans between two ranges (m), (W, K), the cells' ranges, the first one's number; for cells of one bin."""
        assert self._bins == 1, "made so"
        first, last = bisect_left(self._range_list, nearest), bisect_left(self._range_list, farthest)
        return self._scans.view()[first:last, -self._length :].T, self._ranges[first:last], first

    def long_scans(self, first: int, count: int) -> NDArray[np.complex64]:
        """All scans that are kept, oldest first, over the bins of `count` cells from the `first` on, (W, K)."""
        return self._scans.view()[first * self._bins : (first + count) * self._bins].T

    def power(self, scan: NDArray[np.complex64], first: int, count: int) -> Floats:
        """Sums of |x|^2 of one `scan`, shape (M,), over the bins of `count` cells from the `first` on."""
        inside = scan[first * self._bins : (first + count) * self._bins]
        return self._in_cells(inside.real**2 + inside.imag**2, count).astype(np.float64)

    def _in_cells(self, values: NDArray[Any], count: int) -> NDArray[Any]:
        """Sums of `values`, one per bin, over the bins of each of `count` cells."""
        summed: NDArray[Any] = np.add.reduce(values.reshape(count, self._bins), axis=1)
        return summed

    def _start_anew(self, bins: int, parameters: RadarParameters) -> None:
        self._bins = max(1, min(bins, round(self._cell / parameters.range_step)))
        middles = self._bins * np.arange(bins // self._bins, dtype=np.float64) + 0.5 * (self._bins - 1)
        self._ranges = np.asarray(parameters.range_start + parameters.range_step * middles, dtype=np.float64)
        self._range_list = self._ranges.tolist()
        self._scans = SlowTimeWindow(length=self._kept, bins=bins)
        self._count = 0
        self._stamps_ns.clear()
