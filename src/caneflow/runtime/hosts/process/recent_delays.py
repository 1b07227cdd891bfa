"""How long the last samples of one input took: from put to take, and from measurement to take."""

import math
from collections import deque
from collections.abc import Sequence

from caneflow.messages.control import Delays

KEPT = 1000  # samples: 10 s of the cane's IMU


class RecentDelays:
    """The delays of one input stream."""

    def __init__(self, *, live: bool) -> None:
        """`live`: stamps are of this time, so that a sample has an age."""
        self._live = live
        self._latencies: deque[int] = deque(maxlen=KEPT)  # ns
        self._ages: deque[int] = deque(maxlen=KEPT)  # ns
        self._last: int | None = None  # ns

    def note(self, now: int, sent_at: int, stamp: int) -> None:
        """Note a sample of `stamp` that was put at `sent_at` (0: not known) and is taken `now`, all in ns."""
        self._last = now
        if sent_at:
            self._latencies.append(now - sent_at)
        if self._live:
            self._ages.append(now - stamp)

    def spread(self, now: int, handled: float | None = None) -> Delays:
        """Medians and 99th percentiles, in s, and the silence up to `now` (ns); `handled`: its last age (s)."""
        latencies, ages = sorted(self._latencies), sorted(self._ages)
        return Delays(
            latency_p50=percentile(latencies, 0.5),
            latency_p99=percentile(latencies, 0.99),
            age_p50=percentile(ages, 0.5),
            age_p99=percentile(ages, 0.99),
            handled=handled if self._live else None,
            silent=None if self._last is None else (now - self._last) / 1e9,
        )


def percentile(delays: Sequence[int], part: float) -> float | None:
    """The smallest of `delays` (ns, sorted) that at least `part` of them do not exceed, in s; None of none."""
    if not delays:
        return None
    return delays[max(0, math.ceil(part * len(delays)) - 1)] / 1e9
