"""One node as a process: `run(Program)` is the last line of every program file.

The launcher starts `python -m <program> <plan>`; the plan says what to read, what to write and whom to dial.
"""

import logging
import math
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from caneflow.messages import MessageError, Sample, decode, numbered
from caneflow.messages.control import Again, Clock, Counters, PortMark, Progress
from caneflow.runtime.building import build
from caneflow.runtime.hosts.process.bus import (
    Answered,
    Arrived,
    Asked,
    AskEnded,
    Broken,
    Bus,
    Confirmed,
    Event,
    Marked,
    Noted,
    Opened,
    Questioned,
    Started,
    Stopped,
    Timed,
    check_schema,
)
from caneflow.runtime.hosts.process.last_words import telling_failures
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.hosts.process.recent_delays import RecentDelays
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Encoded, Operator, Program, Quiet, Sink, Source
from caneflow.runtime.stages.byte_budget import WAITING, weight
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.sent_samples import History
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.snapshot_keeper import SnapshotKeeper
from caneflow.runtime.stages.source_stage import Feed
from caneflow.runtime.stages.streams import AHEAD_KEPT
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

REPORT_PERIOD = 0.02  # s between two progress marks under load
LIVE_REPORT_PERIOD = 0.5  # s, in a live run: who waits for a mark gets it at once
LIVE_LOOK_PERIOD = 0.1  # s after which a live node looks at what is due by time, though nothing came
LOOKS_PER_LAG = 5  # and so often within the time that it may wait for an input
COUNTERS_PERIOD = 1.0  # s
SAY_AGAIN_PERIOD = 1.0  # s after which a progress mark is said again: the last one may have met a broken link
ASK_PERIOD = 0.3  # s between two requests for samples that have not come
LIVE_PATIENCE = 1.0  # s that later samples wait for them in a live run, while their writer sends and does not answer
SILENT_PATIENCE = 10.0  # s, likewise, while it does neither: it may be busy, and nothing else comes that has to wait
REPLAY_PATIENCE = 60.0  # s, likewise in a replay: nothing is to be lost, and its writer may be coming back
SNAPSHOT_PERIOD = 0.5  # s between two snapshots of an operator
LIVE_SNAPSHOT_PERIOD = 2.0  # s, live: each is work, and wear of the disk; to catch up on so little is soon done
QUICK = 0.002  # s of CPU: a node that takes longer for an event is not quick ...
STALLED = 0.05  # s of the clock: nor is one that takes so long, waiting; less can be a machine with much else to do
MOST_SLOW = (
    0.25  # ... and when so great a share of the last 64 or so was slow, Zenoh's threads do not wait for it any more
)


