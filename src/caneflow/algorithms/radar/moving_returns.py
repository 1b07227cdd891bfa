"""Radar frames, as they come, into what moves: analytic scans without their background, in even steps of time.

Shared by all estimators of speed, so that none works it out twice. Lost scans leave zeros, the neutral value once
the background is gone; a longer gap, or frames of another make, start again and say so.

A scan counts as lost, and leaves no trace in the background, that is far stronger than the others (estimators.md), that
repeats the one before for the third time (no receiver is without noise: it hangs), or whose frame says that it is of
another make, e.g. has other ranges, while the frames before and after it do not.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.glitches import JumpGate
from caneflow.algorithms.quantities import Factor, Time
from caneflow.algorithms.radar.analytic_signal import AnalyticSignal, require_band
from caneflow.algorithms.radar.background import Background

LARGEST_SAMPLE = 1e12  # the square of its spectrum still fits a float32
POWER_TIME = 0.5  # s of scans that a wild one is compared with
FEWEST_POWERS = 10  # scans
MOST_HELD = 3  # wild scans, or frames of another make, in a row; what lasts longer is believed
MOST_REPEATS = 2  # of one scan, bit by bit
GONE_POWER = 2.5  # taking off the background leaves so many times the power of the scan: what it shows is gone
# s, or 3 scans, in a row; right after a rest the ground that lay still adds its own power once, so up to 2 times
GONE_TIME = 0.03
FEWEST_GONE = 3  # scans
FIRST_POWER = 6.0  # by which factor the powers of the first two scans may differ
FEWEST_FOR_OFFSET = 8  # bins; of fewer, the mean over them is the echoes'
# of a scan, whose power varies little by itself; fewer may jump farther: of one, noise alone passes 6 times its median
# in 2 % of the scans
STEADY_BINS = 64
FORGOTTEN = 1.0  # s without a frame, after which one of another make is believed at once
# Of a scan: the longest of a P440 has 16 384; the filter of the pulse takes the square of their number.
MOST_BINS = 20_000


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
    longest_gap: Annotated[float, Ge(0), Le(2)] = 0.05  # s of scans that may be missing before all starts again
    # of the median power of 0.5 s and of the scan before: more is a wild scan; a cane that sets off gives a factor of 2
    wild_power: Factor = 6.0


class MovingReturns(NamedTuple):
    """What one frame adds."""

    scans: NDArray[np.complex64]  # shape (n, M), oldest first; zeros for scans that were lost
    stamps_ns: tuple[int, ...]  # n stamps, the last is the frame's
    stand_ins: tuple[int, ...]  # those of them that stand for a lost scan
    parameters: RadarParameters
    restarted: bool  # forget all scans before these
    standing: "StandingPicture"  # valid until the next frame


class StandingPicture:
    """What the background looked like after a frame, for those who need it."""

    def __init__(self, background: Background, to_analytic: AnalyticSignal | None) -> None:
        self._background, self._to_analytic = background, to_analytic

    def scan(self) -> NDArray[np.complex64]:
        """The running mean of the scans, shape (M,), without what a receiver adds that is not an echo.

        Of real scans with soft ends of the band, so that none rings; of complex ones less the offset of I and Q,
        which is the same in all bins.
        """
        picture = self._background.picture
        if self._to_analytic is not None:
            return self._to_analytic.softened(picture)
        return picture - picture.mean() if len(picture) >= FEWEST_FOR_OFFSET else picture

    @property
    def noise_share(self) -> float:
        """Which part of the scans' noise power is in it, 0..1."""
        return self._background.noise_share


Make: TypeAlias = tuple[RadarParameters, int, bool]  # range bins; complex


