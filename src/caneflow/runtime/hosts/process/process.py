"""One process of a flow: a group of nodes on one session, behind one lock."""

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from caneflow.messages import Sample
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
    SourcesEnd,
    SourcesEnded,
    Started,
    Stopped,
    Timed,
)
from caneflow.runtime.hosts.process.group_recovery import AnyRecovery, recoveries
from caneflow.runtime.hosts.process.inputs import Inputs, look_period
from caneflow.runtime.hosts.process.last_events import take_the_rest
from caneflow.runtime.hosts.process.local_sources import LocalSources
from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.quickness import Quickness
from caneflow.runtime.hosts.process.sayings import Sayings
from caneflow.runtime.hosts.process.speaker import speak_for
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.program import Operator, Sink, Source
from caneflow.runtime.stages.group import Emitted, Group
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.sink_stage import Tap


class Process:
    """Nodes of any kind; a source that is alone has a `SourceProcess`."""

    def __init__(
        self, plan: ProcessPlan, bus: Bus, built: Mapping[str, Operator | Sink | Source], snapshots: Path
    ) -> None:
        self.plan = plan
        self.bus = bus
        self.group = Group(plan.members, self._received_locally, speak_for, spares_marks=True)
        for name, program in built.items():
            self.group.add(plan.members[name], program)
        self.stages = {name: each for name, each in self.group.readers.items() if isinstance(each, Stage)}
        self.taps = {name: each for name, each in self.group.readers.items() if isinstance(each, Tap)}
        self.inputs = {name: Inputs(plan.members[name], plan, self.group, bus) for name in self.group.readers}
        self.outputs = {name: Outputs(plan.members[name], plan, bus) for name in (*self.group.feeds, *self.stages)}
        self.lock = threading.RLock()  # over all of this process's state
        self.recovery: dict[str, AnyRecovery] = recoveries(plan, self.group, self.outputs, snapshots, self.lock)
        self.says = Sayings(plan, bus, self.group, self.inputs, self.outputs, self.recovery)
        self._recoveries = list(dict.fromkeys(self.recovery.values()))
        self.local = LocalSources(self, {name: each for name, each in built.items() if isinstance(each, Source)})
        self.stopped = False
        self._alone = len(plan.nodes) == 1
        self._quickness = Quickness()
        self.look_period = look_period(plan)
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
            self.local.threads.stop()
            if self.taps:
                self.bus.hear_out()
            self.take_no_more()
            self.group.finish()
        for name in self.plan.members:
            self.says.what_was_left_out(name)
            self.says.counters(name, at_once=True)

    def handle_all(self, *, resumed: bool) -> None:
        """Say that the nodes are there, and handle what comes; `resumed`: they go on from a snapshot."""
        self.bus.at_once = self.take_at_once
        self.bus.declare_ready()
        with self.lock:
            for outputs in self.outputs.values() if resumed else ():
                outputs.send_again()  # what came since the snapshot is asked for
            self.local.catch_up(brought for recovery in self._recoveries for brought in recovery.brought_since())
        self.local.threads.begin()
        more = False
        while not self.stopped:
            came = self.take_events(timeout=0 if more else self.look_period)
            with self.lock:
                self.raise_if_broken()
                if not came:
                    self.group.idle(time.time_ns())
                self.group.tell_all_marks()
                more = self.handle_what_is_due()
                self.ask_for_missing()
                self.wait_no_longer_than_allowed()
                self.says.what_is_due()
            self.keep_snapshots()
        if self.group.feeds:
            self.local.threads.stop()
        take_the_rest(self.take_events, self._handle_unless_broken, replay=self.plan.replay)

    def at(self) -> str | None:
        """The sample that is being handled, or was last; None: the process has not begun."""
        if not self.bus.ready:
            return None
        handled = [at for inputs in self.inputs.values() if (at := inputs.at()) is not None]
        return max(handled)[-1] if handled else "the first"

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
                mark = self.group.writer(event.node).progress().ports[event.port]
                self.bus.answer(event, *self.outputs[event.node].asked(event, mark))
            case LeftOutNoted():
                self.taps[event.node].note(event.key, event.payload, time.time_ns())
            case SinkAsked():
                self.bus.answer_question(event, self.taps[event.node].asked(event.question, time.time_ns()))
            case Brought() | Started() | Opened() | SourcesEnd() | SourcesEnded():
                self.local.hear(event)
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

    # --- on the thread that brings it -------------------------------------------------------------------------

    def take_at_once(self, event: Event) -> bool:
        """Take an event and do what follows, on the thread that brought it; False: not here.

        That spares waking the process's own thread for every sample. Live it is the thread that receives: a node that
        is not quick would hold up everything else on its links, and its queues would not see what waits. In a replay a
        put may block, so samples come on threads of their own, and all else, which does not, is left to the process's.
        """
        if not self._quickness.holds or (self.plan.replay and type(event) is not Arrived):
            return False
        with self.lock:
            if not self._quickness.holds:  # it has ended meanwhile, or become slow
                return False
            try:
                if not self.plan.replay:
                    began = self._quickness.begin()
                    self._take_and_follow(event)
                    self._quickness.judge(*began)
                elif isinstance(event, Arrived):
                    self.take_sample_at_once(event)
                    self._between_samples()
            except BaseException as error:
                self.break_down(error)
            self._came = True
        return True

    def break_down(self, error: BaseException) -> None:
        """Let the process end with what was raised on another thread."""
        self._quickness.end()
        self._broken = error
        for recovery in self._recoveries:
            recovery.ended = True
        self.bus.put(Broken(error))

    @property
    def quick(self) -> bool:
        """Whether what comes is handled on the thread that brings it."""
        return self._quickness.holds

    def do(self, work: Callable[[], None], *, follow: bool = True) -> None:
        """Do something that a source has caused, and what follows, on its thread; in a replay only if `follow`."""
        with self.lock:
            if self.stopped or self._broken is not None:
                return
            if self.plan.replay:
                work()
                if follow:
                    self.handle_what_is_due()
                    self._between_samples()
            else:
                began = self._quickness.begin()
                work()
                self._follow_up()
                self._quickness.judge(*began)
            self._came = True

    def take_no_more(self) -> None:
        """From here on what comes waits in the inbox."""
        with self.lock:
            self._quickness.end()

    def _take_and_follow(self, event: Event) -> None:
        if type(event) is Arrived:  # as nearly all are
            self.take_sample_at_once(event)
        else:
            self.take(event)
            if type(event) is not Confirmed:
                self._follow_up()

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
                self.says.to_who_waits()
                return
        self._follow_up()

    def _follow_up(self) -> None:
        """Do what an event makes possible that was taken at once; a sink has done with a sample when it has it."""
        if not self.outputs:
            return
        while self.step(self.now()):
            pass
        self.says.to_who_waits()

    def _between_samples(self) -> None:
        """In a replay, whose samples may come without end: do what else the process's own thread does."""
        if self.bus.pending():
            self.take_events(timeout=0)
            self.handle_what_is_due()
        self._say_if_due()

    def step(self, now: int | None) -> bool:
        """Handle the next sample that is due, and send what follows; whether there was one. `now` as in `now()`."""
        stepped = self.group.step(now)
        if stepped is not None:
            self._send(*stepped)
        return stepped is not None

    def handle_what_is_due(self) -> bool:
        """Handle samples until none is due, or for so long that all else would wait; whether more may be due."""
        until = time.monotonic() + self.look_period
        while self.step(self.now()):
            self._say_if_due()
            if self.bus.pending():
                self.take_events(timeout=0)
            if time.monotonic() > until:
                return True
        return False

    def now(self) -> int | None:
        """The clock (ns) by which samples may be too old; a replay has none."""
        return None if self.plan.replay else time.time_ns()

    def _handle_unless_broken(self) -> bool:
        with self.lock:
            self.raise_if_broken()
            return self.handle_what_is_due()

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

    def _say_if_due(self) -> None:
        """While samples come without end: say how far each node has come, and ask for what a sink is missing."""
        if not self.says.may_be_due():
            return
        for name in self.says.progress_that_is_due():
            if name in self.taps:
                self.ask_for_missing()
                self.says.counters(name)
        self.keep_snapshots()

    def _send(self, node: str, emitted: Emitted) -> None:
        outputs = self.outputs[node]
        outputs.send(emitted)
        if outputs.full:
            self.group.held.add(node)
