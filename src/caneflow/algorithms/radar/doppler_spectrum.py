"""The short-time power spectrum of a continuous-wave Doppler module's output, and the noise under it.

A line of amplitude A (full scale = 1) has the power A^2 in its bin, whatever the window, so spectra of different
windows and of real and complex modules compare. The noise floor is learnt per bin (`noise_floor`), so that mains hum
and the amplifier's 1/f noise are part of it. A spectrum reaches beyond the band, so that a target that is too fast
for it is seen to be there, and no part of it in the band is taken for the whole.

A window in which the channel, or one of I and Q, stands still for a whole period of the lowest frequency is silent:
it has no spectrum, and the floor learns nothing from it. Single impulses and steps are taken out before the transform.
A block that is lost, or that is far louder than all around it, is bridged.
"""

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray
from scipy import fft

from caneflow.algorithms.glitches import JumpGate
from caneflow.algorithms.quantities import Frequency, Time, Zero
from caneflow.algorithms.radar.noise_floor import LEAST_POWER, NoiseFloor
from caneflow.algorithms.radar.waveform_faults import mended

INT16_FULL_SCALE = 32768.0
# int16 without noise is a staircase, whose lines are no target: ten times the power that rounding has as white noise
# in a window of 1024 samples, half a bit's
STAIRCASE = 5e-12
BEYOND = 2.0  # times the highest frequency of the band: what is stronger there is looked for, too
HIGHEST_BEYOND = 0.9  # of the Nyquist frequency, where filters against aliasing end
# What drifts or settles slowly has most of its power below the band. Of an exponential, and of a straight line, a Hann
# window lets at most -19 dB of it through beyond 2.4 cells, and 18 dB an octave less farther off (worked out for time
# constants above 0.1 s; the window's own side lobes: F. Harris, Proc. IEEE 66(1), 1978).
LEAK = 10.0**-1.8
LEAK_FROM = 2.4  # cells, 1 / window
MOST_ROWS = 1000  # of the floor's memory
LARGEST_WINDOW = 1 << 20  # samples: 5 s of a sound card's 192 kHz
FORGOTTEN = 1.0  # s without a block, after which one of another make, or of another level, is believed at once
BRIDGED = 0.25  # of the window: the longest gap across which it goes on; a line loses at most 4 dB of its SNR by it
# dB over the block before: nobody comes so fast; what stays there for three blocks is believed
WILD = 40.0
LOUD = -20.0  # dB of change from sample to sample: a line has it only where it nearly clips

Make: TypeAlias = tuple[float, float, bool]  # sample rate and carrier (Hz), I and Q: the same in all blocks


@dataclass(frozen=True, kw_only=True)
class DopplerSpectrumSettings:
    """Window, hop, band (room.md row 8), and how long the floor remembers."""

    window: Annotated[float, Ge(1e-3), Le(60)] = 0.256  # s, Hann
    hop: Annotated[float, Ge(1e-3), Le(60)] = 0.05  # s between spectra; a block that is longer gives one all the same
    padding: Annotated[float, Ge(1), Le(64)] = 2.0  # length of the transform in windows
    lowest: Frequency | Zero = 8.0  # Hz
    highest: Frequency = 560.0  # Hz
    floor_memory: Time = 20.0  # s


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerSpectrum:
    """Power of one window in the band, and beyond its upper end."""

    frequencies: NDArray[np.float64]  # shape (B,), Hz, increasing; positive is approaching, negative only if signed
    power: NDArray[np.float64]  # shape (B,), squared amplitude of a line on that frequency, full scale = 1
    floor: NDArray[np.float64]  # shape (B,), the mean power that noise alone has there
    signed: bool  # whether the module tells approaching from receding
    carrier: float  # Hz
    noise_bandwidth: float  # bins that one line's power is spread over: sum of `power` / noise_bandwidth = energy
    leak: NDArray[np.float64]  # shape (B,), the most power that what lies below the band may show there
    silent: bool  # the channel carried nothing; `power` is 0
    lowest: float  # Hz, where the band begins
    highest: float  # Hz, where it ends
    cell: float  # Hz, 1 / window: how far apart two lines have to be
    floor_slack: float  # dB by which the floor may be too low in some bin; infinite while it is not known
    elapsed: float  # s since the spectrum before


