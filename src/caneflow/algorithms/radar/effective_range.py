"""Where the power of a range cell comes from: not its middle, but nearer to where more comes from.

A pulse smears every echo over its own length. What is received at range y came from R with p(R | y), which for a
Gaussian pulse whose power has the standard deviation s has the mean y + s^2 d ln P / dy, P the power received
(Tweedie's formula; Efron, J. Am. Stat. Assoc. 106, 2011). Averaged over a cell by power, with the cell's ends y0, y1:

    R = sum(P y) / sum(P) + s^2 (P(y1) - P(y0)) / (step sum(P))

A centimetre of range is 1.3 % of the speed over ground.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.radar.moving_returns import RadarParameters
from caneflow.physics import SPEED_OF_LIGHT

Floats = NDArray[np.float64]

_POWER_TIME: Final = 1.0  # s over which the power is averaged: 0.3 to 3 s alike (docs/methods/ground_velocity.md)
_FAINT: Final = 1e-30  # power of nothing


class EffectiveRanges:
    """The running mean of the power in every bin, and what it says of cells."""

    def __init__(self, pulse_spread: float) -> None:
        """With the pulse's s as a part of c / 2 bandwidth; 0: cells are where their power is, and pulses short."""
        self._pulse_spread = pulse_spread
        self._make: tuple[int, int, RadarParameters] | None = None
        self._cell = 1  # bins
        self._places = np.zeros(1)  # m, of a cell's bins from its middle
        self._middles = np.zeros(0)  # m, of all cells
        self._blur = 0.0  # m, s^2 over the step, over the weights of an end's four bins
        self._power = np.zeros(4)  # of every bin, the first and the last once more on either side
        self._largest = 0.0  # m that a cell's range may differ from its middle

    def start(self, bins: int, cell: int, parameters: RadarParameters) -> None:
        """Be ready for scans of so many `bins`, `cell` of them in a cell; what is known of such scans stays known."""
        make = bins, cell, parameters
        if make == self._make:
            return
        self._make, self._cell = make, cell
        step = parameters.range_step
        self._places = step * (np.arange(cell, dtype=np.float64) - 0.5 * (cell - 1))
        firsts = cell * np.arange(bins // cell, dtype=np.float64)
        self._middles = parameters.range_start + step * (firsts + 0.5 * (cell - 1))
        spread = self._pulse_spread * SPEED_OF_LIGHT / (2.0 * parameters.bandwidth)
        self._blur = spread**2 / step / 6.0
        self._largest = max(spread, 0.5 * step * cell)
        self._power = np.zeros(bins + 4)

    def learn(self, scan: NDArray[np.complex64], elapsed: float) -> None:
        """Take the power of a moving `scan`, (M,), `elapsed` s after the one before."""
        power = self._power
        power *= math.exp(-elapsed / _POWER_TIME)
        power[2:-2] += scan.real**2 + scan.imag**2
        power[:2], power[-2:] = power[2], power[-3]

    def of_cells(self, first: int, count: int) -> Floats:
        """Ranges (m), shape (count,), of the cells from the `first` on."""
        cell, power = self._cell, self._power
        begin, end = first * cell, (first + count) * cell
        inside = power[begin + 2 : end + 2].reshape(count, cell)
        total = np.add.reduce(inside, axis=1) + _FAINT
        # the power at the ends between cells: smoothed over three bins, then the mean of the two next to it
        ends = power[begin + 1 : end + 2 : cell] + power[begin + 2 : end + 3 : cell]
        ends += ends
        ends += power[begin : end + 1 : cell]
        ends += power[begin + 3 : end + 4 : cell]
        shift: Floats = np.einsum("ck,k->c", inside, self._places)
        shift += self._blur * (ends[1:] - ends[:-1])
        shift /= total
        # a few echoes alone have gaps between them, where nothing comes from
        np.minimum(shift, self._largest, out=shift)
        np.maximum(shift, -self._largest, out=shift)
        shift += self._middles[first : first + count]
        return shift
