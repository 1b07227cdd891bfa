"""What a live group decided by the clock, kept in its journal: after a kill it is decided so again.

What followed was published. So samples that were left out are left out once more, and an input that was not waited for
has passed once more, behind the same sample of its own.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeAlias

import msgspec

from caneflow.messages import Sample
from caneflow.messages.control import LeftOut


class WentOn(msgspec.Struct, frozen=True, array_like=True, tag="went on", gc=False):
    """A node waited no longer for one of its inputs."""

    node: str
    port: str
    until: int  # ns: what the input still brings up to this stamp is late
    before: int  # seq of the first sample of it that had not come


class WasLeftOut(msgspec.Struct, frozen=True, array_like=True, tag="left out", gc=False):
    """A node did not handle samples of one of its inputs."""

    note: LeftOut

    @property
    def node(self) -> str:
        """Whose input it was."""
        return self.note.node

    @property
    def port(self) -> str:
        """Which input."""
        return self.note.port


Decision: TypeAlias = WentOn | WasLeftOut


class Decided:
    """What was decided of one input."""

    def __init__(self, decisions: Iterable[Decision]) -> None:
        """`decisions`: in the order in which they were taken."""
        self._passed: deque[WentOn] = deque()
        self._stamps: dict[int, str] = {}  # of samples that came, with the reason
        self._lost: list[tuple[int, int]] = []  # numbers of those that had not, first and last
        for decision in decisions:
            if isinstance(decision, WentOn):
                self._passed.append(decision)
            elif decision.note.stamp >= 0:
                self._stamps[decision.note.stamp] = decision.note.reason
            else:
                self._lost.append((decision.note.first_seq, decision.note.last_seq))

    def passed(self, before: int) -> Iterator[int]:
        """Up to which stamps (ns) the input had passed when no sample with a seq >= `before` had come; each once."""
        while self._passed and self._passed[0].before <= before:
            yield self._passed.popleft().until

    def reason(self, message: Sample) -> str | None:
        """Why a sample was left out; None: it was not."""
        if any(first <= message.seq <= last for first, last in self._lost):
            return "lost"
        return self._stamps.get(message.stamp)
