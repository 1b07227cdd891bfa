"""Whether a process is quick: then samples are taken on the thread that brings them."""

import time

QUICK = 0.002  # s of CPU: a node that takes longer for an event is not quick ...
STALLED = 0.05  # s of the clock: nor is one that takes so long, waiting; less can be a machine with much else to do
WATCHED = 256  # events
MOST_SLOW = (
    0.25  # ... and when so great a share of the last 64 or so was slow, Zenoh's threads do not wait for it any more
)


class Quickness:
    """Judged by how long events take; once lost it does not come back.

    To ask for the processor's time is a call into the kernel: that is done only after an event took long by the clock.
    """

    def __init__(self) -> None:
        self.holds = True
        self._slow = 0.0  # share of events
        self._watched = 0  # events to come, whose time on the processor is taken

    def begin(self) -> tuple[float, float | None]:
        """Take the time (s) at the begin of an event: the clock's, and the processor's where that may be wanted."""
        return time.monotonic(), time.thread_time() if self._watched else None

    def judge(self, began: float, worked: float | None) -> None:
        """Judge by the time that has passed since then."""
        took = time.monotonic() - began
        slow = took > STALLED
        if took > QUICK and not slow:
            if worked is None:
                self._watched = WATCHED
                return
            slow = time.thread_time() - worked > QUICK
        if worked is not None:
            self._watched -= 1
        self._slow += (slow - self._slow) / 64
        if self._slow > MOST_SLOW:
            self.holds = False

    def end(self) -> None:
        """Take nothing at once any more."""
        self.holds = False
