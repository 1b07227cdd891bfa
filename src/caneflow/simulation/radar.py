"""A P440 class pulse radar: scans of a scene, one real-valued scan per pose.

Letters: R range of a scatterer, r range of a bin (both m), f carrier (Hz), c speed of light, k = 4 pi f / c.
A scatterer of complex amplitude a adds Re{a G(theta) / R^2 p(r - R) exp(j k (r - R))}: power falls as R^-4, G is
the two-way pattern, p the Gaussian envelope of the pulse. As R falls, the phase at a given r rises: in the
analytic signal along r, approaching is positive Doppler (wire.md).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.simulation import attitude
from caneflow.simulation.attitude import Floats
from caneflow.simulation.scene import Complexes, Scene
from caneflow.simulation.walk import Motion, Rig

BORESIGHT = (0.0, 1.0, 0.0)  # of the radar in the body frame, as in the paper
RANGE_STEP = 0.5 * SPEED_OF_LIGHT * 32.0 / 512e9 / 1.024  # m, 61.035 ps: 32 bins of 1 / (512 x 1.024) ns (MRM protocol)

_BLOCK = 16  # scans at a time: the arrays stay in the cache
_FINER = 2  # cells per range bin on which echoes are added up; linear between cells costs -57 dB
_FAINT = 0.02  # one-way power gain below which a scatterer is left out: -34 dB two-way


@dataclass(frozen=True, kw_only=True)
class RadarSettings:
    """A P440 (cane.md, row 1: 3.1 to 4.8 GHz)."""

    carrier: Annotated[float, Gt(0)] = 4.3e9  # Hz
    bandwidth: Annotated[float, Gt(0)] = 1.7e9  # Hz, between the -10 dB points
    range_start: Annotated[float, Gt(0)] = 0.3  # m of bin 0, chosen: just before the floor's first echo
    bins: Annotated[int, Gt(0)] = 288  # three of the P440's quanta of 96 samples, up to 2.9 m
    # mean power of the floor's echo at its strongest range, with the cane held at its nominal attitude, over the
    # noise's, both per real sample (cane.md: 15 dB)
    snr: float = 15.0  # dB
    noise: Annotated[float, Gt(0)] = 200.0  # LSB, white up to 8.2 GHz: a P440's recorded scans (p440-rail-mocap)
    # What is received between 3 and 5 GHz over what the receiver makes itself: 8 dB (p440-udp-loss, test_scan711_1000)
    # to 12 dB (test_scan2) in differences of scans of rooms at rest; as it is white noise of the same power by default
    noise_rise: Annotated[float, Ge(0)] = 0.0  # dB, of the noise's density within the band
    jitter: Annotated[float, Ge(0)] = 0.15e-12  # s, sd per scan: that recording's strongest echo while it stands
    # Direct coupling: an antenna's ring-down, at its strongest above the strongest floor echo; both chosen
    coupling: float = 26.0  # dB
    coupling_decay: Annotated[float, Gt(0)] = 0.06  # m per factor e of amplitude
    tip_section: Annotated[float, Ge(0)] = 0.003  # m^2, chosen: a tip and a shaft seen from behind, -25 dBsm

    def ranges(self) -> Floats:
        """Range of each bin, (bins,) m."""
        ranges: Floats = self.range_start + RANGE_STEP * np.arange(self.bins, dtype=np.float64)
        return ranges


def scans(
    motion: Motion,
    scene: Scene,
    rig: Rig,
    pitch: float,
    settings: RadarSettings,
    rng: Generator,
    progress: Callable[[float], None] | None = None,
) -> NDArray[np.int32]:
    """Scans (n, bins), LSB, one per sample of `motion`; nothing moves within a scan.

    `pitch` (rad) is the cane's nominal attitude, on which the SNR is defined. The scans of a shorter motion are
    the beginning of those of the longer one. `progress` is told the part done, 0..1.
    """
    leak_rng, noise_rng = rng.spawn(2)
    floor = float(floor_power(rig, pitch, scene.floor_reflectivity, settings).max())
    gain = settings.noise * 10.0 ** (settings.snr / 20.0) / np.sqrt(floor)
    still = _standing(rig, pitch, np.sqrt(2.0 * floor), settings, leak_rng)
    antenna = motion.position + attitude.rotate(motion.orientation, rig.antenna)
    boresight = attitude.rotate(motion.orientation, BORESIGHT)
    count = len(motion.time)
    out = np.empty((count, settings.bins), dtype=np.int32)
    for first in range(0, count, _BLOCK):
        block = slice(first, min(first + _BLOCK, count))
        points, amplitudes = _seen(scene, antenna[first], boresight[first], rig, settings)
        analytic = echoes(antenna[block], boresight[block], points, amplitudes, rig.aperture, settings) + still
        if scene.walker is not None:
            people = scene.walker.positions(motion.time[block])
            passing = scene.walker.amplitudes
            analytic += echoes(antenna[block], boresight[block], people, passing, rig.aperture, settings)
        draws = noise_rng.normal(0.0, 1.0, (len(analytic), settings.bins + 1))
        # a shift of a picosecond is nothing to the envelope (0.15 mm), but 0.03 rad to the phase
        late = 2.0 * np.pi * settings.carrier * settings.jitter * draws[:, :1]
        received = gain * (analytic * np.exp(-1j * late)).real + settings.noise * _coloured(draws[:, 1:], settings)
        out[block] = np.rint(received)
        if progress is not None:
            progress(block.stop / count)
    return out


def _coloured(noise: Floats, settings: RadarSettings) -> Floats:
    """White noise (n, bins) with more of its power where the pulse is, and the same in all."""
    if not settings.noise_rise:
        return noise
    spacing = 2.0 * RANGE_STEP / SPEED_OF_LIGHT  # s
    frequency = np.fft.rfftfreq(settings.bins, spacing)
    within = np.abs(frequency - settings.carrier) < 0.5 * settings.bandwidth
    density = np.where(within, 10.0 ** (settings.noise_rise / 10.0), 1.0)
    shaped: Floats = np.fft.irfft(np.fft.rfft(noise) * np.sqrt(density / density.mean()), settings.bins)
    return shaped


def echoes(
    antenna: Floats,
    boresight: Floats,
    points: Floats,
    amplitudes: Complexes,
    aperture: float,
    settings: RadarSettings,
) -> Complexes:
    """Noise-free echoes as analytic signals (n, bins), in 1/m: the real part is what a receiver samples.

    `antenna` (n, 3) m, `boresight` (n, 3) unit vectors, `points` (k, 3) m, or (n, k, 3) where they move,
    `amplitudes` (k,) m, `aperture` the full -3 dB angle of the one-way pattern, rad.
    """
    dx = points[..., 0] - antenna[:, :1]
    dy = points[..., 1] - antenna[:, 1:2]
    dz = points[..., 2] - antenna[:, 2:]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = (dx * boresight[:, :1] + dy * boresight[:, 1:2] + dz * boresight[:, 2:]) / distance
    strength = pattern(np.arccos(np.clip(cosine, -1.0, 1.0)), aperture) / distance**2 * np.abs(amplitudes)
    cells = _cells(settings)
    index = (distance - cells[0]) * (_FINER / RANGE_STEP)
    strength[(index < 0.0) | (index >= len(cells) - 1)] = 0.0
    index = np.clip(index, 0.0, len(cells) - 2)
    lower = index.astype(np.intp)
    flat = (lower + len(cells) * np.arange(len(antenna))[:, None]).ravel()
    index -= lower
    # within one turn single precision is plenty (1e-7 rad), and twenty times as fast
    turns = np.angle(amplitudes) / (2.0 * np.pi) - _wave_number(settings) / (2.0 * np.pi) * distance
    phase = (2.0 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    summed = np.zeros((2, len(antenna), len(cells)))
    for part, wave in zip(summed, (np.cos(phase), np.sin(phase)), strict=True):
        to_lower = wave * strength
        to_upper = to_lower * index
        to_lower -= to_upper
        for shift, share in ((0, to_lower), (1, to_upper)):
            part += np.bincount(flat + shift, share.ravel(), part.size).reshape(part.shape)
    return _pulsed(summed, settings)


def pattern(angle: Floats, aperture: float) -> Floats:
    """Amplitude of a Gaussian two-way pattern at `angle` (rad) off the boresight, 1 on it.

    The one-way power is down by 3 dB at half of `aperture`; two ways of it, as amplitude, are the same number.
    """
    gain: Floats = np.exp(-4.0 * np.log(2.0) * (angle / aperture) ** 2)
    return gain


def floor_power(rig: Rig, pitch: float, reflectivity: float, settings: RadarSettings) -> Floats:
    """Mean power of the floor's echo per real sample in each bin, (bins,), 1/m^2, at rest with `pitch` (rad).

    The integral of reflectivity G^2 / R^4 |p|^2 / 2 over the floor, by a sum over rings and sectors.
    """
    held = attitude.from_angles(np.zeros(1), np.array([pitch]), np.zeros(1))
    boresight = attitude.rotate(held, BORESIGHT)[0]
    height = rig.hand_height + attitude.rotate(held, np.subtract(rig.antenna, rig.pivot))[0, 2]
    cells = _cells(settings)
    spacing = 0.01  # m, rad
    radius = spacing * (np.arange(round(cells[-1] / spacing)) + 0.5)[:, None]
    azimuth = spacing * np.arange(round(2.0 * np.pi / spacing))
    area = radius * spacing * 2.0 * np.pi / len(azimuth)
    distance = np.sqrt(radius**2 + height**2)
    across = boresight[0] * np.cos(azimuth) + boresight[1] * np.sin(azimuth)
    cosine = (radius * across - height * boresight[2]) / distance
    density = pattern(np.arccos(np.clip(cosine, -1.0, 1.0)), rig.aperture) ** 2 / distance**4 * area
    edges = np.append(cells, cells[-1] + RANGE_STEP / _FINER) - 0.5 * RANGE_STEP / _FINER
    per_cell = np.histogram(distance.ravel(), edges, weights=density.sum(axis=1))[0]
    return 0.5 * reflectivity * _spread(per_cell, 2, settings)


def _standing(rig: Rig, pitch: float, floor: float, settings: RadarSettings, rng: Generator) -> Complexes:
    """What stands still in the radar's own frame, (bins,): direct coupling and the tip of the cane, 1/m.

    `floor` is the amplitude of the strongest floor echo.
    """
    cells = _cells(settings)
    # a ring-down of random phase: one tap per 3 cm, nearer than a pulse is long
    ringing = np.zeros(len(cells), dtype=np.complex128)
    every = round(0.03 * _FINER / RANGE_STEP)
    phases = rng.uniform(0.0, 2.0 * np.pi, len(cells[::every]))
    ringing[::every] = np.exp(1j * phases - cells[::every] / settings.coupling_decay)
    coupling = _pulsed(np.stack([ringing.real, ringing.imag]), settings)
    coupling *= floor * 10.0 ** (settings.coupling / 20.0) / np.abs(coupling).max()
    # the cane is as long as it takes for its tip to touch the floor in front of the walker
    reach = rig.hand_height / np.sin(pitch) - float(np.linalg.norm(rig.pivot))
    tip = np.zeros(len(cells), dtype=np.complex128)
    if cells[0] < reach < cells[-1]:
        phase = rng.uniform(0.0, 2.0 * np.pi)
        tip[np.searchsorted(cells, reach)] = np.sqrt(settings.tip_section) / reach**2 * np.exp(1j * phase)
    return coupling + _pulsed(np.stack([tip.real, tip.imag]), settings)


def _seen(
    scene: Scene, antenna: Floats, boresight: Floats, rig: Rig, settings: RadarSettings
) -> tuple[Floats, Complexes]:
    """The scatterers that may be within range and beam during a block that begins here."""
    offset = scene.points - antenna
    distance = np.linalg.norm(offset, axis=1)
    # within a block, 0.16 s, a cane moves less than 0.3 m and turns less than 0.4 rad, even at 1 m/s
    widest = rig.aperture * np.sqrt(-np.log(_FAINT) / (4.0 * np.log(2.0))) + 0.4
    kept = (distance < _cells(settings)[-1] + 0.3) & (offset @ boresight > distance * np.cos(widest))
    return scene.points[kept], scene.amplitudes[kept]


def _pulsed(summed: Floats, settings: RadarSettings) -> Complexes:
    """Analytic signals (..., bins) of what is in each cell, (2, ..., cells): its real and its imaginary part."""
    real, imaginary = _spread(summed, 1, settings)
    carried: Complexes = (real + 1j * imaginary) * np.exp(1j * _wave_number(settings) * settings.ranges())
    return carried


def _spread(per_cell: Floats, exponent: int, settings: RadarSettings) -> Floats:
    """What is in each cell (..., cells) under the envelope of a pulse, to the power `exponent`, (..., bins)."""
    spacing = RANGE_STEP / _FINER
    half = round(4.5 * pulse_length(settings) / spacing)
    offset = spacing * np.arange(-half, half + 1)
    envelope = np.exp(-0.5 * exponent * (offset / pulse_length(settings)) ** 2)
    spread: Floats = convolve1d(per_cell, envelope, axis=-1, mode="constant")
    first = _FINER * _beyond(settings)
    return spread[..., first : first + _FINER * settings.bins : _FINER]


def pulse_length(settings: RadarSettings) -> float:
    """Standard deviation (m of range) of the envelope: its power spectrum is down by 10 dB at +-bandwidth / 2."""
    in_frequency = 0.5 * settings.bandwidth / np.sqrt(np.log(10.0))  # Hz, of the amplitude spectrum
    return float(0.5 * SPEED_OF_LIGHT / (2.0 * np.pi * in_frequency))


def _cells(settings: RadarSettings) -> Floats:
    """Ranges (m) on which echoes are added up: finer than the bins, and a pulse more at each end."""
    beyond = _beyond(settings)
    count = _FINER * (settings.bins + 2 * beyond)
    cells: Floats = settings.range_start + RANGE_STEP * (np.arange(count) / _FINER - beyond)
    return cells


def _beyond(settings: RadarSettings) -> int:
    """Bins by which the cells reach beyond the scan at each end."""
    return round(4.0 * pulse_length(settings) / RANGE_STEP)


def _wave_number(settings: RadarSettings) -> float:
    """Phase per metre of range, there and back, rad/m."""
    return 4.0 * np.pi * settings.carrier / SPEED_OF_LIGHT