def run(program: Program) -> None:
    """Run `program` as the node that the plan on the command line describes; the process ends with it."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.INFO, stream=sys.stderr)
    if len(sys.argv) < 2:
        sys.exit(f"usage: {sys.argv[0]} PLAN; a node is started by `caneflow run`")
    with telling_failures():
        path = Path(sys.argv[1])
        plan = NodePlan.read(path)
        folder = path.parent if plan.state_folder is None else Path(plan.state_folder)
        _run(program, plan, folder / f"{plan.node}.snapshot")
    sys.exit(0)


def _run(program: Program, plan: NodePlan, snapshots: Path) -> None:
    with telling_failures(building=True):
        built = build(program, plan)
    with Bus(plan) as bus:
        signal.signal(signal.SIGINT, lambda *_: None)  # the launcher decides when a node ends
        node: _SourceNode | _SinkNode | _OperatorNode
        if isinstance(built, Source):
            node = _SourceNode(plan, bus, built)
        else:
            signal.signal(signal.SIGTERM, lambda *_: bus.put(Stopped()))
            if isinstance(built, Sink):
                node = _SinkNode(plan, bus, built)
            else:
                node = _OperatorNode(plan, bus, built, snapshots)
        with telling_failures(at=node.at):
            node.run()


def _history(plan: NodePlan) -> History:
    """What the node has sent: in a replay it waits while that is too much, live it forgets the oldest."""
    readers = {port: out.readers for port, out in plan.outputs.items()}
    return History(readers, {port: out.budget for port, out in plan.outputs.items()}, waits=plan.replay)


class _Reports:
    """When a node says how far it has come: at once when its readers need to know, else now and then."""

    def __init__(self, bus: Bus, period: float) -> None:
        self._bus = bus
        self._period = period
        self.said: Progress | None = None
        self._next_progress = 0.0
        self._say_again = 0.0
        self._next_counters = time.monotonic() + COUNTERS_PERIOD

    def due(self) -> bool:
        return time.monotonic() >= self._next_progress

    def progress(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress != self.said or now >= self._say_again:
            self._bus.send_progress(progress)
            self.said = progress
            self._say_again = now + SAY_AGAIN_PERIOD
        self._next_progress = now + self._period

    def counters_due(self) -> bool:
        return time.monotonic() >= self._next_counters

    def counters(self, counters: Counters, *, at_once: bool = False) -> None:
        if at_once or self.counters_due():
            self._bus.send_counters(counters)
            self._next_counters = time.monotonic() + COUNTERS_PERIOD


@dataclass
class _Missing:
    """Samples that were sent and have not come."""

    expected: int  # seq of the first of them
    newest: int  # seq that the writer had sent then
    since: float  # s, monotonic
    ask_at: float  # s, monotonic


class _ReaderNode(ABC):
    """What a node with inputs does on a bus, whether operator or sink."""

    history: History | None = None  # what it has sent; a sink sends nothing

    def __init__(self, plan: NodePlan, bus: Bus, reader: Stage | Tap) -> None:
        self.plan = plan
        self.bus = bus
        self.reader = reader
        self.reports = _Reports(bus, REPORT_PERIOD if plan.replay else LIVE_REPORT_PERIOD)
        self.stopped = False
        self.present = Present()
        self._delays = {port: RecentDelays(live=not plan.replay) for port in plan.inputs}
        self._missing: dict[str, _Missing] = {}
        # Each writer is asked at the start what it has sent so far, until it answers: a node that is started anew may
        # have missed its last word, and the link to the writer may not be there yet.
        asked = [port for port, wire in plan.inputs.items() if not wire.external]
        self._unanswered = dict.fromkeys(asked, 0.0)  # s, monotonic: when to ask next
        self._asking: set[str] = set()  # ports whose writer is being asked: what it answers may wait to be looked at
        self._dropped = dict.fromkeys(plan.inputs, 0)  # unseen, as was counted
        reader.bound(WAITING)
        self.lock = threading.RLock()  # over all of this node's state
        self._quick = True
        self._slow = 0.0  # share of events
        lags = [1e-3 * wire.max_lag_ms / LOOKS_PER_LAG for wire in plan.inputs.values() if wire.max_lag_ms is not None]
        self.look_period = REPORT_PERIOD if plan.replay else max(min([LIVE_LOOK_PERIOD, *lags]), REPORT_PERIOD / 4)
        self._came = False  # anything, at once, since this was last looked at
        self._broken: BaseException | None = None  # what was raised at once: the node handles and keeps nothing more
        for port, arrivals in reader.inputs.items():
            arrivals.patient = not plan.inputs[port].external
            arrivals.clock_offset = None if plan.inputs[port].clock else 0

    def at(self) -> str | None:
        """The sample that is being handled, or was last; None: the node has not begun."""
        if not self.bus.ready:
            return None
        handled = [
            (each.handled_at or 0, each.handled_stamp, order, f"{port} seq {each.handled_seq}")
            for order, (port, each) in enumerate(self.reader.inputs.items())
            if each.handled_seq >= 0
        ]
        return max(handled)[-1] if handled else "the first"

    def raise_if_broken(self) -> None:
        """Raise here what was raised on the thread that brought a sample; with the lock held."""
        if self._broken is not None:
            raise self._broken

    def take_events(self, timeout: float) -> bool:
        """Take what came, waiting up to `timeout` s for it; whether anything came."""
        came = False
        for event in self.bus.events(timeout):
            came = True
            with self.lock:
                self.take(event)
        came, self._came = came or self._came, False
        return came

    def take_at_once(self, event: Event) -> bool:
        """Take an event and do what follows, on the thread that brought it; False: not here.

        That spares waking the node's own thread for every sample. Live it is the thread that receives: a node that is
        not quick would hold up everything else on its links, and its queues would not see what waits. In a replay a
        put may block, so samples come on threads of their own, and all else, which does not, is left to the node's.
        """
        if not self._quick or (self.plan.replay and type(event) is not Arrived):
            return False
        with self.lock:
            if not self._quick:  # it has ended meanwhile, or become slow
                return False
            try:
                if not self.plan.replay:
                    self.take_and_time(event)
                elif isinstance(event, Arrived):
                    self.take_sample_at_once(event)
                    self.between_samples()
            except BaseException as error:
                self._quick = False
                self._broken = error
                self.bus.put(Broken(error))
            self._came = True
        return True

    def take_and_time(self, event: Event) -> None:
        """Take an event and do what follows; judge by the time whether this node is quick."""
        began, worked = time.monotonic(), time.thread_time()
        if type(event) is Arrived:  # as nearly all are
            self.take_sample_at_once(event)
        else:
            self.take(event)
            self.follow_up(event)
        took = time.monotonic() - began
        slow = took > STALLED or (took > QUICK and time.thread_time() - worked > QUICK)
        self._slow += (slow - self._slow) / 64
        if self._slow > MOST_SLOW:
            self._quick = False

    def take_sample_at_once(self, arrived: Arrived) -> None:
        """Take a sample and do what follows."""
        self.take(arrived)
        if self.reader.inputs[arrived.port].ahead:
            self.ask_for_missing()
        self.follow_up(arrived)

    @abstractmethod
    def between_samples(self) -> None:
        """In a replay, whose samples may come without end: do what else the node's own thread does."""

    @abstractmethod
    def follow_up(self, event: Event) -> None:
        """Do what an event makes possible that was taken at once."""

    def take_no_more(self) -> None:
        """From here on what comes waits in the inbox."""
        with self.lock:
            self._quick = False

    def take(self, event: Event) -> None:
        match event:
            case Arrived():
                message = self.decoded(event)
                if message is not None:
                    self.take_message(event, message)
            case Answered():
                self._unanswered.pop(event.port, None)
                self.begin_at(event.port, event.first)
                self.take_mark(event.port, event.mark)
                if event.first > self.reader.inputs[event.port].expected:
                    self.skip_to(event.port, event.first)  # the writer does not have what lies before it any more
            case AskEnded():
                self._asking.discard(event.port)
            case Marked():
                self.take_mark(event.port, event.mark)
            case Noted() if isinstance(self.reader, Tap):
                self.reader.note(event.key, event.payload, time.time_ns())
            case Timed():
                self.set_clock(event.clock)
            case Stopped():
                self.stopped = True
            case Broken(error):
                raise error
            case _:
                pass  # for sources

    def take_mark(self, port: str, mark: PortMark) -> None:
        """Take a writer's word on how far it has come, unless it lies where it cannot be yet."""
        arrivals = self.reader.inputs[port]
        ahead = None if self.plan.replay else arrivals.ahead_of(mark.watermark, self.present.now())
        if ahead is None:
            self.reader.mark(port, mark)
        else:
            arrivals.refuse_mark(ahead)

    def set_clock(self, clock: Clock) -> None:
        """Take note of how far a writer's clock is from this machine's."""
        now = clock.offset + clock.drift * (time.time_ns() - clock.at) / 1e9
        for port, wire in self.plan.inputs.items():
            if wire.clock == clock.there:
                self.reader.inputs[port].clock_offset = round(now * 1e9)

    def decoded(self, arrived: Arrived) -> Sample | None:
        """The sample that came, its delays noted; None when it is refused, and counted."""
        wire = self.plan.inputs[arrived.port]
        try:
            check_schema(arrived, wire)
            message = decode(arrived.payload, wire.kind)
        except MessageError as error:
            self.reader.refuse(arrived.port, error)
            return None
        arrivals = self.reader.inputs[arrived.port]
        if not self.plan.replay and (ahead := arrivals.ahead_of(message.stamp, self.present.now())) is not None:
            self.refuse_ahead(arrived, message, ahead)
            return None
        offset = arrivals.clock_offset
        if not (self.plan.replay or arrived.again):
            self._unanswered.pop(arrived.port, None)  # live: what is missing before it shows by its number
        if offset is not None and (arrived.sent_at or not (self.plan.replay or arrived.again)):
            sent_at = arrived.sent_at and arrived.sent_at - offset
            self._delays[arrived.port].note(time.time_ns(), sent_at, message.stamp - offset)
        return message

    @abstractmethod
    def refuse_ahead(self, arrived: Arrived, message: Sample, ahead: int) -> None:
        """Refuse a sample that is stamped `ahead` ns in the future."""

    @abstractmethod
    def take_message(self, arrived: Arrived, message: Sample) -> None:
        """Take a sample that could be decoded."""

    def ask_for_missing(self) -> None:
        """Ask for samples that were sent and have not come; after long enough, go on without them."""
        now = time.monotonic()
        for port, ask_at in self._unanswered.items():
            if now >= ask_at and self.ask(port):
                self._unanswered[port] = now + ASK_PERIOD
        for port, arrivals in self.reader.inputs.items():
            before = arrivals.missing_before
            if before is None:
                self._missing.pop(port, None)
                continue
            missing = self._missing.get(port)
            if missing is None or missing.expected != arrivals.expected:
                # Nothing overtakes on a link, nor in the bus: what is missing here is not on its way.
                ask_at = self._unanswered.get(port, now)  # it may have been asked for
                missing = _Missing(arrivals.expected, arrivals.newest, since=now, ask_at=ask_at)
                self._missing[port] = missing
            if now - missing.since > self._patience(arrivals.newest > missing.newest):
                self.skip_to(port, before)
            elif now >= missing.ask_at and self.ask(port):
                missing.ask_at = now + ASK_PERIOD

    def ask(self, port: str) -> bool:
        """Ask the writer of `port` for what has not come, unless it is being asked already; whether it is asked now."""
        if port in self._asking:
            return False
        self._asking.add(port)
        self.bus.ask_again(port, self.reader.inputs[port].expected)
        return True

    def begin_at(self, port: str, seq: int) -> None:  # noqa: B027 - an operator goes on from its snapshot
        """Hear that the writer has no sample before `seq` any more."""

    def _patience(self, goes_on: bool) -> float:
        """How long (s) later samples wait for missing ones; `goes_on`: their writer sends more and does not answer."""
        if self.plan.replay:
            return REPLAY_PATIENCE
        return LIVE_PATIENCE if goes_on else SILENT_PATIENCE

    @abstractmethod
    def skip_to(self, port: str, seq: int) -> None:
        """Go on without the samples before `seq`."""

    def count(self, outputs: dict[str, int], *, at_once: bool = False) -> None:
        if not (at_once or self.reports.counters_due()):
            return
        self.count_dropped()
        now = time.time_ns()
        inputs = self.reader.inputs
        delays = {port: each.spread(now, inputs[port].handled_age) for port, each in self._delays.items()}
        counts = self.reader.input_counts()
        counters = Counters(
            node=self.plan.node,
            inputs=counts,
            outputs=outputs,
            delays=delays,
            ended=self.reader.finished,
            held=self.bus.held + self.reader.held + (self.history.held if self.history else 0),
            let_go=self.history.let_go if self.history else 0,
        )
        self.reports.counters(counters, at_once=at_once)

    def count_dropped(self) -> None:
        """Count the samples for which the inbox had no room."""
        for port, dropped in self.bus.dropped.items():
            if fresh := dropped - self._dropped[port]:
                self._dropped[port] = dropped
                self.reader.inputs[port].drop_unseen(fresh)


