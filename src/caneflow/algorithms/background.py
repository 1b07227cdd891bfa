"""What stands still in the radar's own frame, and its removal: direct coupling, the cane's tip, walls at rest.

A running mean over the recent past, weighted exp(-age / time constant) (cane.md row 3). The age is elapsed time,
so the mean is the same at any scan rate and forgets by itself across a gap.
"""

import math

import numpy as np
from numpy.typing import NDArray


class Background:
    """The running mean of complex scans."""

    def __init__(self, time_constant: float) -> None:
        """With the given `time_constant` (s) of forgetting."""
        self._time_constant = time_constant
        self._mean: NDArray[np.float32] | None = None  # real and imaginary parts in turn
        self._weight = 0.0  # sum of exp(-age / time constant) over the scans seen
        self._share = np.empty((), np.float32)  # 1 / weight, of the type it scales: no casts

    def remove(self, scan: NDArray[np.complex64], elapsed: float) -> None:
        """Take the mean of the past and itself off `scan`, shape (M,), in place; nothing is left of the first one.

        `elapsed` is the time (s) since the scan before. As every scan arrives with weight 1, the mean is right
        from the first scan on: no start value has to fade out.
        """
        parts = scan.view(np.float32)  # all is linear: real arithmetic takes half of the time
        if self._mean is None:
            self._mean = np.zeros_like(parts)
        self._weight = self._weight * math.exp(-elapsed / self._time_constant) + 1.0
        parts -= self._mean
        self._share[()] = 1.0 / self._weight
        step = parts * self._share
        self._mean += step
        parts -= step
