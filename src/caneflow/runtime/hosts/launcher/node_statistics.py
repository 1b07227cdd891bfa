"""What a launcher can tell of its running nodes: what they count, how fast, and what they cost."""

import os
import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import psutil

import caneflow
from caneflow.messages.control import Counters, Delays, EdgeStatus, FlowStatus, InputCounts, NodeStatus
from caneflow.runtime.plan import NodePlan

LOOK_PERIOD = 1.0  # s between two looks at what the processes cost
RATE_SPAN = 0.5  # s that two counts must at least lie apart for a rate between them
OLD = 1.0  # s of age at which a sample is taken: a position that is made of it looks right, and is not
TOO_SLOW = "this machine or the link is too slow (`caneflow top`), and positions are of then"
OTHER_CLOCK = 3600.0  # s of age above which stamps are taken for those of another clock


SILENT = "nothing was heard of it yet"  # of an external node


class ObservedNode(Protocol):
    """What the launcher knows of a node and is told here."""

    plan: NodePlan
    state: str
    pid: int
    restarts: int
    asked: int
    started_at: float
    counters: Counters | None
    last_line: str


@dataclass
class _Counted:
    """Two counts of one node, far enough apart for a rate."""

    at: float  # s, monotonic: the newer
    now: Counters
    before_at: float  # s, monotonic
    before: Counters

    def take(self, at: float, counters: Counters) -> None:
        if at - self.before_at >= RATE_SPAN + LOOK_PERIOD:
            self.before_at, self.before = self.at, self.now
        self.at, self.now = at, counters

    def rate(self, now: int, before: int) -> float | None:
        """Hz; None while there is no second count, or when the node was started again between them."""
        span = self.at - self.before_at
        return (now - before) / span if span >= RATE_SPAN and now >= before else None


@dataclass
class _Cost:
    """What one process takes."""

    process: psutil.Process
    cpu_s: float  # s of processor time, up to the last look
    at: float  # s, monotonic
    cpu: float | None = None  # of one core
    memory: int | None = None  # bytes, resident

    def look(self, now: float) -> None:
        with suppress(psutil.Error):  # it may have ended
            with self.process.oneshot():
                times = self.process.cpu_times()
                self.memory = self.process.memory_info().rss
            used = times.user + times.system
            if now > self.at:
                self.cpu = max(0.0, used - self.cpu_s) / (now - self.at)
            self.cpu_s, self.at = used, now


