"""Whether a process that ended is started again, and when: a pure policy."""

from enum import Enum, auto
from typing import NamedTuple

from caneflow.runtime.dataflow.graph import Restart

MOST_DOUBLINGS = 30  # of the delay: beyond them it is at its limit anyway


class How(Enum):
    """What ended a process."""

    STOPPED = auto()  # a signal from outside, or it was not ready in time
    FAULT = auto()  # of its own: an exception, an exit status, a crash
    LASTING = auto()  # of its own, and a new start cannot mend it: a missing package, a wrong setting


class Again(NamedTuple):
    """It is started again."""

    delay_s: float


class Failed(NamedTuple):
    """It is given up."""

    why: str


class Restarts:
    """The ends of one node's processes, judged one after the other.

    An end counts until the node has been up (ready) for the policy's `window_s` in one piece.
    """

    def __init__(self, policy: Restart, *, replay: bool) -> None:
        self.counted = 0  # ends that count
        self._policy = policy
        self._replay = replay
        self._up_since: float | None = None  # s; None: it is not up
        self._fault_at: object = None  # where the last fault was

    @property
    def allowed(self) -> int:
        """How many ends may count."""
        return self._policy.max_restarts

    def ready(self, now: float) -> None:
        """Note that the node is up from `now` (s) on."""
        if self._up_since is None:
            self._up_since = now

    def asked(self, now: float) -> None:
        """Note an end at `now` (s) that someone asked for: it does not count, and begins a new time of being up."""
        if self._up_since is not None and now - self._up_since >= self._policy.window_s:
            self.counted = 0
        self._up_since = None

    def ended(self, now: float, handled: object, how: How) -> Again | Failed:
        """Judge an end at `now` (s).

        `handled` names the sample that the node was at; None: it had not begun. A replay comes to a sample in the same
        state each time, so a second fault there is final.
        """
        policy = self._policy
        self.asked(now)
        if policy.policy == "never":
            return Failed("")
        if how is How.LASTING:
            return Failed("a restart would not mend it")
        if self._replay and how is How.FAULT and handled is not None:
            if handled == self._fault_at:
                return Failed(f"given up, it was the second time at the same sample ({handled})")
            self._fault_at = handled
        if self.counted >= policy.max_restarts:
            return Failed(f"given up, it was never up for {policy.window_s:g} s")
        delay = min(policy.delay_s * 2 ** min(self.counted, MOST_DOUBLINGS), policy.max_delay_s)
        self.counted += 1
        return Again(delay)
