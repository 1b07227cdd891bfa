"""One node as a process: `run(Program)` is the last line of every program file.

The launcher starts `python -m <program> <plan>`; the plan says what to read, what to write and whom to dial.
"""

import logging
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from caneflow.errors import CaneflowError
from caneflow.messages import MessageError, Sample, decode, numbered
from caneflow.messages.control import Counters, Progress
from caneflow.messages.rig import read_rig
from caneflow.runtime.bus import Arrived, Bus, Event, Marked, Noted, Opened, Started, Stopped, check_schema
from caneflow.runtime.feed import Feed
from caneflow.runtime.merge import BEGIN, END
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Context, Operator, Program, Quiet, Sink, Source
from caneflow.runtime.programs import validated_settings
from caneflow.runtime.seeds import generator
from caneflow.runtime.stage import Stage
from caneflow.runtime.tap import Tap

log = logging.getLogger(__name__)

REPORT_PERIOD = 0.02  # s between two progress marks under load
COUNTERS_PERIOD = 1.0  # s
MISSING_AFTER = 2.0  # s after which a sample that was sent and has not come is lost


def run(program: Program) -> None:
    """Run `program` as the node that the plan on the command line describes; the process ends with it."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.INFO, stream=sys.stderr)
    try:
        sys.exit(_run(program, NodePlan.read(Path(sys.argv[1]))))
    except IndexError:
        sys.exit(f"usage: {sys.argv[0]} PLAN; a node is started by `caneflow run`")
    except CaneflowError as error:
        log.error("%s", error)
        sys.exit(2)


def build(program: Program, plan: NodePlan) -> Operator | Source | Sink:
    """The program's object with its settings, rig and random numbers, as every host makes it."""
    settings = validated_settings(program, plan.settings)
    ports = plan.outputs if issubclass(program, Source) else plan.inputs
    kinds = {port: wire.kind for port, wire in ports.items()}
    random = generator(plan.seed, plan.node)
    return program(settings, Context(node=plan.node, rig=read_rig(plan.rig), ports=kinds, random=random))


def _run(program: Program, plan: NodePlan) -> int:
    built = build(program, plan)
    with Bus(plan) as bus:
        signal.signal(signal.SIGINT, lambda *_: None)  # the launcher decides when a node ends
        if isinstance(built, Source):
            _SourceNode(plan, bus, built).run()
            return 0
        signal.signal(signal.SIGTERM, lambda *_: bus.put(Stopped()))
        if isinstance(built, Sink):
            _SinkNode(plan, bus, built).run()
        else:
            _OperatorNode(plan, bus, built).run()
    return 0


class _Reports:
    """When a node says how far it has come: at once when its readers need to know, else now and then."""

    def __init__(self, bus: Bus, period: float) -> None:
        self._bus = bus
        self._period = period
        self.said: Progress | None = None
        self._next_progress = 0.0
        self._next_counters = time.monotonic() + COUNTERS_PERIOD

    def due(self) -> bool:
        return time.monotonic() >= self._next_progress

    def progress(self, progress: Progress) -> None:
        if progress != self.said:
            self._bus.send_progress(progress)
            self.said = progress
        self._next_progress = time.monotonic() + self._period

    def counters(self, counters: Counters, *, at_once: bool = False) -> None:
        if at_once or time.monotonic() >= self._next_counters:
            self._bus.send_counters(counters)
            self._next_counters = time.monotonic() + COUNTERS_PERIOD


class _ReaderNode(ABC):
    """What a node with inputs does on a bus, whether operator or sink."""

    def __init__(self, plan: NodePlan, bus: Bus, reader: Stage | Tap) -> None:
        self.plan = plan
        self.bus = bus
        self.reader = reader
        self.reports = _Reports(bus, REPORT_PERIOD if plan.replay else 5 * REPORT_PERIOD)
        self.stopped = False
        self._missing_since: dict[str, float] = {}

    def take_events(self, timeout: float) -> bool:
        """Take what came, waiting up to `timeout` s for it; whether anything came."""
        came = False
        for event in self.bus.events(timeout):
            came = True
            self.take(event)
        return came

    def take(self, event: Event) -> None:
        match event:
            case Arrived():
                self.take_sample(event)
            case Marked():
                self.reader.mark(event.port, event.mark)
            case Noted() if isinstance(self.reader, Tap):
                self.reader.note(event.key, event.payload, time.time_ns())
            case Stopped():
                self.stopped = True
            case _:
                pass  # for sources

    def take_sample(self, arrived: Arrived) -> None:
        wire = self.plan.inputs[arrived.port]
        try:
            check_schema(arrived, wire)
            message = decode(arrived.payload, wire.kind)
        except MessageError as error:
            self.reader.refuse(arrived.port, error)
            return
        self.take_message(arrived, message)

    @abstractmethod
    def take_message(self, arrived: Arrived, message: Sample) -> None:
        """Take a sample that could be decoded."""

    def give_up_missing(self) -> None:
        """Take samples as lost that were sent and have not come for long: their mark must not wait for ever."""
        now = time.monotonic()
        for port, arrivals in self.reader.inputs.items():
            if arrivals.mark is None:
                self._missing_since.pop(port, None)
            elif now - self._missing_since.setdefault(port, now) > MISSING_AFTER:
                self.reader.give_up(port)

    def count(self, outputs: dict[str, int], *, at_once: bool = False) -> None:
        counters = Counters(node=self.plan.node, inputs=self.reader.input_counts(), outputs=outputs)
        self.reports.counters(counters, at_once=at_once)


