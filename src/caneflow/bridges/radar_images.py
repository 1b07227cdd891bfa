"""Radar frames as pictures for other programs: the range-Doppler map of what moves, in grey."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.radar.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.radar.range_doppler import SlowTimeWindow, hann, range_doppler_map, speed_limit
from caneflow.messages import RadarFrame

SCANS = 64  # in one map: 0.64 s at 100 Hz
PERIOD = 100_000_000  # ns between two pictures: a map changes little within it
SPAN = 40.0  # dB from black to white
FADE = 0.9  # how much of the greatest power seen is left after each picture


class MapImage(NamedTuple):
    """One range-Doppler map: rows are radial speeds, the fastest approach on top; columns are ranges, near first."""

    stamp: int  # ns, of the newest scan in it
    grey: NDArray[np.uint8]  # shape (SCANS, M); 255 is the greatest power of late, 0 is SPAN dB below it
    fastest: float  # m/s at the upper edge; the lower edge is as fast the other way
    nearest: float  # m, of the first column
    range_step: float  # m between columns


class RadarImages:
    """The frames of one stream into one picture per PERIOD.

    Frames wait until a picture is due, and are filtered together: at 100 Hz that costs a third of one at a time.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._returns = MovingReturnsFilter(MovingReturnsSettings())
        self._weights = hann(SCANS)
        self._window: SlowTimeWindow | None = None
        self._filled = 0  # scans in the window
        self._waiting: list[RadarFrame] = []
        self._count = 0  # scans that wait
        self._next_ns = 0
        self._last_ns = -1  # of the newest frame
        self._greatest = 0.0

    def take(self, frame: RadarFrame) -> MapImage | None:
        """The picture up to `frame`, if one is due; raises ValueError for frames of which none can be made.

        When time goes back, as in a viewer that jumps, the pictures begin again.
        """
        if frame.stamp <= self._last_ns:
            self._begin()
        self._last_ns = frame.stamp
        if self._waiting and not _follows(self._waiting[-1], frame):
            self._filter()
        self._waiting.append(frame)
        self._count += len(frame.scans)
        is_due = frame.stamp >= self._next_ns and self._filled + self._count >= SCANS
        if not is_due and self._count < SCANS:
            return None
        self._filter()
        if self._window is None or self._filled < SCANS or frame.stamp < self._next_ns:
            return None
        self._next_ns = frame.stamp + PERIOD
        fastest = speed_limit(scan_period=frame.scan_period, carrier=frame.carrier)
        return MapImage(frame.stamp, self._grey(self._window), fastest, frame.range_start, frame.range_step)

    def _filter(self) -> None:
        """Bring what waits into the window, without what stands still."""
        frames, self._waiting, self._count = self._waiting, [], 0
        newest = frames[-1]
        scans = newest.scans if len(frames) == 1 else np.concatenate([each.scans for each in frames])
        returns = self._returns.update(newest.stamp, scans, _parameters(newest))
        if returns.restarted or self._window is None:
            self._window, self._filled = SlowTimeWindow(length=SCANS, bins=scans.shape[1]), 0
        for scan in returns.scans[-SCANS:]:
            self._window.push(scan)
        self._filled += len(returns.scans)

    def _grey(self, window: SlowTimeWindow) -> NDArray[np.uint8]:
        spectrum = range_doppler_map(window.view(), self._weights, SCANS).astype(np.complex64)
        power = spectrum.real**2 + spectrum.imag**2
        self._greatest = max(FADE * self._greatest, float(power.max()), float(np.finfo(np.float32).tiny))
        below = 10 * np.log10(np.maximum(power / np.float32(self._greatest), np.float32(10 ** (-SPAN / 10))))  # dB
        grey = np.rint(255 * (1 + below / SPAN)).astype(np.uint8)
        return np.ascontiguousarray(np.fft.fftshift(grey, axes=1).T[::-1])


def _parameters(frame: RadarFrame) -> RadarParameters:
    return RadarParameters(
        scan_period=frame.scan_period,
        range_start=frame.range_start,
        range_step=frame.range_step,
        carrier=frame.carrier,
        bandwidth=frame.bandwidth,
    )


def _follows(before: RadarFrame, frame: RadarFrame) -> bool:
    """Whether two frames can be taken for one: of one make, and no scan is missing between them."""
    same = before.scans.shape[1] == frame.scans.shape[1] and before.scans.dtype == frame.scans.dtype
    elapsed = (frame.stamp - before.stamp) * 1e-9 / frame.scan_period  # scans
    return same and abs(elapsed - len(frame.scans)) < 0.5 and _parameters(before) == _parameters(frame)
