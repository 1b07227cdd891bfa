"""The latest that it can be by this machine's clock, which may be set while a flow runs."""

import time


class Present:
    """A clock that goes forward with the machine's and never back with it.

    Stamps that a driver derives from the monotonic clock go on when the machine's clock is set back: they do not lie in
    the future then, though that clock has yet to come to them again.
    """

    def __init__(self) -> None:
        self._ahead = 0  # ns: the most that the machine's clock was ahead of the monotonic one

    def now(self) -> int:
        """ns, Unix epoch."""
        monotonic = time.monotonic_ns()
        self._ahead = max(self._ahead, time.time_ns() - monotonic)
        return monotonic + self._ahead
