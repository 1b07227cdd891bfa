"""What has come to a node and waits to be looked at: in order, for one taker, within a budget of bytes."""

import queue
from collections.abc import Callable
from typing import Generic, TypeVar

E = TypeVar("E")

MOST_DROPPED = 64  # events at a time, to make room for one


class Inbox(Generic[E]):
    """Events in the order in which they were put; one thread puts those that have a weight, one takes."""

    def __init__(
        self, budget: int, weigh: Callable[[E], int], drop: Callable[[E], None], *, oldest_first: bool
    ) -> None:
        """`weigh`: what an event takes, in bytes; 0: it is never dropped. `drop`: is told of one that is.

        `oldest_first`: beyond the budget the oldest are dropped, else what comes.
        """
        self._queue: queue.SimpleQueue[E] = queue.SimpleQueue()
        self._budget = budget
        self._weigh = weigh
        self._drop = drop
        self._oldest_first = oldest_first
        # Bytes. Each is written by one thread only, so that none needs a lock: a signal handler puts events as well.
        self._came = 0
        self._dropped = 0
        self._taken = 0

    @property
    def held(self) -> int:
        """What everything that waits takes, in bytes."""
        return self._came - self._dropped - self._taken

    def put(self, event: E) -> None:
        """Add an event, or drop it or older ones."""
        weight = self._weigh(event)
        if weight:
            if not self._oldest_first and self.held >= self._budget:
                self._drop(event)
                return
            self._came += weight
            if self._oldest_first and self.held > self._budget:
                self._make_room()
        self._queue.put(event)

    def get(self, timeout: float | None = None) -> E:
        """The next event; raises queue.Empty when none comes within `timeout` s (None: forever)."""
        event = self._queue.get(timeout=timeout)
        self._taken += self._weigh(event)
        return event

    def get_nowait(self) -> E:
        """The next event, if there is one; else raises queue.Empty."""
        event = self._queue.get_nowait()
        self._taken += self._weigh(event)
        return event

    def empty(self) -> bool:
        """Whether nothing waits."""
        return self._queue.empty()

    def _make_room(self) -> None:
        for _ in range(MOST_DROPPED):
            try:
                oldest = self._queue.get_nowait()
            except queue.Empty:
                return
            weight = self._weigh(oldest)
            if weight:
                self._dropped += weight
                self._drop(oldest)
            else:
                self._queue.put(oldest)
            if self.held <= self._budget:
                return
