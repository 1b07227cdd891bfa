"""How far the sources of a replay may send, from how far the readers are."""

from collections.abc import Iterable

from caneflow.runtime.stages.merge import BEGIN, END

REPLAY_WINDOW = 5_000_000_000  # ns of event time that the sources of a replay may be ahead of the slowest reader
WINDOW_PERIOD = 1.0  # s after which the window is said again: the last word may have met a broken link


class ReplayWindow:
    """Opens in steps; `until`: the stamp (ns) up to which the sources may send, BEGIN before the first step."""

    def __init__(self, origin: int) -> None:
        """`origin`: the stamp (ns) at which the replay begins."""
        self._origin = origin
        self._say_at = 0.0  # s, monotonic
        self.until = BEGIN

    def to_be_said(self, handled: Iterable[int], now: float) -> bool:
        """Open as far as the slowest reader allows; whether `until` is to be said now (s, monotonic).

        `handled`: the stamp (ns) up to which each reader has handled everything.
        """
        slowest = min(handled, default=END)
        if slowest >= END - 1:
            return False  # nobody needs a window any more, and sessions may be closing
        until = max(slowest, self._origin) + REPLAY_WINDOW
        if until >= self.until + REPLAY_WINDOW // 16:
            self.until = until
        elif now < self._say_at:
            return False
        self._say_at = now + WINDOW_PERIOD
        return True
