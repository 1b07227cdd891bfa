"""The only node of a process, when it is a source: on the main thread, where it may block in a read of its device.

What comes is taken on a second thread.
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from caneflow.messages import Sample
from caneflow.messages.control import Counters
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import Confirmed, Event, HistoryAsked, Opened, Started, Stopped
from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.hosts.process.reports import SAY_AGAIN_PERIOD, Reports
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.program import Encoded, Quiet, Source
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.source_stage import Feed


class _Ended(BaseException):
    """Raised in the main thread by SIGTERM: a source may be blocked in a read of its device."""


class SourceProcess:
    """A source that has its process for itself."""

    def __init__(self, plan: ProcessPlan, bus: Bus, source: Source) -> None:
        (self.plan,) = plan.nodes
        self.bus = bus
        self.source = source
        self.feed = Feed(self.plan.node, self.plan.outputs, ordered=source.ordered)
        self.outputs = Outputs(self.plan, plan, bus)
        self.reports = Reports(bus, replay=plan.replay)
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
        """Send what the source brings until the launcher ends it."""
        threading.Thread(target=self._take_all_events, name="requests", daemon=True).start()
        try:
            with self._ended_by_sigterm():
                self.bus.declare_ready()
                self._wait_for(lambda: self.started)
                self._send_all()
                self._end()
        except _Ended:
            pass
        finally:
            self.stopped = True
        if self.broken is not None:
            raise self.broken
        self._count(at_once=True)

    def _wait_for(self, condition: Callable[[], bool], timeout: float | None = None) -> None:
        """Wait until what has come fulfils the condition, or the source is to end, or for `timeout` s."""
        with self.lock:
            self.lock.wait_for(lambda: self.stopped or condition(), timeout)

    def _send_all(self) -> None:
        samples = self.source.samples()
        try:
            for item in samples:
                if self.stopped:
                    return
                if isinstance(item, Quiet):
                    self._report(item.until)
                    continue
                port, sample = item
                self._wait_for_window(sample.stamp)
                self._wait_for_room(sample.stamp)
                self._send(port, sample)
                if self.reports.due():
                    self._report()
                    self._count()
        finally:
            samples.close()

    def _send(self, port: str, sample: Sample | Encoded) -> None:
        with self.lock:
            payload = self.feed.take(port, sample, self._now())
            seq = self.feed.outputs[port].sent - 1
        if payload is not None:
            # First sent, then kept: what is sent again on request never arrives before the sample itself. And without
            # the lock: requests do not wait for a link.
            self.bus.send(self.plan.node, port, payload)
            with self.lock:
                self.outputs.history.keep(port, seq, payload)

    def _report(self, nothing_until: int = BEGIN) -> None:
        """Say how far the source has come; no sample up to the stamp `nothing_until` (ns) will follow."""
        with self.lock:
            self.feed.nothing_until(nothing_until, self._now())
            progress = self.feed.progress()
        self.reports.progress(progress)

    def _now(self) -> int | None:
        """The clock (ns) that no sample may lie far ahead of; a replay has none."""
        return None if self.plan.replay else self._present.now()

    def _wait_for_window(self, stamp: int) -> None:
        """Hold a replay's sample back until the readers have come near enough."""
        while stamp > self.until and not self.stopped:
            self._report(stamp - 1)
            self._wait_for(lambda: stamp <= self.until, SAY_AGAIN_PERIOD)

    def _wait_for_room(self, stamp: int) -> None:
        """Hold a replay's sample back while readers have not confirmed more than they, and this node, may hold."""
        while self.outputs.full and not self.stopped:
            self._report(stamp - 1)
            self._count()
            self._wait_for(lambda: not self.outputs.full, SAY_AGAIN_PERIOD)

    def _take_all_events(self) -> None:
        """Take what comes, however long the source is silent: a restarted reader asks for what it missed."""
        try:
            while not self.stopped:
                for event in self.bus.events(timeout=None):
                    self._take(event)
        except BaseException as error:
            if not self.stopped:  # else the session is closing
                self.broken = error
                main = threading.main_thread().ident or 0
                signal.pthread_kill(main, signal.SIGTERM)  # it raises the error, and may be blocked in a read

    def _take(self, event: Event) -> None:
        if isinstance(event, HistoryAsked):
            with self.lock:
                payloads, end = self.outputs.asked(event, self.feed.progress().ports[event.port])
            self.bus.answer(event, payloads, end)
            return
        with self.lock:
            match event:
                case Started():
                    self.started = True
                case Opened():
                    self.until = max(self.until, event.until)
                case Confirmed():
                    self.outputs.confirm(event)
                case _:
                    pass  # a source has no inputs
            self.lock.notify_all()

    def _end(self) -> None:
        """Say that nothing more will come, and stay until the launcher ends the flow."""
        self.feed.ended = True
        self._count(at_once=True)
        while not self.stopped:
            self._report()
            self._count()
            self._wait_for(lambda: False, SAY_AGAIN_PERIOD)

    @contextmanager
    def _ended_by_sigterm(self) -> Iterator[None]:
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

    def _count(self, *, at_once: bool = False) -> None:
        if at_once or self.reports.counters_due():
            self.reports.counters(counted(self.feed, self.outputs))


def counted(feed: Feed, outputs: Outputs) -> Counters:
    """What became of a source's samples."""
    return Counters(
        node=feed.node,
        inputs={},
        outputs={port: out.sent for port, out in feed.outputs.items()},
        refused=feed.refused,
        unsent=dict(feed.unsent),
        ended=feed.ended,
        held=outputs.history.held,
        let_go=outputs.history.let_go,
    )
