"""How far another machine's clock is from this one's, from round trips: NTP's four stamps, least delay, and drift.

t1 this clock when the question left, t2 theirs when it came, t3 theirs when the answer left, t4 this clock when it came
back. Then theta = ((t2 - t1) + (t3 - t4)) / 2 is their clock less this one, wrong by at most half of the delay
delta = (t4 - t1) - (t3 - t2), whatever the two ways took (RFC 5905, section 8). Of several exchanges the one with the
least delay is the best (its clock filter, section 10); a line through the best of successive spans gives the drift.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt


@dataclass(frozen=True, kw_only=True)
class ClockOffsetSettings:
    """How much of the past counts."""

    span: Annotated[float, Gt(0)] = 8.0  # s in which the exchange with the least delay is taken
    spans: Annotated[int, Ge(3)] = 12  # that the line goes through
    drift_limit: Annotated[float, Gt(0)] = 5e-4  # s/s; two crystals are never further apart, so more is noise
    steps: Annotated[int, Ge(1)] = 3  # exchanges in a row that contradict the line before it is taken to be broken


@dataclass(frozen=True, kw_only=True)
class ClockEstimate:
    """Their clock less this one."""

    offset: float  # s, at the time `at`
    drift: float  # s/s, positive when theirs is faster
    uncertainty: float  # s: no further is the offset from the truth, at the time `at`
    delay: float  # s, the least of late
    at: int  # ns, this clock

    def offset_at(self, now: int) -> float:
        """Their clock less this one (s) at `now` (ns, this clock)."""
        return self.offset + self.drift * (now - self.at) / 1e9

    def uncertainty_at(self, now: int, settings: ClockOffsetSettings) -> float:
        """How far (s) `offset_at` may be from the truth at `now` (ns, this clock)."""
        return self.uncertainty + 2 * settings.drift_limit * max(0.0, (now - self.at) / 1e9)


@dataclass(frozen=True)
class _Exchange:
    at: int  # ns, this clock: the middle of the round trip
    offset: float  # s
    delay: float  # s


class ClockOffset:
    """The offset and drift of one other clock."""

    def __init__(self, settings: ClockOffsetSettings) -> None:
        self._settings = settings
        self._best: deque[_Exchange] = deque(maxlen=settings.spans)  # of each span the one with the least delay
        self._span_end = 0  # ns, this clock
        self._against: list[_Exchange] = []  # the last ones, while they contradict the line
        self.estimate: ClockEstimate | None = None
        self.stepped = 0  # how often either clock has jumped

    def update(self, sent: int, came_there: int, left_there: int, came_back: int) -> ClockEstimate:
        """The estimate after one more exchange, of four stamps t1..t4 (ns).

        Raises ValueError for stamps that no round trip can have.
        """
        delay = (came_back - sent) - (left_there - came_there)
        if delay < 0 or left_there < came_there or came_back < sent:
            raise ValueError(f"no round trip: it took {came_back - sent} ns here, {left_there - came_there} ns there")
        offset = ((came_there - sent) + (left_there - came_back)) / 2e9
        exchange = _Exchange(sent + (came_back - sent) // 2, offset, delay / 1e9)
        if self._contradicts(exchange):
            self._against.append(exchange)
            if len(self._against) < self._settings.steps:
                assert self.estimate is not None
                return self.estimate
            self._begin_anew()
        else:
            self._against.clear()
            self._take(exchange)
        self.estimate = self._fitted()
        return self.estimate

    def _contradicts(self, exchange: _Exchange) -> bool:
        """Whether no clock that was where the line says can have answered so."""
        line = self.estimate
        if line is None:
            return False
        if exchange.at < line.at - self._settings.span * 1e9:
            return True  # this clock has jumped back
        allowed = line.uncertainty_at(exchange.at, self._settings) + exchange.delay / 2
        return abs(exchange.offset - line.offset_at(exchange.at)) > allowed

    def _begin_anew(self) -> None:
        self.stepped += 1
        self._best.clear()
        self._span_end = 0
        for exchange in self._against:
            self._take(exchange)
        self._against.clear()

    def _take(self, exchange: _Exchange) -> None:
        if exchange.at >= self._span_end or not self._best:
            self._best.append(exchange)
            self._span_end = exchange.at + round(self._settings.span * 1e9)
        elif exchange.delay <= self._best[-1].delay:
            self._best[-1] = exchange

    def _fitted(self) -> ClockEstimate:
        """A line through the best exchanges, those with less delay counting more."""
        last = self._best[-1].at
        times = np.array([(each.at - last) / 1e9 for each in self._best])  # shape (n,), s, up to 0
        offsets = np.array([each.offset for each in self._best])
        bounds = np.array([each.delay / 2 for each in self._best]) + 1e-6  # s, what each may be wrong by
        weights = bounds**-2
        mean_time, mean_offset = np.average(times, weights=weights), np.average(offsets, weights=weights)
        spread = float(np.sum(weights * (times - mean_time) ** 2))
        drift = 0.0
        if len(times) >= 3 and spread > 0:
            drift = float(np.sum(weights * (times - mean_time) * (offsets - mean_offset)) / spread)
            drift = math.copysign(min(abs(drift), self._settings.drift_limit), drift)
        # Whatever the drift, within its limit: each exchange leaves the offset so much room, and all of them hold.
        room = bounds - self._settings.drift_limit * times
        low, high = float(np.max(offsets - room)), float(np.min(offsets + room))
        at_last = min(max(float(mean_offset - drift * mean_time), low), high)
        uncertainty = max(high - at_last, at_last - low)
        return ClockEstimate(
            offset=at_last,
            drift=drift,
            uncertainty=uncertainty,
            delay=min(each.delay for each in self._best),
            at=last,
        )