class MovingReturnsFilter:
    """Takes frames one at a time; its state is the background and the last stamp."""

    def __init__(self, settings: MovingReturnsSettings) -> None:
        self._settings = settings
        self._make: Make | None = None
        self._makes: JumpGate[Make] = JumpGate(0.0, _apart, most_held=MOST_HELD, longest_gap=FORGOTTEN)
        self._impossible = 0  # frames in a row of a make that cannot be
        self._to_analytic: AnalyticSignal | None = None  # None: frames are complex already
        self._background = Background(settings.background_time)
        self._known = _Known(1)
        self._last_ns: int | None = None  # None: nothing to continue

    def update(self, stamp_ns: int, scans: NDArray[np.number], parameters: RadarParameters) -> MovingReturns:
        """The moving part of a frame's `scans`, shape (N, M), real or complex; `stamp_ns` is its last scan's.

        Raises:
            ValueError: no scan at all, samples that are not numbers or absurdly large, a stamp that is not newer
                than the frame's before, or a pulse that the range bins cannot hold.
        """
        count, bins = scans.shape
        if count == 0 or bins == 0:
            raise ValueError(f"a frame of {count} scans of {bins} bins holds nothing")
        if bins > MOST_BINS:
            raise ValueError(f"a frame of {bins} bins; at most {MOST_BINS} are taken")
        kind = scans.dtype.kind
        if kind in "fc" and not np.abs(scans).max() <= LARGEST_SAMPLE:
            # One NaN would stay in the running mean forever; a huge value would become one.
            raise ValueError(f"frame at {stamp_ns} ns has samples that are not finite or above {LARGEST_SAMPLE:g}")
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise ValueError(f"frame at {stamp_ns} ns is not newer than the last, {self._last_ns} ns")
        make = (parameters, bins, kind == "c")
        believed = self._believed(stamp_ns, make)
        if believed != self._make:
            self._start_anew(believed)
        parameters, bins, _ = believed
        period_ns = parameters.scan_period * 1e9
        first_ns = stamp_ns - round((count - 1) * period_ns)
        elapsed_ns, lost, restarted = self._since_last(first_ns, period_ns)
        self._last_ns = stamp_ns
        stamps: tuple[int, ...] = (stamp_ns,)
        if count > 1 or lost:
            stand_ins = (first_ns - elapsed_ns * back // (lost + 1) for back in range(lost, 0, -1))
            stamps = (*stand_ins, *(stamp_ns - round(back * period_ns) for back in range(count - 1, -1, -1)))
        if believed == make:
            moving, missing, fresh = self._without_background(scans, elapsed_ns * 1e-9, parameters.scan_period)
        else:
            moving, missing, fresh = np.zeros((count, bins), np.complex64), [True] * count, False
        if lost:
            moving = np.concatenate([np.zeros((lost, bins), np.complex64), moving])
        return MovingReturns(
            scans=moving,
            stamps_ns=stamps,
            stand_ins=_missing(stamps, lost, missing),
            parameters=parameters,
            restarted=restarted or fresh,
            standing=StandingPicture(self._background, self._to_analytic),
        )

    def _believed(self, stamp_ns: int, make: Make) -> Make:
        """`make`, or that of the frames before; raises ValueError, and takes note of nothing, for an impossible one."""
        parameters, bins, is_complex = make
        try:
            if make != self._make and not is_complex:
                require_band(bins, parameters.range_step, parameters.carrier, parameters.bandwidth)
        except ValueError:
            if self._make is None or self._impossible >= MOST_HELD:
                raise
            self._impossible += 1
            return self._make
        self._impossible = 0
        return self._makes.update(stamp_ns, make)

    def _start_anew(self, make: Make) -> None:
        parameters, bins, is_complex = make
        to_analytic = None
        if not is_complex:
            to_analytic = AnalyticSignal(
                bins=bins,
                range_step=parameters.range_step,
                carrier=parameters.carrier,
                bandwidth=parameters.bandwidth,
            )
        self._to_analytic = to_analytic  # only now: it raises ValueError for a pulse that the bins cannot hold
        self._background = Background(self._settings.background_time)
        self._known = _Known(
            max(round(POWER_TIME / parameters.scan_period), FEWEST_POWERS),
            jump=math.sqrt(max(STEADY_BINS / bins, 1.0)),
            gone_scans=max(round(GONE_TIME / parameters.scan_period), FEWEST_GONE),
        )
        self._last_ns = None
        self._make = make

    def _since_last(self, first_ns: int, period_ns: float) -> tuple[int, int, bool]:
        """Time since the last scan (ns), how many are missing in between, whether to forget what was before."""
        if self._last_ns is None:
            return round(period_ns), 0, True
        elapsed_ns = max(first_ns - self._last_ns, 0)  # a frame's first stamp is worked out and may err a little
        lost = max(round(elapsed_ns / period_ns) - 1, 0)
        if lost > round(self._settings.longest_gap * 1e9 / period_ns):
            return elapsed_ns, 0, True
        return elapsed_ns, lost, False

    def _without_background(
        self, scans: NDArray[np.number], elapsed: float, scan_period: float
    ) -> tuple[NDArray[np.complex64], list[bool], bool]:
        """What moves, zeros for what counts as lost, which scans those are, and whether to forget all before."""
        analytic = self._to_analytic(scans) if self._to_analytic else scans.astype(np.complex64)
        missing, fresh, known = self._known.repeated(scans), False, self._known
        for index, scan in enumerate(analytic):
            if not missing[index] and known.contradicts(scan):
                self._background = Background(self._settings.background_time)
                analytic[:index] = 0.0
                missing[:index] = [True] * index
                fresh = True
            whole = _power(scan)
            power = self._background.take_off(scan, elapsed)
            elapsed = scan_period
            if missing[index] or known.is_wild(power, self._settings.wild_power):
                scan[:] = 0.0
                missing[index] = True
                continue
            self._background.learn(scan)
            if known.is_gone(whole, power):  # the antenna is covered, say: the scene before would look like rest
                self._background = Background(self._settings.background_time)
                analytic[: index + 1] = 0.0
                missing[: index + 1] = [True] * (index + 1)
                fresh = True
        return analytic, missing, fresh


class _Known:
    """What is known of the scans so far, to tell what cannot be one of them."""

    def __init__(self, count: int, *, jump: float = 1.0, gone_scans: int = 3) -> None:
        """`count`: how many powers are remembered; `jump`: how much more than usual they may differ."""
        self._jump, self._gone_scans = jump, gone_scans
        self._powers: deque[float] = deque(maxlen=count)
        self._held = 0  # wild scans in a row
        self._first: float | None = None  # power of the first scan, background and all, until a second one agrees
        self._begun = False
        self._last: NDArray[np.number] | None = None  # the last scan, as it came
        self._repeats = 0  # of it
        self._added = 0  # scans in a row to which the background adds power

    def repeated(self, scans: NDArray[np.number]) -> list[bool]:
        """Which of `scans`, shape (N, M), say the same as the one before for more than the second time."""
        found = []
        for scan in scans:
            last, middle = self._last, len(scan) // 2
            # one bin tells nearly always, at a tenth of what it costs to look at all
            same = last is not None and bool(scan[middle] == last[middle]) and bool((scan == last).all())
            self._repeats = self._repeats + 1 if same else 0
            self._last = scan
            found.append(self._repeats > MOST_REPEATS)
        return found

    def contradicts(self, scan: NDArray[np.complex64]) -> bool:
        """Whether `scan` is the second one and so unlike the first in power that one of the two is wild.

        The first may be: then it must not stay in the background. If it is the second, the third will say so.
        """
        if self._begun and self._first is None:
            return False
        power, first = _power(scan), self._first
        apart = first is not None and max(power, first) > self._jump * FIRST_POWER * min(power, first)
        self._first = power if apart or not self._begun else None
        self._begun = True
        if apart:
            self._powers.clear()
        return apart

    def is_gone(self, whole: float, left: float) -> bool:
        """Whether the background has added power to several scans: `whole` before it was taken off, `left` after."""
        self._added = self._added + 1 if left > GONE_POWER * whole else 0
        if self._added < self._gone_scans:
            return False
        self._added = 0
        self._powers.clear()
        return True

    def is_wild(self, power: float, factor: float) -> bool:
        """Whether a scan has so much more `power`, less the background, than the others; takes note of it if not."""
        powers, factor = self._powers, self._jump * factor
        if len(powers) >= FEWEST_POWERS and power > factor * powers[-1] and self._held < MOST_HELD:
            middle = len(powers) // 2
            if power > factor * float(np.partition(powers, middle)[middle]):
                self._held += 1
                return True
        self._held = 0
        powers.append(power)
        return False


def _missing(stamps: tuple[int, ...], lost: int, missing: list[bool]) -> tuple[int, ...]:
    """The stamps of `lost` scans before a frame, and of those of the frame that are `missing`."""
    if True not in missing:
        return stamps[:lost]
    return tuple(stamp for stamp, gone in zip(stamps, [True] * lost + missing, strict=True) if gone)


def _power(scan: NDArray[np.complex64]) -> float:
    parts = scan.view(np.float32)
    return float(np.add.reduce(parts * parts))


def _apart(one: Make, other: Make) -> float:
    return float(one != other)
