"""One node's place on the bus: its Zenoh session, its keys, and one inbox for everything that comes.

Zenoh's threads put things into the inbox; what they mean is decided on the node's own thread. But a node may take
samples at once, on the thread that brought them: waking another one costs more than most operators do.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from types import TracebackType
from typing import Any, TypeAlias, TypeVar

import msgspec
import zenoh

from caneflow.messages import MEDIA_TYPE, MessageError, control_key, decode, encode
from caneflow.messages.codec import MAX_SEQ
from caneflow.messages.control import Again, Clock, Counters, LeftOut, PortMark, Progress, Window
from caneflow.messages.registry import SCHEMA
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.session import KnownThreads, open_session, sending_now, sent_at
from caneflow.runtime.hosts.process.inbox import Inbox
from caneflow.runtime.plan import InputPlan, NodePlan
from caneflow.runtime.stages.byte_budget import CONTROL, INBOX, PER_REQUEST, PER_SAMPLE, share

log = logging.getLogger(__name__)

C = TypeVar("C", bound=msgspec.Struct)

AGAIN = "caneflow.Again/1"
ANSWER_TIMEOUT = 10.0  # s that a writer may take to send samples again
TIMED_IN_REPLAY = 17  # one sample in so many says when it was sent; odd, so that streams in turn all come to it
TIMED_PERIOD = 0.047  # s between two in a live run; odd as well
ENCODINGS_KEPT = 8
LONGEST_ENCODING = 256  # characters
HEARING_OUT = 1.0  # s, at most, for what has come when a node is to end
POLL = 0.01  # s between two looks at a condition that Zenoh does not signal


class Arrived(msgspec.Struct, frozen=True, gc=False):
    """A sample, not yet looked at."""

    port: str
    payload: bytes
    schema: str  # "" when the writer did not say
    again: bool = False  # it was asked for
    sent_at: int = 0  # ns: when the writer put it, as it says beside the sample; 0: it did not say


class Marked(msgspec.Struct, frozen=True, gc=False):
    """A writer's progress, on the port that reads from it."""

    port: str
    mark: PortMark


class Answered(msgspec.Struct, frozen=True, gc=False):
    """A writer has sent again what it still has of a stream."""

    port: str
    first: int  # seq of the oldest sample that it still has
    mark: PortMark


class AskEnded(msgspec.Struct, frozen=True, gc=False):
    """A request of this node's for samples is over: all that came of it was put before this."""

    port: str


class Asked(msgspec.Struct, frozen=True, gc=False):
    """A reader asks for samples of an output port again."""

    port: str
    first: int  # seq of the first one it wants
    query: zenoh.Query


class Questioned(msgspec.Struct, frozen=True, gc=False):
    """A tool asks a sink something."""

    question: bytes
    query: zenoh.Query


class Confirmed(msgspec.Struct, frozen=True, gc=False):
    """A reader will not ask for a sample or any before it."""

    port: str  # of this node
    reader: str
    seq: int


class Noted(msgspec.Struct, frozen=True, gc=False):
    """What a node says that it left out."""

    key: str
    payload: bytes


