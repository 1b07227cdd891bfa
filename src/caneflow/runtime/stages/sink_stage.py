"""One sink with its inputs: every sample is handed on as it comes, checked against its stream."""

from collections.abc import Mapping

from caneflow.messages import MessageError, Sample
from caneflow.messages.control import InputCounts, PortMark, Progress
from caneflow.runtime.plan import InputPlan
from caneflow.runtime.program import Sink
from caneflow.runtime.stages.byte_budget import share
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.streams import Arrivals
from caneflow.runtime.wording import listed


class Tap:
    """A sink at the end of its streams."""

    def __init__(self, node: str, sink: Sink, inputs: Mapping[str, InputPlan]) -> None:
        self.node = node
        self.inputs = {port: Arrivals(node, port, plan) for port, plan in inputs.items()}
        self.finished = False
        self._sink = sink
        self._watermarks = {port: BEGIN for port in inputs}
        self._payloads: dict[str, dict[int, bytes]] = {port: {} for port in inputs}  # of samples on their way, by seq

    def bound(self, budget: int) -> None:
        """Let samples that wait for missing ones take no more than `budget` bytes, of all inputs."""
        for arrivals in self.inputs.values():
            arrivals.budget = share(budget, len(self.inputs))

    @property
    def held(self) -> int:
        """What the samples that wait take, in bytes: each is kept decoded and as it came."""
        return sum(2 * arrivals.ahead_held for arrivals in self.inputs.values())

    def offer(self, port: str, message: Sample, payload: bytes, time: int, *, again: bool = False) -> None:
        """Take a decoded sample that arrived on `port` at `time` (ns); `again`: it was asked for."""
        arrivals = self.inputs[port]
        if arrivals.is_simply_next(message):  # as nearly all are
            arrivals.take_next(message)
            self._hand_on(port, arrivals, message, payload, time)
            return
        self._payloads[port][message.seq] = payload
        for each in arrivals.admit(message, again=again):
            self._take(port, each, time)
        if message.seq not in arrivals.ahead:
            self._payloads[port].pop(message.seq, None)
        self._count_mark(port)

    def refuse(self, port: str, error: MessageError) -> None:
        """Count a sample on `port` that could not be decoded."""
        self.inputs[port].refuse_unreadable(error)
        self._count_mark(port)

    def refuse_ahead(self, port: str, message: Sample, ahead: int, time: int, *, again: bool = False) -> None:
        """Refuse a live sample on `port` that is stamped `ahead` ns in the future."""
        for each in self.inputs[port].refuse_ahead(message, ahead, again=again):
            self._take(port, each, time)
        self._count_mark(port)

    def mark(self, port: str, mark: PortMark) -> None:
        """Take the writer's word on how far the stream of `port` has come."""
        self.inputs[port].note_mark(mark)
        self._count_mark(port)

    def skip_to(self, port: str, seq: int, time: int) -> None:
        """Stop waiting for samples of `port` before `seq` that were sent and did not arrive."""
        for each in self.inputs[port].skip_to(seq):
            self._take(port, each, time)
        self._count_mark(port)

    def close(self, port: str) -> None:
        """Note that nothing more will come on `port`."""
        self._advance(port, END)

    def note(self, key: str, payload: bytes, time: int) -> None:
        """Hand on what a node says that it left out."""
        if not self.finished:
            self._sink.note(key, payload, time)

    def asked(self, question: bytes, time: int) -> bytes | None:
        """The sink's answer to a tool's question."""
        return None if self.finished else self._sink.asked(question, time)

    def idle(self, time: int) -> None:
        """Give the sink a moment when nothing comes."""
        if not self.finished:
            self._sink.idle(time)

    def finish(self) -> None:
        """End the sink, once."""
        if not self.finished:
            self.finished = True
            self._sink.finish()

    @property
    def ended(self) -> bool:
        """Whether every stream has ended."""
        return min(self._watermarks.values()) == END

    def progress(self) -> Progress:
        """How far every stream has been taken."""
        taken = min(self._watermarks.values())
        confirmed = {each.plan.key: each.handled_seq for each in self.inputs.values()}
        return Progress(self.node, END if self.finished else min(taken, END - 1), {}, confirmed)

    def state(self) -> dict[str, tuple[int, int]]:
        """By port the seq and stamp (ns) of the last sample taken."""
        return {port: (each.handled_seq, each.handled_stamp) for port, each in self.inputs.items()}

    def resume(self, state: Mapping[str, tuple[int, int]]) -> None:
        """Go on after the samples of `state`; raises SnapshotError when it is one of other ports."""
        if self.inputs.keys() != state.keys():
            raise SnapshotError(f"it has the inputs {listed(state)}; expected {listed(self.inputs)}")
        for port, (seq, stamp) in state.items():
            arrivals = self.inputs[port]
            arrivals.handled_seq, arrivals.handled_stamp = seq, stamp
            arrivals.expected, arrivals.last_stamp = seq + 1, stamp
            self._advance(port, stamp)

    def input_counts(self) -> dict[str, InputCounts]:
        """What became of every sample that came, per port."""
        for arrivals in self.inputs.values():
            arrivals.counts.waiting = len(arrivals.ahead)
        return {port: arrivals.counts for port, arrivals in self.inputs.items()}

    def _take(self, port: str, message: Sample, time: int) -> None:
        self._hand_on(port, self.inputs[port], message, self._payloads[port].pop(message.seq), time)

    def _hand_on(self, port: str, arrivals: Arrivals, message: Sample, payload: bytes, time: int) -> None:
        arrivals.counts.handled += 1
        arrivals.note_handled(message, time)
        self._sink.take(arrivals.plan.key, message, payload, time)
        self._advance(port, message.stamp)

    def _count_mark(self, port: str) -> None:
        watermark = self.inputs[port].arrived_mark()
        if watermark is not None:
            self._advance(port, watermark)

    def _advance(self, port: str, watermark: int) -> None:
        if watermark > self._watermarks[port]:
            self._watermarks[port] = watermark
