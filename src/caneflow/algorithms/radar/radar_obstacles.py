"""What stands up from the floor in front of a radar that moves: echoes whose Doppler the floor cannot have.

A floor at range R below an antenna at height h, which moves at v, has radial speeds of at most
v sqrt(1 - (h / R)^2), the floor's edge. What stands as high as the antenna comes at up to v, and what comes by itself
even faster. So energy above the edge is not from the floor. Neither a side nor a height can be told.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Factor, Length
from caneflow.algorithms.radar.moving_returns import MovingReturns, RadarParameters
from caneflow.algorithms.radar.range_doppler import (
    SlowTimeWindow,
    hann,
    range_doppler_map,
    range_of_bin,
    speed_of_bin,
    speed_per_bin,
)
from caneflow.physics import SPEED_OF_LIGHT

MOST_TARGETS = 16
FEWEST_CELLS = 64  # free of floor and of targets, of which a noise level says something
MEDIAN_OF_MEAN = math.log(2.0)  # of power that is exponentially distributed, as noise is
# dB below the strongest cell of the same range: floor that passes through a range cell within the window is smeared
# over Doppler, and leaves that much above its edge
SMEARED = 10.0


@dataclass(frozen=True, kw_only=True)
class RadarObstaclesSettings:
    """The window over slow time, and what counts as a target."""

    window: Annotated[int, Ge(8), Le(1024)] = 64  # scans
    every: Annotated[int, Ge(1), Le(1000)] = 10  # scans between two looks
    margin: Factor = 2.0  # Doppler cells above the floor's edge: half the main lobe of a Hann window
    threshold: Factor = 15.0  # dB over the noise
    separation: Length = 0.3  # m between targets
    nearest: Length = 0.5  # m; nearer is the antenna's own coupling
    farthest: Length = 3.0  # m; beyond, the edge is too near to the speed itself to tell them apart


class Targets(NamedTuple):
    """K targets, the nearest first."""

    ranges: NDArray[np.float32]  # (K,) m
    range_rates: NDArray[np.float32]  # (K,) m/s, positive away
    snr: NDArray[np.float32]  # (K,) dB
    above_floor: NDArray[np.uint8]  # (K,) 1 where the Doppler is above the floor's edge; 0: it goes away


class RadarObstacles:
    """Takes what moves, scan by scan; looks at it now and then."""

    def __init__(self, settings: RadarObstaclesSettings) -> None:
        self._settings = settings
        self._weights = hann(settings.window)
        self._window: SlowTimeWindow | None = None
        self._parameters: RadarParameters | None = None
        self._filled = 0  # scans in the window
        self._since = 0  # scans since the last look

    def take(self, returns: MovingReturns) -> bool:
        """Add the scans of a frame; whether it is time to look."""
        bins = returns.scans.shape[1]
        if self._window is None or returns.restarted or returns.parameters != self._parameters:
            self._window = SlowTimeWindow(length=self._settings.window, bins=bins)
            self._parameters, self._filled = returns.parameters, 0
        for scan in returns.scans:
            self._window.push(scan)
        self._filled += len(returns.scans)
        self._since += len(returns.scans)
        return self._since >= self._settings.every and self._filled >= self._settings.window

    def look(self, *, height: float, speed: float) -> Targets:
        """Targets in the window, seen from an antenna above the floor.

        `height` is the lowest in the window, m; `speed` the fastest, m/s: with both the edge is nowhere higher.
        """
        assert self._window is not None and self._parameters is not None
        self._since = 0
        settings, parameters = self._settings, self._parameters
        scans = self._window.view()
        ranges = range_of_bin(np.arange(len(scans)), start=parameters.range_start, step=parameters.range_step)
        chosen = np.flatnonzero((ranges >= settings.nearest) & (ranges <= settings.farthest))
        ranges = ranges[chosen]
        spectra = range_doppler_map(scans[chosen], self._weights, settings.window)
        power = np.square(np.abs(spectra)).astype(np.float64)
        scale = {"scan_period": parameters.scan_period, "carrier": parameters.carrier}
        cell = speed_per_bin(**scale, transform=settings.window)
        speeds = speed_of_bin(np.arange(settings.window), **scale, transform=settings.window)
        reached = ranges + SPEED_OF_LIGHT / (2.0 * parameters.bandwidth)  # a pulse reaches that much farther
        edge = speed * np.sqrt(np.maximum(1.0 - (height / reached) ** 2, 0.0))
        # Each frequency of a wide band has a Doppler of its own; half way to the band's end a line has fallen off.
        edge *= 1.0 + parameters.bandwidth / (4.0 * parameters.carrier)
        above = speeds > edge[:, None] + settings.margin * cell
        away = np.broadcast_to(speeds < -settings.margin * cell, above.shape)
        return self._strongest(ranges, speeds, power, above, away)

    def _strongest(
        self,
        ranges: NDArray[np.float64],
        speeds: NDArray[np.float64],
        power: NDArray[np.float64],
        above: NDArray[np.bool_],
        away: NDArray[np.bool_],
    ) -> Targets:
        """The strongest cell of each range where there is no floor, then of those the peaks over range."""
        settings, free = self._settings, above | away
        if np.count_nonzero(free) < FEWEST_CELLS:
            return _NO_TARGETS
        noise = float(np.median(power[free])) / MEDIAN_OF_MEAN
        if noise <= 0.0:
            return _NO_TARGETS
        only_free = np.where(free, power, 0.0)
        best = only_free.argmax(axis=1)
        strength = only_free[np.arange(len(best)), best]
        strength[strength < power.max(axis=1) * 10 ** (-SMEARED / 10.0)] = 0.0
        least = noise * 10 ** (settings.threshold / 10.0)
        found: list[int] = []
        for row in np.argsort(-strength, kind="stable").tolist():
            if strength[row] < least or len(found) == MOST_TARGETS:
                break
            if all(abs(ranges[row] - ranges[other]) >= settings.separation for other in found):
                found.append(row)
        rows = np.array(sorted(found), np.intp)
        return Targets(
            ranges=ranges[rows].astype(np.float32),
            range_rates=(-speeds[best[rows]]).astype(np.float32),
            snr=(10.0 * np.log10(strength[rows] / noise)).astype(np.float32),
            above_floor=above[rows, best[rows]].astype(np.uint8),
        )


_EMPTY = np.zeros(0, np.float32)
_NO_TARGETS = Targets(_EMPTY, _EMPTY, _EMPTY, np.zeros(0, np.uint8))
