"""The short-time power spectrum of a continuous-wave Doppler module's output, and the noise under it.

A line of amplitude A (full scale = 1) has the power A^2 in its bin, whatever the window, so spectra of different
windows and of real and complex modules compare. The noise floor is learnt per bin, so that lamp hum and 1/f noise
are part of it: the smallest value that the smoothed spectrum has had for a while, as a person who walks does not
stay on one frequency (minimum statistics: R. Martin, IEEE Trans. Speech and Audio Processing 9(5), 2001).
"""

from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray
from scipy import fft, ndimage

from caneflow.algorithms.quantities import Frequency, Time, Zero

INT16_FULL_SCALE = 32768.0
SMOOTHING = 0.95  # per hop, of the spectrum whose minimum is taken: 1 s at the hop of 50 ms
FLOOR_BIAS = 0.565  # that minimum over 20 s of white noise, relative to its mean; a test simulates it
QUARTILE = 0.288  # lower quartile of one spectrum of white noise, relative to its mean: ln(4/3)
SETTLING = 20  # spectra before the first minimum is taken
REFRESH = 4  # spectra between two looks at the minima
PARTS = 8  # of the memory; the oldest is forgotten as a whole
BROAD = 21  # bins, 40 Hz; a line fills 4
SMEAR = 30.0  # over the lower quartile of the floor, 15 dB: as much as 1/f noise may rise at the low end
LEAST_POWER = 1e-16  # of full scale: far below the last bit of any converter


@dataclass(frozen=True, kw_only=True)
class DopplerSpectrumSettings:
    """Window, hop, band (room.md row 8), and how long the floor's minimum looks back."""

    window: Annotated[float, Ge(1e-3), Le(60)] = 0.256  # s, Hann
    hop: Annotated[float, Ge(1e-3), Le(60)] = 0.05  # s between spectra; a block that is longer gives one all the same
    padding: Annotated[float, Ge(1), Le(64)] = 2.0  # length of the transform in windows
    lowest: Frequency | Zero = 8.0  # Hz
    highest: Frequency = 560.0  # Hz
    floor_memory: Time = 20.0  # s


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerSpectrum:
    """Power of one window in the band."""

    frequencies: NDArray[np.float64]  # shape (B,), Hz, increasing; positive is approaching, negative only if signed
    power: NDArray[np.float64]  # shape (B,), squared amplitude of a line on that frequency, full scale = 1
    floor: NDArray[np.float64]  # shape (B,), the mean power that noise alone has there
    signed: bool  # whether the module tells approaching from receding
    carrier: float  # Hz
    noise_bandwidth: float  # bins that one line's power is spread over: sum of `power` / noise_bandwidth = energy


