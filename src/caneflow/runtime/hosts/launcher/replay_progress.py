"""How far a replay is, told now and then, from how far its readers are."""

import time
from collections.abc import Callable, Iterable

from caneflow.runtime.stages.merge import BEGIN, END

TELL_PERIOD = 0.25  # s


class ReplayProgress:
    """Of one replay; nothing to tell of a live run."""

    def __init__(self, origin: int, last: int | None, tell: Callable[[float, float | None], None]) -> None:
        """`origin`, `last`: the stamps (ns) of its first and last sample, None without end; `tell`: see Watcher."""
        self._origin, self._last, self._tell = origin, last, tell
        self._next = 0.0  # s, monotonic

    def look(self, handled: Iterable[int]) -> None:
        """Tell how far the slowest reader is, if it is time to; `handled`: the stamp (ns) that each has come to."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + TELL_PERIOD
        slowest = min(handled, default=BEGIN)
        if slowest == BEGIN or slowest >= END - 1:
            return  # nothing is handled yet, or everything
        of_s = None if self._last is None else (self._last - self._origin) / 1e9
        played_s = max(0.0, (slowest - self._origin) / 1e9)
        self._tell(played_s if of_s is None else min(played_s, of_s), of_s)