class Timed(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word on another machine's clock."""

    clock: Clock


class Broken(msgspec.Struct, frozen=True, gc=False):
    """Something was raised while an event was taken at once: it belongs to the node's own thread."""

    error: BaseException


class Started(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word that every node is ready."""


class Opened(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word on how far the sources of a replay may send."""

    until: int


class Stopped(msgspec.Struct, frozen=True, gc=False):
    """The flow ends: SIGTERM, or Ctrl-C."""


Held: TypeAlias = "zenoh.Subscriber[None] | zenoh.Queryable[None] | zenoh.LivelinessToken"
Event: TypeAlias = (
    Arrived
    | Answered
    | AskEnded
    | Asked
    | Questioned
    | Confirmed
    | Noted
    | Marked
    | Timed
    | Broken
    | Started
    | Opened
    | Stopped
)


class _Lane:
    """In a replay, all that comes for one input port, in order, on a thread of its own, which may block.

    Zenoh's receiving thread never waits for it: two nodes that wait for each other's would wait for ever. And a mark or
    an answer never overtakes the samples that its writer sent before it: they would seem missing.
    """

    def __init__(self, name: str, inbox: Inbox[Event], bring: Callable[[Event], None]) -> None:
        self._inbox = inbox
        self.put = inbox.put
        self._bring = bring
        self._thread = threading.Thread(target=self._bring_all, name=name, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Bring what has come, and no more."""
        self._inbox.put(Stopped())
        self._thread.join(HEARING_OUT)

    @property
    def held(self) -> int:
        """What waits, in bytes."""
        return self._inbox.held

    def _bring_all(self) -> None:
        while type(event := self._inbox.get()) is not Stopped:
            self._bring(event)


class Bus:
    """A node's session; a context manager, since a session that is not closed hangs its process."""

    def __init__(self, plan: NodePlan) -> None:
        self.ready = False  # it hears, is heard, and has said so
        self._plan = plan
        self.dropped = dict.fromkeys(plan.inputs, 0)  # by input port: samples for which there was no room
        self._unheard = False  # a mark or a request was dropped, as was said
        self._inbox = self._new_inbox(CONTROL if plan.replay else INBOX)
        # Takes an event on the thread that brought it; False: it did not, and the event goes into the inbox.
        self.at_once: Callable[[Event], bool] | None = None
        self._threads = KnownThreads()
        links = plan.links
        self._session = open_session(
            listen=links.listen, connect=links.connect, replay=plan.replay, identity=links.identity
        )
        # Whatever must outlive its statement: a liveliness token that no variable holds is undeclared at once.
        self._held: list[Held] = []
        self._subscribers: list[zenoh.Subscriber[Any]] = []  # of samples in a replay
        self._lanes: dict[str, _Lane] = {}  # by input port, in a replay
        self._listen()
        self._publishers = {port: self._publisher(out.key, out.schema) for port, out in plan.outputs.items()}
        self._progress = self._control_publisher("progress", plan.node)
        self._marks = self._control_publisher("marks", plan.node)
        self._counters = self._control_publisher("counters", plan.node)
        self._late = self._control_publisher("late")
        self._timed_next = 0.0  # s, monotonic; live
        self._until_timed = 0  # in a replay: samples to send before the next that says when it was sent

    def __enter__(self) -> "Bus":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hear_out()
        for held in self._held:  # first, or Zenoh reports what still comes for a session that is closing
            held.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
        self._session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types

    def declare_ready(self) -> None:
        """Tell the launcher that this node hears its inputs and is heard by its readers; waits for the latter."""
        for reader in self._plan.readers:
            if reader not in self._plan.absent:
                self._wait_for_reader(reader)
        key = control_key(self._plan.flow, "ready", self._plan.node)
        self._held.append(self._session.liveliness().declare_token(key))
        self.ready = True

    def hear_out(self) -> None:
        """End the threads that samples come on, once they have brought what has come."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
        for lane in self._lanes.values():
            lane.end()
        self._subscribers.clear()

    def put(self, event: Event) -> None:
        """Add an event of this process's own; safe in a signal handler."""
        self._inbox.put(event)

    @property
    def held(self) -> int:
        """What has come and waits to be looked at, in bytes."""
        return self._inbox.held + sum(lane.held for lane in self._lanes.values())

    def _new_inbox(self, budget: int) -> Inbox[Event]:
        # Live the newest counts; in a replay no more is on its way than there is room for, unless somebody forges.
        return Inbox(budget, _weight, self._drop, oldest_first=not self._plan.replay)

    def _drop(self, event: Event) -> None:
        if isinstance(event, Arrived):
            self.dropped[event.port] += not event.again  # else it is asked for once more
        elif not self._unheard:
            self._unheard = True
            log.warning("%s: more marks and requests come than it can take; dropped", self._plan.node)

    def _bring(self, event: Event) -> None:
        if self.at_once is None or not self.at_once(event):
            self._inbox.put(event)

    def events(self, timeout: float | None) -> Iterator[Event]:
        """Everything in the inbox, after waiting up to `timeout` s (None: for ever) for the first."""
        try:
            yield self._inbox.get(timeout=timeout)
            while not self._inbox.empty():
                yield self._inbox.get_nowait()
        except queue.Empty:
            return

    def pending(self) -> bool:
        """Whether the inbox holds anything."""
        return not self._inbox.empty()

    def ask_again(self, port: str, first: int) -> None:
        """Ask the writer of an input for its samples from seq `first` on.

        They come as events, then Answered; at the end, also when nobody answers, AskEnded.
        """
        wire = self._plan.inputs[port]
        key = control_key(self._plan.flow, "history", wire.writer, wire.key.rpartition("/")[2])
        take = self._inbox.put if self._lanes.get(port) is None else self._lanes[port].put
        handler = zenoh.handlers.Callback(self._on_reply(port, take), partial(take, AskEnded(port)), indirect=False)
        # Without this Zenoh keeps only the last of several replies under one key.
        every = zenoh.ConsolidationMode.NONE
        self._session.get(key, handler, payload=str(first), timeout=ANSWER_TIMEOUT, consolidation=every)

    def answer(self, asked: Asked, payloads: Iterable[bytes], end: Again) -> None:
        """Send samples again to the one who asked."""
        out = self._plan.outputs[asked.port]
        key = control_key(self._plan.flow, "history", self._plan.node, asked.port)
        encoding = zenoh.Encoding(MEDIA_TYPE).with_schema(out.schema)
        with asked.query as query:
            for payload in payloads:
                query.reply(key, payload, encoding=encoding)
            query.reply(key, encode(end), encoding=zenoh.Encoding(MEDIA_TYPE).with_schema(AGAIN))

    def answer_question(self, questioned: Questioned, answer: bytes | None) -> None:
        """Send a sink's answer; without one, the tool is told that there is none."""
        with questioned.query as query:
            if answer is None:
                query.reply_err(f"{self._plan.node} has no answer to this")
            else:
                query.reply(query.key_expr, answer)

    def send(self, port: str, payload: bytes) -> None:
        """Publish a sample's bytes on an output port."""
        if self._is_timed():  # beside the sample, whose bytes are the recording's
            self._publishers[port].put(payload, attachment=sending_now())
        else:
            self._publishers[port].put(payload)

    def _is_timed(self) -> bool:
        """Whether the next sample is to say when it was sent: some do, which is enough to know how long they take."""
        if self._plan.replay:
            self._until_timed = self._until_timed - 1 if self._until_timed else TIMED_IN_REPLAY - 1
            return self._until_timed == TIMED_IN_REPLAY - 1
        now = time.monotonic()
        if now < self._timed_next:
            return False
        self._timed_next = now + TIMED_PERIOD
        return True

    def send_progress(self, progress: Progress) -> None:
        """Publish how far this node has come."""
        self._progress.put(encode(progress))

    def send_marks(self, progress: Progress) -> None:
        """Publish how far this node has come to those of its readers that wait for it."""
        self._marks.put(encode(progress))

    def send_left_out(self, note: LeftOut) -> None:
        """Publish that a sample was not handled."""
        self._late.put(encode(note))

    def send_counters(self, counters: Counters) -> None:
        """Publish what became of this node's samples."""
        self._counters.put(encode(counters))

    def _listen(self) -> None:
        plan = self._plan
        by_writer: dict[str, dict[str, str]] = {}  # writer -> its port -> this node's port
        for port, wire in plan.inputs.items():
            if plan.replay:
                inbox = self._new_inbox(share(INBOX, len(plan.inputs)))
                self._lanes[port] = _Lane(wire.key, inbox, self._bring)
                handler = zenoh.handlers.Callback(self._on_sample(port), indirect=False)
                self._subscribers.append(self._session.declare_subscriber(wire.key, handler))
            else:
                self._subscribe(wire.key, self._on_sample(port))
            by_writer.setdefault(wire.writer, {})[wire.key.rpartition("/")[2]] = port
        for writer, ports in by_writer.items():
            # Whoever has no readers keeps nobody waiting.
            for word in ("progress",) if plan.replay or not plan.outputs else ("progress", "marks"):
                self._subscribe(control_key(plan.flow, word, writer), self._on_progress(ports))
            # That a writer's question arrives here shows that this side's subscriptions arrived there.
            key = control_key(plan.flow, "edge", writer, plan.node)
            self._answer_with(key, partial(_say_yes, key))
        for port, out in plan.outputs.items():
            self._answer_with(control_key(plan.flow, "history", plan.node, port), self._on_asked(port))
            for reader in out.readers:
                self._subscribe(control_key(plan.flow, "progress", reader), self._on_confirmed(port, reader, out.key))
        self._subscribe(control_key(plan.flow, "start"), lambda _: self._inbox.put(Started()))
        if plan.replay:
            self._subscribe(control_key(plan.flow, "window"), self._on_window)
        for machine in {wire.clock for wire in plan.inputs.values()} - {""}:
            self._subscribe(control_key(plan.flow, "clock", plan.machine, machine), self._on_clock)
        if plan.hears_notes:
            self._subscribe(control_key(plan.flow, "late"), self._on_note)
        if plan.inputs and not plan.outputs:
            self._answer_with(control_key(plan.flow, "ask", plan.node), self._on_question)

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
        # Straight on Zenoh's receiving thread: a put into the inbox does not hold it up, nor does a node that is quick.
        handler = zenoh.handlers.Callback(callback, indirect=False)
        self._held.append(self._session.declare_subscriber(key, handler))

    def _answer_with(self, key: str, callback: Callable[[zenoh.Query], None]) -> None:
        handler = zenoh.handlers.Callback(callback, indirect=False)
        self._held.append(self._session.declare_queryable(key, handler))

    def _wait_for_reader(self, reader: str) -> None:
        key = control_key(self._plan.flow, "edge", self._plan.node, reader)
        deadline = time.monotonic() + self._plan.ready_timeout_s
        while not any(reply.ok for reply in self._session.get(key, timeout=1.0)):
            if time.monotonic() > deadline:
                raise DataflowError(f"{reader} does not answer after {self._plan.ready_timeout_s:g} s")
            time.sleep(POLL)

    def _publisher(self, key: str, schema: str) -> zenoh.Publisher:
        replay = self._plan.replay
        return self._session.declare_publisher(
            key,
            encoding=zenoh.Encoding(MEDIA_TYPE).with_schema(schema),
            congestion_control=zenoh.CongestionControl.BLOCK if replay else zenoh.CongestionControl.DROP,
            express=not replay,  # live: the newest sample at once; replay: throughput
        )

    def _control_publisher(self, *parts: str) -> zenoh.Publisher:
        return self._session.declare_publisher(
            control_key(self._plan.flow, *parts), congestion_control=zenoh.CongestionControl.BLOCK
        )

    def _on_sample(self, port: str) -> Callable[[zenoh.Sample], None]:
        schemas: dict[str, str] = {}  # by encoding: there is one, or a few that are wrong
        take = self._taking(port)

        def put(sample: zenoh.Sample) -> None:
            self._threads.know_this_one()
            encoding = str(sample.encoding)
            schema = schemas.get(encoding)
            if schema is None:
                schema = encoding.rpartition(";")[2]
                if len(schemas) < ENCODINGS_KEPT and len(encoding) < LONGEST_ENCODING:
                    schemas[encoding] = schema
            take(Arrived(port, sample.payload.to_bytes(), schema, sent_at=sent_at(sample)))

        return put

    def _taking(self, port: str) -> Callable[[Event], None]:
        """Where what comes for an input port goes, in the order in which its writer sent it."""
        lane = self._lanes.get(port)
        return self._bring if lane is None else lane.put

    def _on_reply(self, port: str, take: Callable[[Event], None]) -> Callable[[zenoh.Reply], None]:
        def put(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                return
            schema = str(reply.ok.encoding).rpartition(";")[2]
            if schema != AGAIN:
                take(Arrived(port, reply.ok.payload.to_bytes(), schema, again=True))
            elif end := _control(reply.ok, Again):
                take(Answered(port, end.first, end.mark))

        return put

    def _on_asked(self, port: str) -> Callable[[zenoh.Query], None]:
        def put(query: zenoh.Query) -> None:
            first = query.payload.to_bytes() if query.payload is not None else b""
            if first.isdigit() and len(first) <= len(str(MAX_SEQ)):  # else nobody of ours asks
                self._inbox.put(Asked(port, int(first), query))

        return put

    def _on_confirmed(self, port: str, reader: str, key: str) -> Callable[[zenoh.Sample], None]:
        def put(sample: zenoh.Sample) -> None:
            progress = _control(sample, Progress)
            if progress and key in progress.confirmed:
                self._bring(Confirmed(port, reader, progress.confirmed[key]))

        return put

    def _on_progress(self, ports: dict[str, str]) -> Callable[[zenoh.Sample], None]:
        takes = {port: self._taking(own) for port, own in ports.items()}

        def put(sample: zenoh.Sample) -> None:
            progress = _control(sample, Progress)
            for port, mark in progress.ports.items() if progress else ():
                if port in ports:
                    takes[port](Marked(ports[port], mark))

        return put

    def _on_question(self, query: zenoh.Query) -> None:
        question = query.payload.to_bytes() if query.payload is not None else b""
        self._inbox.put(Questioned(question, query))

    def _on_note(self, sample: zenoh.Sample) -> None:
        self._inbox.put(Noted(str(sample.key_expr), sample.payload.to_bytes()))

    def _on_clock(self, sample: zenoh.Sample) -> None:
        clock = _control(sample, Clock)
        if clock:
            self._inbox.put(Timed(clock))

    def _on_window(self, sample: zenoh.Sample) -> None:
        window = _control(sample, Window)
        if window:
            self._inbox.put(Opened(window.until))


def _weight(event: Event) -> int:
    """What an event takes in the inbox, in bytes; 0: it is the launcher's or this process's own."""
    kind = type(event)
    if kind is Arrived:
        return PER_SAMPLE + len(event.payload) + len(event.schema)  # type: ignore[union-attr]  # the kind says it
    match event:
        case Started() | Stopped() | Broken() | AskEnded():
            return 0
        case Noted():
            return PER_SAMPLE + len(event.payload)
        case Asked():
            return PER_REQUEST
        case Questioned():
            return PER_REQUEST + len(event.question)
        case _:
            return PER_SAMPLE


def _say_yes(key: str, query: zenoh.Query) -> None:
    with query:
        query.reply(key, b"")


def check_schema(arrived: Arrived, wire: InputPlan) -> None:
    """Raise MessageError when the writer said another type than the port takes."""
    # A writer that says no schema (a C client: "zenoh/bytes;application/msgpack") is decoded by the port's type.
    if arrived.schema != wire.schema and SCHEMA.fullmatch(arrived.schema):
        raise MessageError(f"a {arrived.schema} came; the port takes {wire.schema}")


def _control(sample: zenoh.Sample, kind: type[C]) -> C | None:
    try:
        return decode(sample.payload.to_bytes(), kind)
    except MessageError as error:
        log.warning("%s: refused: %s", sample.key_expr, error)
        return None
