"""The predominant line of a Doppler spectrum: how fast the person moves along the beam, and how strongly it echoes.

Rather than the total energy the paper takes the magnitude of the predominant frequency, which likely belongs to the
direct path (Ferrand et al., ICCHP 2020). Positive frequency is approaching, so range rate = -c f / (2 carrier).
Which line predominates goes by its power over the noise floor at its own frequency, since an amplifier's noise may be
30 dB stronger at one end of the band than at the other, and by what was there just before.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Decibels, Frequency, Probability, Zero
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum
from caneflow.physics import SPEED_OF_LIGHT

Floats = NDArray[np.float64]

LOWEST_SNR = -99.0  # dB, of a spectrum with nothing in it
LARGEST_ACCELERATION = 3.0  # m/s^2 of a trunk along the beam, by which the next line may be off the last
FARTHEST = 0.1  # s of it; farther off it is as likely noise
FOLLOWED = 0.3  # s after the last valid line, for which the next is looked for beside it
OVERTONES = (2, 3, 5)  # of a line that an amplifier or a converter clips; a foot goes two to three times as fast, too
MAINS = (50.0, 60.0)  # Hz
MAINS_ERROR = 0.001  # relative, of a grid in order; and in Hz, of what a mean frequency is measured to:
MEASURED_TO = 0.2
STEADY = 0.8  # Hz, of one frequency off their mean
STEADY_FOR = 0.5  # s; nobody walks so evenly
HUSHED = 1e-6  # of the floor, what is left of the power there
HUM_LOBE = 2.5  # cells to either side of a line of the mains, of the window's main lobe
SLOW = (
    3.0  # cells (1 / window) above the band's lower end, where a step looks like a line when it has passed a high-pass
)
SLOW_FOR = 0.45  # s, longer than a window sees a step and what is left of it


@dataclass(frozen=True, kw_only=True)
class DopplerLineSettings:
    """When a peak counts as a person (room.md row 10)."""

    least_snr: Decibels | Zero = 10.0  # dB over the noise floor
    least_share: Probability = 0.25  # of the in-band energy above the floor
    half_width: Frequency = 8.0  # Hz to either side, that the share is taken from
    continuity: Decibels | Zero = 6.0  # dB that a line beside the last one may be weaker than another and still be it
    follow: Decibels | Zero = 2.0  # dB below least_snr down to which a line counts that has gone on for 0.3 s


@dataclass(frozen=True, kw_only=True)
class DopplerLine:
    """One target: the predominant line."""

    range_rate: float  # m/s, positive away; its magnitude when not signed
    amplitude: float  # full scale = 1
    snr: float  # dB over the noise floor at that frequency
    valid: bool


SILENT = DopplerLine(range_rate=0.0, amplitude=0.0, snr=LOWEST_SNR, valid=False)


@dataclass(frozen=True, kw_only=True)
class _Peak:
    """A local maximum, between the bins by a parabola through the logarithms."""

    bin: int
    frequency: float  # Hz
    logarithm: float  # of the power
    snr: float  # dB


def predominant_line(spectrum: DopplerSpectrum, settings: DopplerLineSettings) -> DopplerLine:
    """The line that stands highest above the floor, of one spectrum by itself and a floor that is taken at its word.

    A silent channel has none: not valid, of speed and amplitude 0 and the lowest SNR.
    """
    if spectrum.silent:
        return SILENT
    peak = _fundamental(spectrum, _peak(spectrum, _top(spectrum, int(np.argmax(_excess(spectrum))))), settings)
    return _line(spectrum, peak, valid=_stands_out(spectrum, peak, settings, settings.least_snr))


class LineFollower:
    """The predominant line from one spectrum to the next.

    One that goes on from the last valid line is preferred, and counts from `least_snr` on, once it has lasted from
    `follow` below it on; a new one has to stand above the floor by what the floor may be wrong as well. Nothing is
    valid while the floor is not known, nor where the strongest line is beyond the band, nor on a harmonic of the mains
    that moves less than anybody who walks.
    """

    def __init__(self, settings: DopplerLineSettings) -> None:
        self._settings = settings
        self._last: float | None = None  # Hz, of the last valid line
        self._ago = math.inf  # s, how long it is ago
        self._age = 0.0  # s, for how long the line has gone on
        self._steady_at = math.nan  # Hz
        self._steady_for = 0.0  # s
        self._slow_for = 0.0  # s that the strongest line has been at the band's lower end
        self._hum: list[float] = []  # Hz, lines of the mains that came later and that the floor has not learnt yet

    def update(self, spectrum: DopplerSpectrum) -> DopplerLine:
        """The line of the next spectrum."""
        self._ago += spectrum.elapsed
        if spectrum.silent:
            return SILENT
        spectrum = self._without_hum(spectrum)
        score = _excess(spectrum)
        beside = self._beside(spectrum)
        score[beside] += self._settings.continuity
        peak = _fundamental(spectrum, _peak(spectrum, _top(spectrum, int(np.argmax(score)))), self._settings)
        goes_on = bool(beside[peak.bin])
        least = self._least(spectrum, goes_on=goes_on)
        valid = _stands_out(spectrum, peak, self._settings, least)
        valid = not self._may_be_a_step(spectrum, peak, known=goes_on or not valid) and valid
        valid = not self._is_hum(spectrum, peak) and valid
        if valid:
            self._age = self._age + self._ago if goes_on else 0.0
            self._last, self._ago = peak.frequency, 0.0
        return _line(spectrum, peak, valid=valid)

    def _least(self, spectrum: DopplerSpectrum, *, goes_on: bool) -> float:
        """How far (dB) a line has to stand over the floor: least where one goes on that no noise is that long."""
        least = self._settings.least_snr
        if not goes_on:
            return least + spectrum.floor_slack
        return least - self._settings.follow if self._age >= FOLLOWED else least

    def _beside(self, spectrum: DopplerSpectrum) -> NDArray[np.bool_]:
        """Which bins a line that goes on may have reached."""
        if self._last is None or self._ago > FOLLOWED:
            return np.zeros(len(spectrum.power), dtype=np.bool_)
        hertz = 2.0 * spectrum.carrier / SPEED_OF_LIGHT  # at 1 m/s
        reach = self._settings.half_width + hertz * LARGEST_ACCELERATION * min(self._ago, FARTHEST)
        return np.asarray(np.abs(spectrum.frequencies - self._last) <= reach)

    def _may_be_a_step(self, spectrum: DopplerSpectrum, peak: _Peak, *, known: bool) -> bool:
        """Whether a line that is new is so low and so young that it may be the end of a step."""
        if known or abs(peak.frequency) > spectrum.lowest + SLOW * spectrum.cell:
            self._slow_for = 0.0
            return False
        self._slow_for += spectrum.elapsed
        return self._slow_for < SLOW_FOR

    def _is_hum(self, spectrum: DopplerSpectrum, peak: _Peak) -> bool:
        """Whether a line is a harmonic of the mains and has stood still for STEADY_FOR."""
        frequency = abs(peak.frequency)
        if not abs(frequency - self._steady_at) <= STEADY or peak.snr < self._settings.least_snr:
            self._steady_at, self._steady_for = frequency, 0.0
            return False
        self._steady_for += spectrum.elapsed
        self._steady_at += (frequency - self._steady_at) * spectrum.elapsed / max(self._steady_for, spectrum.elapsed)
        if self._steady_for < STEADY_FOR or not of_the_mains(self._steady_at):
            return False
        self._hum.append(self._steady_at)
        return True

    def _without_hum(self, spectrum: DopplerSpectrum) -> DopplerSpectrum:
        """The spectrum without the lines of the mains that are known, for as long as they stand above the floor."""
        apart = [np.abs(np.abs(spectrum.frequencies) - line) for line in self._hum]
        excess = _excess(spectrum) if apart else np.empty(0)
        there = [excess[off <= 0.5 * spectrum.cell].max() >= self._settings.least_snr for off in apart]
        self._hum = [line for line, stands in zip(self._hum, there, strict=True) if stands]
        for off, stands in zip(apart, there, strict=True):
            if stands:
                lobe = off <= HUM_LOBE * spectrum.cell
                spectrum = replace(spectrum, power=np.where(lobe, HUSHED * spectrum.floor, spectrum.power))
        return spectrum


def of_the_mains(frequency: float) -> bool:
    """Whether a line (Hz) may be a harmonic of the mains, or a lamp's that flickers twice as fast."""
    off = min(abs(frequency - mains * round(frequency / mains)) for mains in MAINS)
    return off <= MEASURED_TO + MAINS_ERROR * abs(frequency)


