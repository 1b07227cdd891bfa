"""When a process says how far it has come, and what it has counted."""

import time

from caneflow.messages.control import Counters, Progress
from caneflow.runtime.hosts.process.bus import Bus

REPORT_PERIOD = 0.02  # s between two progress marks under load
LIVE_REPORT_PERIOD = 0.5  # s, in a live run: who waits for a mark gets it at once
COUNTERS_PERIOD = 1.0  # s
SAY_AGAIN_PERIOD = 1.0  # s after which a progress mark is said again: the last one may have met a broken link


class Reports:
    """What one node says of itself."""

    def __init__(self, bus: Bus, *, replay: bool) -> None:
        self._bus = bus
        self._period = REPORT_PERIOD if replay else LIVE_REPORT_PERIOD
        self.said: Progress | None = None
        self._marked: Progress | None = None  # what readers that wait were told last
        self._next_progress = 0.0
        self._say_again = 0.0
        self._next_counters = time.monotonic() + COUNTERS_PERIOD

    def due(self) -> bool:
        """Whether a progress mark is due."""
        return time.monotonic() >= self._next_progress

    def progress(self, progress: Progress) -> None:
        """Say how far the node has come, unless that was just said."""
        now = time.monotonic()
        if progress != self.said or now >= self._say_again:
            self._bus.send_progress(progress)
            self.said = progress
            self._say_again = now + SAY_AGAIN_PERIOD
        self._next_progress = now + self._period

    def marks(self, progress: Progress) -> None:
        """Say at once how far the node has come, to those that wait for it, unless they know."""
        if progress != self._marked:
            self._bus.send_marks(progress)
            self._marked = progress

    def counters_due(self) -> bool:
        """Whether the counters are due."""
        return time.monotonic() >= self._next_counters

    def counters(self, counters: Counters) -> None:
        """Say what the node has counted."""
        self._bus.send_counters(counters)
        self._next_counters = time.monotonic() + COUNTERS_PERIOD
