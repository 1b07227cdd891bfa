"""The range-Doppler map that the page draws, and the superior edge in it, of the newest radar scans.

For the eye, beside the flow: a part of the ranges, the same edge detector as the front end's (cane.md row 6).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.edges import EDGE_BEYOND_SPEED, superior_edges
from caneflow.algorithms.radar.range_doppler import hann, range_doppler_map, speed_limit, speed_per_bin
from caneflow.algorithms.radar.rest import peaks_and_floor
from caneflow.messages import RadarFrame

SCANS = 64  # of slow time, one spectrum
TRANSFORM = 256  # Doppler bins
DRAWN_COLUMNS = 128  # of them, by the greater of two neighbours
RANGE_SPACING = 0.035  # m between drawn ranges: less than half a cell of the pulse
MOST_RANGES = 128
TOP_DB = 40.0  # above the noise floor: the brightest that is told apart
LEAST_PEAK = 10.0  # noise floors that a range's spectrum must reach for an edge to be drawn
ALIAS_SHARE = 0.9  # of the speed limit, up to which an edge is drawn


@dataclass(frozen=True, kw_only=True)
class RadarPicture:
    """Power over range (rows, near first) and radial speed (columns, receding to approaching)."""

    stamp: int  # ns, of the newest scan
    levels: NDArray[np.uint8]  # (R, DRAWN_COLUMNS): 0 the noise floor, 255 TOP_DB above it
    range_start: float  # m, of row 0
    range_step: float  # m between rows
    speed_limit: float  # m/s: columns run from -limit to +limit
    edges: NDArray[np.float32]  # (R,) m/s, the superior edge of each range, NaN where there is none
    strongest: tuple[float, float, float]  # range in m, radial speed in m/s, dB above the noise floor


class RadarWindow:
    """The newest scans of one radar, as they come; bounded, whatever a frame holds."""

    def __init__(self) -> None:
        self._scans: list[NDArray[Any]] = []
        self._last: RadarFrame | None = None

    def take(self, frame: RadarFrame) -> None:
        """Add a frame's scans; one of another make begins again."""
        if self._last is not None and (
            frame.scans.shape[1] != self._last.scans.shape[1] or frame.range_step != self._last.range_step
        ):
            self._scans.clear()
        self._last = frame
        self._scans.extend(frame.scans)
        del self._scans[:-SCANS]

    def copy(self) -> "RadarWindow":
        """The same scans, which do not change when this one takes more."""
        window = RadarWindow()
        window._scans, window._last = list(self._scans), self._last
        return window

    def picture(self) -> RadarPicture | None:
        """The map of the newest SCANS scans; None while there are fewer, or for a pulse that they cannot hold."""
        frame = self._last
        if frame is None or len(self._scans) < SCANS:
            return None
        try:
            return radar_picture(np.array(self._scans), frame)
        except ValueError:
            return None


def radar_picture(scans: NDArray[Any], frame: RadarFrame) -> RadarPicture:
    """The map of `scans`, shape (SCANS, bins), oldest first; `frame` says what they are.

    Raises:
        ValueError: the pulse's band lies outside of what the scans can hold.
    """
    power, step = _power(scans, frame)
    summed = power.copy()  # a range with its neighbours, as the front end has it: one alone is speckle
    summed[:-1] += power[1:]
    summed[1:] += power[:-1]
    cell = TRANSFORM / SCANS
    floor = peaks_and_floor(power.sum(axis=0), cell)[2] / len(power) + 1e-30
    limit = speed_limit(scan_period=frame.scan_period, carrier=frame.carrier)
    drawn = np.fft.fftshift(power, axes=1).reshape(len(power), DRAWN_COLUMNS, -1).max(axis=2) / floor
    decibels = 10.0 * np.log10(np.maximum(drawn, 1e-12))
    row, column = np.unravel_index(int(decibels.argmax()), decibels.shape)
    spacing = step * frame.range_step
    return RadarPicture(
        stamp=frame.stamp,
        levels=np.clip(decibels * (255.0 / TOP_DB), 0, 255).astype(np.uint8),
        range_start=frame.range_start,
        range_step=spacing,
        speed_limit=limit,
        edges=_edges(summed, 3.0 * floor, frame),
        strongest=(
            frame.range_start + float(row) * spacing,
            (float(column) + 0.5) / DRAWN_COLUMNS * 2 * limit - limit,
            float(decibels[row, column]),
        ),
    )


def _power(scans: NDArray[Any], frame: RadarFrame) -> tuple[NDArray[np.float32], int]:
    """Doppler power of every so many bins, shape (R, TRANSFORM) in FFT order, and how many bins they are apart."""
    bins = scans.shape[1]
    if not np.iscomplexobj(scans):
        scans = AnalyticSignal(
            bins=bins, range_step=frame.range_step, carrier=frame.carrier, bandwidth=frame.bandwidth
        )(scans)
    step = max(1, int(RANGE_SPACING / frame.range_step), -(-bins // MOST_RANGES))
    moving = scans[:, ::step] - scans[:, ::step].mean(axis=0)
    spectra = range_doppler_map(moving.T.astype(np.complex64), hann(len(scans)), TRANSFORM)
    power: NDArray[np.float32] = spectra.real**2 + spectra.imag**2
    return power, step


def _edges(power: NDArray[np.float32], floor: float, frame: RadarFrame) -> NDArray[np.float32]:
    """The superior edge (m/s) of each row of `power`, NaN where nothing stands out of the noise."""
    half = TRANSFORM // 2
    approaching = power[:, : half + 1]
    edges = np.array(superior_edges(np.sqrt(approaching))[0])
    shown = (approaching.max(axis=1) > LEAST_PEAK * floor) & (edges <= ALIAS_SHARE * half)
    beyond = EDGE_BEYOND_SPEED * TRANSFORM / SCANS
    per_bin = speed_per_bin(scan_period=frame.scan_period, carrier=frame.carrier, transform=TRANSFORM)
    return np.where(shown, np.maximum(edges - beyond, 0.0) * per_bin, np.nan).astype(np.float32)
