"""A 24 GHz continuous-wave Doppler module on a wall: from points that move to the samples of its ADC.

Letters: R one-way path (m), lambda wavelength, g one-way amplitude of the antenna's pattern (1 on its axis), a
square root of a cross-section. One way, a point is reached by h = sum over paths of g / R exp(-j 2 pi R / lambda):
directly, and over floor and walls from mirror images. There and back is h squared, with all mixed paths in it, so a
lone point gives a g^2 / R^2 exp(-j 4 pi R / lambda): power falls as R^-4 and approaching is a positive frequency.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.room_course import RATE

Kind: TypeAlias = Literal["real", "iq"]
Complexes: TypeAlias = NDArray[np.complex64]

NotNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True, kw_only=True)
class ModuleSettings:
    """A module, its amplifier and its converter. Data sheet: RFbeam K-LD2 rev. C; the paper names no type."""

    carrier: Positive = 24.125e9  # Hz (room.md; data sheet)
    sample_rate: Annotated[int, Gt(0)] = 4000  # Hz (room.md); a multiple of RATE
    azimuth_beam: Annotated[float, Gt(0)] = 60.0 * DEGREE  # rad off the axis where one way is down by 3 dB (room.md)
    elevation_beam: Annotated[float, Gt(0)] = 17.0 * DEGREE  # rad, likewise (data sheet: 34 deg between -3 dB)
    side_lobes: Annotated[float, Gt(0)] = 0.06  # one-way amplitude that the pattern never falls below, -24 dB (chosen)
    # Amplitude, in parts of full scale, of 1 m^2 at 1 m: a trunk at 3 m fills a tenth of the range (chosen: "about
    # 60 dB" of amplification, paper section 3, leave headroom for a person near by)
    gain: Positive = 1.15  # m
    gain_spread: NotNegative = 1.5  # dB, sd between modules (chosen)

    # The noise is what lets the detection fade at 9 to 10 m (room.md): there the line of `reference_section`, steady
    # at 1 m/s on the axis, stands 10 dB (room.md, row 10) over the noise in a Hann window of 256 ms (row 8). A trunk
    # that surges and turns in every step has a broader line than that, which costs it some 2 dB
    detection_range: Positive = 10.0  # m
    reference_section: Positive = 0.6  # m^2 (room.md)
    flicker_corner: NotNegative = 150.0  # Hz where 1/f noise is as strong as white noise (chosen)
    noise_spread: NotNegative = 1.0  # dB, sd between modules (chosen)
    # An ordinary amplifier has much more noise at the lower end: so many dB over the white noise, below a corner where
    # it has fallen by 3 dB, 18 dB an octave beyond. 0: none
    amplifier_rise: NotNegative = 0.0  # dB
    amplifier_corner: Positive = 40.0  # Hz
    # Lamps on the mains flicker at 100 Hz, and a fluorescent tube's plasma reflects; over the same noise (chosen)
    hum: float = 0.0  # dB
    hum_spread: NotNegative = 5.0  # dB, sd between modules
    mains: Positive = 50.0  # Hz

    band: tuple[float, float] = (5.0, 900.0)  # Hz, -3 dB (room.md; paper), second order on each side (chosen)
    bits: Annotated[int, Ge(2)] = 12  # (room.md)
    # I/Q: sd of the ratio of the two channels' gains and of their angle's error (chosen: what such sheets call typical)
    gain_imbalance: NotNegative = 0.5  # dB
    phase_imbalance: NotNegative = 3.0 * DEGREE  # rad

    @property
    def wavelength(self) -> float:
        """Wavelength in m."""
        return SPEED_OF_LIGHT / self.carrier


# As real 24 GHz modules were found: amplifier noise below 60 Hz 20 to 35 dB over the rest in four recordings of others,
# 29 dB (8 to 16 Hz over 1 to 1.3 kHz) in the walk of github MishayNaidoo/Traffic-Monitoring-Using-Doppler-Radar
# @ ccabd7c. The hum is chosen: lamps nearer by
REAL_AMPLIFIER = ModuleSettings(amplifier_rise=28.0, amplifier_corner=30.0, hum=10.0)


class Module(NamedTuple):
    """One module as it came from the factory."""

    gain: float  # m, as in the settings
    noise: float  # standard deviations of the nominal noise
    hum: complex  # amplitude and phase of what a lamp reflects, in units of full scale, before the gain's spread
    second_hum: float  # its second harmonic, relative
    local_phase: float  # rad, of the local oscillator: what a single mixer sees of a phase
    gain_ratio: float  # of I to Q
    phase_error: float  # rad, of Q


class Mounting(NamedTuple):
    """Where a module is."""

    position: Floats  # (3,) m
    azimuth: float  # rad from x0, of the antenna's axis, which is horizontal


class Wall(NamedTuple):
    """A plane mirror: the floor or an upright wall."""

    axis: int  # 0, 1, 2: x, y or z is constant
    at: float  # m
    reflection: float  # amplitude, sign included


def module(settings: ModuleSettings, rng: Generator) -> Module:
    """A module out of many."""
    spread = rng.normal(0.0, 1.0, 6)
    level = settings.hum + settings.hum_spread * spread[2]
    # a line of amplitude A has the power A^2 / 2 per channel
    strength = np.sqrt(2.0 * _window_noise(settings) * 10.0 ** (0.1 * level))
    return Module(
        gain=float(10.0 ** (0.05 * settings.gain_spread * spread[0])),
        noise=float(10.0 ** (0.05 * settings.noise_spread * spread[1])),
        hum=complex(strength * np.exp(2.0j * np.pi * rng.uniform())),
        second_hum=float(rng.uniform(0.1, 0.5)),
        local_phase=float(2.0 * np.pi * rng.uniform()),
        gain_ratio=float(10.0 ** (0.05 * settings.gain_imbalance * spread[3])),
        phase_error=float(settings.phase_imbalance * spread[4]),
    )


def pattern(offset: Floats, mounting: Mounting, settings: ModuleSettings) -> Floats:
    """One-way amplitude (...,) towards `offset` (..., 3) m from the module, 1 on the axis.

    A power of the cosine in azimuth and one in elevation; half of the axis's power at the beams' half angles.
    """
    azimuth = np.arctan2(offset[..., 1], offset[..., 0]) - mounting.azimuth
    across = np.hypot(offset[..., 0], offset[..., 1])
    level = across / np.hypot(across, offset[..., 2])
    gain = _cosine(np.cos(azimuth), settings.azimuth_beam) * _cosine(level, settings.elevation_beam)
    return np.asarray(np.maximum(gain, settings.side_lobes), dtype=np.float64)


def echo(
    points: Floats,
    amplitudes: Floats,
    mounting: Mounting,
    walls: Sequence[Wall],
    settings: ModuleSettings,
    progress: Callable[[float], None] | None = None,
) -> Complexes:
    """Sum of the echoes of points, before any noise or filter; 1 is full scale.

    `points` (q, n, 3) m and `amplitudes` (q, n) m at RATE give (n * sample_rate / RATE,) samples. Between the
    given instants paths are cubic splines, which for a foot at its fastest is within some micrometres.
    `progress` is told the part done, 0..1.
    """
    paths, strengths = _paths(points, mounting, walls, settings)
    finer = settings.sample_rate // RATE
    count = points.shape[1]
    coefficients = spline_filter1d(paths, order=3, axis=-1, mode="mirror")
    coefficients = np.concatenate([coefficients[..., 1:2], coefficients, coefficients[..., -2:-4:-1]], axis=-1)
    held = np.concatenate([strengths, strengths[..., -1:]], axis=-1).astype(np.float32)
    weights = np.concatenate([amplitudes, amplitudes[:, -1:]], axis=-1).astype(np.float32)
    cubic, linear = _cubic_weights(finer), _linear_weights(finer).astype(np.float32)
    out = np.empty(count * finer, dtype=np.complex64)
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        turns = _between(coefficients[..., first : last + 3], cubic) / settings.wavelength
        # within one turn single precision is plenty (1e-7 rad), and many times as fast
        phase = (-2.0 * np.pi * (turns - np.rint(turns))).astype(np.float32)
        strength = _between(held[..., first : last + 1], linear)
        one_way = np.empty(strength.shape[:1] + strength.shape[2:], dtype=np.complex64)
        one_way.real = np.sum(strength * np.cos(phase), axis=1)
        one_way.imag = np.sum(strength * np.sin(phase), axis=1)
        weight = _between(weights[:, first : last + 1], linear)
        out[first * finer : last * finer] = settings.gain * np.sum(weight * one_way * one_way, axis=0)
        if progress is not None:
            progress(last / count)
    return out


def receive(
    echoes: Complexes, unit: Module, kind: Kind, settings: ModuleSettings, rng: Generator
) -> NDArray[np.int16] | Complexes:
    """What the ADC says of echoes (m,): int16 in steps of 16 for one mixer, complex64 of full scale 1 for I/Q.

    The amplifier has been on for a second with everything as at the first sample, so that nothing settles any more.
    """
    lead = settings.sample_rate
    time = (np.arange(lead + len(echoes)) - lead) / settings.sample_rate
    lamp = 2.0 * np.pi * 2.0 * settings.mains * time
    flicker = np.cos(lamp) + unit.second_hum * np.cos(2.0 * lamp)
    received = np.concatenate([np.full(lead, echoes[0]), echoes]) + unit.hum * flicker
    received *= np.exp(1j * unit.local_phase)
    channels = [received.real]
    if kind == "iq":
        channels = [
            received.real * np.sqrt(unit.gain_ratio),
            (received * np.exp(1j * unit.phase_error)).imag / np.sqrt(unit.gain_ratio),
        ]
    from scipy.signal import butter, sosfilt  # here: it takes a second to import, and walks outdoors need none

    filters = butter(2, settings.band, "bandpass", fs=settings.sample_rate, output="sos")
    steps = 2 ** (settings.bits - 1)
    codes = []
    for channel in channels:
        noisy = unit.gain * (channel + unit.noise * noise(len(channel), settings, rng))
        filtered = sosfilt(filters, noisy)[lead:]
        codes.append(np.clip(np.rint(filtered * steps), -steps, steps - 1))
    if kind == "real":
        return np.asarray(codes[0] * (2**15 // steps), dtype=np.int16)
    return np.asarray((codes[0] + 1j * codes[1]) / steps, dtype=np.complex64)


def noise(count: int, settings: ModuleSettings, rng: Generator) -> Floats:
    """Nominal noise of one channel (count,), full scale 1, before the band-pass: white, 1/f, amplifier."""
    white = rng.normal(0.0, np.sqrt(0.5 * settings.sample_rate * white_density(settings)), count)
    spectrum = np.fft.rfft(white)
    frequency = np.fft.rfftfreq(count, 1.0 / settings.sample_rate)
    # 1/f has to end somewhere: below 1 Hz, far under the band
    shape = 1.0 + settings.flicker_corner / np.maximum(frequency, 1.0)
    if settings.amplifier_rise > 0.0:
        shape += 10.0 ** (0.1 * settings.amplifier_rise) / (1.0 + (frequency / settings.amplifier_corner) ** 6)
    spectrum *= np.sqrt(shape)
    return np.asarray(np.fft.irfft(spectrum, count), dtype=np.float64)


def white_density(settings: ModuleSettings) -> float:
    """One-sided spectral density of the white noise of one channel, 1/Hz, full scale 1."""
    doppler = 2.0 / settings.wavelength  # Hz at 1 m/s
    return _window_noise(settings) / _HANN_BANDWIDTH / (1.0 + settings.flicker_corner / doppler)


def _window_noise(settings: ModuleSettings) -> float:
    """Noise power of a channel within the bandwidth of the window, at 1 m/s.

    A real line of amplitude A has the power A^2 / 2, and stands as high over the noise as that over this.
    """
    line = settings.gain * np.sqrt(settings.reference_section) / settings.detection_range**2
    return float(0.5 * line**2 / _DETECTED)


_DETECTED = 10.0  # power of a line over the noise: 10 dB (room.md, row 10)
_HANN_BANDWIDTH = 1.5 / 0.256  # Hz, equivalent noise bandwidth of the Hann window of 256 ms (room.md, row 8)
_BLOCK = 40  # instants at RATE at a time, 0.2 s: the arrays stay in the cache


def _cosine(cosine: Floats, half_angle: float) -> Floats:
    """Amplitude of a power of the cosine whose square is 1/2 at `half_angle`; 0 behind."""
    exponent = 0.5 * np.log(0.5) / np.log(np.cos(half_angle))
    return np.asarray(np.maximum(cosine, 0.0) ** exponent, dtype=np.float64)


def _paths(
    points: Floats, mounting: Mounting, walls: Sequence[Wall], settings: ModuleSettings
) -> tuple[Floats, Floats]:
    """One-way paths (q, w, n), m, and their strengths g / R (q, w, n), 1/m: direct, then over each mirror."""
    images = [points]
    factors = [1.0]
    for wall in walls:
        image = points.copy()
        image[..., wall.axis] = 2.0 * wall.at - image[..., wall.axis]
        images.append(image)
        factors.append(wall.reflection)
    offsets = np.stack(images, axis=1) - mounting.position
    length = np.linalg.norm(offsets, axis=-1)
    strength = pattern(offsets, mounting, settings) / length * np.array(factors)[:, None]
    return length, strength


def _between(values: NDArray[np.floating], weights: NDArray[np.floating]) -> NDArray[np.floating]:
    """Values (..., k + taps - 1) at RATE, interpolated to (..., k * finer) by weights (taps, finer)."""
    taps = weights.shape[0]
    windows = np.lib.stride_tricks.sliding_window_view(values, taps, axis=-1)
    fine: NDArray[np.floating] = windows @ weights
    return fine.reshape(*fine.shape[:-2], -1)


def _cubic_weights(finer: int) -> Floats:
    """Cubic B-splines at the instants between two nodes, (4, finer)."""
    u = np.arange(finer) / finer
    return np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]) / 6.0


def _linear_weights(finer: int) -> Floats:
    """Shares of two nodes at the instants between them, (2, finer)."""
    u = np.arange(finer) / finer
    return np.stack([1.0 - u, u])