class _OperatorNode(_ReaderNode):
    def __init__(self, plan: NodePlan, bus: Bus, operator: Operator) -> None:
        self.stage = Stage(plan.node, operator, plan.inputs, plan.outputs)
        super().__init__(plan, bus, self.stage)
        # Live: for each input that may lag, when the samples of the others came, and their stamps.
        self._others: dict[str, deque[tuple[float, int]]] = {
            port: deque() for port, wire in plan.inputs.items() if wire.max_lag_ms is not None and not plan.replay
        }

    def run(self) -> None:
        self.bus.declare_ready()
        while not self.stopped:
            self.take_events(timeout=REPORT_PERIOD)
            self.handle_what_is_due()
            self.give_up_missing()
            self.wait_no_longer_than_allowed()
            self.report()
        self.count(self.sent(), at_once=True)

    def take_message(self, arrived: Arrived, message: Sample) -> None:
        for port, others in self._others.items():
            if port != arrived.port:
                others.append((time.monotonic(), message.stamp))
        self.stage.offer(arrived.port, message)

    def handle_what_is_due(self) -> None:
        now = None if self.plan.replay else time.time_ns()
        while (emitted := self.stage.step(now)) is not None:
            for port, message, seq in emitted:
                self.bus.send(port, numbered(message, seq))
            if self.reports.due():
                self.reports.progress(self.stage.progress())
            if self.bus.pending():
                self.take_events(timeout=0)

    def wait_no_longer_than_allowed(self) -> None:
        """Live: go on without an input that holds up what came longer than its max_lag_ms ago."""
        now = time.monotonic()
        for port, others in self._others.items():
            limit = self.plan.inputs[port].max_lag_ms or 0.0
            until = None
            while others and (now - others[0][0]) * 1e3 > limit:
                _, until = others.popleft()
            if until is not None:
                self.stage.go_on_without(port, until)
                self.handle_what_is_due()

    def report(self) -> None:
        for note in self.stage.left_out():
            self.bus.send_left_out(note)
        progress = self.stage.progress()
        if self.stage.finished or self.stage.tells_more_than_samples() or self.reports.due():
            if self.stage.finished:
                self.count(self.sent(), at_once=progress != self.reports.said)
            self.reports.progress(progress)
        self.count(self.sent())

    def sent(self) -> dict[str, int]:
        return {port: out.sent for port, out in self.stage.outputs.items()}


class _SinkNode(_ReaderNode):
    def __init__(self, plan: NodePlan, bus: Bus, sink: Sink) -> None:
        self.tap = Tap(plan.node, sink, plan.inputs)
        super().__init__(plan, bus, self.tap)

    def run(self) -> None:
        try:
            self.bus.declare_ready()
            while not self.stopped:
                if not self.take_events(timeout=REPORT_PERIOD):
                    self.tap.idle(time.time_ns())
                self.give_up_missing()
                if self.tap.ended and not self.tap.finished:
                    self.tap.finish()
                    self.count({}, at_once=True)
                if self.reports.due() or self.tap.finished:
                    self.reports.progress(self.tap.progress())
                self.count({})
        finally:
            self.tap.finish()
        self.count({}, at_once=True)

    def take_message(self, arrived: Arrived, message: Sample) -> None:
        self.tap.offer(arrived.port, message, arrived.payload, time.time_ns())


class _Ended(BaseException):
    """Raised in the main thread by SIGTERM: a source may be blocked in a read of its device."""


class _SourceNode:
    def __init__(self, plan: NodePlan, bus: Bus, source: Source) -> None:
        self.plan = plan
        self.bus = bus
        self.source = source
        self.feed = Feed(plan.node, plan.outputs, ordered=source.ordered)
        self.reports = _Reports(bus, REPORT_PERIOD if plan.replay else 5 * REPORT_PERIOD)
        self.started = False
        self.until = BEGIN if plan.replay else END  # how far a replay may send

    def run(self) -> None:
        try:
            with _ended_by_sigterm():
                self.bus.declare_ready()
                while not self.started:
                    self.take_events(timeout=None)
                self.send_all()
                self.end()
        except _Ended:
            self.count(at_once=True)

    def send_all(self) -> None:
        samples = self.source.samples()
        try:
            for item in samples:
                if isinstance(item, Quiet):
                    self.feed.nothing_until(item.until)
                    self.reports.progress(self.feed.progress())
                    continue
                port, sample = item
                self.wait_for_window(sample.stamp)
                payload = self.feed.take(port, sample)
                if payload is not None:
                    self.bus.send(port, payload)
                if self.reports.due():
                    self.reports.progress(self.feed.progress())
                    self.count()
        finally:
            samples.close()

    def wait_for_window(self, stamp: int) -> None:
        """Hold a replay's sample back until the readers have come near enough."""
        if self.bus.pending():
            self.take_events(timeout=0)
        while stamp > self.until:
            self.feed.nothing_until(stamp - 1)
            self.reports.progress(self.feed.progress())
            self.take_events(timeout=None)

    def take_events(self, timeout: float | None) -> None:
        for event in self.bus.events(timeout):
            match event:
                case Started():
                    self.started = True
                case Opened():
                    self.until = max(self.until, event.until)
                case _:
                    pass  # a source has no inputs

    def end(self) -> None:
        """Say that nothing more will come, and stay until the launcher ends the flow."""
        self.feed.ended = True
        self.count(at_once=True)
        self.reports.progress(self.feed.progress())
        while True:
            self.take_events(timeout=None)

    def count(self, *, at_once: bool = False) -> None:
        sent = {port: out.sent for port, out in self.feed.outputs.items()}
        counters = Counters(node=self.plan.node, inputs={}, outputs=sent, refused=self.feed.refused)
        self.reports.counters(counters, at_once=at_once)


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    def end(*_: object) -> None:
        raise _Ended

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
