"""Radar frames, as they come, into what moves: analytic scans without their background, in even steps of time.

Shared by all estimators of speed, so that none works it out twice. Lost scans leave zeros, the neutral value once
the background is gone; a longer gap, or a frame of another make, starts anew and says so.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.analytic_signal import AnalyticSignal
from caneflow.algorithms.background import Background
from caneflow.algorithms.quantities import Time

LARGEST_SAMPLE = 1e12  # the square of its spectrum still fits a float32


@dataclass(frozen=True, kw_only=True)
class RadarParameters:
    """What a frame says of its scans."""

    scan_period: float  # s between scans
    range_start: float  # m, range of bin 0
    range_step: float  # m between bins
    carrier: float  # Hz
    bandwidth: float  # Hz


@dataclass(frozen=True, kw_only=True)
class MovingReturnsSettings:
    """How the standing picture is removed and how gaps are met."""

    background_time: Time = 0.5  # s, time constant of the running mean (cane.md row 3)
    longest_gap: Annotated[int, Ge(0), Le(1000)] = 5  # scans that may be missing in a row before all starts anew


class MovingReturns(NamedTuple):
    """What one frame adds."""

    scans: NDArray[np.complex64]  # shape (n, M), oldest first; zeros for scans that were lost before the frame
    stamps_ns: tuple[int, ...]  # n stamps, the last is the frame's
    lost: int  # how many of the n are stand-ins
    parameters: RadarParameters
    restarted: bool  # forget all scans before these


class MovingReturnsFilter:
    """Takes frames one at a time; its state is the background and the last stamp."""

    def __init__(self, settings: MovingReturnsSettings) -> None:
        self._settings = settings
        self._make: tuple[object, ...] = ()  # what may not change between frames
        self._to_analytic: AnalyticSignal | None = None  # None: frames are complex already
        self._background = Background(settings.background_time)
        self._last_ns: int | None = None  # None: nothing to continue

    def update(self, stamp_ns: int, scans: NDArray[np.number], parameters: RadarParameters) -> MovingReturns:
        """The moving part of a frame's `scans`, shape (N, M), real or complex; `stamp_ns` is its last scan's.

        Raises:
            ValueError: no scan at all, samples that are no numbers or absurdly large, a stamp that is not newer
                than the frame's before, or a pulse that the range bins cannot hold.
        """
        count, bins = scans.shape
        if count == 0 or bins == 0:
            raise ValueError(f"a frame of {count} scans of {bins} bins holds nothing")
        kind = scans.dtype.kind
        if kind in "fc" and not np.abs(scans).max() <= LARGEST_SAMPLE:
            # One NaN would stay in the running mean for ever; a huge value would become one.
            raise ValueError(f"frame at {stamp_ns} ns has samples that are not finite or above {LARGEST_SAMPLE:g}")
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise ValueError(f"frame at {stamp_ns} ns is not newer than the last, {self._last_ns} ns")
        make = (parameters, bins, kind == "c")
        if make != self._make:
            self._start_anew(make, parameters, bins, is_complex=kind == "c")
        period_ns = parameters.scan_period * 1e9
        first_ns = stamp_ns - round((count - 1) * period_ns)
        elapsed_ns, lost, restarted = self._since_last(first_ns, period_ns)
        self._last_ns = stamp_ns
        stamps: tuple[int, ...] = (stamp_ns,)
        if count > 1 or lost:
            stand_ins = (first_ns - elapsed_ns * back // (lost + 1) for back in range(lost, 0, -1))
            stamps = (*stand_ins, *(stamp_ns - round(back * period_ns) for back in range(count - 1, -1, -1)))
        return MovingReturns(
            scans=self._without_background(scans, lost, elapsed_ns * 1e-9, parameters.scan_period),
            stamps_ns=stamps,
            lost=lost,
            parameters=parameters,
            restarted=restarted,
        )

    def _start_anew(
        self, make: tuple[object, ...], parameters: RadarParameters, bins: int, *, is_complex: bool
    ) -> None:
        self._to_analytic = None
        if not is_complex:
            self._to_analytic = AnalyticSignal(
                bins=bins,
                range_step=parameters.range_step,
                carrier=parameters.carrier,
                bandwidth=parameters.bandwidth,
            )
        self._background = Background(self._settings.background_time)
        self._last_ns = None
        self._make = make

    def _since_last(self, first_ns: int, period_ns: float) -> tuple[int, int, bool]:
        """Time since the last scan (ns), how many are missing in between, whether to forget what was before."""
        if self._last_ns is None:
            return round(period_ns), 0, True
        elapsed_ns = max(first_ns - self._last_ns, 0)  # a frame's first stamp is worked out and may err a little
        lost = max(round(elapsed_ns / period_ns) - 1, 0)
        if lost > self._settings.longest_gap:
            return elapsed_ns, 0, True
        return elapsed_ns, lost, False

    def _without_background(
        self, scans: NDArray[np.number], lost: int, elapsed: float, scan_period: float
    ) -> NDArray[np.complex64]:
        analytic = self._to_analytic(scans) if self._to_analytic else scans.astype(np.complex64)
        for scan in analytic:
            self._background.remove(scan, elapsed)
            elapsed = scan_period
        if not lost:
            return analytic
        return np.concatenate([np.zeros((lost, analytic.shape[1]), dtype=np.complex64), analytic])
