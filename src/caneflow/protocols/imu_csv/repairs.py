"""Times of readings made strictly increasing: counters that wrap or begin again, outliers, late rows, equal stamps.

Nothing is repaired without a line that says so.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.errors import ProtocolError

Stamps: TypeAlias = NDArray[np.int64]

NEAR = 10  # steps: what lies so near to the row before goes on from it, or is a row that comes late
BURST = 3  # rows: of so many that lie off together each is an outlier; of more, the clock has changed
GAP = 5  # steps without a reading
GAP_TOLD = 1_000_000  # ns: shorter ones are jitter
FAR = 10_000_000_000  # ns: a first or last reading that lies so far off, and NEAR steps, is an outlier
WHOLE = 500_000_000  # ns: times so far apart, with several readings each, cannot tell those apart

OUTLIER = "whose time is an outlier"
WRAPPED = "wraps of the counter, followed"
RESET = "times that the clock wrapped, went back or was reset; it goes on one reading later"
LATE = "rows later than their time, put in order"
SPREAD = "readings with the stamp of the one before, spread evenly"
TWICE = "rows written twice, taken once"


class IndistinctTimesError(ProtocolError):
    """Times that many readings share: no repair can tell when each was taken."""


@dataclass
class Repairs:
    """What was done to the times of a table: how often, and at which row first (both by what it was)."""

    counts: dict[str, int] = field(default_factory=dict)
    first: dict[str, int] = field(default_factory=dict)

    def note(self, what: str, row: int, count: int = 1) -> None:
        """Count a repair at a row."""
        self.counts[what] = self.counts.get(what, 0) + count
        self.first.setdefault(what, row)


def followed(times: Sequence[int], wraps: Sequence[int], repairs: Repairs) -> list[int | None]:
    """Times (ns) of one clock that goes on, None for outliers; a row that only comes late keeps its time.

    `wraps`: ns after which such a counter begins again.
    """
    clock = _Clock(times, wraps, repairs)
    for row in range(len(times)):
        clock.take(row)
    clock.end()
    return clock.stamps


class _Clock:
    """A clock that is followed from row to row."""

    def __init__(self, times: Sequence[int], wraps: Sequence[int], repairs: Repairs) -> None:
        self.stamps: list[int | None] = [None] * len(times)
        self._times, self._wraps, self._repairs = times, wraps, repairs
        self._step, self._near = _usual_steps(times)
        self._offset = 0  # what has been lost by wraps and resets so far
        self._skip_to = 0  # rows before this one are known to lie off
        self._recent: deque[int] = deque(maxlen=BURST + 2)  # rows on the clock, newest last

    def take(self, row: int) -> None:
        """Put a row on the clock, or leave it, or rows before it, out."""
        if row < self._skip_to:
            return
        here = self._at(row)
        if not self._recent or here >= self._stamp(-1):
            self._require_sound_start(row)
            self._accept(row)
        elif off := self._rows_off_from(row):
            if self._stamp(-1) - here > self._near:
                self._skip_to = row + off
                self._repairs.note(OUTLIER, row, off)
            else:
                self.stamps[row] = here  # late; the clock stays where it is
        elif off := self._newest_rows_off(row):
            self._leave_out(off)
            self._accept(row)
        else:
            self._go_on(row)

    def end(self) -> None:
        """Leave out the last row if it lies far off: nothing after it says whether the clock has changed."""
        if len(self._recent) > 1 and self._stamp(-1) - self._stamp(-2) > max(FAR, self._near):
            self._leave_out(1)

    def _at(self, row: int) -> int:
        return self._times[row] + self._offset

    def _stamp(self, place: int) -> int:
        stamp = self.stamps[self._recent[place]]
        assert stamp is not None  # on the clock
        return stamp

    def _accept(self, row: int) -> None:
        self.stamps[row] = self._at(row)
        self._recent.append(row)

    def _leave_out(self, count: int) -> None:
        for _ in range(count):
            row = self._recent.pop()
            self.stamps[row] = None
            self._repairs.note(OUTLIER, row)

    def _require_sound_start(self, row: int) -> None:
        """Leave the very first row out if the second is far from it, and the third goes on from the second."""
        here, following = self._at(row), row + 1
        goes_on = following == len(self._times) or self._at(following) >= here
        if self._is_at_start() and goes_on and here - self._stamp(-1) > max(FAR, self._near):
            self._leave_out(1)

    def _is_at_start(self) -> bool:
        return len(self._recent) == 1 and self._recent[0] == 0

    def _rows_off_from(self, row: int) -> int:
        """How many rows from this one on lie off, or come late: what follows them goes on from what was before."""
        last = self._stamp(-1)
        for count in range(1, BURST + 1):
            if row + count == len(self._times):
                fell = last - self._at(row) > self._near
                alone = count == 1 and fell and not self._period(row) and not self._newest_rows_off(row)
                return 1 if alone else 0
            following = self._at(row + count)
            if last <= following <= last + (count + 1) * self._near:
                at_once = count == 1 and following > last + self._step // 2
                return count if at_once or not self._begins_anew(row) else 0
        return 0

    def _begins_anew(self, row: int) -> bool:
        """Whether a clock that has only begun falls to its very beginning, or before: no row comes that late."""
        here = self._at(row)
        return self._recent[0] == 0 and here <= self._stamp(0) and self._stamp(-1) - here <= self._near

    def _newest_rows_off(self, row: int) -> int:
        """How many rows before this one lie off, because it goes on from the row before those; 0: none do."""
        here = self._at(row)
        for count in range(1, len(self._recent)):
            before = self._stamp(-count - 1)
            if before <= here <= before + (count + 1) * self._near and not self._begins_anew(row):
                return count
        fell = self._stamp(-1) - here
        return 1 if self._is_at_start() and fell > max(FAR, self._near) and not self._period(row) else 0

    def _go_on(self, row: int) -> None:
        """Follow a clock that fell: by the period of a wrap, or by so much that it is one step later."""
        period = self._period(row)
        self._repairs.note(WRAPPED if period else RESET, row)
        self._offset += period or self._stamp(-1) - self._at(row) + self._step
        self._accept(row)

    def _period(self, row: int) -> int:
        """The period after which the counter has begun again at a row; 0 for none."""
        fall = self._stamp(-1) - self._at(row)
        for period in self._wraps:
            if 0 < period - fall <= min(2 * self._near, period // 4):
                return period
        return 0


def _usual_steps(times: Sequence[int]) -> tuple[int, int]:
    """The usual time (ns) between readings, equal stamps counted, and how far the next may be and still go on."""
    difference = np.diff(np.array(times, dtype=np.int64))
    positive = difference[difference > 0]
    if not len(positive):
        return 1, NEAR
    share = len(positive) / (len(positive) + int((difference == 0).sum()))
    step = max(round(float(np.median(positive)) * share), 1)
    return step, max(NEAR * step, 3 * int(np.percentile(positive, 95)))


def spread(stamps: Stamps, repairs: Repairs, rows: NDArray[np.int64]) -> Stamps:
    """Sorted stamps (n,) ns with those that are equal spread evenly until the next, and strictly increasing.

    Raises IndistinctTimesError where they are too far apart for that. `rows`: numbers of the rows, for `repairs`.
    """
    distinct, starts, counts = np.unique(stamps, return_index=True, return_counts=True)
    if len(distinct) == len(stamps):
        return stamps
    shared = int(counts[counts > 1].sum())
    apart = int(np.median(np.diff(distinct))) if len(distinct) > 1 else WHOLE
    if 2 * shared > len(stamps) > 2 and apart >= WHOLE:
        times = "1 time" if len(distinct) == 1 else f"{len(distinct)} times"
        raise IndistinctTimesError(
            f"{len(stamps)} readings share {times}: their resolution is too coarse to tell the readings apart; "
            "leave time out of --columns and use --rate HZ if they are evenly spaced"
        )
    usual = apart / float(np.median(counts))
    room = np.append(np.diff(distinct), apart).astype(np.float64)
    share = np.minimum(room / counts, np.maximum(usual, 1.0))  # before a gap they keep their usual spacing
    share = np.where(share * counts > room, room / counts, share)
    index = np.arange(len(stamps)) - np.repeat(starts, counts)
    apart_by = np.repeat(share, counts) * index
    repairs.note(SPREAD, int(rows[int(np.flatnonzero(index > 0)[0])]), len(stamps) - len(distinct))
    return _increasing(stamps + apart_by.astype(np.int64))


def gaps(stamps: Stamps, rows: NDArray[np.int64]) -> Iterator[str]:
    """A line for the gaps between stamps, if there are any: how many, the longest and where."""
    if len(stamps) < 3:
        return
    difference = np.diff(stamps)
    step = int(np.median(difference))
    wide = np.flatnonzero((difference > GAP * step) & (difference > GAP_TOLD))
    if len(wide):
        worst = int(wide[np.argmax(difference[wide])])
        plural = "a gap" if len(wide) == 1 else f"{len(wide)} gaps"
        yield (
            f"{plural} of more than {GAP} readings; the longest of {difference[worst] * 1e-9:.3g} s "
            f"after line {rows[worst]}"
        )


def _increasing(stamps: Stamps) -> Stamps:
    """The stamps, each at least 1 ns after the one before."""
    index = np.arange(len(stamps))
    lifted: Stamps = np.maximum.accumulate(stamps - index) + index
    return lifted
