"""Several stages with wires between them, on no host in particular.

A sample goes from one member to the next by a call; what goes beyond the group is handed to the host. Nothing here
knows Zenoh, threads or a clock.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from caneflow.messages import MessageError, Sample, decode, encode, with_number
from caneflow.messages.control import Counters, PortMark
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Encoded, Operator, Sink, Source
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.source_stage import Feed

Reader: TypeAlias = Stage | Tap
Emitted: TypeAlias = list[tuple[str, Sample, int]]  # what a node has sent: (port, message, seq)


class Group:
    """Nodes that run together: samples between them are decoded once, and never encoded for each other."""

    def __init__(
        self,
        plans: Mapping[str, NodePlan],
        received: Callable[[str, str, Sample], int],
        working: Callable[[str], None] | None = None,
        *,
        spares_marks: bool = False,
    ) -> None:
        """The members to be; `add` each.

        `received`: the time (ns) at which a node takes a sample on a port. `working`: is told whose turn it is.
        `spares_marks`: those that say no more than the samples pass only when `tell_all_marks` asks for it.
        """
        self._working = working
        self._spares_marks = spares_marks
        self._tells_all = True
        self.feeds: dict[str, Feed] = {}
        self.readers: dict[str, Reader] = {}  # writers before their readers
        self.held: set[str] = set()  # those that handle nothing: what they have sent has to be taken first
        self._received = received
        self._order = in_order(plans)
        self._plans = plans
        self._wires: dict[tuple[str, str], list[tuple[str, str]]] = {  # (node, port) -> its local readers' ports
            (name, port): [] for name, plan in plans.items() for port in plan.outputs
        }
        for name in self._order:
            for port, wire in plans[name].inputs.items():
                if wire.writer in plans:
                    self._wires.setdefault((wire.writer, wire.key.rpartition("/")[2]), []).append((name, port))
        self._heard = {name for (name, _), readers in self._wires.items() if readers}  # by other members
        self._steps: list[tuple[str, Reader]] = []
        self._next = 0  # of those: where `step` goes on

    def add(self, plan: NodePlan, built: Operator | Source | Sink) -> Feed | Reader:
        """The stage of a member's program."""
        if isinstance(built, Source):
            feed = self.feeds[plan.node] = Feed(plan.node, plan.outputs, ordered=built.ordered)
            return feed
        if isinstance(built, Sink):
            self.readers[plan.node] = Tap(plan.node, built, plan.inputs)
        else:
            self.readers[plan.node] = Stage(plan.node, built, plan.inputs, plan.outputs)
        self._steps = [(name, self.readers[name]) for name in self._order if name in self.readers]
        return self.readers[plan.node]

    def bring(self, node: str, port: str, sample: Sample | Encoded, now: int | None = None) -> bytes | None:
        """Let what a source brings reach its local readers, decoded once; the bytes to send, None: it cannot be sent.

        `now` (ns) is the host's clock, given by a live host only: no stamp may lie far ahead of it.
        """
        payload = self.feeds[node].take(port, sample, now)
        if payload is not None:
            self.deliver(node, port, payload)
        return payload

    def deliver(self, node: str, port: str, payload: bytes) -> None:
        """Hand the bytes of a source's sample, which has its number, to its local readers."""
        readers = self._wires[node, port]
        if not readers:
            return
        try:
            message = decode(payload, self.feeds[node].outputs[port].plan.kind)
        except MessageError as error:
            for reader, at in readers:
                self.refuse(reader, at, error)
        else:
            self._spread(node, port, message, payload)

    def take(
        self, node: str, port: str, message: Sample, payload: bytes | None, time: int, *, again: bool = False
    ) -> None:
        """Take a sample that came to a member at `time` (ns); `payload`: its bytes, where there are any yet."""
        self._next = 0
        if self._working is not None:
            self._working(node)
        reader = self.readers[node]
        if isinstance(reader, Stage):
            reader.offer(port, message, again=again)
        else:
            reader.offer(port, message, payload or encode(message), time, again=again)

    def take_at_once(self, node: str, port: str, message: Sample, now: int | None) -> Emitted | None:
        """`take` and `step` in one, for a sample to an operator that is next and due; None: nothing was done."""
        stage = self.readers[node]
        emitted = stage.handle_at_once(port, message, now) if isinstance(stage, Stage) else None
        if emitted:
            self._spread_all(node, emitted)
        return emitted

    def refuse(self, node: str, port: str, error: MessageError) -> None:
        """Count a sample to a member that could not be decoded."""
        self._next = 0
        self.readers[node].refuse(port, error)

    def refuse_ahead(
        self, node: str, port: str, message: Sample, ahead: int, time: int, *, again: bool = False
    ) -> None:
        """Refuse a live sample that is stamped `ahead` ns in the future."""
        self._next = 0
        reader = self.readers[node]
        if isinstance(reader, Stage):
            reader.refuse_ahead(port, message, ahead, again=again)
        else:
            reader.refuse_ahead(port, message, ahead, time, again=again)

    def skip_to(self, node: str, port: str, seq: int, time: int) -> None:
        """Stop waiting for samples before `seq` that were sent to a member's port and did not arrive."""
        self._next = 0
        reader = self.readers[node]
        if isinstance(reader, Stage):
            reader.skip_to(port, seq)
        else:
            reader.skip_to(port, seq, time)

    def mark(self, node: str, port: str, mark: PortMark) -> None:
        """Take a writer's word on how far the stream to a member's port has come."""
        self._next = 0
        self.readers[node].mark(port, mark)

    def step(self, now: int | None = None) -> tuple[str, Emitted] | None:
        """Handle the next sample that is due, writers first: the node, and what it has sent. None: nothing is due.

        `now` (ns) is the host's clock, given by a live host only: inputs may have a greatest age.
        """
        if self._next == 0:
            for name, feed in self.feeds.items():
                if name in self._heard and (self._passes_all or feed.tells_more_than_samples()):
                    self._pass_marks(name, feed)
        while self._next < len(self._steps):
            name, reader = self._steps[self._next]
            if isinstance(reader, Tap):
                if reader.ended:
                    reader.finish()
            elif name not in self.held:
                if self._working is not None:
                    self._working(name)
                if (emitted := reader.step(now)) is not None:
                    self._spread_all(name, emitted)
                    return name, emitted
                if name in self._heard and (self._passes_all or reader.finished or reader.tells_more_than_samples()):
                    self._pass_marks(name, reader)
            self._next += 1
        self._next = 0
        self._tells_all = False
        return None

    def tell_all_marks(self) -> None:
        """Let the next round of `step` pass all marks between members."""
        self._tells_all = True

    @property
    def _passes_all(self) -> bool:
        return self._tells_all or not self._spares_marks

    def writer(self, node: str) -> Feed | Stage:
        """The stage of a member that sends."""
        if node in self.feeds:
            return self.feeds[node]
        stage = self.readers[node]
        assert isinstance(stage, Stage)
        return stage

    def local_ports(self, node: str) -> list[str]:
        """The ports of a member that other members write to."""
        return [port for port, wire in self._plans[node].inputs.items() if wire.writer in self._plans]

    def readers_of(self, node: str) -> list[Reader]:
        """The members that read what `node` sends."""
        names = {reader for (name, _), wires in self._wires.items() if name == node for reader, _ in wires}
        return [self.readers[name] for name in names]

    def idle(self, time: int) -> None:
        """Give the sinks a moment when nothing comes, at `time` (ns)."""
        for reader in self.readers.values():
            if isinstance(reader, Tap):
                reader.idle(time)

    def finish(self) -> None:
        """End the sinks, each once."""
        for reader in self.readers.values():
            if isinstance(reader, Tap):
                reader.finish()

    def counters(self) -> Iterator[Counters]:
        """What became of each member's samples."""
        for name, feed in self.feeds.items():
            sent = {port: out.sent for port, out in feed.outputs.items()}
            yield Counters(node=name, inputs={}, outputs=sent, refused=feed.refused, unsent=dict(feed.unsent))
        for name, reader in self.readers.items():
            outputs = {} if isinstance(reader, Tap) else {port: out.sent for port, out in reader.outputs.items()}
            yield Counters(node=name, inputs=reader.input_counts(), outputs=outputs)

    def _spread_all(self, node: str, emitted: Emitted) -> None:
        for port, message, seq in emitted:
            if self._wires[node, port]:
                self._spread(node, port, with_number(message, seq), None)

    def _spread(self, node: str, port: str, message: Sample, payload: bytes | None) -> None:
        """Hand one sample to all its local readers."""
        for reader, at in self._wires[node, port]:
            self.take(reader, at, message, payload, self._received(reader, at, message))

    def _pass_marks(self, name: str, writer: Feed | Stage) -> None:
        for port, mark in writer.progress().ports.items():
            for reader, at in self._wires[name, port]:
                self.readers[reader].mark(at, mark)


def in_order(plans: Mapping[str, NodePlan]) -> list[str]:
    """The nodes, writers before their readers; the graph has been checked to have no cycle."""
    done: dict[str, None] = {}
    while len(done) < len(plans):
        for name, plan in plans.items():
            if all(wire.writer in done or wire.writer not in plans for wire in plan.inputs.values()):
                done.setdefault(name)
    return list(done)
