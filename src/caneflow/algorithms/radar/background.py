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
        self._squares = 0.0  # sum of the squares of those weights
        self._share = np.zeros((), np.float32)  # 1 / weight, of the type it scales: no casts

    def remove(self, scan: NDArray[np.complex64], elapsed: float) -> None:
        """Take the mean of the past and itself off `scan`, shape (M,), in place; nothing is left of the first one.

        `elapsed` is the time (s) since the scan before. As every scan arrives with weight 1, the mean is right
        from the first scan on: no start value has to fade out.
        """
        self.take_off(scan, elapsed)
        self.learn(scan)

    def take_off(self, scan: NDArray[np.complex64], elapsed: float) -> float:
        """The first half of `remove`: the mean of the past alone. Returns the power that is left, summed over bins."""
        parts = scan.view(np.float32)  # all is linear: real arithmetic takes half of the time
        if self._mean is None:
            self._mean = np.zeros_like(parts)
        forgotten = math.exp(-elapsed / self._time_constant)
        self._weight *= forgotten
        self._squares *= forgotten * forgotten
        parts -= self._mean
        return float(np.add.reduce(parts * parts))

    def learn(self, scan: NDArray[np.complex64]) -> None:
        """The second half: make what `take_off` left of `scan` part of the mean, and take that part off too."""
        assert self._mean is not None, "take_off comes first"
        parts = scan.view(np.float32)
        self._weight += 1.0
        self._squares += 1.0
        self._share[()] = 1.0 / self._weight
        step = parts * self._share
        self._mean += step
        parts -= step

    @property
    def picture(self) -> NDArray[np.complex64]:
        """The mean, shape (M,); valid until the next scan."""
        assert self._mean is not None, "a scan comes first"
        return self._mean.view(np.complex64)

    @property
    def noise_share(self) -> float:
        """Which part of the scans' noise power is in the mean's, 0..1."""
        return self._squares / self._weight**2 if self._weight else 1.0
