"""Streams at a node's edge: what arrives is held against its number and stamp, what departs is numbered."""

import logging
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from caneflow.messages import MessageError, Sample
from caneflow.messages.control import InputCounts, LeftOut, PortMark
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.stages.byte_budget import WAITING, weight_of
from caneflow.runtime.stages.decisions import Decided, Decision, WasLeftOut
from caneflow.runtime.stages.merge import BEGIN, END

log = logging.getLogger(__name__)

NOTES_KEPT = 10_000  # per stream, until a live host has told them
AHEAD_KEPT = 65_536  # samples of one stream that may wait for what is missing before them
CAUSES_NAMED = 100  # per stream: a hostile writer must not fill the memory
LONGEST_CAUSE = 300  # characters of one, likewise
SILENCE = 1_000_000_000  # ns from one stamp of a stream to the next that are worth a line
FAR_AHEAD = (
    1_000_000_000  # ns that a live stamp may lie ahead of its clock, which is known to some ms; sensors stamp the past
)
FAR_AHEAD_UNKNOWN = 100 * 365 * 86_400 * 1_000_000_000  # ns, while the writer's clock is not known: 1970 to 2070
SECOND_WRITER = 1_000  # samples of one writer between two of another, at most: more, and it was a restart
NUMBER = re.compile(r"[-+]?(\d[\d.]*(e[-+]?\d+)?|\b(nan|inf)\b)")
SILENCES_NAMED = 10  # per stream: one that is slow is not to be complained of forever


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
    left_out: deque[LeftOut] = field(default_factory=lambda: deque(maxlen=NOTES_KEPT))  # a live host tells them
    clock_offset: int | None = 0  # ns, the writer's clock less this machine's; None: not known
    keep: Callable[[Decision], None] | None = None  # takes what is decided of this input, before anything follows
    decided: Decided | None = None  # before a kill
    patient: bool = False  # what is missing can be had again: later samples wait for it
    ahead: dict[int, Sample] = field(default_factory=dict)  # those that wait, by seq
    handled_seq: int = -1  # of the last sample that needs no asking for
    handled_stamp: int = BEGIN  # ns, likewise
    handled_at: int | None = None  # ns, the host's clock, when the sample of that stamp was; a live host only
    mark: PortMark | None = None  # of the writer, waiting for its last sample to arrive
    budget: int = WAITING  # bytes that those may take
    ahead_held: int = 0  # bytes that they take
    newest: int = -1  # seq of the last sample that is known to be sent, while some are missing
    other: int | None = None  # seq that was due when the numbers went back: who goes on there is a second writer
    other_since: int = 0  # seq to which they went back
    _ahead_first: int | None = None  # the smallest seq of those that wait
    _named: set[str] = field(default_factory=set)
    _silences: int = 0  # that were said

    def refuse(self, cause: object, kind: str = "") -> None:
        """Count a sample that cannot be taken; name the cause once per kind of cause, whatever its numbers."""
        self.counts.refused += 1
        self._say_once(kind or NUMBER.sub("", str(cause)[:LONGEST_CAUSE]), f"refused: {cause}")

    def drop_unseen(self, count: int) -> None:
        """Count samples that were dropped before they were looked at: more came than the node may hold."""
        self.counts.received += count
        self.counts.dropped += count
        self._say_once("dropped", f"{count} samples dropped unseen: they came faster than the node takes them")

    def refuse_unreadable(self, error: MessageError) -> None:
        """Count a sample that could not be decoded: its number is not known, so it is not lost as well."""
        self.counts.received += 1
        self.unreadable += 1
        self.refuse(error)

    def ahead_of(self, stamp: int, now: int) -> int | None:
        """How far (ns) a live stamp lies ahead of its writer's clock, if too far; `now`: this machine's (ns)."""
        ahead = stamp - now - (self.clock_offset or 0)
        bound = FAR_AHEAD if self.clock_offset is not None else FAR_AHEAD_UNKNOWN
        return ahead if ahead > bound and stamp != END else None

    def refuse_ahead(self, message: Sample, ahead: int, *, again: bool = False) -> list[Sample]:
        """Refuse a sample that lies `ahead` (ns) of its writer's clock; those that waited for its number only."""
        had_come = message.seq < self.expected or message.seq in self.ahead
        if not (again or had_come):
            self.counts.received += 1
            self.refuse(f"seq {message.seq} {lies_ahead(ahead)}", "ahead")
        if message.seq == self.expected:  # nobody has to ask for it
            self.expected, self.unreadable = message.seq + 1, 0
            return self._caught_up()
        self.unreadable += not (again or had_come)
        return []

    def refuse_mark(self, ahead: int) -> None:
        """Name a writer's word on how far it has come that lies `ahead` (ns) of its clock; it moves nothing."""
        self._say_once("mark", f"a progress mark {lies_ahead(ahead)}; refused")

    def admit(self, message: Sample, *, again: bool = False) -> list[Sample]:
        """The samples that are next in the stream now that `message` has come; counts it, and what is missing.

        `again`: it was asked for, so it is not a fault if it has come before.
        """
        if self.is_simply_next(message):
            self.take_next(message)
            return [message]
        self.counts.received += 1
        if self.plan.external and self.last_stamp == BEGIN:
            self.expected = message.seq  # it was there before: what it said to others is not lost
        if message.seq == self.other and not again and self.expected - self.other_since <= SECOND_WRITER:
            self._change_writer()
        if message.stamp <= self.last_stamp or message.seq in self.ahead:
            self._refuse_old(message, again=again)
            return []
        if not self.patient or message.seq <= self.expected + self.unreadable:
            self._note_lost(message.seq)
            return [self._next(message), *self._caught_up()]
        self._let_wait(message)
        if len(self.ahead) <= AHEAD_KEPT and self.ahead_held <= self.budget:
            return []
        return self.skip_to(self._ahead_first or 0)

    def is_simply_next(self, message: Sample) -> bool:
        """Whether `message` is as it should be, and nearly always is: next in number and time, with nothing missing.

        And the writer's mark, if one waits, goes on waiting.
        """
        return (
            message.seq == self.expected
            and 0 < message.stamp - self.last_stamp <= SILENCE
            and not (self.ahead or self.unreadable)
            and (self.mark is None or self.mark.last_seq > message.seq)
        )

    def take_next(self, message: Sample) -> None:
        """Count a sample that is simply next."""
        self.counts.received += 1
        self.expected, self.last_stamp = message.seq + 1, message.stamp

    def note_mark(self, mark: PortMark) -> None:
        """Take the writer's word on how far it has come, if it is no older than the one that waits."""
        if self.mark is None or mark.watermark >= self.mark.watermark:
            self.mark = mark
            self.newest = max(self.newest, mark.last_seq)

    def skip_to(self, seq: int) -> list[Sample]:
        """Take what is missing before `seq` as lost; the samples that waited for it."""
        self._note_lost(seq)
        self.expected, self.unreadable = max(self.expected, seq), 0
        return self._caught_up()

    @property
    def missing_before(self) -> int | None:
        """The seq before which samples are known to be missing."""
        if self._ahead_first is not None:
            return self._ahead_first
        return None if self.mark is None else self.mark.last_seq + 1

    def _let_wait(self, message: Sample) -> None:
        seq = message.seq
        self.ahead[seq] = message
        self.ahead_held += weight_of(message)
        self.newest = max(self.newest, seq)
        self._ahead_first = seq if self._ahead_first is None else min(self._ahead_first, seq)

    def _change_writer(self) -> None:
        """Two programs write on this key, each with numbers of its own: that is neither a restart nor a loss."""
        self.expected, self.other = self.other or 0, self.expected
        self.other_since, self.unreadable = self.expected, 0
        self._say_once(
            "writers",
            f"two programs write on this key (one is at seq {self.expected}, one at {self.other}); end or rename one",
        )

    def _refuse_old(self, message: Sample, *, again: bool) -> None:
        if again:
            self.counts.received -= 1
        elif message.seq < self.expected or message.seq in self.ahead:
            self.counts.repeated += 1
            self._say_once("repeated", f"seq {message.seq} came again; dropped")
        else:
            stamps = f"seq {message.seq} has stamp {message.stamp}, after {self.last_stamp}"
            self.refuse(f"time goes backwards: {stamps}", "backwards")
            self.expected = message.seq + 1

    def _next(self, message: Sample) -> Sample:
        # A smaller seq with a newer stamp is a writer that was restarted and counts again.
        if message.seq < self.expected:
            self.newest, self.other, self.other_since = message.seq, self.expected, message.seq
        self._note_silence(message)
        self.expected, self.unreadable = message.seq + 1, 0
        self.last_stamp = message.stamp
        return message

    def _caught_up(self) -> list[Sample]:
        """The samples that waited and are next now."""
        found = []
        while (message := self.ahead.pop(self.expected, None)) is not None:
            self.ahead_held -= weight_of(message)
            found.append(self._next(message))
        if found:
            self._ahead_first = min(self.ahead, default=None)
        return found

    def note_handled(self, message: Sample, now: int | None = None) -> None:
        """Note that `message` needs no asking for any more; `now` (ns): it is in the program's hands, live."""
        if message.seq > self.handled_seq:
            self.handled_seq, self.handled_stamp, self.handled_at = message.seq, message.stamp, now

    @property
    def handled_age(self) -> float | None:
        """How old (s) the last sample was when it was handled; None where that is not known."""
        if self.handled_at is None or self.clock_offset is None:
            return None
        return (self.handled_at + self.clock_offset - self.handled_stamp) / 1e9

    def too_old(self, message: Sample, now: int) -> bool:
        """Whether `message` is older than the graph wants it."""
        limit = self.plan.max_age_ms
        if limit is None or self.clock_offset is None:
            return False  # on a clock that is not known yet nothing is old
        return now + self.clock_offset - message.stamp > limit * 1e6

    def leave_out(self, message: Sample, reason: str) -> None:
        """Note a sample that came and is not handled."""
        seq = message.seq
        self._note(
            LeftOut(node=self.node, port=self.port, reason=reason, first_seq=seq, last_seq=seq, stamp=message.stamp)
        )

    def _note_lost(self, before: int) -> None:
        """Count what is missing of the samples with a seq < `before`."""
        count = before - self.expected - self.unreadable
        if count > 0:
            self.counts.lost += count
            self._say_once("lost", f"{count} samples lost before seq {before}")
            self._note(
                LeftOut(node=self.node, port=self.port, reason="lost", first_seq=self.expected, last_seq=before - 1)
            )

    def _note(self, note: LeftOut) -> None:
        if self.keep is not None:
            self.keep(WasLeftOut(note))
        self.left_out.append(note)

    def _note_silence(self, message: Sample) -> None:
        """Say how long nothing was measured, or what was is lost, before `message`."""
        silent = message.stamp - self.last_stamp
        if self.last_stamp == BEGIN or silent <= SILENCE or self._silences == SILENCES_NAMED:
            return
        self._silences += 1
        last = " (not said again)" if self._silences == SILENCES_NAMED else ""
        log.warning("%s: nothing for %.2f s before seq %d%s", self.plan.key, silent / 1e9, message.seq, last)

    def _say_once(self, kind: str, text: str) -> None:
        kind, text = kind[:LONGEST_CAUSE], text[:LONGEST_CAUSE]
        if kind not in self._named and len(self._named) < CAUSES_NAMED:
            self._named.add(kind)
            log.warning("%s: %s (counted from now on, not repeated)", self.plan.key, text)

    def arrived_mark(self) -> int | None:
        """The writer's watermark (ns), once everything that was sent before it has come."""
        if self.mark is None or self.mark.last_seq >= self.expected + self.unreadable:
            return None
        watermark, self.mark = self.mark.watermark, None
        return watermark


def lies_ahead(ahead: int) -> str:
    """What is wrong with a stamp that is `ahead` ns in the future."""
    return f"is stamped {ahead / 1e9:.1f} s ahead of the clock; at most {FAR_AHEAD / 1e9:g} s is taken"


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
