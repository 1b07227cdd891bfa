"""One process of a flow: a group of nodes on one session, behind one lock."""

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import msgspec

from caneflow.messages import Sample, decode
from caneflow.messages.control import Counters, Progress
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import (
    Arrived,
    AskEnded,
    Broken,
    Brought,
    Confirmed,
    Event,
    HistoryAnswered,
    HistoryAsked,
    LeftOutNoted,
    Marked,
    Opened,
    SinkAsked,
    Started,
    Stopped,
    Timed,
)
from caneflow.runtime.hosts.process.group_recovery import GroupRecovery
from caneflow.runtime.hosts.process.inputs import Inputs
from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.hosts.process.recovery import Recovery
from caneflow.runtime.hosts.process.reports import REPORT_PERIOD, Reports
from caneflow.runtime.hosts.process.source_threads import SourceThreads
from caneflow.runtime.hosts.process.sources import counted
from caneflow.runtime.hosts.process.speaker import speak_for
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.program import Encoded, Operator, Sink, Source
from caneflow.runtime.stages import journal
from caneflow.runtime.stages.byte_budget import WAITING
from caneflow.runtime.stages.group import Emitted, Group
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.source_stage import Feed

LIVE_LOOK_PERIOD = 0.1  # s after which a live node looks at what is due by time, though nothing came
LOOKS_PER_LAG = 5  # and so often within the time that it may wait for an input
QUICK = 0.002  # s of CPU: a node that takes longer for an event is not quick ...
STALLED = 0.05  # s of the clock: nor is one that takes so long, waiting; less can be a machine with much else to do
MOST_SLOW = (
    0.25  # ... and when so great a share of the last 64 or so was slow, Zenoh's threads do not wait for it any more
)