class NodeStatistics:
    """Counts and costs of the nodes of one launcher, over the last second or so."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._counted: dict[str, _Counted] = {}
        self._costs: dict[int, _Cost] = {}  # by pid
        self._next_look = 0.0
        self._old: set[tuple[str, str]] = set()  # node and input whose samples are too old, as was said

    def grown_old(self, counters: Counters) -> Iterator[str]:
        """A line for each input of a live node whose samples have become too old, and one when they no longer are."""
        for port, delays in counters.delays.items():
            age, wire = delays.handled, (counters.node, port)
            if age is None or age > OTHER_CLOCK:
                continue
            if age > OLD and wire not in self._old:
                self._old.add(wire)
                yield f"{port}: samples are {age:.1f} s old when they are handled: {TOO_SLOW}"
            elif age < OLD / 2 and wire in self._old:
                self._old.remove(wire)
                yield f"{port}: samples are {age:.1f} s old, as they should be"

    def note(self, counters: Counters) -> None:
        """Take what a node says that it counted."""
        now = time.monotonic()
        counted = self._counted.get(counters.node)
        if counted is None:
            self._counted[counters.node] = _Counted(now, counters, now, counters)
        else:
            counted.take(now, counters)

    def look(self, nodes: Iterable[ObservedNode]) -> None:
        """See what each process costs, once a second."""
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + LOOK_PERIOD
        running = {node.pid: node for node in nodes if node.pid}
        self._costs = {pid: cost for pid, cost in self._costs.items() if pid in running}
        for pid, node in running.items():
            if pid not in self._costs:
                with suppress(psutil.Error):
                    self._costs[pid] = _Cost(psutil.Process(pid), 0.0, node.started_at)
        for cost in self._costs.values():
            cost.look(now)

    def status(
        self, flow: str, machine: str, nodes: Mapping[str, ObservedNode], *, replay: bool, endpoint: str
    ) -> FlowStatus:
        """Everything, now."""
        now = time.monotonic()
        return FlowStatus(
            flow=flow,
            version=caneflow.__version__,
            host=platform.node(),
            pid=os.getpid(),
            uptime=now - self._since,
            replay=replay,
            clock=time.time_ns(),
            machine=machine,
            nodes=[self._node(name, node, now, machine, nodes) for name, node in nodes.items()],
            edges=[edge for name, node in nodes.items() for edge in self._edges(name, node)],
            rig=next((node.plan.rig for node in nodes.values()), {}),
            endpoint=endpoint,
        )

    def _node(
        self, name: str, node: ObservedNode, now: float, machine: str, nodes: Mapping[str, ObservedNode]
    ) -> NodeStatus:
        members = [other for other in nodes.values() if other.plan.runs_in == node.plan.runs_in]
        cost = self._costs.get(node.pid) if members[0] is node else None  # it belongs to the process
        counted = self._counted.get(name)
        sent = dict(counted.now.outputs) if counted else {}
        rates = {port: self._sent_rate(name, port) for port in node.plan.outputs}
        said = node.last_line
        if node.plan.external:  # it counts nothing for us: what its readers heard
            sent, rates = self._heard_of(node, nodes)
            said = said or ("" if any(sent.values()) else SILENT)
        return NodeStatus(
            node=name,
            program=node.plan.file or node.plan.module or "",
            state=node.state,
            pid=node.pid,
            restarts=node.restarts,
            asked=node.asked,
            uptime=now - (node.started_at or self._since),
            cpu=cost.cpu if cost else None,
            memory=cost.memory if cost else None,
            sent={port: sent.get(port, 0) for port in node.plan.outputs},
            rates=rates,
            counted=now - counted.at if counted else None,
            said=said,
            process=node.plan.runs_in if len(members) > 1 else "",
            machine=machine,
            listen=node.plan.links.listen,
            connect=node.plan.links.connect,
            held=counted.now.held if counted else 0,
            let_go=counted.now.let_go if counted else 0,
            settings=node.plan.settings,
        )

    def _heard_of(
        self, node: ObservedNode, nodes: Mapping[str, ObservedNode]
    ) -> tuple[dict[str, int], dict[str, float | None]]:
        """By output port of an external node how many samples a reader knows of, and at which rate (Hz) it got them."""
        sent, rates = dict.fromkeys(node.plan.outputs, 0), dict[str, float | None].fromkeys(node.plan.outputs)
        for port, out in node.plan.outputs.items():
            for reader, other in nodes.items():
                for own, wire in other.plan.inputs.items():
                    counted = self._counted.get(reader)
                    if wire.key == out.key and counted is not None:
                        counts = counted.now.inputs.get(own, InputCounts())
                        sent[port] = max(sent[port], counts.received + counts.lost)
                        rates[port] = self._received_rate(reader, own) or rates[port]
        return sent, rates

    def _edges(self, name: str, node: ObservedNode) -> Iterable[EdgeStatus]:
        counted = self._counted.get(name)
        for port, wire in node.plan.inputs.items():
            output = wire.key.rpartition("/")[2]
            counts = counted.now.inputs.get(port, InputCounts()) if counted else InputCounts()
            writer = self._counted.get(wire.writer)
            yield EdgeStatus(
                writer=f"{wire.writer}/{output}",
                reader=f"{name}.{port}",
                schema=wire.schema,
                sent=writer.now.outputs.get(output, 0) if writer else 0,
                received=counts.received,
                handled=counts.handled,
                waiting=counts.waiting,
                rate=self._received_rate(name, port),
                sender=writer.now.unsent.get(output, 0) if writer else 0,
                wire=counts.lost,
                decode=counts.refused,
                queue=counts.dropped,
                late=counts.late,
                repeated=counts.repeated,
                delays=counted.now.delays.get(port, Delays()) if counted else Delays(),
            )

    def _sent_rate(self, name: str, port: str) -> float | None:
        counted = self._counted.get(name)
        if counted is None:
            return None
        return counted.rate(counted.now.outputs.get(port, 0), counted.before.outputs.get(port, 0))

    def _received_rate(self, name: str, port: str) -> float | None:
        counted = self._counted.get(name)
        if counted is None or port not in counted.now.inputs or port not in counted.before.inputs:
            return None
        return counted.rate(counted.now.inputs[port].received, counted.before.inputs[port].received)