def range_from_strength(amplitude: float, k: float) -> float:
    """Distance in m of an echo of `amplitude`, by the free-field model P = k / R^4 (room.md row 7).

    Raises ValueError for an amplitude of 0.
    """
    if not amplitude > 0.0:
        raise ValueError("an echo of amplitude 0 has no range")
    return float((k / amplitude**2) ** 0.25)


def _excess(spectrum: DopplerSpectrum) -> Floats:
    """How far each bin is over the floor, dB."""
    return np.asarray(10.0 * np.log10(np.maximum(spectrum.power / spectrum.floor, 1e-9)), dtype=np.float64)


def _fundamental(spectrum: DopplerSpectrum, peak: _Peak, settings: DopplerLineSettings) -> _Peak:
    """The line of which this one is an overtone: one that stands out of its own noise and is stronger; else itself."""
    for overtone in OVERTONES:
        for frequency in (peak.frequency / overtone, -peak.frequency / overtone):
            near = np.flatnonzero(np.abs(spectrum.frequencies - frequency) <= 0.5 * settings.half_width)
            if not len(near):
                continue
            below = _peak(spectrum, int(near[np.argmax(spectrum.power[near])]))
            if below.logarithm > peak.logarithm and below.snr >= settings.least_snr:
                return below
    return peak


