"""What one sensor alone shows, as numbers to draw: a radar's ranges and speeds, a Doppler module's spectrum, an IMU.

Times are in s since `origin`, the stamp (ns) of a picture's left edge.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.gated_attitude import GatedAttitude
from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.doppler_line import DopplerLine, DopplerLineSettings, LineFollower
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum, DopplerSpectrumSettings, SlidingSpectrum
from caneflow.algorithms.radar.range_doppler import hann, range_doppler_map, speed_limit
from caneflow.messages import DopplerBlock, Imu, RadarFrame
from caneflow.physics import SPEED_OF_LIGHT

Floats: TypeAlias = NDArray[np.float64]

SLOW_TIME = 64  # scans of one spectrum: 0.64 s of a cane
LEAST_SCANS = 8  # of which a spectrum is still made, where there are no more
SPECTRUM = 256  # lines of one spectrum
MOST_COLUMNS = 800  # spectra side by side: more than there are pixels
MOST_RANGES = 400
LEAST_POWER = 1e-12

FASTEST = 8.0  # m/s that a Doppler module's picture shows: a runner
SPECTRUM_LOWEST = 2.0  # Hz of the picture's band: the noise below a walker is to be seen


@dataclass(frozen=True, kw_only=True)
class RadarPictures:
    """Power (dB) of all that moves: over time and range, time and radial speed, range and radial speed.

    What stands still in a window of SLOW_TIME scans is taken off.
    """

    times: Floats  # (n,) s, the middle of each window
    ranges: Floats  # (r,) m
    speeds: Floats  # (m,) m/s, approaching positive
    range_time: Floats  # (r, n)
    speed_time: Floats  # (m, n)
    range_speed: Floats  # (m, r), mean over all windows


@dataclass(frozen=True, kw_only=True)
class DopplerPicture:
    """A Doppler module's spectrum over time, and the line in it."""

    times: Floats  # (n,) s, the middle of each window
    speeds: Floats  # (m,) m/s, away positive, as a target's range rate; magnitudes unless `signed`
    power: Floats  # (m, n), dB over the median
    signed: bool
    line: Floats  # (n,) m/s, NaN where there is none
    source: str  # of the line


@dataclass(frozen=True, kw_only=True)
class ImuPicture:
    """An IMU's readings, and its attitude."""

    times: Floats  # (n,) s
    gyro: Floats  # (n, 3) rad/s
    accel: Floats | None  # (n, 3) m/s^2, NaN where missing; None: never there
    attitude: Floats | None  # (n, 3) roll, pitch, yaw in degrees, NaN where not known
    source: str  # of the attitude


