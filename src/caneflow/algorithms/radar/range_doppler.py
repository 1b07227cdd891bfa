"""From scans to the range-Doppler map, and from its indices to metres and metres per second (paper IV.A, eq. 1).

Slow time runs over scans, fast time over range bins. Doppler bins are in FFT order: 0, positive (approaching) up
to half the transform, then negative.
"""

import math

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT


def range_of_bin(
    index: float | NDArray[np.integer] | NDArray[np.floating], *, start: float, step: float
) -> NDArray[np.float64]:
    """Range (m) of fractional bin `index`; bin 0 lies at `start` m, bins are `step` m apart."""
    return start + np.asarray(index, dtype=np.float64) * step


def bin_of_range(distance: float | NDArray[np.floating], *, start: float, step: float) -> NDArray[np.intp]:
    """The bin nearest to `distance` (m); may lie outside of the scan."""
    return np.rint((np.asarray(distance, dtype=np.float64) - start) / step).astype(np.intp)


def speed_per_bin(*, scan_period: float, carrier: float, transform: int) -> float:
    """Radial speed (m/s) between neighbouring Doppler bins of a slow-time FFT of length `transform`."""
    return SPEED_OF_LIGHT / (2 * carrier * scan_period * transform)


def speed_of_bin(
    index: float | NDArray[np.integer], *, scan_period: float, carrier: float, transform: int
) -> NDArray[np.float64]:
    """Radial speed (m/s, approaching positive) of Doppler bin `index` in FFT order."""
    signed = (np.asarray(index, dtype=np.float64) + transform / 2) % transform - transform / 2
    return signed * speed_per_bin(scan_period=scan_period, carrier=carrier, transform=transform)


def speed_limit(*, scan_period: float, carrier: float) -> float:
    """Radial speed (m/s) above which Doppler wraps round: a quarter of a wavelength per scan."""
    return SPEED_OF_LIGHT / (4 * carrier * scan_period)


def hann(length: int) -> NDArray[np.float32]:
    """The Hann window of `length` scans, shape (length,), symmetric about the middle between first and last.

    Sampled half way between the usual points: no weight is 0, and its spectrum is that of the periodic form.
    """
    phase = 2 * math.pi * (np.arange(length) + 0.5) / length
    return (0.5 - 0.5 * np.cos(phase)).astype(np.float32)


def range_doppler_map(
    scans: NDArray[np.complex64], weights: NDArray[np.float32], transform: int
) -> NDArray[np.complex64]:
    """Slow-time spectra of `scans`.

    Args:
        scans: shape (M, N): M range bins of N scans, oldest first.
        weights: shape (N,), the window over slow time.
        transform: length of the FFT, at least N: shorter windows are padded with zeros.

    Returns:
        Shape (M, transform); column k holds radial speed `speed_of_bin(k)`.
    """
    return np.fft.fft(scans * weights, transform).astype(np.complex64, copy=False)  # it is; the stub says complex128


class SlowTimeWindow:
    """The newest N scans of M range bins, in one piece of memory, without moving it for every scan."""

    def __init__(self, *, length: int, bins: int) -> None:
        """Empty: N = `length` scans of zeros."""
        self._length = length
        self._twice = np.zeros((2 * length, bins), dtype=np.complex64)
        self._next = 0

    def push(self, scan: NDArray[np.complex64]) -> None:
        """Let `scan`, shape (M,), take the place of the oldest."""
        # Every scan is written twice, N rows apart: from any row on, the next N are the whole window.
        self._twice[self._next :: self._length] = scan
        self._next = (self._next + 1) % self._length

    def view(self) -> NDArray[np.complex64]:
        """All of it, shape (M, N), oldest first; valid until the next push."""
        return self._newest().T

    def of(self, bins: NDArray[np.intp]) -> NDArray[np.complex64]:
        """Of K range `bins`, none of them outside, shape (N, K), oldest first; in memory of its own."""
        return self._newest().take(bins, axis=1, mode="clip")  # "raise" takes a third longer

    def _newest(self) -> NDArray[np.complex64]:
        return self._twice[self._next : self._next + self._length]
