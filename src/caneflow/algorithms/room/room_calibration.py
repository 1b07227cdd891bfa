"""The range calibration k of a Doppler module, from a walk along its axis (room.md row 6).

k = median of P R^4 over the valid hops between 3 and 10 m, P the squared amplitude. R is known, or it is integrated
from where the walk starts; a module with one mixer does not tell the direction, so that its sign is changed wherever
the person has all but stopped.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from caneflow.algorithms.radar.doppler_line import DopplerLineSettings, predominant_line
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum
from caneflow.algorithms.room.room_tracking import StaticSensor

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CalibrationSettings:
    """Which hops count."""

    nearest: Annotated[float, Gt(0)] = 3.0  # m
    farthest: Annotated[float, Gt(0)] = 10.0  # m
    off_axis: Annotated[float, Gt(0)] = math.radians(15.0)  # rad, to either side of the boresight
    least_rate: Annotated[float, Ge(0)] = 0.35  # m/s along the beam: who crosses it shows another side
    least_hops: Annotated[int, Gt(0)] = 50
    turning_share: Annotated[float, Gt(0)] = 0.35  # of the usual speed, below which the person turns
    turning_time: Annotated[float, Gt(0)] = 1.0  # s, least time between two turns


@dataclass(frozen=True, kw_only=True)
class RangeCalibration:
    """What a walk along the axis says."""

    k: float  # m^4
    spread: float  # dB, half of what lies between the 16th and 84th percentile of P R^4
    exponent: float  # n of P = k / R^n that would fit best; 4 in the free field
    hops: int  # how many there were


@dataclass(frozen=True, kw_only=True, eq=False)
class Hops:
    """What one sensor's front end saw of one walk, by hop."""

    stamps: NDArray[np.int64]  # shape (H,), ns, of what the value belongs to
    range_rates: Floats  # shape (H,), m/s
    amplitudes: Floats  # shape (H,), full scale = 1
    valid: NDArray[np.bool_]  # shape (H,)
    signed: bool


def hops_over(spectra: Sequence[tuple[int, DopplerSpectrum]], floor: Floats) -> Hops:
    """The predominant lines of at least one spectrum, each with its time (ns), over the empty room's floor (B,)."""
    lines = [predominant_line(replace(each, floor=floor), DopplerLineSettings()) for _, each in spectra]
    return Hops(
        stamps=np.array([stamp for stamp, _ in spectra], dtype=np.int64),
        range_rates=np.array([line.range_rate for line in lines]),
        amplitudes=np.array([line.amplitude for line in lines]),
        valid=np.array([line.valid for line in lines], dtype=np.bool_),
        signed=spectra[0][1].signed,
    )


def counting(hops: Hops, off: Floats, settings: CalibrationSettings) -> NDArray[np.bool_]:
    """Which hops tell of k, shape (H,): valid ones along the beam, `off` rad from the sensor's axis."""
    rates = np.abs(hops.range_rates)
    return np.asarray(hops.valid & (np.abs(off) <= settings.off_axis) & (rates >= settings.least_rate))


def range_calibration(amplitudes: Floats, ranges: Floats, settings: CalibrationSettings) -> RangeCalibration | None:
    """The k of amplitudes (full scale = 1) and ranges (m) of valid hops, both shape (H,); None: too few."""
    counts = (ranges >= settings.nearest) & (ranges <= settings.farthest) & (amplitudes > 0.0)
    hops = int(counts.sum())
    if hops < settings.least_hops:
        return None
    power, distance = 20.0 * np.log10(amplitudes[counts]), 10.0 * np.log10(ranges[counts])
    strength = power + 4.0 * distance
    low, middle, high = np.percentile(strength, (16.0, 50.0, 84.0))
    exponent = -float(np.polyfit(distance, power, 1)[0]) if np.ptp(distance) > 1.0 else math.nan
    return RangeCalibration(
        k=float(10.0 ** (middle / 10.0)), spread=0.5 * float(high - low), exponent=exponent, hops=hops
    )


def sight(sensor: StaticSensor, positions: Floats) -> tuple[Floats, Floats]:
    """Distance (m) and angle off the boresight (rad) of positions, shape (H, 2); each of shape (H,)."""
    x, y = positions[:, 0] - sensor.position[0], positions[:, 1] - sensor.position[1]
    off = np.arctan2(y, x) - sensor.azimuth
    return np.hypot(x, y), (off + np.pi) % (2.0 * np.pi) - np.pi


def integrated_ranges(
    seconds: Floats,
    range_rates: Floats,
    valid: NDArray[np.bool_],
    start: float,
    settings: CalibrationSettings,
    *,
    signed: bool,
) -> Floats:
    """Distance over time, shape (H,), m, of a walk that starts `start` m away.

    Args:
        seconds: shape (H,), s, increasing.
        range_rates: shape (H,), m/s; where not `valid` the person is taken to stand.
        valid: shape (H,).
        start: m.
        settings: when the person counts as turning.
        signed: false for magnitudes: away and towards alternate from stop to stop, and the first direction is the
            one that keeps the person in front of the sensor, between the nearest and the farthest.
    """
    rates = np.where(valid, range_rates, 0.0)
    if signed:
        return start + _integral(seconds, rates)
    alternating = rates * _alternating_signs(seconds, rates, settings)
    away, towards = start + _integral(seconds, alternating), start - _integral(seconds, alternating)
    return min(away, towards, key=lambda ranges: _outside(ranges, settings))


def _integral(seconds: Floats, rates: Floats) -> Floats:
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(seconds)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _alternating_signs(seconds: Floats, rates: Floats, settings: CalibrationSettings) -> Floats:
    """+1 up to the first stop, -1 up to the second, and so on; shape (H,)."""
    speeds = np.abs(rates)
    walking = speeds[speeds > 0.0]
    threshold = settings.turning_share * float(np.median(walking)) if len(walking) else math.inf
    signs, sign, turned, was_walking = np.ones(len(speeds)), 1.0, -math.inf, False
    smooth = np.convolve(speeds, np.ones(7) / 7.0, mode="same")  # a gap of one hop is not a stop
    for index, (at, speed) in enumerate(zip(seconds, smooth, strict=True)):
        if speed >= threshold:
            was_walking = True
        elif was_walking and at - turned > settings.turning_time:
            sign, turned, was_walking = -sign, float(at), False
        signs[index] = sign
    return signs


def _outside(ranges: Floats, settings: CalibrationSettings) -> float:
    """How far, in sum, a walk leaves what can be."""
    return float(
        np.maximum(0.3 * settings.nearest - ranges, 0.0).sum() + np.maximum(ranges - 1.3 * settings.farthest, 0.0).sum()
    )