class _OperatorNode(_ReaderNode):
    def __init__(self, plan: NodePlan, bus: Bus, operator: Operator, snapshots: Path) -> None:
        self.stage = Stage(plan.node, operator, plan.inputs, plan.outputs)
        super().__init__(plan, bus, self.stage)
        self.history: History = _history(plan)
        # Bytes after which a snapshot confirms what was handled: writers keep no more than twice as many for this node.
        self._snapshot_bytes = min(wire.budget for wire in plan.inputs.values()) // 2
        self._since_snapshot = 0  # bytes of samples that came
        self._keeps = True  # the last snapshot could be kept
        self.keeper = SnapshotKeeper(snapshots, operator)
        self.marked: Progress | None = None  # what readers that wait were told last
        self.confirmed: dict[str, int] = {}  # by input key what the last snapshot has handled
        self._snapshot_period = SNAPSHOT_PERIOD if plan.replay else LIVE_SNAPSHOT_PERIOD
        self._next_snapshot = time.monotonic() + self._snapshot_period
        # Live: for each input that may lag, when the samples of the others came, and their stamps.
        self._others: dict[str, deque[tuple[float, int]]] = {
            port: deque(maxlen=AHEAD_KEPT)
            for port, wire in plan.inputs.items()
            if wire.max_lag_ms is not None and not plan.replay
        }

    def run(self) -> None:
        resumed = self.resume()
        try:
            self.handle_all(resumed=resumed)
        except (Exception, SystemExit):
            self.keeper.note_failure()
            raise

    def handle_all(self, *, resumed: bool) -> None:
        self.bus.at_once = self.take_at_once
        self.bus.declare_ready()
        if resumed:
            with self.lock:
                self.send_again()
        more = False
        while not self.stopped:
            self.take_events(timeout=0 if more else self.look_period)
            with self.lock:
                self.raise_if_broken()
                more = self.handle_what_is_due()
                self.ask_for_missing()
                self.wait_no_longer_than_allowed()
                self.report()
            self.keep_snapshot()
        self.take_no_more()
        self.tell_left_out()
        self.count(self.sent(), at_once=True)

    def take_sample_at_once(self, arrived: Arrived) -> None:
        message = self.decoded(arrived)
        if message is None:
            self.follow_up(arrived)
            return
        self._since_snapshot += weight(arrived.payload)
        emitted = None if self.history.full else self.stage.handle_at_once(arrived.port, message, self.now())
        if emitted is None:
            self.take_message(arrived, message)
            if self.stage.inputs[arrived.port].ahead:
                self.ask_for_missing()
            self.follow_up(arrived)
        else:
            self.send(emitted)
            self.tell_who_waits()

    def between_samples(self) -> None:
        if self.bus.pending():
            self.take_events(timeout=0)
            self.handle_what_is_due()
        self.report_if_due()

    def follow_up(self, event: Event) -> None:
        if isinstance(event, Confirmed):
            return
        while (emitted := self.step()) is not None:
            self.send(emitted)
        self.tell_who_waits()

    def step(self) -> list[tuple[str, Sample, int]] | None:
        """What follows from the next sample that is due; None: none is, or a replay's readers have to come on first."""
        return None if self.history.full else self.stage.step(self.now())

    def tell_who_waits(self) -> None:
        """Say at once how far this node has come, when a reader cannot see it from the samples and waits for it."""
        if not self.plan.replay and self.stage.tells_more_than_samples():
            progress = self.stage.progress()
            if progress != self.marked:
                self.bus.send_marks(progress)
                self.marked = progress

    def take(self, event: Event) -> None:
        match event:
            case Confirmed():
                self.history.confirm(event.port, event.reader, event.seq)
            case Asked():
                mark = self.stage.progress().ports[event.port]
                end = Again(self.history.first(event.port), mark)
                self.bus.answer(event, self.history.since(event.port, event.first), end)
            case _:
                super().take(event)

    def take_message(self, arrived: Arrived, message: Sample) -> None:
        for port, others in self._others.items():
            if port != arrived.port:
                others.append((time.monotonic(), message.stamp))
        self.stage.offer(arrived.port, message, again=arrived.again)

    def refuse_ahead(self, arrived: Arrived, message: Sample, ahead: int) -> None:
        self.stage.refuse_ahead(arrived.port, message, ahead, again=arrived.again)

    def skip_to(self, port: str, seq: int) -> None:
        self.stage.skip_to(port, seq)

    def handle_what_is_due(self) -> bool:
        """Handle samples until none is due, or for so long that all else would wait; whether more may be due."""
        until = time.monotonic() + self.look_period
        while (emitted := self.step()) is not None:
            self.send(emitted)
            self.report_if_due()
            if self.bus.pending():
                self.take_events(timeout=0)
            if time.monotonic() > until:
                return True
        return False

    def now(self) -> int | None:
        """The clock (ns) by which samples may be too old; a replay has none."""
        return None if self.plan.replay else time.time_ns()

    def report_if_due(self) -> None:
        if self.reports.due():
            self.reports.progress(self.progress())
            self.keep_snapshot()

    def send(self, emitted: list[tuple[str, Sample, int]]) -> None:
        for port, message, seq in emitted:
            payload = numbered(message, seq)
            self.history.keep(port, seq, payload)
            self.bus.send(port, payload)

    def progress(self) -> Progress:
        """How far the node has come, and what its readers' writers may forget."""
        return msgspec.structs.replace(self.stage.progress(), confirmed=self.confirmed)

    def keep_snapshot(self) -> None:
        """Now and then: what a new process in this one's place needs to go on."""
        with self.lock:
            full = self._since_snapshot >= self._snapshot_bytes
            due = time.monotonic() >= self._next_snapshot or (full and self._keeps)
            if self._broken is not None or not due or self._next_snapshot == math.inf:
                return
            came = self._since_snapshot
            self._next_snapshot = math.inf  # until this one is kept
            handled = {self.plan.inputs[port].key: seq for port, (seq, _) in self.stage.state().inputs.items()}
            fresh = handled != self.confirmed
            snapshot = self.taken_snapshot() if fresh else None
        self._keeps = not fresh or self.is_kept(snapshot)  # live without the lock: samples do not wait for the disk
        if self._keeps:
            with self.lock:
                self._since_snapshot -= came
        if self._keeps or full:  # else the writers of a replay would wait for a snapshot without end
            self.confirmed = handled
        self._next_snapshot = time.monotonic() + self._snapshot_period

    def taken_snapshot(self) -> bytes | None:
        snapshot = self.keeper.taken(self.stage.state(), self.history.kept(), self.stage.operator)
        if self.keeper.state is not None:
            self.stage.note_packed(self.keeper.state)
        return snapshot

    def is_kept(self, snapshot: bytes | None) -> bool:
        """Keep a snapshot, or None for a state that cannot be kept; whether writers may forget what it has handled.

        They may when a process in this one's place would not ask for it. So while no snapshot can be written they keep
        what came since the last one, up to the bound of their histories: beyond it a replay goes on, and would end with
        status 1 if this process were killed. A replay without any snapshot begins again with its first sample; a live
        operator with what is new, since old samples would only make it late.
        """
        if snapshot is not None:
            return self.keeper.keep(snapshot)
        if not self.plan.replay:
            self.keeper.discard()
        return not self.plan.replay

    def resume(self) -> bool:
        """Go on where a process before this one was killed; whether there was one, and its snapshot fits."""
        try:
            kept = self.keeper.resume()
            if kept is None:
                return False
            self.stage.resume(kept.stage, kept.operator)
        except SnapshotError as error:
            log.warning("starts without its snapshot, which cannot be used: %s", one_line(error))
            return False
        self.keeper.go_on_with(kept.operator)
        for port, samples in kept.history.items():
            for seq, payload in samples:
                self.history.keep(port, seq, payload)
        self.confirmed = {self.plan.inputs[port].key: seq for port, (seq, _) in kept.stage.inputs.items()}
        return True

    def send_again(self) -> None:
        """Send what readers may not have got before the kill; what came since the snapshot is asked for."""
        for port, samples in self.history.kept().items():
            for kept in samples:
                self.bus.send(port, kept.payload)

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

    def tell_left_out(self) -> None:
        for note in self.stage.left_out():
            self.bus.send_left_out(note)

    def report(self) -> None:
        self.tell_left_out()
        if self.stage.finished or self.stage.tells_more_than_samples() or self.reports.due():
            progress = self.progress()
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
            self.bus.at_once = self.take_at_once
            self.bus.declare_ready()
            while not self.stopped:
                came = self.take_events(timeout=self.look_period)
                with self.lock:
                    self.raise_if_broken()
                    self.go_on(came)
        finally:
            self.bus.hear_out()
            self.take_no_more()
            self.tap.finish()
        self.count({}, at_once=True)

    def go_on(self, came: bool) -> None:
        """What is to be done now and then, whether samples came or not."""
        if not came:
            self.tap.idle(time.time_ns())
        self.ask_for_missing()
        if self.tap.ended and not self.tap.finished:
            self.tap.finish()
            self.count({}, at_once=True)
        if self.reports.due() or self.tap.finished:
            self.reports.progress(self.tap.progress())
        self.count({})

    def between_samples(self) -> None:
        if self.bus.pending():
            self.take_events(timeout=0)
        if self.reports.due():
            self.go_on(came=True)

    def follow_up(self, event: Event) -> None:
        """Nothing: a sink has done with a sample when it has taken it."""

    def take(self, event: Event) -> None:
        if isinstance(event, Questioned):
            self.bus.answer_question(event, self.tap.asked(event.question, time.time_ns()))
        else:
            super().take(event)

    def take_message(self, arrived: Arrived, message: Sample) -> None:
        self.tap.offer(arrived.port, message, arrived.payload, time.time_ns(), again=arrived.again)

    def begin_at(self, port: str, seq: int) -> None:
        """In the place of another: what lies before the writer's oldest sample was that one's, and is not lost."""
        arrivals = self.tap.inputs[port]
        if self.plan.takes_over and arrivals.handled_seq < 0 and seq > arrivals.expected:
            arrivals.expected = seq
            self.skip_to(port, seq)

    def refuse_ahead(self, arrived: Arrived, message: Sample, ahead: int) -> None:
        self.tap.refuse_ahead(arrived.port, message, ahead, time.time_ns(), again=arrived.again)

    def skip_to(self, port: str, seq: int) -> None:
        self.tap.skip_to(port, seq, time.time_ns())


