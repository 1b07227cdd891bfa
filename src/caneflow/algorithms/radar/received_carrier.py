"""The effective carrier of radar scans, measured from what moves: its phase against its echo's own motion.

A pulse of 3.1 to 4.8 GHz is received with whatever spectrum the antennas leave of it, so the phase of an echo turns as
at the centroid of that, which lies below the middle of the transmitted band. The speed by which the whole echo moves
along the range axis (a slant stack: one speed for all lines of the fast-time spectrum, each at its own Doppler) needs
no carrier; the Doppler frequency at its peak divided by that speed is the carrier.

Where many echoes of many speeds share a place (a floor, a body that walks) that does not settle. Then the centroid of
the spectrum of what changes between scans stands for it: less exact, but every scan says something.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT

Floats = NDArray[np.float64]

WINDOW = 32  # scans
TRANSFORM = 512  # Doppler bins
BAND = (2.9e9, 5.3e9)  # Hz, of fast time, that holds all of a P440's pulse
NOMINAL = 4.1e9  # Hz, from which the search begins
SEARCHED = 0.2  # of the speed by that, to either side
SLOWEST = 0.15  # m/s: a slower echo moves too little in a window
FASTEST_TURN = 0.35  # turns between two scans, beyond which the sign of a Doppler frequency may be wrong
CLEAR = 12.0  # times the median magnitude of the map
COHERENT = 0.3  # of what an echo of a single speed would give; several in one place have less
LEAST_LINES = 8  # of fast time in the band; fewer are not a spectrum
GATE = 0.5  # m to either side of an echo
ECHOES = 4  # per window, at most
LEAST = 6  # echoes that a measurement takes
# Hz of fast time where no pulse is: what the receiver itself makes, and so the noise to take off
QUIET = (5.8e9, 7.8e9)
CLEAR_POWER = 2.0  # times that noise, on average over the band: below it a window says too little
# Relative, 1 sd: against the phase -0.5 % on the rail, 0.1, 0.3 and 1.5 % on three logs of a walker, known to 1 %
CENTROID_ERROR = 0.01
CENTROID_WINDOWS = 16  # after which a radar that runs is told the centroid, while the phase has not settled
SETTLED, SETTLED_ERROR = 12, 0.01  # echoes and relative error from which on a radar that runs is told its carrier


@dataclass(frozen=True, kw_only=True)
class ReceivedCarrier:
    """What a recording says of its carrier."""

    carrier: float  # Hz
    spread: float  # Hz, standard deviation of one echo's
    echoes: int  # or windows
    by_centroid: bool = False

    @property
    def error(self) -> float:
        """Hz, standard error; overlapping windows count half."""
        random = self.spread / math.sqrt(max(0.5 * self.echoes, 1.0))
        return math.hypot(random, CENTROID_ERROR * self.carrier) if self.by_centroid else random

    @property
    def settled(self) -> bool:
        """Whether it is known to 1 %."""
        return not self.by_centroid and self.error <= SETTLED_ERROR * self.carrier


def received_carrier(
    scans: NDArray[np.number], times: Floats, range_step: float, *, hop: int = WINDOW // 4
) -> ReceivedCarrier | None:
    """The carrier of real-valued scans, shape (n, bins), at `times` (n,) s, `range_step` m apart; None: nothing moves.

    Windows whose scans are not evenly spaced, within a third of a period, are left out.
    """
    if len(scans) < WINDOW:
        return None
    usual = float(np.median(np.diff(times)))
    pairs = [
        pair
        for first in range(0, len(scans) - WINDOW + 1, hop)
        for pair in echoes(scans[first : first + WINDOW], times[first : first + WINDOW], usual, range_step)
    ]
    return _carrier_of(np.array(pairs)) if len(pairs) >= LEAST else None


def centroid_carrier(scans: NDArray[np.number], range_step: float, *, hop: int = WINDOW // 4) -> ReceivedCarrier | None:
    """The centroid (Hz) of the spectrum of what changes within windows of scans (n, bins); None: too little does."""
    windows = [
        found
        for first in range(0, len(scans) - WINDOW + 1, hop)
        if (found := _window_centroid(scans[first : first + WINDOW], range_step)) is not None
    ]
    return _centroid_of(np.array(windows)) if len(windows) >= LEAST else None


class CarrierMeter:
    """The same while scans come, in one window of two, until the standard error is within 1 %."""

    def __init__(self) -> None:
        self._scans: list[tuple[float, NDArray[np.number]]] = []
        self._pairs: list[tuple[float, float]] = []
        self._centroids: list[tuple[float, float]] = []

    def update(self, time: float, scan: NDArray[np.number], range_step: float) -> ReceivedCarrier | None:
        """The carrier after a scan (bins,) at `time` s that settles it, and before that, once, the centroid."""
        if self._scans and (len(scan) != len(self._scans[-1][1]) or time <= self._scans[-1][0]):
            self._scans.clear()
        self._scans.append((time, scan))
        if len(self._scans) < 2 * WINDOW:
            return None
        times, scans = zip(*self._scans[WINDOW:], strict=True)
        self._scans.clear()
        block = np.stack(scans).astype(np.float32)
        self._pairs += echoes(block, np.array(times), float(np.median(np.diff(times))), range_step)
        found = _carrier_of(np.array(self._pairs)) if len(self._pairs) >= SETTLED else None
        if found is not None and found.echoes >= SETTLED and found.settled:
            return found
        centroid = _window_centroid(block, range_step) if len(self._centroids) < CENTROID_WINDOWS else None
        if centroid is None:
            return None
        self._centroids.append(centroid)
        return _centroid_of(np.array(self._centroids)) if len(self._centroids) == CENTROID_WINDOWS else None


def _window_centroid(scans: NDArray[np.number], range_step: float) -> tuple[float, float] | None:
    """Centroid (Hz) and power of what changes within one window; None: too little, or too coarse for a quiet band."""
    lines = np.fft.rfftfreq(scans.shape[1], 2.0 * range_step / SPEED_OF_LIGHT)
    inside, quiet = ((low < lines) & (lines < high) for low, high in (BAND, QUIET))
    if np.count_nonzero(inside) < LEAST_LINES or lines[-1] < QUIET[1]:
        return None
    changing = (scans - scans.mean(axis=0)) * np.hanning(scans.shape[1])
    power = np.mean(np.abs(np.fft.rfft(changing, axis=1)) ** 2, axis=0)
    noise = float(power[quiet].mean())
    signal = power[inside] - noise
    total = float(signal.sum())
    if not signal.mean() > CLEAR_POWER * noise:
        return None
    return float(signal @ lines[inside]) / total, total


def _centroid_of(windows: Floats) -> ReceivedCarrier:
    """From centroids (Hz) of windows and their powers, shape (n, 2)."""
    each, power = windows.T
    carrier = float(each @ power / power.sum())
    return ReceivedCarrier(carrier=carrier, spread=float(each.std()), echoes=len(each), by_centroid=True)


def _carrier_of(pairs: Floats) -> ReceivedCarrier | None:
    """From Doppler frequencies (Hz) and speeds (m/s), shape (n, 2); those far off the median are left out."""
    each = 0.5 * SPEED_OF_LIGHT * pairs[:, 0] / pairs[:, 1]
    off = np.abs(each - np.median(each))
    kept = off <= 3.0 * max(1.4826 * float(np.median(off)), 1e-3 * NOMINAL)
    if np.count_nonzero(kept) < LEAST:
        return None
    doppler, speed = pairs[kept].T
    return ReceivedCarrier(
        carrier=0.5 * SPEED_OF_LIGHT * float(speed @ doppler) / float(speed @ speed),
        spread=float(each[kept].std()),
        echoes=int(np.count_nonzero(kept)),
    )


def echoes(scans: NDArray[np.number], times: Floats, usual: float, range_step: float) -> list[tuple[float, float]]:
    """Doppler frequency (Hz) and speed (m/s) of the strongest echoes of one window of scans `usual` s apart."""
    frequencies = np.fft.rfftfreq(scans.shape[1], 2.0 * range_step / SPEED_OF_LIGHT)
    inside = (frequencies > BAND[0]) & (frequencies < BAND[1])
    if np.count_nonzero(inside) < LEAST_LINES:
        return []
    intervals = np.diff(times)
    period = float(intervals.mean())
    if np.abs(np.cumsum(intervals - period)).max() > 0.6 * usual or abs(period / usual - 1.0) > 0.05:
        return []
    moving = scans - scans.mean(axis=0)
    lines = np.fft.rfft(moving, axis=1) * inside
    analytic = np.zeros(moving.shape, dtype=np.complex128)
    analytic[:, : lines.shape[1]] = 2.0 * lines
    hann = np.hanning(WINDOW + 2)[1:-1, None]
    magnitude = np.abs(np.fft.fft(np.fft.ifft(analytic, axis=1) * hann, TRANSFORM, axis=0))
    doppler = np.fft.fftfreq(TRANSFORM, period)
    usable = np.abs(doppler) < FASTEST_TURN / period
    usable &= np.abs(doppler) > 2.0 * SLOWEST * NOMINAL / SPEED_OF_LIGHT
    least = CLEAR * float(np.median(magnitude))
    reach = max(round(GATE / range_step), 1)
    found = []
    for _ in range(ECHOES):
        strongest = int(np.argmax(magnitude.max(axis=0)))
        at = int(np.argmax(magnitude[:, strongest]))
        if magnitude[at, strongest] < least:
            break
        gate = slice(max(strongest - reach, 0), strongest + reach + 1)
        if usable[at]:
            frequency = doppler[at] + _vertex(magnitude[:, strongest], at) / (TRANSFORM * period)
            speed = _speed(moving[:, gate] * hann, frequency, period, range_step)
            if speed is not None:
                found.append((float(frequency), speed))
        magnitude[:, gate] = 0.0
    return found


def _speed(echo: Floats, frequency: float, period: float, range_step: float) -> float | None:
    """Speed (m/s) that fits all lines of an echo's spectrum best, near what `frequency` says; None: no single one."""
    spectrum = np.fft.rfft(echo * np.hanning(echo.shape[1]), TRANSFORM, axis=1)
    lines = np.fft.rfftfreq(TRANSFORM, 2.0 * range_step / SPEED_OF_LIGHT)
    inside = (lines > BAND[0]) & (lines < BAND[1])
    spectrum, lines = spectrum[:, inside], lines[inside]
    rough = 0.5 * SPEED_OF_LIGHT * frequency / NOMINAL
    speeds = rough * np.linspace(1.0 - SEARCHED, 1.0 + SEARCHED, 41)
    turns = 2.0 / SPEED_OF_LIGHT * period * np.arange(WINDOW)[:, None] * lines
    power = np.array([np.sum(np.abs(np.sum(spectrum * np.exp(-2j * np.pi * v * turns), axis=0)) ** 2) for v in speeds])
    best = int(np.argmax(power))
    if not 0 < best < len(speeds) - 1 or power[best] < COHERENT * WINDOW * np.sum(np.abs(spectrum) ** 2):
        return None
    return float(speeds[best] + _vertex(power, best) * (speeds[1] - speeds[0]))


def _vertex(values: Floats, at: int) -> float:
    """Where the parabola through three values, around on themselves, has its top, in steps off the middle one."""
    left, middle, right = values[at - 1], values[at], values[(at + 1) % len(values)]
    curvature = left - 2.0 * middle + right
    return float(0.5 * (left - right) / curvature) if curvature < 0.0 else 0.0