def radar_pictures(frames: Iterable[RadarFrame], *, scans: int, origin: int) -> RadarPictures | None:
    """The pictures of a radar's frames, `scans` scans together; None for too few, or ones that no spectrum is made of.

    A frame of SLOW_TIME / 4 scans or more is a burst, and a window of its own.
    """
    length = min(SLOW_TIME, scans)
    if length < LEAST_SCANS:
        return None
    window: deque[NDArray[Any]] = deque(maxlen=length)
    times, by_range, by_speed = list[float](), list[Floats](), list[Floats]()
    whole: Floats | None = None
    last: RadarFrame | None = None
    every, since = max(length // 8, scans // MOST_COLUMNS), 0
    for frame in frames:
        burst = len(frame.scans) >= SLOW_TIME // 4
        if burst or (last is not None and not _alike(frame, last)):
            window.clear()
        if last is not None and not _alike(frame, last):
            times, by_range, by_speed, whole = [], [], [], None  # the newest make is drawn
        window.extend(frame.scans)
        last, since = frame, since + len(frame.scans)
        if since < every or not (burst or len(window) == length):
            continue
        since = 0
        power = _range_speed_power(np.array(window), frame)
        if power is None:
            return None
        times.append((frame.stamp - origin) * 1e-9 - 0.5 * len(window) * frame.scan_period)
        by_range.append(power.sum(axis=1))
        by_speed.append(power.sum(axis=0))
        whole = power if whole is None else whole + power
    if last is None or whole is None:
        return None
    limit = speed_limit(scan_period=last.scan_period, carrier=last.carrier)
    group = -(-len(whole) // MOST_RANGES)
    return RadarPictures(
        times=np.array(times),
        ranges=np.asarray(last.range_start + last.range_step * (np.arange(0, len(whole), group) + 0.5 * (group - 1))),
        speeds=np.linspace(-limit, limit, SPECTRUM, endpoint=False),
        range_time=_decibels(_grouped(np.stack(by_range, axis=1), group)),
        speed_time=_decibels(np.stack(by_speed, axis=1)),
        range_speed=_decibels(_grouped(whole / len(times), group).T),
    )


def doppler_picture(blocks: Sequence[DopplerBlock], *, origin: int) -> DopplerPicture | None:
    """The spectrum of a Doppler module's blocks, and the line that its operator finds with default settings."""
    if not blocks:
        return None
    first = blocks[0]
    highest = min(0.49 * first.sample_rate, 2.0 * FASTEST * first.carrier / SPEED_OF_LIGHT)
    columns = _spectra(blocks, DopplerSpectrumSettings(lowest=SPECTRUM_LOWEST, highest=highest))
    if not columns:
        return None
    stamps, spectra = zip(*columns, strict=True)
    delay = 0.5 * DopplerSpectrumSettings().window
    times = (np.array(stamps) - origin) * 1e-9 - delay
    power = _decibels(np.stack([spectrum.power for spectrum in spectra], axis=1))
    speeds = -spectra[-1].frequencies * SPEED_OF_LIGHT / (2.0 * spectra[-1].carrier)
    signed = spectra[-1].signed
    if not signed:
        speeds = -speeds
    shown = np.abs(speeds) <= FASTEST  # a spectrum reaches beyond its band
    every = max(1, len(times) // MOST_COLUMNS)
    found = np.array([(stamp, line.range_rate) for stamp, line in _lines(blocks) if line.valid]).reshape(-1, 2)
    at = {int(stamp): rate for stamp, rate in found}
    line = np.array([at.get(int(stamp), np.nan) for stamp in stamps])
    return DopplerPicture(
        times=times[::every],
        speeds=speeds[shown],
        power=(power - np.median(power))[shown, ::every],
        signed=signed,
        line=line[::every],
        source="line of operators.doppler",
    )


def imu_picture(samples: Sequence[Imu], *, origin: int) -> ImuPicture | None:
    """The readings of an IMU; its attitude is the chip's own, or that of the attitude filter where there is none."""
    if len(samples) < 2:
        return None
    orientations, source = _orientations(samples)
    accel = np.array([(np.nan,) * 3 if sample.accel is None else sample.accel for sample in samples])
    return ImuPicture(
        times=np.array([sample.stamp - origin for sample in samples]) * 1e-9,
        gyro=np.array([sample.gyro for sample in samples]),
        accel=accel if np.isfinite(accel).any() else None,
        attitude=None if orientations is None else euler_angles(orientations),
        source=source,
    )


def euler_angles(orientations: Floats) -> Floats:
    """Roll, pitch and yaw (n, 3) in degrees of orientations (n, 4), w x y z, body to world: about z, then y, then x.

    The angles go on through 180 degrees.
    """
    w, x, y, z = orientations.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = np.stack([roll, pitch, yaw], axis=1)
    known = np.isfinite(angles).all(axis=1)
    angles[known] = np.unwrap(angles[known], axis=0)
    degrees: Floats = np.degrees(angles)
    return degrees


def _orientations(samples: Sequence[Imu]) -> tuple[Floats | None, str]:
    unknown = (np.nan,) * 4
    if any(sample.orientation is not None for sample in samples):
        given = [sample.orientation or unknown for sample in samples]
        return np.array(given), "as recorded"
    attitude = GatedAttitude(AttitudeFilter(AttitudeFilterSettings()), GlitchSettings(), "plot")
    found = []
    for sample in samples:
        try:
            estimate, _ = attitude.update(sample.stamp, sample.gyro, sample.accel, sample.mag)
            found.append(estimate.orientation)
        except ValueError:  # before the first accelerometer reading
            found.append(unknown)
    source = "attitude filter" if any(sample.mag is not None for sample in samples) else "attitude filter, yaw from 0"
    orientations = np.array(found)
    return (orientations, source) if np.isfinite(orientations).any() else (None, source)


def _lines(blocks: Sequence[DopplerBlock]) -> Iterable[tuple[int, DopplerLine]]:
    follower = LineFollower(DopplerLineSettings())
    for stamp, spectrum in _spectra(blocks, DopplerSpectrumSettings()):
        yield stamp, follower.update(spectrum)


def _spectra(blocks: Iterable[DopplerBlock], settings: DopplerSpectrumSettings) -> list[tuple[int, DopplerSpectrum]]:
    sliding = SlidingSpectrum(settings)
    found = list[tuple[int, DopplerSpectrum]]()
    for block in blocks:
        try:
            spectrum = sliding.update(block.stamp, block.samples, block.sample_rate, block.carrier)
        except ValueError:  # a block that the operator refuses as well
            continue
        if spectrum is not None:
            if found and len(found[-1][1].frequencies) != len(spectrum.frequencies):
                found.clear()  # the newest make is drawn
            found.append((block.stamp, spectrum))
    return found


def _alike(frame: RadarFrame, other: RadarFrame) -> bool:
    return frame.scans.shape[1] == other.scans.shape[1] and frame.range_step == other.range_step


def _range_speed_power(scans: NDArray[Any], frame: RadarFrame) -> Floats | None:
    """Power (bins, SPECTRUM) of scans (n, bins), the lowest speed first; None for a pulse that they cannot hold."""
    if not np.iscomplexobj(scans):
        try:
            signal = AnalyticSignal(
                bins=scans.shape[1], range_step=frame.range_step, carrier=frame.carrier, bandwidth=frame.bandwidth
            )
        except ValueError:
            return None
        scans = signal(scans)
    moving = (scans - scans.mean(axis=0)).T.astype(np.complex64)
    power = np.abs(range_doppler_map(moving, hann(len(scans)), SPECTRUM)) ** 2
    shifted: Floats = np.fft.fftshift(power, axes=1).astype(np.float64)
    return shifted


def _grouped(power: Floats, group: int) -> Floats:
    """The sums (r / group, n) of `group` neighbouring rows."""
    summed: Floats = np.add.reduceat(power, np.arange(0, len(power), group), axis=0)
    return summed


def _decibels(power: Floats) -> Floats:
    return 10.0 * np.log10(power + LEAST_POWER)
