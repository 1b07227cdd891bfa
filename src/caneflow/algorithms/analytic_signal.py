"""The analytic signal of radar scans along fast time: real samples in, complex ones out, within the pulse's band.

A real scan holds every echo twice, at plus and minus the carrier, and so cannot tell approaching from receding.
Its analytic signal keeps the positive half of the spectrum, doubled; what lies outside the pulse's band is only
noise (cane.md row 2). An echo at range R then has the phase -4 pi R carrier / c: it grows while the range shrinks,
so positive Doppler means approaching.
"""

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.range_doppler import SPEED_OF_LIGHT


def fast_time_frequencies(bins: int, range_step: float) -> NDArray[np.float64]:
    """Frequency (Hz) of each line of the one-sided fast-time spectrum of `bins` samples; shape (bins // 2 + 1,).

    `range_step` is the spacing of the samples in metres of range.
    """
    return np.arange(bins // 2 + 1, dtype=np.float64) * (SPEED_OF_LIGHT / (2 * range_step * bins))


class AnalyticSignal:
    """A filter for scans of one length; its band is worked out once."""

    def __init__(self, *, bins: int, range_step: float, carrier: float, bandwidth: float) -> None:
        """For scans of `bins` samples every `range_step` m; `carrier` and `bandwidth` of the pulse in Hz.

        Raises:
            ValueError: the pulse's band lies outside of what the samples can hold.
        """
        frequencies = fast_time_frequencies(bins, range_step)
        inside = np.abs(frequencies - carrier) <= bandwidth / 2
        if not inside.any() or carrier >= frequencies[-1]:
            raise ValueError(
                f"a pulse at {carrier:.4g} Hz, {bandwidth:.3g} Hz wide, does not show in {bins} samples "
                f"every {range_step:.4g} m: they hold 0..{frequencies[-1]:.4g} Hz"
            )
        self._first, self._end = int(inside.argmax()), int(np.flatnonzero(inside)[-1]) + 1  # lines of the band
        self._gain = 2 * bins
        self._shape: tuple[int, ...] = ()  # of the scans that the buffers are made for

    def __call__(self, scans: NDArray[np.number]) -> NDArray[np.complex64]:
        """The analytic signals of real `scans`, shape (..., bins); same shape."""
        if scans.shape != self._shape:
            self._make_buffers(scans.shape)
        # Without a factor of its own (norm="backward") numpy would transform forward in double precision.
        np.fft.rfft(scans.astype(np.float32), norm="forward", out=self._one_sided)  # type: ignore[arg-type]  # stubs know double only
        np.multiply(self._found, self._gain, out=self._kept)
        signals = np.empty(scans.shape, np.complex64)
        np.fft.ifft(self._spectrum, out=signals)  # type: ignore[arg-type]
        return signals

    def _make_buffers(self, shape: tuple[int, ...]) -> None:
        """Spectra of scans of one shape, one-sided and whole, and the band in both; the rest of the whole stays 0."""
        self._shape = shape
        self._one_sided = np.empty((*shape[:-1], shape[-1] // 2 + 1), np.complex64)
        self._spectrum = np.zeros(shape, np.complex64)
        self._found = self._one_sided[..., self._first : self._end]
        self._kept = self._spectrum[..., self._first : self._end]