class SlidingSpectrum:
    """Takes blocks of samples; gives one spectrum per hop once a whole window is there."""

    def __init__(self, settings: DopplerSpectrumSettings) -> None:
        if settings.lowest >= settings.highest:
            raise ValueError(f"the band is {settings.lowest:g} to {settings.highest:g} Hz; it has no width")
        self._settings = settings
        self._make: Make | None = None
        self._makes: JumpGate[Make] = JumpGate(0.0, apart, longest_gap=FORGOTTEN)
        self._levels: JumpGate[float] = JumpGate(WILD, _louder, longest_gap=FORGOTTEN)
        self._last_ns: int | None = None  # stamp of the last block
        self._seen_ns: int | None = None  # the same, of one that was refused as well
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

        A block of another make than the ones before, for three blocks in a row at most, is one by mistake: where its
        stamp fits its samples at the rate before, it is taken for one of that make, otherwise it counts as lost. So
        does one that is louder by WILD.

        Raises:
            ValueError: a block that is not newer than the one before, or a rate that cannot hold the band or takes too
                long a window; nothing has changed then.
        """
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise ValueError(f"block at {stamp_ns} ns is not newer than the last, {self._last_ns} ns")
        make = (sample_rate, carrier, samples.dtype.kind == "c")
        elapsed_ns = stamp_ns - (self._seen_ns or 0)
        impossible = self._impossible(sample_rate)
        if not impossible:
            believed = self._makes.update(stamp_ns, make)
        elif self._make is not None and _fits(self._make, samples, elapsed_ns):
            believed = self._make
        else:
            raise ValueError(impossible)
        self._seen_ns = stamp_ns
        if believed != make and not _fits(believed, samples, elapsed_ns):
            return None
        if believed != self._make:
            self._prepare(believed)
        self._levels.update(stamp_ns, _level(samples))
        if self._levels.holding:
            return None
        scaled = self._scaled(samples)
        self._bridge_or_forget(stamp_ns, scaled)
        self._last_ns = stamp_ns
        self._take(scaled, present=True)
        due = self._since_hop >= self._hop
        self._since_hop %= self._hop
        return self._spectrum(stamp_ns) if due and self._filled == len(self._kept) else None

    def _impossible(self, sample_rate: float) -> str:
        """What is wrong with a rate; empty when nothing is."""
        settings = self._settings
        if 2.0 * settings.highest > sample_rate:
            return f"a band up to {settings.highest:g} Hz takes more than {sample_rate:g} samples a second"
        if settings.window * sample_rate > LARGEST_WINDOW:
            return f"a window of {settings.window:g} s at {sample_rate:g} Hz has more than {LARGEST_WINDOW} samples"
        return ""

    def _prepare(self, make: Make) -> None:
        settings = self._settings
        sample_rate, _, signed = make
        count = round(settings.window * sample_rate)
        self._make = make
        self._kept = np.zeros(count, dtype=np.complex128 if signed else np.float64)
        self._present = np.zeros(count, dtype=bool)  # which of them were measured, and not bridged
        self._filled = 0
        # whatever is in the band changes within its period; a band that begins at 0 has no longest one
        self._longest_still = round(min(sample_rate / max(settings.lowest, 1e-9), 0.5 * count))
        self._hop = max(round(settings.hop * sample_rate), 1)
        self._since_hop = 0
        self._given_ns: int | None = None  # stamp of the last spectrum
        self._hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(count) / count)
        self._length = fft.next_fast_len(round(settings.padding * count), real=not signed)
        frequencies = fft.fftfreq(self._length, 1.0 / sample_rate)
        if not signed:
            frequencies = np.abs(frequencies[: self._length // 2 + 1])
        order = np.argsort(frequencies, kind="stable")
        beyond = max(settings.highest, min(BEYOND * settings.highest, 0.5 * HIGHEST_BEYOND * sample_rate))
        in_band = (np.abs(frequencies) >= settings.lowest) & (np.abs(frequencies) <= beyond)
        self._bins = order[in_band[order]]
        self._frequencies = frequencies[self._bins]
        self._below = np.flatnonzero((np.abs(frequencies) > 0.0) & (np.abs(frequencies) < settings.lowest))
        cells = np.maximum(np.abs(self._frequencies) * settings.window, LEAK_FROM)
        self._leak = LEAK * (LEAK_FROM / cells) ** 6
        # a real line is half at its frequency and half at the negative of it
        self._scale = ((1.0 if signed else 2.0) / self._hann.sum()) ** 2
        # Parseval: a line of power 1 gives this in sum over the bins of its lobe
        self._noise_bandwidth = self._length * float((self._hann**2).sum()) / float(self._hann.sum()) ** 2
        spacing = max(round(0.5 * settings.window / settings.hop), 1)
        rows = min(round(settings.floor_memory / (spacing * settings.hop)), MOST_ROWS)
        self._floor = NoiseFloor(rows, spacing, self._length / count)

    def _bridge_or_forget(self, stamp_ns: int, scaled: NDArray[np.inexact]) -> None:
        """A straight line where few samples are missing before these; where many are, the window begins again."""
        if self._make is None or self._last_ns is None:
            return
        count = len(scaled)
        elapsed = (stamp_ns - self._last_ns) * 1e-9 * self._make[0]  # samples
        if elapsed <= count + _jitter(count):
            return
        self.gaps += 1
        missing = round(elapsed) - count
        if missing <= BRIDGED * len(self._kept):
            # without a step there, what is slow and strong does not spread over the band
            line = np.linspace(self._kept[-1], scaled[0], missing + 2)[1:-1]
            self._take(line, present=False)
        else:
            self._filled = self._since_hop = 0

    def _scaled(self, samples: NDArray[np.number]) -> NDArray[np.inexact]:
        """The samples with a full scale of 1."""
        whole = samples.dtype.kind == "i"
        self._least_floor = STAIRCASE if whole else LEAST_POWER
        return np.asarray(samples / INT16_FULL_SCALE if whole else samples)

    def _take(self, scaled: NDArray[np.inexact], *, present: bool) -> None:
        size = len(self._kept)
        fresh = scaled[-size:]
        for kept, new in ((self._kept, fresh), (self._present, present)):
            kept[: size - len(fresh)] = kept[len(fresh) :].copy()
            kept[size - len(fresh) :] = new
        self._filled = min(self._filled + len(scaled), size)
        self._since_hop += len(scaled)

    def _spectrum(self, stamp_ns: int) -> DopplerSpectrum:
        assert self._make is not None
        _, carrier, signed = self._make
        samples, still = self._mended(signed)
        silent = still >= self._longest_still
        power, below = np.zeros(len(self._bins)), 0.0
        if not silent:
            windowed = (samples - samples.mean()) * self._hann * self._filling()
            transform = fft.fft(windowed, self._length) if signed else fft.rfft(windowed, self._length)
            power = self._power(transform[self._bins])
            below = float(self._power(transform[self._below]).max(initial=0.0))
        elapsed = 0.0 if self._given_ns is None else 1e-9 * (stamp_ns - self._given_ns)
        self._given_ns = stamp_ns
        slack = self._floor.slack
        return DopplerSpectrum(
            frequencies=self._frequencies,
            power=power,
            floor=np.full(len(power), LEAST_POWER)
            if silent
            else np.maximum(self._floor.update(power), self._least_floor),
            signed=signed,
            carrier=carrier,
            noise_bandwidth=self._noise_bandwidth,
            leak=below * self._leak,
            silent=silent,
            lowest=self._settings.lowest,
            highest=self._settings.highest,
            cell=1.0 / self._settings.window,
            floor_slack=slack,
            elapsed=elapsed,
        )

    def _filling(self) -> float:
        """By what a line's amplitude grows again that has lost what was bridged."""
        if self._present.all():
            return 1.0
        return float(self._hann.sum() / self._hann[self._present].sum())

    def _power(self, lines: NDArray[np.complex128]) -> NDArray[np.float64]:
        power: NDArray[np.float64] = self._scale * (lines.real**2 + lines.imag**2)
        return power

    def _mended(self, signed: bool) -> tuple[NDArray[np.inexact], int]:
        """The window without impulses and steps, and how long its channel, or the quieter of I and Q, stood still."""
        if not signed:
            return mended(self._kept.real)
        in_phase, quadrature = mended(self._kept.real), mended(self._kept.imag)
        return in_phase.samples + 1j * quadrature.samples, max(in_phase.still, quadrature.still)


def apart(one: Make, other: Make) -> float:
    """0 for the same make, 1 for another."""
    return float(one != other)


def _level(samples: NDArray[np.number]) -> float:
    """Of a block, dB: its median change from sample to sample, which single impulses and steps leave as it is."""
    if len(samples) < 2:
        return LOUD
    scaled = samples * np.float64(1.0 / INT16_FULL_SCALE if samples.dtype.kind == "i" else 1.0)
    return 20.0 * math.log10(max(float(np.median(np.abs(scaled[1:] - scaled[:-1]))), LEAST_POWER))


def _louder(now: float, before: float) -> float:
    """By how many dB a loud block is louder than the one before."""
    return now - before if now > LOUD else 0.0


def _jitter(count: float) -> float:
    """By how many samples the stamp of a block of `count` may be off: half a block."""
    return 0.5 * count + 1.0


def _fits(make: Make, samples: NDArray[np.number], elapsed_ns: int) -> bool:
    """Whether samples may be of `make`, by their kind and the time since the block before."""
    sample_rate, _, signed = make
    elapsed, count = elapsed_ns * 1e-9 * sample_rate, len(samples)
    return signed == (samples.dtype.kind == "c") and abs(elapsed - count) <= _jitter(min(elapsed, count))
