"""Host time of a device's own clock: a running line from its readings to the times at which they arrived.

A reading shows whole ticks, wraps, and arrives late by a delay that is never negative and now and then large. So the
line lies under the arrivals and touches them where the delay was least: the lower convex hull's edge at the points'
mean time, which is the line under all of them with the least sum of distances (Moon, Skelly & Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). What is finer than a tick
comes from counting: scans follow each other by one period, exactly, on the device's own clock.
"""

from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray

REGULAR = 1.5  # ticks by which the difference of two readings may miss the period: each is cut to whole ticks
COUNTED = 512  # differences from which the period is told
FIRST_COUNTED = 32  # differences after which a period that nobody gave is told for the first time
RECOUNTED = 64  # readings between two looks at the period
LONGEST_GAP = 10  # periods: how many scans a longer gap lacks is a guess, so it says nothing of the period
FEWEST_BUCKETS = 3  # from which the drift is told; until then it is 0
SINGLE = 0.1  # quantile of the differences that is one period: nine in ten may lack a scan


@dataclass(frozen=True, kw_only=True)
class ClockFitSettings:
    """What the device's clock is like, and how far the fit looks back."""

    tick: Annotated[float, Gt(0)] = 1e6  # ns of a step of the device's clock
    wraps_at: Annotated[int, Gt(1)] = 1 << 32  # ticks; 49.7 days of ms
    window: Annotated[float, Gt(0)] = 60e9  # ns that the line looks back
    bucket: Annotated[float, Gt(0)] = 1e9  # ns of which only the earliest arrival counts
    most_drift: Annotated[float, Gt(0)] = 5e-4  # of the device's clock against the host's, which may be slewed
    jump: Annotated[float, Gt(0)] = 50e6  # ns: a reading earlier than the line by more shows that a clock was set
    period_change: Annotated[float, Gt(0)] = 2e-3  # part of the period; less is not a reason to tell another one


