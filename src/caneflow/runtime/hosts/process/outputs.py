"""Samples for other processes: sent, kept until confirmed, sent again on request."""

from caneflow.messages import numbered
from caneflow.messages.control import Again, PortMark
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import Confirmed, HistoryAsked
from caneflow.runtime.plan import NodePlan, ProcessPlan
from caneflow.runtime.stages.group import Emitted
from caneflow.runtime.stages.sent_samples import History


class Outputs:
    """The outputs of one node."""

    def __init__(self, plan: NodePlan, process: ProcessPlan, bus: Bus) -> None:
        self._node = plan.node
        self._bus = bus
        # Some outside wait for a mark of this node's.
        self.awaited = any(
            out.awaited and (process.readers_outside(out) or not process.is_group) for out in plan.outputs.values()
        )
        readers = {port: process.readers_outside(out) for port, out in plan.outputs.items()}
        self._read = {port for port, names in readers.items() if names or not process.is_group}
        # In a replay it waits while what it has sent is too much, live it forgets the oldest.
        budgets = {port: out.budget for port, out in plan.outputs.items()}
        self.history = History(readers, budgets, waits=plan.replay)

    @property
    def full(self) -> bool:
        """Whether the readers have to come on before more is sent."""
        return bool(self.history.full)

    def send(self, emitted: Emitted) -> None:
        """Send what an operator has emitted."""
        for port, message, seq in emitted:
            if port in self._read or self._bus.is_heard(self._node, port):
                self.send_encoded(port, seq, numbered(message, seq))

    def send_encoded(self, port: str, seq: int, payload: bytes) -> None:
        """Send a sample that has its bytes."""
        self.history.keep(port, seq, payload)
        if port in self._read or self._bus.is_heard(self._node, port):
            self._bus.send(self._node, port, payload)

    def send_again(self) -> None:
        """Send what readers may not have got before a kill."""
        for port, samples in self.history.kept().items():
            for kept in samples:
                self._bus.send(self._node, port, kept.payload)

    def confirm(self, confirmed: Confirmed) -> None:
        """Forget what a reader will not ask for again."""
        self.history.confirm(confirmed.port, confirmed.reader, confirmed.seq)

    def asked(self, asked: HistoryAsked, mark: PortMark) -> tuple[list[bytes], Again]:
        """What a reader asks for again, as far as it is there, and its end; `mark`: how far the stream has come."""
        return self.history.since(asked.port, asked.first), Again(self.history.first(asked.port), mark)