class SlidingSpectrum:
    """Takes blocks of samples; gives one spectrum per hop once a whole window is there."""

    def __init__(self, settings: DopplerSpectrumSettings) -> None:
        if settings.lowest >= settings.highest:
            raise ValueError(f"the band is {settings.lowest:g} to {settings.highest:g} Hz; it has no width")
        self._settings = settings
        self._make: tuple[object, ...] = ()  # what may not change between blocks
        self._last_ns: int | None = None
        self.gaps = 0  # how many times samples were missing between blocks

    @property
    def delay(self) -> float:
        """Seconds by which a spectrum lags the stamp of its last sample: half the window."""
        return 0.5 * self._settings.window

    def update(
        self, stamp_ns: int, samples: NDArray[np.number], sample_rate: float, carrier: float
    ) -> DopplerSpectrum | None:
        """The spectrum of the window that ends with this block; None between hops and until there is a window.

        Args:
            stamp_ns: of the last of the samples.
            samples: shape (n,), int16 (full scale 32768), or float or complex (full scale 1).
            sample_rate: Hz.
            carrier: Hz.

        Raises:
            ValueError: a block that is not newer than the one before, or a band that the sample rate cannot hold.
        """
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise ValueError(f"block at {stamp_ns} ns is not newer than the last, {self._last_ns} ns")
        signed = samples.dtype.kind == "c"
        if (sample_rate, carrier, signed) != self._make:
            self._prepare(sample_rate, carrier, signed)
        self._forget_over_gap(stamp_ns, len(samples))
        self._last_ns = stamp_ns
        self._take(samples)
        due = self._since_hop >= self._hop
        self._since_hop %= self._hop
        return self._spectrum() if due and self._filled == len(self._kept) else None

    def _prepare(self, sample_rate: float, carrier: float, signed: bool) -> None:
        settings = self._settings
        if 2.0 * settings.highest > sample_rate:
            raise ValueError(f"a band up to {settings.highest:g} Hz takes more than {sample_rate:g} samples a second")
        count = round(settings.window * sample_rate)
        self._make = sample_rate, carrier, signed
        self._kept = np.zeros(count, dtype=np.complex128 if signed else np.float64)
        self._filled = 0
        self._hop = max(round(settings.hop * sample_rate), 1)
        self._since_hop = 0
        self._hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(count) / count)
        self._length = fft.next_fast_len(round(settings.padding * count), real=not signed)
        frequencies = fft.fftfreq(self._length, 1.0 / sample_rate)
        if not signed:
            frequencies = np.abs(frequencies[: self._length // 2 + 1])
        order = np.argsort(frequencies, kind="stable")
        in_band = (np.abs(frequencies) >= settings.lowest) & (np.abs(frequencies) <= settings.highest)
        self._bins = order[in_band[order]]
        self._frequencies = frequencies[self._bins]
        # a real line is half at its frequency and half at the negative of it
        self._scale = ((1.0 if signed else 2.0) / self._hann.sum()) ** 2
        # Parseval: a line of power 1 gives this in sum over the bins of its lobe
        self._noise_bandwidth = self._length * float((self._hann**2).sum()) / float(self._hann.sum()) ** 2
        self._floor = NoiseFloor(max(round(settings.floor_memory / settings.hop), 1))

    def _forget_over_gap(self, stamp_ns: int, count: int) -> None:
        """Start the window anew where samples are missing; half a block of jitter is none."""
        if self._last_ns is None:
            return
        sample_rate = self._make[0]
        assert isinstance(sample_rate, float | int)
        elapsed = (stamp_ns - self._last_ns) * 1e-9 * sample_rate  # samples
        if elapsed > 1.5 * count + 1.0:
            self.gaps += 1
            self._filled = self._since_hop = 0

    def _take(self, samples: NDArray[np.number]) -> None:
        scaled = samples / INT16_FULL_SCALE if samples.dtype.kind == "i" else samples
        size = len(self._kept)
        fresh = scaled[-size:]
        self._kept[: size - len(fresh)] = self._kept[len(fresh) :].copy()
        self._kept[size - len(fresh) :] = fresh
        self._filled = min(self._filled + len(samples), size)
        self._since_hop += len(samples)

    def _spectrum(self) -> DopplerSpectrum:
        _, carrier, signed = self._make
        assert isinstance(carrier, float | int)
        windowed = (self._kept - self._kept.mean()) * self._hann
        transform = fft.fft(windowed, self._length) if signed else fft.rfft(windowed, self._length)
        at = transform[self._bins]
        power = self._scale * (at.real**2 + at.imag**2)
        return DopplerSpectrum(
            frequencies=self._frequencies,
            power=power,
            floor=self._floor.update(power),
            signed=bool(signed),
            carrier=carrier,
            noise_bandwidth=self._noise_bandwidth,
        )


class NoiseFloor:
    """Per bin the minimum of the smoothed power over the last `memory` spectra.

    Somebody who walks for long at one speed leaves a broad rise, which is taken off. Until there has been time for a
    minimum, a line that stands would be taken for noise; so at first no floor is further above the quieter bins' than
    1/f noise may be.
    """

    def __init__(self, memory: int) -> None:
        self._part = max(memory // PARTS, SETTLING)  # spectra per part
        self._minima: deque[NDArray[np.float64]] = deque(maxlen=PARTS)
        self._smooth: NDArray[np.float64] | None = None
        self._floor: NDArray[np.float64] | None = None
        self._count = 0

    def update(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        """The floor, shape (B,), after one more spectrum of shape (B,)."""
        self._count += 1
        if self._smooth is None:
            self._smooth = power.copy()
        else:  # at first the plain mean: a single spectrum has zeros
            self._smooth += max(1.0 - SMOOTHING, 1.0 / self._count) * (power - self._smooth)
        if self._count <= SETTLING:
            highest = SMEAR * _lower_quartile(power) / QUARTILE
            return self._raised(np.minimum(self._smooth, highest))
        if (self._count - SETTLING - 1) % self._part == 0:
            self._minima.append(self._smooth.copy())
        else:
            np.minimum(self._minima[-1], self._smooth, out=self._minima[-1])
        if self._count % REFRESH == 0 or self._floor is None:
            self._floor = self._found()
        return self._floor

    def _found(self) -> NDArray[np.float64]:
        floor = np.asarray(np.min(self._minima, axis=0), dtype=np.float64) / FLOOR_BIAS
        if self._count <= self._part:
            np.minimum(floor, SMEAR * _lower_quartile(floor), out=floor)
        return self._raised(self._without_smear(floor))

    @staticmethod
    def _without_smear(floor: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is both broad and far above the quiet bins is a person who walked on and on; hum is narrow."""
        broad = ndimage.median_filter(floor, size=BROAD, mode="nearest")
        highest = SMEAR * _lower_quartile(floor)
        return np.asarray(floor * np.minimum(1.0, highest / broad), dtype=np.float64)

    @staticmethod
    def _raised(floor: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(floor, LEAST_POWER)


def _lower_quartile(values: NDArray[np.float64]) -> float:
    at = len(values) // 4
    return float(np.partition(values, at)[at])
