"""The predominant line of a Doppler spectrum: how fast the person moves along the beam, and how strongly it echoes.

Rather than the total energy the paper takes the magnitude of the predominant frequency, which likely belongs to the
direct path (Ferrand et al., ICCHP 2020). Positive frequency is approaching, so range rate = -c f / (2 carrier).
"""

import math
from dataclasses import dataclass

import numpy as np

from caneflow.algorithms.quantities import Decibels, Frequency, Probability, Zero
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum
from caneflow.physics import SPEED_OF_LIGHT

LOWEST_SNR = -99.0  # dB, of a spectrum with nothing in it


@dataclass(frozen=True, kw_only=True)
class DopplerLineSettings:
    """When a peak counts as a person (room.md row 10)."""

    least_snr: Decibels | Zero = 10.0  # dB over the noise floor
    least_share: Probability = 0.25  # of the in-band energy above the floor
    half_width: Frequency = 8.0  # Hz to either side, that the share is taken from


@dataclass(frozen=True, kw_only=True)
class DopplerLine:
    """One target: the strongest line."""

    range_rate: float  # m/s, positive away; its magnitude when not signed
    amplitude: float  # full scale = 1
    snr: float  # dB over the noise floor at that frequency
    valid: bool


def predominant_line(spectrum: DopplerSpectrum, settings: DopplerLineSettings) -> DopplerLine:
    """The strongest line above the floor, between the bins by a parabola through the logarithms.

    A silent channel has none: not valid, of speed and amplitude 0 and the lowest SNR.
    """
    if spectrum.silent:
        return DopplerLine(range_rate=0.0, amplitude=0.0, snr=LOWEST_SNR, valid=False)
    power, floor = spectrum.power, spectrum.floor
    excess = power - floor
    peak = int(np.argmax(excess))
    shift, logarithm = _interpolated(power, peak)
    frequencies = spectrum.frequencies
    frequency = float(frequencies[peak]) + shift * float(frequencies[1] - frequencies[0])
    snr = max(10.0 / math.log(10.0) * (logarithm - math.log(float(floor[peak]))), LOWEST_SNR)
    near = np.abs(frequencies - frequency) <= settings.half_width
    # not clipped at 0: what noise has above its mean in one bin it lacks in another
    inside, energy = float(excess[near].sum()), float(excess.sum())
    share = inside / max(energy, inside) if inside > 0.0 else 0.0
    clear = snr >= settings.least_snr and share >= settings.least_share
    range_rate = -SPEED_OF_LIGHT * frequency / (2.0 * spectrum.carrier)
    return DopplerLine(
        range_rate=range_rate if spectrum.signed else abs(range_rate),
        amplitude=math.exp(0.5 * logarithm),
        snr=snr,
        valid=clear and bool(power[peak] > spectrum.leak[peak]),
    )


def range_from_strength(amplitude: float, k: float) -> float:
    """Distance in m of an echo of `amplitude`, by the free-field model P = k / R^4 (room.md row 7).

    Raises ValueError for an amplitude of 0.
    """
    if not amplitude > 0.0:
        raise ValueError("an echo of amplitude 0 has no range")
    return float((k / amplitude**2) ** 0.25)


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