class _Ended(BaseException):
    """Raised in the main thread by SIGTERM: a source may be blocked in a read of its device."""


class _SourceNode:
    """A source on the main thread, where it may block in a read of its device; what comes is taken on a second one."""

    def __init__(self, plan: NodePlan, bus: Bus, source: Source) -> None:
        self.plan = plan
        self.bus = bus
        self.source = source
        self.feed = Feed(plan.node, plan.outputs, ordered=source.ordered)
        self.history = _history(plan)
        self.reports = _Reports(bus, REPORT_PERIOD if plan.replay else LIVE_REPORT_PERIOD)
        self.lock = threading.Condition()  # over all of this node's state; told when something has come
        self.started = False
        self.stopped = False
        self.broken: BaseException | None = None  # raised on the second thread
        self.until = BEGIN if plan.replay else END  # how far a replay may send
        self._present = Present()

    def at(self) -> str | None:
        """The sample that was sent last; None: the node has not begun."""
        if not self.bus.ready:
            return None
        return ", ".join(f"{port} seq {out.sent - 1}" for port, out in self.feed.outputs.items())

    def run(self) -> None:
        threading.Thread(target=self.take_all_events, name="requests", daemon=True).start()
        try:
            with self.ended_by_sigterm():
                self.bus.declare_ready()
                self.wait_for(lambda: self.started)
                self.send_all()
                self.end()
        except _Ended:
            pass
        finally:
            self.stopped = True
        if self.broken is not None:
            raise self.broken
        self.count(at_once=True)

    def wait_for(self, condition: Callable[[], bool], timeout: float | None = None) -> None:
        """Wait until what has come fulfils the condition, or the source is to end, or for `timeout` s."""
        with self.lock:
            self.lock.wait_for(lambda: self.stopped or condition(), timeout)

    def send_all(self) -> None:
        samples = self.source.samples()
        try:
            for item in samples:
                if self.stopped:
                    return
                if isinstance(item, Quiet):
                    self.report(item.until)
                    continue
                port, sample = item
                self.wait_for_window(sample.stamp)
                self.wait_for_room(sample.stamp)
                self.send(port, sample)
                if self.reports.due():
                    self.report()
                    self.count()
        finally:
            samples.close()

    def send(self, port: str, sample: Sample | Encoded) -> None:
        with self.lock:
            payload = self.feed.take(port, sample, self.now())
            seq = self.feed.outputs[port].sent - 1
        if payload is not None:
            # First sent, then kept: what is sent again on request never arrives before the sample itself. And without
            # the lock: requests do not wait for a link.
            self.bus.send(port, payload)
            with self.lock:
                self.history.keep(port, seq, payload)

    def report(self, nothing_until: int = BEGIN) -> None:
        """Say how far the source has come; no sample up to the stamp `nothing_until` (ns) will follow."""
        with self.lock:
            self.feed.nothing_until(nothing_until, self.now())
            progress = self.feed.progress()
        self.reports.progress(progress)

    def now(self) -> int | None:
        """The clock (ns) that no sample may lie far ahead of; a replay has none."""
        return None if self.plan.replay else self._present.now()

    def wait_for_window(self, stamp: int) -> None:
        """Hold a replay's sample back until the readers have come near enough."""
        while stamp > self.until and not self.stopped:
            self.report(stamp - 1)
            self.wait_for(lambda: stamp <= self.until, SAY_AGAIN_PERIOD)

    def wait_for_room(self, stamp: int) -> None:
        """Hold a replay's sample back while readers have not confirmed more than they, and this node, may hold."""
        while self.history.full and not self.stopped:
            self.report(stamp - 1)
            self.count()
            self.wait_for(lambda: not self.history.full, SAY_AGAIN_PERIOD)

    def take_all_events(self) -> None:
        """Take what comes, however long the source is silent: a restarted reader asks for what it missed."""
        try:
            while not self.stopped:
                for event in self.bus.events(timeout=None):
                    self.take(event)
        except BaseException as error:
            if not self.stopped:  # else the session is closing
                self.broken = error
                main = threading.main_thread().ident or 0
                signal.pthread_kill(main, signal.SIGTERM)  # it raises the error, and may be blocked in a read

    def take(self, event: Event) -> None:
        if isinstance(event, Asked):
            with self.lock:
                end = Again(self.history.first(event.port), self.feed.progress().ports[event.port])
                payloads = self.history.since(event.port, event.first)
            self.bus.answer(event, payloads, end)
            return
        with self.lock:
            match event:
                case Started():
                    self.started = True
                case Opened():
                    self.until = max(self.until, event.until)
                case Confirmed():
                    self.history.confirm(event.port, event.reader, event.seq)
                case _:
                    pass  # a source has no inputs
            self.lock.notify_all()

    def end(self) -> None:
        """Say that nothing more will come, and stay until the launcher ends the flow."""
        self.feed.ended = True
        self.count(at_once=True)
        while not self.stopped:
            self.report()
            self.count()
            self.wait_for(lambda: False, SAY_AGAIN_PERIOD)

    @contextmanager
    def ended_by_sigterm(self) -> Iterator[None]:
        """Let SIGTERM end the source, out of a blocked read as well."""

        def end(*_: object) -> None:
            self.stopped = True
            self.bus.put(Stopped())  # an exception that is raised inside a destructor is lost: the event is not
            raise _Ended

        before = signal.signal(signal.SIGTERM, end)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before)

    def count(self, *, at_once: bool = False) -> None:
        sent = {port: out.sent for port, out in self.feed.outputs.items()}
        unsent = self.feed.unsent
        counters = Counters(
            node=self.plan.node,
            inputs={},
            outputs=sent,
            refused=self.feed.refused,
            unsent=dict(unsent),
            ended=self.feed.ended,
            held=self.history.held,
            let_go=self.history.let_go,
        )
        self.reports.counters(counters, at_once=at_once)
