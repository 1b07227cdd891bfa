"""Several streams in one order that depends on their stamps alone, never on when they happened to arrive.

A sample is handed on only when every other stream is known to have passed it: its watermark w promises that no
sample with a stamp <= w will come any more. So the order (stamp, port order, seq) is the same in every run.
"""

from collections import deque
from collections.abc import Sequence

from caneflow.messages import Sample

BEGIN = -1  # the watermark of a stream that has said nothing
END = 2**63 - 1  # the watermark of a stream that will say nothing more


class Merge:
    """The samples of a node's input ports, handed on in event time."""

    def __init__(self, ports: Sequence[str]) -> None:
        self.ports = tuple(ports)
        self._queues: list[deque[Sample]] = [deque() for _ in ports]
        self._watermarks = [BEGIN for _ in ports]
        self._index = {port: i for i, port in enumerate(ports)}

    def push(self, port: str, message: Sample) -> None:
        """Add a sample; stamps strictly increase per port, and lie beyond the port's watermark."""
        i = self._index[port]
        self._queues[i].append(message)
        self._watermarks[i] = message.stamp

    def pass_by(self, port: str, stamp: int) -> bool:
        """Whether a sample of `stamp` (ns) on `port` is due at once, past all queues; if so, it counts as handed on."""
        if any(self._queues):
            return False
        own = self._index[port]
        for i, mark in enumerate(self._watermarks):
            if mark >= stamp if i == own else mark < (stamp if i < own else stamp - 1):
                return False
        self._watermarks[own] = stamp
        return True

    def advance(self, port: str, watermark: int) -> None:
        """Note that no sample with a stamp <= `watermark` (ns) will come on `port`."""
        i = self._index[port]
        if watermark > self._watermarks[i]:
            self._watermarks[i] = watermark

    def watermark(self, port: str) -> int:
        """Up to which stamp (ns) everything of `port` has come."""
        return self._watermarks[self._index[port]]

    def waiting(self, port: str) -> int:
        """How many samples of `port` wait."""
        return len(self._queues[self._index[port]])

    def samples(self, port: str) -> list[Sample]:
        """Those of `port` that wait."""
        return list(self._queues[self._index[port]])

    def drop_oldest(self, port: str) -> Sample:
        """Take the oldest waiting sample of `port` away."""
        return self._queues[self._index[port]].popleft()

    def pop(self) -> tuple[str, Sample] | None:
        """The next sample in event time, or None while another stream may still come before it."""
        first, holding = self._next()
        if first is None or holding is not None:
            return None
        return self.ports[first], self._queues[first].popleft()

    def held_by(self) -> str | None:
        """The port that the next sample waits for, if one waits at all."""
        _, holding = self._next()
        return None if holding is None else self.ports[holding]

    def handled(self) -> int:
        """Up to which stamp (ns) everything has come and has been handed on."""
        lowest = END
        for queue, mark in zip(self._queues, self._watermarks):  # noqa: B905 - of equal length; looked at for each sample
            passed = queue[0].stamp - 1 if queue else mark
            if passed < lowest:
                lowest = passed
        return lowest

    @property
    def ended(self) -> bool:
        """Whether everything has come and has been handed on."""
        return self._watermarks[-1] == END and self.handled() == END

    def _next(self) -> tuple[int | None, int | None]:
        """The port whose oldest sample is next by (stamp, port order), and one that may still bring one before it."""
        first, stamp = None, END
        for i, queue in enumerate(self._queues):
            if queue and (first is None or queue[0].stamp < stamp):
                first, stamp = i, queue[0].stamp
        if first is not None:
            for i, queue in enumerate(self._queues):
                # At the same stamp the earlier port goes first: only such a one must have passed it.
                if not queue and self._watermarks[i] < (stamp if i < first else stamp - 1):
                    return first, i
        return first, None
