"""Samples from other processes: decoded, timed, asked for again when they are missing."""

import time
from collections import deque
from dataclasses import dataclass

from caneflow.messages import MessageError, Sample, decode
from caneflow.messages.control import Clock, Delays, PortMark
from caneflow.messages.registry import SCHEMA
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import Arrived, HistoryAnswered
from caneflow.runtime.hosts.process.present import Present
from caneflow.runtime.hosts.process.recent_delays import RecentDelays
from caneflow.runtime.hosts.process.reports import LIVE_REPORT_PERIOD, REPORT_PERIOD
from caneflow.runtime.plan import InputPlan, NodePlan, ProcessPlan
from caneflow.runtime.stages.byte_budget import WAITING
from caneflow.runtime.stages.group import Group
from caneflow.runtime.stages.merge import BEGIN
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.streams import AHEAD_KEPT, Arrivals

ASK_PERIOD = 0.3  # s between two requests for samples that have not come
LIVE_PATIENCE = 1.0  # s that later samples wait for them in a live run, while their writer sends and does not answer
RESUME_PATIENCE = 3.0  # s that a group which goes on after a kill waits for what had come, whatever an input's lag
SILENT_PATIENCE = 10.0  # s, likewise, while it does neither: it may be busy, and nothing else comes that has to wait
REPLAY_PATIENCE = 60.0  # s, likewise in a replay: nothing is to be lost, and its writer may be coming back


LIVE_LOOK_PERIOD = 0.1  # s after which a live process looks at what is due by time, though nothing came
LOOKS_PER_LAG = 5  # and so often within the time that it may wait for an input


def look_period(plan: ProcessPlan) -> float:
    """How often (s) a process looks at what is due by time."""
    if plan.replay:
        return REPORT_PERIOD
    wires = [wire for node in plan.nodes for wire in node.inputs.values()]
    lags = [wire.max_lag_ms for wire in wires if wire.max_lag_ms is not None]
    if not (lags or plan.arriving):
        return LIVE_REPORT_PERIOD
    return max(min([LIVE_LOOK_PERIOD, *(1e-3 * lag / LOOKS_PER_LAG for lag in lags)]), REPORT_PERIOD / 4)


@dataclass
class _Missing:
    """Samples that were sent and have not come."""

    expected: int  # seq of the first of them
    newest: int  # seq that the writer had sent then
    since: float  # s, monotonic
    ask_at: float  # s, monotonic


