"""One operator with its inputs and outputs, on no host in particular: what both hosts do the same way.

Samples come in as they arrive and are checked against their stream; the operator gets them in event time; what it
emits is numbered. Nothing here knows Zenoh, processes or a clock.
"""

import logging
from collections.abc import Iterator, Mapping
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from caneflow.messages import MessageError, Sample
from caneflow.messages.control import InputCounts, LeftOut, PortMark, Progress
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.program import Operator, Refused
from caneflow.runtime.stages.byte_budget import share, weight_of
from caneflow.runtime.stages.decisions import Decided, WentOn
from caneflow.runtime.stages.merge import BEGIN, END, Merge
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.rollback import Rollback, blames_sample, let_overflow_raise
from caneflow.runtime.stages.streams import Arrivals, Departures
from caneflow.runtime.wording import listed, one_line

log = logging.getLogger(__name__)

Number: TypeAlias = Annotated[int, Meta(ge=-1, le=END)]  # -1: none yet


class StageState(msgspec.Struct, frozen=True):
    """Where the streams of a stage stand."""

    inputs: dict[str, tuple[Number, Number]]  # by port the seq and stamp (ns) of the last sample handled
    outputs: dict[str, tuple[Number, Number]]  # by port how many were sent, and the last one's stamp (ns)
    finished: bool


