"""What the sources of a group bring: numbered, kept, sent, and handed to the members that read it."""

import threading
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Protocol

from caneflow.messages import Sample, decode
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import Brought, Opened, SourcesEnd, SourcesEnded, Started
from caneflow.runtime.hosts.process.group_recovery import AnyRecovery
from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.hosts.process.source_threads import SourceThreads
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.program import Encoded, Source
from caneflow.runtime.stages import journal
from caneflow.runtime.stages.byte_budget import WAITING
from caneflow.runtime.stages.group import Group

BATCH = 32  # samples of a replay that are handled together


class Host(Protocol):
    """The process, as its sources' threads see it."""

    plan: ProcessPlan
    bus: Bus
    group: Group
    outputs: dict[str, Outputs]
    recovery: dict[str, AnyRecovery]
    lock: threading.RLock

    @property
    def quick(self) -> bool:
        """Whether what comes is handled on the thread that brings it."""

    def do(self, work: Callable[[], None], *, follow: bool = True) -> None:
        """Do something with the lock held, and what follows; in a replay only if `follow`."""

    def step(self, now: int | None) -> bool:
        """Handle the next sample that is due; whether there was one."""

    def handle_what_is_due(self) -> bool:
        """Handle all that is due; whether more may be."""

    def break_down(self, error: BaseException) -> None:
        """End with an error."""


class LocalSources:
    """Takes what the threads of the sources bring, and orders for these."""

    def __init__(self, host: Host, sources: Mapping[str, Source]) -> None:
        self._host = host
        self.threads = SourceThreads(sources, self, host.lock, replay=host.plan.replay)
        self._replay = host.plan.replay
        self._feeds = host.group.feeds
        self._present = Present()
        self._brought = 0  # samples of a replay
        self._readers = {node: host.group.readers_of(node) for node in self._feeds}

    def hear(self, event: Brought | Started | Opened | SourcesEnd | SourcesEnded) -> None:
        """Take an event that is for the sources, or comes from them; with the lock held."""
        match event:
            case Brought():
                self.take(event.node, event.port, event.sample)
            case Started():
                self.threads.start()
            case Opened():
                self.threads.open(event.until)
            case SourcesEnd():
                self.threads.stop_and(lambda: self._host.bus.put(SourcesEnded()))
            case SourcesEnded():
                while self._host.handle_what_is_due():
                    pass
                self._host.bus.declare_gone(self._feeds)  # what they brought is sent: others may end

    def bring(self, node: str, port: str, sample: Sample | Encoded) -> None:
        """Take a sample, and do what follows; by the inbox while the process is not quick."""
        if self._replay:  # what is not handled here the process's own thread handles soon
            self._brought += 1
            self._host.do(partial(self.take, node, port, sample), follow=self._brought % BATCH == 0)
        elif self._host.quick:
            self._host.do(partial(self.take, node, port, sample))
        else:
            self._host.bus.put(Brought(node, port, sample))

    def nothing_until(self, node: str, stamp: int) -> None:
        """Take a source's word that no sample with a stamp (ns) at or before this will come."""
        self._host.do(partial(self._feeds[node].nothing_until, stamp, self._latest()))

    def has_room(self, node: str) -> bool:
        """Whether a source of a replay may bring more: readers outside, and members, hold no more than they may."""
        if not self._replay:
            return True
        full = self._host.outputs[node].full
        return not full and all(reader.held < WAITING // 2 for reader in self._readers[node])

    def source_ended(self, node: str) -> None:
        """Take a source's word that nothing more will come."""
        self._host.do(partial(setattr, self._feeds[node], "ended", True))

    def break_down(self, error: BaseException) -> None:
        """Let the process end with what a source has raised."""
        self._host.break_down(error)

    def take(self, node: str, port: str, sample: Sample | Encoded) -> None:
        """Number a sample, keep it, send it and hand it to the members that read it; with the lock held."""
        payload = self._feeds[node].take(port, sample, self._latest())
        if payload is not None:
            self._host.recovery[node].keep_brought(journal.Brought(node, port, payload))
            self._spread(node, port, payload)

    def catch_up(self, brought: Iterable[journal.Brought]) -> None:
        """Handle once more what the process before this one had brought after its snapshot; with the lock held."""
        for each in brought:
            node, port, payload = each.node, each.port, each.payload
            kind = self._feeds[node].outputs[port].plan.kind
            message = decode(payload, kind)
            again = self._feeds[node].take(port, Encoded(kind, message.stamp, message.seq, payload))
            if again is not None:
                self._spread(node, port, again)
                while self._host.step(None):
                    pass

    def _spread(self, node: str, port: str, payload: bytes) -> None:
        seq = self._feeds[node].outputs[port].sent - 1
        self._host.outputs[node].send_encoded(port, seq, payload)
        self._host.group.deliver(node, port, payload)

    def _latest(self) -> int | None:
        """The clock (ns) that no sample may lie far ahead of; a replay has none."""
        return None if self._replay else self._present.now()