class Inputs:
    """The inputs of one node."""

    def __init__(self, plan: NodePlan, process: ProcessPlan, group: Group, bus: Bus) -> None:
        self._plan = plan
        self._group = group
        self._bus = bus
        self._reader = group.readers[plan.node]
        self._present = Present()
        self._delays = {port: RecentDelays(live=not plan.replay) for port in plan.inputs}
        arriving = {port: wire for port, wire in plan.inputs.items() if (plan.node, port) in process.arriving}
        self._arriving: dict[str, Arrivals] = {port: self._reader.inputs[port] for port in arriving}
        self._missing: dict[str, _Missing] = {}
        # Each writer is asked at the start what it has sent so far, until it answers: a node that is started again may
        # have missed its last word, and the link to the writer may not be there yet.
        asked = [port for port, wire in arriving.items() if not wire.external]
        self._unanswered = dict.fromkeys(asked, 0.0)  # s, monotonic: when to ask next
        self._asking: set[str] = set()  # ports whose writer is being asked: what it answers may wait to be looked at
        self._dropped = dict.fromkeys(arriving, 0)  # unseen, as was counted
        # Live: for each input that may lag, when the samples of the others came, and their stamps.
        self._others: dict[str, deque[tuple[float, int]]] = {
            port: deque(maxlen=AHEAD_KEPT)
            for port, wire in plan.inputs.items()
            if wire.max_lag_ms is not None and plan.outputs and not plan.replay
        }
        self._begun = time.monotonic()  # s
        self._reader.bound(WAITING)
        for port, arrivals in self._reader.inputs.items():
            arrivals.patient = port in arriving and not arriving[port].external
            arrivals.clock_offset = None if plan.inputs[port].clock else 0

    @property
    def held(self) -> int:
        """What the samples that wait take, in bytes."""
        return self._reader.held

    def at(self) -> tuple[int, int, int, str] | None:
        """When the last sample was handled, its stamp, the order of its port, and what it is called; None: none was."""
        handled = [
            (each.handled_at or 0, each.handled_stamp, order, f"{port} seq {each.handled_seq}")
            for order, (port, each) in enumerate(self._reader.inputs.items())
            if each.handled_seq >= 0
        ]
        return max(handled) if handled else None

    def decoded(self, arrived: Arrived) -> Sample | None:
        """The sample that came, its delays noted; None when it is refused, and counted."""
        port = arrived.port
        wire = self._plan.inputs[port]
        try:
            check_schema(arrived, wire)
            message = decode(arrived.payload, wire.kind)
        except MessageError as error:
            self._group.refuse(arrived.node, port, error)
            return None
        arrivals = self._reader.inputs[port]
        if not self._plan.replay and (ahead := arrivals.ahead_of(message.stamp, self._present.now())) is not None:
            self._group.refuse_ahead(arrived.node, port, message, ahead, time.time_ns(), again=arrived.again)
            return None
        offset = arrivals.clock_offset
        if not (self._plan.replay or arrived.again):
            self._unanswered.pop(port, None)  # live: what is missing before it shows by its number
        if offset is not None and (arrived.sent_at or not (self._plan.replay or arrived.again)):
            sent_at = arrived.sent_at and arrived.sent_at - offset
            self._delays[port].note(time.time_ns(), sent_at, message.stamp - offset)
        return message

    def note_local(self, port: str, message: Sample) -> int:
        """Note that a sample comes from a node of this process; the time (ns) at which it does."""
        now = time.time_ns()
        if not self._plan.replay:
            self._delays[port].note(now, now, message.stamp)
        self.note_others(port, message.stamp)
        return now

    def note_others(self, port: str, stamp: int) -> None:
        """Note that a sample of `stamp` (ns) has come on `port`: the other inputs may lag behind it for so long."""
        for lagging, others in self._others.items():
            if lagging != port:
                others.append((time.monotonic(), stamp))

    def take_mark(self, port: str, mark: PortMark) -> None:
        """Take a writer's word on how far it has come, unless it lies where it cannot be yet."""
        arrivals = self._reader.inputs[port]
        ahead = None if self._plan.replay else arrivals.ahead_of(mark.watermark, self._present.now())
        if ahead is None:
            self._group.mark(self._plan.node, port, mark)
        else:
            arrivals.refuse_mark(ahead)

    def take_answer(self, answered: HistoryAnswered) -> None:
        """Take a writer's word on what it still has, after all of that has come."""
        port, arrivals = answered.port, self._reader.inputs[answered.port]
        self._unanswered.pop(port, None)
        self._begin_at(port, arrivals, answered.first)
        self.take_mark(port, answered.mark)
        if answered.first > arrivals.expected:
            self.skip_to(port, answered.first)  # the writer does not have what lies before it any more

    def ask_ended(self, port: str) -> None:
        """Note that a request for samples of `port` is over."""
        self._asking.discard(port)

    def set_clock(self, clock: Clock) -> None:
        """Take note of how far a writer's clock is from this machine's."""
        now = clock.offset + clock.drift * (time.time_ns() - clock.at) / 1e9
        for port, wire in self._plan.inputs.items():
            if wire.clock == clock.there:
                self._reader.inputs[port].clock_offset = round(now * 1e9)

    def has_gap(self, port: str) -> bool:
        """Whether samples of `port` wait for missing ones."""
        return bool(self._reader.inputs[port].ahead)

    def ask_for_missing(self) -> None:
        """Ask for samples that were sent and have not come; after long enough, go on without them."""
        now = time.monotonic()
        for port, ask_at in self._unanswered.items():
            if now >= ask_at and self._ask(port):
                self._unanswered[port] = now + ASK_PERIOD
        for port, arrivals in self._arriving.items():
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
            elif now >= missing.ask_at and self._ask(port):
                missing.ask_at = now + ASK_PERIOD

    def skip_to(self, port: str, seq: int) -> None:
        """Go on without the samples before `seq`."""
        self._group.skip_to(self._plan.node, port, seq, time.time_ns())

    def lagging(self) -> list[tuple[str, int]]:
        """Live: the inputs that hold up what came longer than their max_lag_ms ago, and up to which stamp (ns)."""
        now, found = time.monotonic(), []
        for port, others in self._others.items():
            limit = self._plan.inputs[port].max_lag_ms or 0.0
            until = None
            awaited = self._awaited_again_until(port, now)
            while others and (now - others[0][0]) * 1e3 > limit and others[0][1] > awaited:
                _, until = others.popleft()
            if until is not None:
                found.append((port, until))
        return found

    def _awaited_again_until(self, port: str, now: float) -> int:
        """After a kill, the stamp (ns) up to which the clock does not decide: what had come has been asked for."""
        coming = port in self._unanswered or self.has_gap(port)
        if not (isinstance(self._reader, Stage) and coming and now < self._begun + RESUME_PATIENCE):
            return BEGIN
        return self._reader.caught_up_at

    def count_dropped(self) -> None:
        """Count the samples for which the inbox had no room."""
        for port, counted in self._dropped.items():
            dropped = self._bus.dropped[self._plan.node, port]
            if fresh := dropped - counted:
                self._dropped[port] = dropped
                self._reader.inputs[port].drop_unseen(fresh)

    def delays(self) -> dict[str, Delays]:
        """How long the last samples of each input took."""
        now, inputs = time.time_ns(), self._reader.inputs
        return {port: each.spread(now, inputs[port].handled_age) for port, each in self._delays.items()}

    def _ask(self, port: str) -> bool:
        """Ask the writer of `port` for what has not come, unless it is being asked already; whether it is asked now."""
        if port in self._asking:
            return False
        self._asking.add(port)
        self._bus.ask_again(self._plan.node, port, self._arriving[port].expected)
        return True

    def _begin_at(self, port: str, arrivals: Arrivals, seq: int) -> None:
        """A sink in the place of another: what lies before the writer's oldest sample was that one's, and is not lost.

        An operator goes on from its snapshot.
        """
        is_new = isinstance(self._reader, Tap) and self._plan.takes_over and arrivals.handled_seq < 0
        if is_new and seq > arrivals.expected:
            arrivals.expected = seq
            self.skip_to(port, seq)

    def _patience(self, goes_on: bool) -> float:
        """How long (s) later samples wait for missing ones; `goes_on`: their writer sends more and does not answer."""
        if self._plan.replay:
            return REPLAY_PATIENCE
        return LIVE_PATIENCE if goes_on else SILENT_PATIENCE


def check_schema(arrived: Arrived, wire: InputPlan) -> None:
    """Raise MessageError when the writer said another type than the port takes."""
    # A writer that says no schema (a C client: "zenoh/bytes;application/msgpack") is decoded by the port's type.
    if arrived.schema != wire.schema and SCHEMA.fullmatch(arrived.schema):
        raise MessageError(f"a {arrived.schema} came; the port takes {wire.schema}")