class Process:
    """Nodes of any kind; a source that is alone has a `SourceProcess`."""

    def __init__(
        self, plan: ProcessPlan, bus: Bus, built: Mapping[str, Operator | Sink | Source], snapshots: Path
    ) -> None:
        self.plan = plan
        self.bus = bus
        self.group = Group(plan.members, received=self._received_locally, working=speak_for)
        for name, program in built.items():
            self.group.add(plan.members[name], program)
        self.stages = {name: each for name, each in self.group.readers.items() if isinstance(each, Stage)}
        self.taps = {name: each for name, each in self.group.readers.items() if isinstance(each, Tap)}
        self.inputs = {name: Inputs(plan.members[name], plan, self.group, bus) for name in self.group.readers}
        self.outputs = {name: Outputs(plan.members[name], plan, bus) for name in (*self.group.feeds, *self.stages)}
        self.reports = {name: Reports(bus, replay=plan.replay) for name in plan.members}
        self.lock = threading.RLock()  # over all of this process's state
        self.recovery: dict[str, Recovery | GroupRecovery] = {
            name: Recovery(plan.members[name], stage, self.outputs[name], snapshots, self.lock)
            for name, stage in self.stages.items()
            if not plan.is_group
        }
        if plan.is_group:
            group = GroupRecovery(plan, self.group, self.outputs, snapshots, self.lock)
            self.recovery = dict.fromkeys(plan.members, group)
        self._recoveries = list(dict.fromkeys(self.recovery.values()))
        sources = {name: program for name, program in built.items() if isinstance(program, Source)}
        self.sources = SourceThreads(sources, self, self.lock, replay=plan.replay)
        self._present = Present()
        self.stopped = False
        self._alone = len(plan.nodes) == 1
        self._quick = True
        self._slow = 0.0  # share of events
        wires = [wire for node in plan.nodes for wire in node.inputs.values()]
        lags = [wire.max_lag_ms for wire in wires if wire.max_lag_ms is not None]
        shortest = min([LIVE_LOOK_PERIOD, *(1e-3 * lag / LOOKS_PER_LAG for lag in lags)])
        self.look_period = REPORT_PERIOD if plan.replay else max(shortest, REPORT_PERIOD / 4)
        self._came = False  # anything, at once, since this was last looked at
        self._broken: BaseException | None = None  # what was raised at once: nothing more is handled and kept

    def run(self) -> None:
        """Handle what comes until the launcher ends it."""
        resumed = [recovery for recovery in self._recoveries if recovery.resume()]
        try:
            self.handle_all(resumed=bool(resumed))
        except (Exception, SystemExit):
            for recovery in self._recoveries:
                recovery.note_failure()
            raise
        finally:
            self.sources.stop()
            if self.taps:
                self.bus.hear_out()
            self.take_no_more()
            self.group.finish()
        for name in self.plan.members:
            self._tell_left_out(name)
            self.count(name, at_once=True)

    def handle_all(self, *, resumed: bool) -> None:
        """Say that the nodes are there, and handle what comes; `resumed`: they go on from a snapshot."""
        self.bus.at_once = self.take_at_once
        self.bus.declare_ready()
        with self.lock:
            for outputs in self.outputs.values() if resumed else ():
                outputs.send_again()  # what came since the snapshot is asked for
            self._catch_up()
        self.sources.begin()
        more = False
        while not self.stopped:
            came = self.take_events(timeout=0 if more else self.look_period)
            with self.lock:
                self.raise_if_broken()
                if not came:
                    for tap in self.taps.values():
                        tap.idle(time.time_ns())
                more = self.handle_what_is_due()
                self.ask_for_missing()
                self.wait_no_longer_than_allowed()
                self.report()
            self.keep_snapshots()
        if self.group.feeds:
            self.sources.stop()
            self.take_events(timeout=0)  # what they brought last
            with self.lock:
                self.handle_what_is_due()

    def at(self) -> str | None:
        """The sample that is being handled, or was last; None: the process has not begun."""
        if not self.bus.ready:
            return None
        handled = [at for inputs in self.inputs.values() if (at := inputs.at()) is not None]
        return max(handled)[-1] if handled else "the first"

    def stop(self) -> None:
        """End the process soon; safe in a signal handler."""
        self.bus.put(Stopped())

    def raise_if_broken(self) -> None:
        """Raise here what was raised on the thread that brought a sample; with the lock held."""
        if self._broken is not None:
            raise self._broken

    # --- what comes -------------------------------------------------------------------------------------------

    def take_events(self, timeout: float) -> bool:
        """Take what came, waiting up to `timeout` s for it; whether anything came."""
        came = False
        for event in self.bus.events(timeout):
            came = True
            with self.lock:
                self.take(event)
        came, self._came = came or self._came, False
        return came

    def take(self, event: Event) -> None:
        """Take an event; what follows from it is another step."""
        match event:
            case Arrived():
                message = self.inputs[event.node].decoded(event)
                if message is not None:
                    self._take_message(event, message)
            case HistoryAnswered():
                self.inputs[event.node].take_answer(event)
            case AskEnded():
                self.inputs[event.node].ask_ended(event.port)
            case Marked():
                self.inputs[event.node].take_mark(event.port, event.mark)
            case Confirmed():
                outputs = self.outputs[event.node]
                outputs.confirm(event)
                if not outputs.full:
                    self.group.held.discard(event.node)
            case HistoryAsked():
                mark = self._writer(event.node).progress().ports[event.port]
                self.bus.answer(event, *self.outputs[event.node].asked(event, mark))
            case LeftOutNoted():
                self.taps[event.node].note(event.key, event.payload, time.time_ns())
            case SinkAsked():
                self.bus.answer_question(event, self.taps[event.node].asked(event.question, time.time_ns()))
            case Brought():
                self._bring(event.node, event.port, event.sample)
            case Started():
                self.sources.start()
            case Opened():
                self.sources.open(event.until)
            case Timed():
                for inputs in self.inputs.values():
                    inputs.set_clock(event.clock)
            case Stopped():
                self.stopped = True
            case Broken(error):
                raise error

    def _take_message(self, arrived: Arrived, message: Sample) -> None:
        self.inputs[arrived.node].note_others(arrived.port, message.stamp)
        now = time.time_ns()
        self.group.take(arrived.node, arrived.port, message, arrived.payload, now, again=arrived.again)

    def _received_locally(self, node: str, port: str, message: Sample) -> int:
        return self.inputs[node].note_local(port, message)

    # --- what its own sources bring, each on its thread -------------------------------------------------------

    def bring(self, node: str, port: str, sample: Sample | Encoded) -> None:
        """Take what a source has brought, and do what follows; in the inbox while this process is not quick."""
        if not (self._quick or self.plan.replay):
            self.bus.put(Brought(node, port, sample))
            return
        with self.lock:
            if self.stopped or self._broken is not None:
                return
            if self.plan.replay:
                self._bring(node, port, sample)
                self._follow_up()
                self._between_samples()
            else:
                self._timed(partial(self._bring_and_follow, node, port, sample))
            self._came = True

    def nothing_until(self, node: str, stamp: int) -> None:
        """Take a source's word that no sample with a stamp (ns) at or before this will come."""
        with self.lock:
            self.group.feeds[node].nothing_until(stamp, self._latest())
            self._follow_up()
            self._report_if_due()

    def has_room(self, node: str) -> bool:
        """Whether a source of a replay may bring more: readers outside, and members, hold no more than they may."""
        if not self.plan.replay:
            return True
        with self.lock:
            return not self.outputs[node].full and all(
                reader.held < WAITING // 2 for reader in self.group.readers_of(node)
            )

    def source_ended(self, node: str) -> None:
        """Take a source's word that nothing more will come."""
        with self.lock:
            self.group.feeds[node].ended = True
            self._follow_up()
            self.count(node, at_once=True)

    def break_down(self, error: BaseException) -> None:
        """Let the process end with what was raised on another thread."""
        self._quick = False
        self._broken = error
        for recovery in self._recoveries:
            recovery.ended = True
        self.bus.put(Broken(error))

    def _bring_and_follow(self, node: str, port: str, sample: Sample | Encoded) -> None:
        self._bring(node, port, sample)
        self._follow_up()

    def _bring(self, node: str, port: str, sample: Sample | Encoded) -> None:
        payload = self.group.feeds[node].take(port, sample, self._latest())
        if payload is None:
            return
        self.recovery[node].keep_brought(journal.Brought(node, port, payload))
        self._spread(node, port, payload)

    def _catch_up(self) -> None:
        """Handle once more what the sources of the process before this one brought after its snapshot."""
        for recovery in self._recoveries:
            for node, port, payload in recovery.brought_since():
                kind = self.group.feeds[node].outputs[port].plan.kind
                message = decode(payload, kind)
                again = self.group.feeds[node].take(port, Encoded(kind, message.stamp, message.seq, payload))
                if again is not None:
                    self._spread(node, port, again)
                    while (stepped := self.group.step()) is not None:
                        self._send(*stepped)

    def _spread(self, node: str, port: str, payload: bytes) -> None:
        seq = self.group.feeds[node].outputs[port].sent - 1
        self.outputs[node].send_encoded(port, seq, payload)
        self.group.deliver(node, port, payload)

    def _latest(self) -> int | None:
        """The clock (ns) that no sample may lie far ahead of; a replay has none."""
        return None if self.plan.replay else self._present.now()

    # --- on the thread that brings it -------------------------------------------------------------------------

    def take_at_once(self, event: Event) -> bool:
        """Take an event and do what follows, on the thread that brought it; False: not here.

        That spares waking the process's own thread for every sample. Live it is the thread that receives: a node that
        is not quick would hold up everything else on its links, and its queues would not see what waits. In a replay a
        put may block, so samples come on threads of their own, and all else, which does not, is left to the process's.
        """
        if not self._quick or (self.plan.replay and type(event) is not Arrived):
            return False
        with self.lock:
            if not self._quick:  # it has ended meanwhile, or become slow
                return False
            try:
                if not self.plan.replay:
                    self._timed(partial(self._take_and_follow, event))
                elif isinstance(event, Arrived):
                    self.take_sample_at_once(event)
                    self._between_samples()
            except BaseException as error:
                self.break_down(error)
            self._came = True
        return True

    def take_no_more(self) -> None:
        """From here on what comes waits in the inbox."""
        with self.lock:
            self._quick = False

    def _take_and_follow(self, event: Event) -> None:
        if type(event) is Arrived:  # as nearly all are
            self.take_sample_at_once(event)
        else:
            self.take(event)
            if type(event) is not Confirmed:
                self._follow_up()

    def _timed(self, work: Callable[[], None]) -> None:
        """Do something that comes at once; judge by the time whether this process is quick."""
        began, worked = time.monotonic(), time.thread_time()
        work()
        took = time.monotonic() - began
        slow = took > STALLED or (took > QUICK and time.thread_time() - worked > QUICK)
        self._slow += (slow - self._slow) / 64
        if self._slow > MOST_SLOW:
            self._quick = False

    def take_sample_at_once(self, arrived: Arrived) -> None:
        """Take a sample and do what follows."""
        node, port = arrived.node, arrived.port
        inputs = self.inputs[node]
        message = inputs.decoded(arrived)
        emitted: Emitted | None = None
        if message is not None:
            if node in self.stages:
                if node in self.recovery:
                    self.recovery[node].note(arrived.payload)
                if node not in self.group.held:
                    emitted = self.group.take_at_once(node, port, message, self.now())
            if emitted is None:
                self._take_message(arrived, message)
                if inputs.has_gap(port):
                    self.ask_for_missing()
        if emitted is not None:
            self._send(node, emitted)
            if self._alone:  # nobody else here has got what was sent
                self._tell_who_waits()
                return
        self._follow_up()

    def _follow_up(self) -> None:
        """Do what an event makes possible that was taken at once; a sink has done with a sample when it has it."""
        if not self.outputs:
            return
        while (stepped := self.group.step(self.now())) is not None:
            self._send(*stepped)
        self._tell_who_waits()

    def _between_samples(self) -> None:
        """In a replay, whose samples may come without end: do what else the process's own thread does."""
        if self.bus.pending():
            self.take_events(timeout=0)
            self.handle_what_is_due()
        self._report_if_due()

    # --- what follows -----------------------------------------------------------------------------------------

    def handle_what_is_due(self) -> bool:
        """Handle samples until none is due, or for so long that all else would wait; whether more may be due."""
        until = time.monotonic() + self.look_period
        while (stepped := self.group.step(self.now())) is not None:
            self._send(*stepped)
            self._report_if_due()
            if self.bus.pending():
                self.take_events(timeout=0)
            if time.monotonic() > until:
                return True
        return False

    def now(self) -> int | None:
        """The clock (ns) by which samples may be too old; a replay has none."""
        return None if self.plan.replay else time.time_ns()

    def ask_for_missing(self) -> None:
        """Ask for samples that were sent by other processes and have not come."""
        for inputs in self.inputs.values():
            inputs.ask_for_missing()

    def wait_no_longer_than_allowed(self) -> None:
        """Live: go on without an input that holds up what came longer than its max_lag_ms ago."""
        for name, stage in self.stages.items():
            for port, until in self.inputs[name].lagging():
                stage.go_on_without(port, until)
                self.handle_what_is_due()

    def keep_snapshots(self) -> None:
        """Now and then: what a new process in this one's place needs to go on."""
        for recovery in self._recoveries:
            recovery.keep()

    def _writer(self, node: str) -> Feed | Stage:
        return self.group.feeds[node] if node in self.group.feeds else self.stages[node]

    def _send(self, node: str, emitted: Emitted) -> None:
        outputs = self.outputs[node]
        outputs.send(emitted)
        if outputs.full:
            self.group.held.add(node)

    # --- what is said -----------------------------------------------------------------------------------------

    def progress(self, name: str) -> Progress:
        """How far a node has come, and what its inputs' writers may forget."""
        if name in self.group.feeds:
            return self.group.feeds[name].progress()
        progress = self.group.readers[name].progress()
        if name in self.recovery:
            return msgspec.structs.replace(progress, confirmed=self.recovery[name].confirmed_by(name))
        return progress

    def report(self) -> None:
        """Say how far each node has come, when somebody waits for it or it is due, and what was counted."""
        for name, feed in self.group.feeds.items():
            if feed.ended or self.reports[name].due():
                self.reports[name].progress(feed.progress())
            self.count(name)
        for name, reader in self.group.readers.items():
            self._tell_left_out(name)
            reports = self.reports[name]
            waited_for = isinstance(reader, Stage) and self.outputs[name].awaited and reader.tells_more_than_samples()
            if reader.finished or waited_for or reports.due():
                progress = self.progress(name)
                if reader.finished:
                    self.count(name, at_once=progress != reports.said)
                reports.progress(progress)
            self.count(name)

    def count(self, name: str, *, at_once: bool = False) -> None:
        """Say what became of a node's samples, once a second or `at_once`."""
        reports = self.reports[name]
        if not (at_once or reports.counters_due()):
            return
        if name in self.group.feeds:
            reports.counters(counted(self.group.feeds[name], self.outputs[name]))
            return
        inputs = self.inputs[name]
        inputs.count_dropped()
        history = self.outputs[name].history if name in self.outputs else None
        reader = self.group.readers[name]
        counts = reader.input_counts()
        reports.counters(
            Counters(
                node=name,
                inputs=counts,
                outputs={port: out.sent for port, out in reader.outputs.items()} if isinstance(reader, Stage) else {},
                delays=inputs.delays(),
                ended=reader.finished,
                held=self.bus.held + inputs.held + (history.held if history else 0),
                let_go=history.let_go if history else 0,
            )
        )

    def _report_if_due(self) -> None:
        for name, reports in self.reports.items():
            if reports.due():
                reports.progress(self.progress(name))
                if name in self.taps:
                    self.ask_for_missing()
                    self.count(name)
        self.keep_snapshots()

    def _tell_who_waits(self) -> None:
        """Say at once how far a node has come, when a reader cannot see it from the samples and waits for it."""
        if self.plan.replay:
            return
        for name, stage in self.stages.items():
            if self.outputs[name].awaited and stage.tells_more_than_samples():
                self.reports[name].marks(stage.progress())

    def _tell_left_out(self, name: str) -> None:
        if name in self.stages:
            for note in self.stages[name].left_out():
                self.bus.send_left_out(note)