class Stage:
    """An operator between its input and output streams."""

    def __init__(
        self, node: str, operator: Operator, inputs: Mapping[str, InputPlan], outputs: Mapping[str, OutputPlan]
    ) -> None:
        self.node = node
        self.inputs = {port: Arrivals(node, port, plan) for port, plan in inputs.items()}
        self.outputs = {port: Departures(plan) for port, plan in outputs.items()}
        self.finished = False
        self.caught_up_at = BEGIN  # ns: after a kill, up to here neither age nor length decides again
        self._awaited = [out for out in self.outputs.values() if out.plan.awaited]
        self._operator = operator
        self._rollback = Rollback(node, operator)
        self._merge = Merge(tuple(inputs))
        self._budget: int | None = None  # bytes of one port that may wait for their turn; None: not bounded
        self._held = dict.fromkeys(inputs, 0)  # bytes of those, where they are bounded

    def bound(self, budget: int) -> None:
        """Let samples that wait take no more than `budget` bytes, of all inputs; the oldest are dropped beyond."""
        self._budget = share(budget, len(self.inputs))
        for arrivals in self.inputs.values():
            arrivals.budget = self._budget

    @property
    def operator(self) -> Operator:
        """The operator as it is now: another object after a sample that the one before could not handle."""
        return self._operator

    @property
    def held(self) -> int:
        """What the samples that wait take, in bytes."""
        return sum(self._held.values()) + sum(arrivals.ahead_held for arrivals in self.inputs.values())

    def offer(self, port: str, message: Sample, *, again: bool = False) -> None:
        """Take a decoded sample that arrived on `port`; `again`: it was asked for, and may have come before."""
        arrivals = self.inputs[port]
        for each in arrivals.admit(message, again=again):
            self._queue(port, arrivals, each)
        self._count_mark(port, arrivals)

    def refuse(self, port: str, error: MessageError) -> None:
        """Count a sample on `port` that could not be decoded."""
        self.inputs[port].refuse_unreadable(error)
        self._count_mark(port, self.inputs[port])

    def refuse_ahead(self, port: str, message: Sample, ahead: int, *, again: bool = False) -> None:
        """Refuse a live sample on `port` that is stamped `ahead` ns in the future."""
        arrivals = self.inputs[port]
        for each in arrivals.refuse_ahead(message, ahead, again=again):
            self._queue(port, arrivals, each)
        self._count_mark(port, arrivals)

    def skip_to(self, port: str, seq: int) -> None:
        """Stop waiting for samples of `port` before `seq` that were sent and did not arrive."""
        arrivals = self.inputs[port]
        for each in arrivals.skip_to(seq):
            self._queue(port, arrivals, each)
        self._count_mark(port, arrivals)

    def mark(self, port: str, mark: PortMark) -> None:
        """Take the writer's word on how far the stream of `port` has come."""
        arrivals = self.inputs[port]
        arrivals.note_mark(mark)
        self._count_mark(port, arrivals)

    def close(self, port: str) -> None:
        """Note that nothing more will come on `port`, whatever its writer said."""
        self._merge.advance(port, END)

    def go_on_without(self, port: str, until: int) -> None:
        """Wait for `port` no longer up to the stamp `until` (ns): what it still brings there is late."""
        arrivals = self.inputs[port]
        if arrivals.keep is not None and until > self._merge.watermark(port):
            arrivals.keep(WentOn(self.node, port, until, arrivals.expected))
        self._merge.advance(port, until)

    def went_on(self) -> Iterator[WentOn]:
        """How far inputs have passed beyond what came on them."""
        for port, arrivals in self.inputs.items():
            if arrivals.last_stamp < self._merge.watermark(port) < END - 1:
                yield WentOn(self.node, port, self._merge.watermark(port), arrivals.expected)

    def decide_again(self, port: str, decided: Decided) -> None:
        """Decide of `port` as before a kill, from which the stage has been resumed."""
        self.inputs[port].decided = decided
        self._count_mark(port, self.inputs[port])

    def held_by(self) -> str | None:
        """The port that the next sample waits for."""
        return self._merge.held_by()

    def step(self, now: int | None = None) -> list[tuple[str, Sample, int]] | None:
        """Handle the next sample in event time: what follows, as (port, message, seq). None: nothing is due.

        `now` (ns) is the host's clock, given by a live host only: inputs may have a greatest age.
        """
        due = self._merge.pop()
        if due is not None:
            port, message = due
            if self._budget is not None:
                self._held[port] -= weight_of(message)
            return self._handled(port, self.inputs[port], message, now)
        if not self.finished and self._merge.ended:
            self.finished = True
            return self._finished()
        return None

    def handle_at_once(self, port: str, message: Sample, now: int | None) -> list[tuple[str, Sample, int]] | None:
        """`offer` and `step` in one, for a sample that is next in its stream and due: what follows from it.

        `now` as in `step`. None: it is not so simple, and nothing was done.
        """
        arrivals = self.inputs[port]
        if arrivals.plan.left_out or arrivals.decided is not None or not arrivals.is_simply_next(message):
            return None
        if not self._merge.pass_by(port, message.stamp):
            return None
        arrivals.take_next(message)
        return self._handled(port, arrivals, message, now)

    def progress(self) -> Progress:
        """How far the node has come: what is handled can cause no further output."""
        handled = END if self.finished else min(self._merge.handled(), END - 1)
        # Between the last sample and what follows from the end, no time that could be stamped is promised.
        told = handled if handled != END - 1 else max(each.handled_stamp for each in self.inputs.values())
        marks = {port: PortMark(out.sent - 1, told) for port, out in self.outputs.items()}
        return Progress(self.node, handled, marks)

    def state(self) -> StageState:
        """Where the streams stand, between two samples."""
        return StageState(
            inputs={port: (each.handled_seq, each.handled_stamp) for port, each in self.inputs.items()},
            outputs={port: (out.sent, out.last_stamp) for port, out in self.outputs.items()},
            finished=self.finished,
        )

    def resume(self, state: StageState, operator: Operator) -> None:
        """Go on where `state` was taken, with the operator of then; what was not handled has to come again.

        Raises SnapshotError, with nothing changed, when the state is one of other ports.
        """
        for what, ports, found in (("inputs", self.inputs, state.inputs), ("outputs", self.outputs, state.outputs)):
            if ports.keys() != found.keys():
                raise SnapshotError(f"it has the {what} {listed(found)}; expected {listed(ports)}")
        self._operator = operator
        self._rollback.resume(operator)
        for port, (seq, stamp) in state.inputs.items():
            arrivals = self.inputs[port]
            arrivals.handled_seq, arrivals.handled_stamp = seq, stamp
            arrivals.expected, arrivals.last_stamp = seq + 1, stamp
            self._merge.advance(port, stamp)
        for port, (sent, stamp) in state.outputs.items():
            self.outputs[port].sent, self.outputs[port].last_stamp = sent, stamp
        self.finished = state.finished

    def waiting(self, port: str) -> list[Sample]:
        """The samples of `port` that have come and were not handled."""
        return [*self._merge.samples(port), *self.inputs[port].ahead.values()]

    def note_packed(self, state: bytes) -> None:
        """Take note that the operator was packed just now: a sample that it cannot handle sets it back to there."""
        self._rollback.rebase(state)

    def tells_more_than_samples(self) -> bool:
        """Whether a reader waits, and cannot see from the samples alone, how far this node has come."""
        if not self._awaited:
            return False
        handled = self._merge.handled()
        return any(out.last_stamp < handled for out in self._awaited)

    def left_out(self) -> list[LeftOut]:
        """What was not handled since this was last asked."""
        found = [note for arrivals in self.inputs.values() for note in arrivals.left_out]
        for arrivals in self.inputs.values():
            arrivals.left_out.clear()
        return found

    def input_counts(self) -> dict[str, InputCounts]:
        """What became of every sample that came, per port."""
        for port, arrivals in self.inputs.items():
            arrivals.counts.waiting = self._merge.waiting(port) + len(arrivals.ahead)
        return {port: arrivals.counts for port, arrivals in self.inputs.items()}

    def _queue(self, port: str, arrivals: Arrivals, message: Sample) -> None:
        """Let a sample that is next in its stream wait for its turn in event time."""
        if arrivals.decided is not None and self._is_left_out_again(port, arrivals, arrivals.decided, message):
            return
        if message.stamp in arrivals.plan.left_out_stamps:
            arrivals.counts.left_out += 1
            arrivals.note_handled(message)
            self._merge.advance(port, message.stamp)
        elif message.stamp <= self._merge.watermark(port):
            arrivals.counts.late += 1
            arrivals.note_handled(message)
            arrivals.leave_out(message, "late")
        else:
            self._merge.push(port, message)
            if self._budget is not None:
                self._held[port] += weight_of(message)
            self._keep_length(port, arrivals)

    def _is_left_out_again(self, port: str, arrivals: Arrivals, decided: Decided, message: Sample) -> bool:
        for until in decided.passed(message.seq):
            self._merge.advance(port, until)
        reason = decided.reason(message)
        if reason is None:
            return False
        arrivals.counts.dropped += reason == "dropped"
        arrivals.counts.late += reason != "dropped"
        arrivals.note_handled(message)
        arrivals.leave_out(message, reason)
        self._merge.advance(port, message.stamp)
        return True

    def _handled(
        self, port: str, arrivals: Arrivals, message: Sample, now: int | None
    ) -> list[tuple[str, Sample, int]]:
        arrivals.note_handled(message, now)
        if now is not None and message.stamp > self.caught_up_at and arrivals.too_old(message, now):
            arrivals.counts.dropped += 1
            arrivals.leave_out(message, "dropped")
            return []
        follows: list[tuple[str, Sample]] = []
        let_overflow_raise()
        try:
            for each in self._operator.handle(port, message):
                follows.append(each)
        except Refused as refused:
            arrivals.refuse(refused)
        except Exception as error:
            cause = blames_sample(error)
            if cause is None:
                raise
            self._operator = self._rollback.restored(port, message, self._operator, error)
            arrivals.refuse(cause)
            return []
        else:
            arrivals.counts.handled += 1
        self._rollback.note(port, message, self._operator)
        return [self._numbered(out, each) for out, each in follows]

    def _finished(self) -> list[tuple[str, Sample, int]]:
        """What the operator has left to say at the end, as far as it can be said."""
        follows: list[tuple[str, Sample, int]] = []
        let_overflow_raise()
        try:
            for out, each in self._operator.finish():
                follows.append(self._numbered(out, each))
        except Exception as error:
            cause = blames_sample(error)
            if cause is None:
                raise
            log.warning("%s: at its end: %s", self.node, one_line(error))
        return follows

    def _numbered(self, port: str, message: Sample) -> tuple[str, Sample, int]:
        departures = self.outputs.get(port)
        if departures is None:
            raise DataflowError(f"{self.node}: emitted on port {port!r}; it has {', '.join(self.outputs) or 'none'}")
        return port, message, departures.number(message)

    def _keep_length(self, port: str, arrivals: Arrivals) -> None:
        length, budget = arrivals.plan.length, self._budget
        while (
            length is not None
            and self._merge.waiting(port) > length
            and self._merge.samples(port)[0].stamp > self.caught_up_at
        ) or (budget is not None and self._held[port] > budget and self._merge.waiting(port) > 1):
            oldest = self._merge.drop_oldest(port)
            if budget is not None:
                self._held[port] -= weight_of(oldest)
            arrivals.leave_out(oldest, "dropped")
            arrivals.counts.dropped += 1

    def _count_mark(self, port: str, arrivals: Arrivals) -> None:
        if arrivals.decided is not None:
            for until in arrivals.decided.passed(arrivals.expected):
                self._merge.advance(port, until)
        if arrivals.mark is not None and (watermark := arrivals.arrived_mark()) is not None:
            self._merge.advance(port, watermark)