def _stands_out(spectrum: DopplerSpectrum, peak: _Peak, settings: DopplerLineSettings, least_snr: float) -> bool:
    """Whether a peak is a target: in the band, so many dB clear, and with enough of the energy."""
    if abs(peak.frequency) > spectrum.highest or not peak.snr >= least_snr:
        return False
    if not spectrum.power[peak.bin] > spectrum.leak[peak.bin]:
        return False
    near = np.abs(spectrum.frequencies - peak.frequency) <= settings.half_width
    excess = spectrum.power - spectrum.floor
    return max(_share(excess, near), _share(excess / spectrum.floor, near)) >= settings.least_share


def _share(excess: Floats, near: NDArray[np.bool_]) -> float:
    """Of the energy above the floor, what is near the line.

    Not clipped at 0: what noise has above its mean in one bin it lacks in another.
    """
    inside, energy = float(excess[near].sum()), float(excess.sum())
    return inside / max(energy, inside) if inside > 0.0 else 0.0


def _line(spectrum: DopplerSpectrum, peak: _Peak, *, valid: bool) -> DopplerLine:
    range_rate = -SPEED_OF_LIGHT * peak.frequency / (2.0 * spectrum.carrier)
    return DopplerLine(
        range_rate=range_rate if spectrum.signed else abs(range_rate),
        amplitude=math.exp(0.5 * peak.logarithm),
        snr=peak.snr,
        valid=valid,
    )


def _top(spectrum: DopplerSpectrum, at: int) -> int:
    """The bin of the most power in the lobe around one; the floor under a lobe is not the same everywhere."""
    reach = max(round(spectrum.cell / float(spectrum.frequencies[1] - spectrum.frequencies[0])), 1)
    first = max(at - reach, 0)
    return first + int(np.argmax(spectrum.power[first : at + reach + 1]))


def _peak(spectrum: DopplerSpectrum, at: int) -> _Peak:
    shift, logarithm = _interpolated(spectrum.power, at)
    frequencies = spectrum.frequencies
    snr = 10.0 / math.log(10.0) * (logarithm - math.log(float(spectrum.floor[at])))
    return _Peak(
        bin=at,
        frequency=float(frequencies[at]) + shift * float(frequencies[1] - frequencies[0]),
        logarithm=logarithm,
        snr=max(snr, LOWEST_SNR),
    )


def _interpolated(power: np.ndarray, peak: int) -> tuple[float, float]:
    """Where the parabola through three logarithms has its top: bins off `peak`, and the logarithm of the power."""
    tiny = 1e-30
    middle = math.log(float(power[peak]) + tiny)
    if not 0 < peak < len(power) - 1:
        return 0.0, middle
    left, right = math.log(float(power[peak - 1]) + tiny), math.log(float(power[peak + 1]) + tiny)
    curvature = left - 2.0 * middle + right
    if curvature >= 0.0 or left > middle or right > middle:
        return 0.0, middle
    shift = 0.5 * (left - right) / curvature
    return shift, middle - 0.25 * (left - right) * shift
