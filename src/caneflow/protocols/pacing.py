"""When to read a chip so that each of its values is read once. No clock: the time is told.

The chip does not say when it has new values, nor counts them, and its rate is not quite the host's. So it is read a
little more often than it has new values, each time a little earlier after they came. When they had not yet come, it
is read again at once, and the next readings are moved a bit behind: thus they stay within MARGIN of the change.
"""

import math
from enum import Enum, auto

FASTER = 1.01  # readings for each value
MARGIN = 0.002  # s behind the change of the values, to which a reading that came too early moves the others
AGAIN_AFTER = 0.001  # s
QUICKEST = 0.2  # intervals that MARGIN takes at most; AGAIN_AFTER half of them
FROZEN_AFTER = 1.0  # s of the very same values: noise alone changes some of the numbers every time
GAP = 5.0  # intervals


class Verdict(Enum):
    """What a reading is."""

    NEW = auto()
    REPEATED = auto()  # the values were read before: it is not a sample
    FROZEN = auto()  # the values have not changed for long: the chip's fusion stands still


class Pacing:
    """The times of the readings, s on a clock that does not jump."""

    def __init__(self, rate: float, start: float, *, chip_rate: float, faster: float = FASTER) -> None:
        """`rate` Hz; below the chip's own, `chip_rate`, the readings simply keep it, and leave values out.

        `faster`: readings for each value; a chip that is faster than it says by less loses none.
        """
        self.missed = 0  # readings that were not made because the one before took too long
        self.repeated = 0
        self._chip_rate = chip_rate
        self._margin = min(MARGIN, QUICKEST / chip_rate)
        self._again_after = min(AGAIN_AFTER, 0.5 * QUICKEST / chip_rate)
        self._step = 1.0 / (rate * faster if rate >= chip_rate else rate)
        self._values = b""
        self._changed = start
        self.restart(start)

    def restart(self, now: float) -> None:
        """Begin at `now`; which values were the last to be read is not forgotten."""
        self.due = now  # when to read next
        self._planned = now  # when the reading under way would have been, were nothing ever late
        self._again = False

    def took(self, values: bytes, now: float) -> Verdict:
        """Take note of what the reading gave; plans the next one."""
        again, self._again = self._again, False
        if values != self._values:
            self._values, self._changed = values, now
            self._go_on(now, later=self._margin if again else 0.0)
            return Verdict.NEW
        if self._step < 1.0 / self._chip_rate and not again:
            self.repeated += 1
            self._again = True
            self.due = now + self._again_after
            return Verdict.REPEATED
        # Twice the same: new values have come by now, so they are equal.
        self._go_on(now)
        return Verdict.FROZEN if now - self._changed > FROZEN_AFTER else Verdict.NEW

    def failed(self, now: float) -> None:
        """Take note that the reading gave nothing of use."""
        self._again = False
        self._go_on(now)

    def _go_on(self, now: float, later: float = 0.0) -> None:
        self._planned += self._step + later
        behind = int((now - self._planned) / self._step)
        if behind > 0:
            self.missed += behind
            self._planned += behind * self._step
        self.due = self._planned


class Spacing:
    """How evenly the samples of a stream lie in time."""

    def __init__(self, period: float) -> None:
        """`period` s; more than GAP times as much between two samples is a gap, not jitter."""
        self._limit_ns = round(GAP * period * 1e9)
        self._last: int | None = None
        self.clear()

    def clear(self) -> None:
        """Begin again, with the interval from the last sample to the next."""
        self.count = 0  # intervals
        self.gaps = 0
        self.longest = 0.0  # s, gaps aside
        self.mean = 0.0  # s
        self._squares = 0.0  # s^2, of the deviations from the mean

    def take(self, stamp: int) -> None:
        """Note a sample's stamp, ns."""
        last, self._last = self._last, stamp
        if last is None:
            return
        if stamp - last > self._limit_ns:
            self.gaps += 1
            return
        interval = (stamp - last) * 1e-9
        self.count += 1
        self.longest = max(self.longest, interval)
        deviation = interval - self.mean  # Welford's running sums
        self.mean += deviation / self.count
        self._squares += deviation * (interval - self.mean)

    @property
    def jitter(self) -> float:
        """Standard deviation of the intervals, s; 0 when there are fewer than two."""
        return math.sqrt(self._squares / self.count) if self.count else 0.0