class ClockFit:
    """Tells for each reading of a device's clock when, on the host's clock, it was taken.

    The least delay between device and host cannot be seen from the host: stamps are late by it, all alike.

    period: ticks between scans, None as long as it is not known. It stays the same until it is wrong by more than
        `period_change`, so that what depends on it need not begin again.
    missed: scans that are missing between the readings since the fit was made.
    restarts: how often a clock was found to have been set.
    """

    def __init__(self, settings: ClockFitSettings | None = None, *, period: float | None = None) -> None:
        """`period`: ticks between scans as the device was told to keep it, None if it was not."""
        self._settings = settings or ClockFitSettings()
        self._count = PeriodCount(period, self._settings.period_change)
        self._line = LineBelow(self._settings)
        self._reading: int | None = None  # the last one; None: the next begins again
        self._ticks = 0  # unwrapped, of that reading
        self._fine = 0.0  # the same, with its fraction
        self._stamp = -(1 << 63)  # ns, the last that was told
        self.restarts = 0

    @property
    def period(self) -> float | None:
        """Ticks between scans."""
        return self._count.period

    @property
    def missed(self) -> int:
        """Scans that the count of periods lacks since the fit was made."""
        return self._count.missed

    def restart(self) -> None:
        """Forget the device's clock, as after its reboot; stamps go on increasing."""
        self._line = LineBelow(self._settings)
        self._reading = None

    def update(self, reading: int, arrival: int) -> int:
        """The stamp (ns, host) of the scan with clock `reading` (ticks, wrapping) that came at `arrival` (ns, host).

        Readings come in order. Stamps strictly increase; unless that forbids it, none is later than its arrival.
        """
        step = 0 if self._reading is None else self._difference(reading, self._reading)
        if step < 0:
            self.restarts += 1
            self.restart()
        if self._reading is None:
            self._ticks, self._fine = reading, float(reading)
        else:
            self._advance(step)
        self._reading = reading
        self._stamp = max(self._stamp + 1, min(round(self._host_time(arrival)), arrival))
        return self._stamp

    def _advance(self, step: int) -> None:
        self._ticks += step
        expected = self._fine + self._count.add(step)
        if abs(expected - self._ticks) > REGULAR:  # the device lost its rhythm
            expected = self._ticks
        # The reading is the time, cut to whole ticks: an expectation outside of the tick is wrong by the excess.
        self._fine = min(max(expected, self._ticks), self._ticks + 1 - 1e-6)

    def _host_time(self, arrival: int) -> float:
        device = self._fine * self._settings.tick
        expected = self._line.at(device)
        if expected is not None and arrival < expected - self._settings.jump:
            self.restarts += 1
            self._line = LineBelow(self._settings)
        self._line.add(device, arrival)
        at = self._line.at(device)
        assert at is not None
        return at

    def _difference(self, later: int, earlier: int) -> int:
        span = self._settings.wraps_at
        return (later - earlier + span // 2) % span - span // 2


class PeriodCount:
    """The period of scans whose clock shows whole ticks and of which some are missing."""

    def __init__(self, period: float | None, change: float) -> None:
        self.period = period  # ticks
        self.missed = 0
        self._change = change
        self._steps: deque[int] = deque(maxlen=COUNTED)
        self._next_look = FIRST_COUNTED

    def add(self, step: int) -> float:
        """Take the difference of two readings, whole ticks; the same with its fraction, as far as it is known."""
        count = max(round(step / self.period), 1) if self.period else 1
        whole_periods = count * self.period if self.period else float(step)
        self.missed += count - 1
        self._steps.append(step)
        self._next_look -= 1
        if self._next_look == 0:
            self._next_look = RECOUNTED
            self._look()
        return whole_periods

    def _look(self) -> None:
        steps = np.array(self._steps)
        single = steps[np.abs(steps - np.quantile(steps, SINGLE, method="lower")) <= REGULAR].mean()
        if not single:  # a clock that stands still
            return
        short = steps[steps < LONGEST_GAP * single]
        counts = np.maximum(np.rint(short / single), 1)
        period = float(short.sum() / counts.sum())
        resolution = 2 / counts.sum()  # ticks: the first and the last reading are cut to whole ones
        before = self.period
        if before is None or abs(period - before) > max(resolution, self._change * before):
            self.period = period
            self.missed += _missing(steps, period) - (_missing(steps, before) if before else 0)


def _missing(steps: NDArray[np.integer], period: float) -> int:
    return int((np.maximum(np.rint(steps / period), 1) - 1).sum())


class LineBelow:
    """host = device + offset + drift * device, under all recent arrivals; one point a bucket bounds the work."""

    def __init__(self, settings: ClockFitSettings) -> None:
        self._settings = settings
        self._origin: tuple[float, int] | None = None  # device, host: what is fitted is small beside them
        self._points: deque[tuple[float, float]] = deque()  # device time, delay; ns
        self._drift = 0.0
        self._offset = 0.0  # ns

    def at(self, device: float) -> float | None:
        """Host time (ns) of the device's `device` (ns); None before the first point."""
        if self._origin is None:
            return None
        x = device - self._origin[0]
        return self._origin[1] + x + self._offset + self._drift * x

    def add(self, device: float, host: int) -> None:
        """Take a point: what the device's clock showed (ns), and when the host heard of it (ns)."""
        if self._origin is None:
            self._origin = (device, host)
        x = device - self._origin[0]
        delay = (host - self._origin[1]) - x
        bucket = self._settings.bucket
        if self._points and self._points[-1][0] // bucket == x // bucket:
            last_x, last_delay = self._points[-1]
            if delay - self._drift * x >= last_delay - self._drift * last_x:
                return
            self._points.pop()
        self._points.append((x, delay))
        while x - self._points[0][0] > self._settings.window:
            self._points.popleft()
        self._fit()

    def _fit(self) -> None:
        finished = list(self._points)[:-1]  # the last bucket may have late arrivals only, as yet
        most = self._settings.most_drift
        drift = _drift_below(finished) if len(finished) >= FEWEST_BUCKETS else 0.0
        self._drift = min(max(drift, -most), most)
        self._offset = min(delay - self._drift * x for x, delay in self._points)


def _drift_below(points: list[tuple[float, float]]) -> float:
    """The slope of the line under `points`, by increasing x, with the least sum of distances from them."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) >= _slope(hull[-1], point):
            hull.pop()
        hull.append(point)
    mean = sum(x for x, _ in points) / len(points)
    right = next(i for i, point in enumerate(hull) if point[0] > mean)
    return _slope(hull[right - 1], hull[right])


def _slope(a: tuple[float, float], b: tuple[float, float]) -> float:
    return (b[1] - a[1]) / (b[0] - a[0])
