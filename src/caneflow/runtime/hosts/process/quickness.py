"""Whether a process is quick: then samples are taken on the thread that brings them."""

import time

QUICK = 0.002  # s of CPU: a node that takes longer for an event is not quick ...
STALLED = 0.05  # s of the clock: nor is one that takes so long, waiting; less can be a machine with much else to do
MOST_SLOW = (
    0.25  # ... and when so great a share of the last 64 or so was slow, Zenoh's threads do not wait for it any more
)


class Quickness:
    """Judged by how long events take; once lost it does not come back."""

    def __init__(self) -> None:
        self.holds = True
        self._slow = 0.0  # share of events

    def begin(self) -> tuple[float, float]:
        """Take the time (s) at the begin of an event: the clock's, and the processor's."""
        return time.monotonic(), time.thread_time()

    def judge(self, began: float, worked: float) -> None:
        """Judge by the time that has passed since then."""
        took = time.monotonic() - began
        slow = took > STALLED or (took > QUICK and time.thread_time() - worked > QUICK)
        self._slow += (slow - self._slow) / 64
        if self._slow > MOST_SLOW:
            self.holds = False

    def end(self) -> None:
        """Take nothing at once any more."""
        self.holds = False
