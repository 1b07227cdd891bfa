"""Streams at a node's edge: what arrives is held against its number and stamp, what departs is numbered."""

import logging
from dataclasses import dataclass, field

from caneflow.messages import MessageError, Sample
from caneflow.messages.control import InputCounts, LeftOut, PortMark
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.merge import BEGIN
from caneflow.runtime.plan import InputPlan, OutputPlan

log = logging.getLogger(__name__)

CAUSES_NAMED = 100  # per stream: a hostile writer must not fill the memory


@dataclass
class Arrivals:
    """One input stream as it arrives: numbered, in order, each fault counted and named once."""

    node: str
    port: str
    plan: InputPlan
    counts: InputCounts = field(default_factory=InputCounts)
    expected: int = 0  # seq of the next sample
    last_stamp: int = BEGIN  # ns
    unreadable: int = 0  # refused samples whose seq is not known: they are not lost as well
    left_out: list[LeftOut] = field(default_factory=list)  # to be told by a live host, which empties it
    mark: PortMark | None = None  # of the writer, waiting for its last sample to arrive
    _named: set[str] = field(default_factory=set)

    def refuse(self, cause: object, kind: str = "") -> None:
        """Count a sample that cannot be taken; name the cause once per kind of cause."""
        self.counts.refused += 1
        self._say_once(kind or str(cause), f"refused: {cause}")

    def refuse_unreadable(self, error: MessageError) -> None:
        """Count a sample that could not be decoded: its number is not known, so it is not lost as well."""
        self.counts.received += 1
        self.unreadable += 1
        self.refuse(error)

    def admit(self, message: Sample) -> bool:
        """Whether `message` is the stream's next; counts it, and what is missing before it."""
        if message.stamp <= self.last_stamp:
            if message.seq < self.expected:
                self.counts.repeated += 1
                self._say_once("repeated", f"seq {message.seq} came again; dropped")
            else:
                stamps = f"seq {message.seq} has stamp {message.stamp}, after {self.last_stamp}"
                self.refuse(f"time goes backwards: {stamps}", "backwards")
                self.expected = message.seq + 1
            return False
        self._note_lost(message.seq)
        self.unreadable = 0
        # A smaller seq with a newer stamp is a writer that was restarted and counts anew.
        self.expected = message.seq + 1
        self.last_stamp = message.stamp
        return True

    def too_old(self, message: Sample, now: int) -> bool:
        """Whether `message` is older than the graph wants it."""
        limit = self.plan.max_age_ms
        return limit is not None and now - message.stamp > limit * 1e6

    def give_up(self) -> None:
        """Take what the writer's mark still promises as lost, so that it counts."""
        if self.mark is not None:
            self._note_lost(self.mark.last_seq + 1)
            self.expected, self.unreadable = self.mark.last_seq + 1, 0

    def leave_out(self, message: Sample, reason: str) -> None:
        """Note a sample that came and is not handled."""
        self.left_out.append(
            LeftOut(
                node=self.node,
                port=self.port,
                reason=reason,
                first_seq=message.seq,
                last_seq=message.seq,
                stamp=message.stamp,
            )
        )

    def _note_lost(self, before: int) -> None:
        """Count what is missing of the samples with a seq < `before`."""
        count = before - self.expected - self.unreadable
        if count > 0:
            self.counts.lost += count
            self._say_once("lost", f"{count} samples lost before seq {before}")
            self.left_out.append(
                LeftOut(node=self.node, port=self.port, reason="lost", first_seq=self.expected, last_seq=before - 1)
            )

    def _say_once(self, kind: str, text: str) -> None:
        if kind not in self._named and len(self._named) < CAUSES_NAMED:
            self._named.add(kind)
            log.warning("%s: %s (counted from now on, not repeated)", self.plan.key, text)

    def arrived_mark(self) -> int | None:
        """The writer's watermark (ns), once everything that was sent before it has come."""
        if self.mark is None or self.mark.last_seq >= self.expected + self.unreadable:
            return None
        watermark, self.mark = self.mark.watermark, None
        return watermark


@dataclass
class Departures:
    """One output stream: numbered 0, 1, 2 ..., stamps strictly increasing."""

    plan: OutputPlan
    sent: int = 0
    last_stamp: int = BEGIN  # ns

    def number(self, message: Sample) -> int:
        """The number of `message` in its stream; raises DataflowError for one that must not leave."""
        return self.number_encoded(type(message), message.stamp)

    def number_encoded(self, kind: type[Sample], stamp: int) -> int:
        """The same for a sample of type `kind` that has its bytes already."""
        if kind is not self.plan.kind:
            raise DataflowError(f"{self.plan.key}: a {kind.__name__}; it is declared {self.plan.kind.__name__}")
        if stamp <= self.last_stamp:
            raise DataflowError(
                f"{self.plan.key}: stamp {stamp} after {self.last_stamp}; stamps of one stream strictly increase"
            )
        self.last_stamp = stamp
        seq, self.sent = self.sent, self.sent + 1
        return seq
