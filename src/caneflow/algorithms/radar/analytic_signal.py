"""The analytic signal of radar scans along fast time: real samples in, complex ones out, within the pulse's band.

A real scan holds every echo twice, at plus and minus the carrier, and so cannot tell approaching from receding.
Its analytic signal keeps the positive half of the spectrum, doubled; what lies outside the pulse's band is only
noise (cane.md row 2). An echo at range R then has the phase -4 pi R carrier / c: it grows while the range shrinks,
so positive Doppler means approaching.
"""

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT

LARGEST_FILTER = 1 << 21  # lines times samples, 50 MB: 3000 samples of a P440


def fast_time_frequencies(bins: int, range_step: float) -> NDArray[np.float64]:
    """Frequency (Hz) of each line of the one-sided fast-time spectrum of `bins` samples; shape (bins // 2 + 1,).

    `range_step` is the spacing of the samples in metres of range.
    """
    return np.arange(bins // 2 + 1, dtype=np.float64) * (SPEED_OF_LIGHT / (2 * range_step * bins))


def require_band(bins: int, range_step: float, carrier: float, bandwidth: float) -> NDArray[np.bool_]:
    """Which lines of the fast-time spectrum, (bins // 2 + 1,), are in the pulse's band.

    Raises:
        ValueError: none is, or there are so many that a filter for them is more than a gateway can hold.
    """
    frequencies = fast_time_frequencies(bins, range_step)
    inside = np.abs(frequencies - carrier) <= bandwidth / 2
    if not inside.any() or carrier >= frequencies[-1]:
        raise ValueError(
            f"a pulse at {carrier:.4g} Hz, {bandwidth:.3g} Hz wide, does not show in {bins} samples "
            f"every {range_step:.4g} m: they hold 0..{frequencies[-1]:.4g} Hz"
        )
    if (count := int(np.count_nonzero(inside))) * bins > LARGEST_FILTER:
        raise ValueError(
            f"a scan of {bins} samples, with {count} lines in the pulse's band, is too long: "
            f"expected at most {LARGEST_FILTER} as their product"
        )
    return inside


class AnalyticSignal:
    """A filter for scans of one length; its band is worked out once."""

    def __init__(self, *, bins: int, range_step: float, carrier: float, bandwidth: float) -> None:
        """For scans of `bins` samples every `range_step` m; `carrier` and `bandwidth` of the pulse in Hz.

        Raises:
            ValueError: the pulse's band lies outside of what the samples can hold.
        """
        inside = require_band(bins, range_step, carrier, bandwidth)
        # From 0 over 1 in the band's middle to 0: what `softened` multiplies the spectrum with.
        lines = np.flatnonzero(inside)
        self._taper = np.zeros(bins, dtype=np.float32)
        self._taper[lines] = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(len(lines)) + 0.5) / len(lines))
        # The band has a tenth of a scan's lines: two small products cost less than two transforms of all of them.
        turns = np.outer(lines, np.arange(bins)) % bins * (2 * np.pi / bins)  # rad, lines x samples
        cosines, sines = np.cos(turns), np.sin(turns)
        # each line's real and imaginary part out of a scan, and what those parts add to each sample's parts
        self._to_lines = (np.stack([cosines, -sines]) * (2 / bins)).reshape(-1, bins).astype(np.float32)
        self._from_lines = _parts_in_turn(np.stack([cosines + 1j * sines, 1j * cosines - sines]).reshape(-1, bins))

    def __call__(self, scans: NDArray[np.number]) -> NDArray[np.complex64]:
        """The analytic signals of real `scans`, shape (..., bins); same shape."""
        # einsum keeps to its own loops: the sums are the same on any number of threads
        lines = np.einsum("...k,jk->...j", scans.astype(np.float32), self._to_lines)
        parts: NDArray[np.float32] = np.einsum("...j,jk->...k", lines, self._from_lines)
        return parts.view(np.complex64)

    def softened(self, scan: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """One analytic `scan`, shape (bins,), of half the resolution, in which strong echoes do not ring.

        The band's sharp ends make each echo ring on over all ranges: at a metre by -40 dB, which for direct coupling is
        as much as ground has. With soft ends it falls by 18 dB an octave.
        """
        return np.fft.ifft(np.fft.fft(scan) * self._taper).astype(np.complex64)


def _parts_in_turn(values: NDArray[np.complex128]) -> NDArray[np.float32]:
    """Real and imaginary parts side by side, as they lie in memory; twice as many columns."""
    return values.astype(np.complex64).view(np.float32)
