"""A process's place on the bus: its session, the keys of its nodes, and one inbox for everything that comes.

Zenoh's threads put things into the inbox; what they mean is decided on the process's own thread. But it may take
samples at once, on the thread that brought them: waking another one costs more than most operators do.
"""

import logging
import queue
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from types import TracebackType
from typing import Any, TypeAlias

import zenoh

from caneflow.messages import MEDIA_TYPE, control_key, encode
from caneflow.messages.control import Again, Counters, LeftOut, Progress
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.session import KnownThreads, open_session, sending_now
from caneflow.runtime.hosts.process import callbacks
from caneflow.runtime.hosts.process.events import (
    Arrived,
    AskEnded,
    Event,
    HistoryAsked,
    SinkAsked,
    Started,
    weight_of_event,
)
from caneflow.runtime.hosts.process.inbox import Inbox
from caneflow.runtime.hosts.process.lanes import HEARING_OUT, Lane
from caneflow.runtime.plan import NodePlan, ProcessPlan
from caneflow.runtime.stages.byte_budget import CONTROL, INBOX, share

log = logging.getLogger(__name__)

Held: TypeAlias = "zenoh.Subscriber[None] | zenoh.Queryable[None] | zenoh.MatchingListener[None]"

ANSWER_TIMEOUT = 10.0  # s that a writer may take to send samples again
TIMED_IN_REPLAY = 17  # one sample in so many says when it was sent; odd, so that streams in turn all come to it
TIMED_PERIOD = 0.047  # s between two in a live run; odd as well
POLL = 0.01  # s between two looks at a condition that Zenoh does not signal


class Bus:
    """A process's session; a context manager, since a session that is not closed hangs its process."""

    def __init__(self, plan: ProcessPlan) -> None:
        self.ready = False  # its nodes hear, are heard, and have said so
        self._plan = plan
        self.dropped = dict.fromkeys(plan.arriving, 0)  # by node and input port: samples for which there was no room
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
        self._tokens: dict[str, zenoh.LivelinessToken] = {}  # by node: it is ready
        self._subscribers: list[zenoh.Subscriber[Any]] = []  # of samples in a replay
        self._lanes: dict[tuple[str, str], Lane] = {}  # by node and input port, in a replay
        self._listen()
        self._publishers = {
            (node.node, port): self._publisher(out.key, out.schema)
            for node in plan.nodes
            for port, out in node.outputs.items()
        }
        # Ports whose samples go out: all, but in a group those that only members read, while nobody else listens.
        self._heard = set(self._publishers)
        if plan.is_group:
            self._watch_listeners()
        self._words = {
            (word, node): self._control_publisher(word, node)
            for node in plan.members
            for word in ("progress", "marks", "counters")
        }
        self._late = self._control_publisher("late")
        self._timed_next = 0.0  # s, monotonic; live
        self._until_timed = 0  # in a replay: samples to send before the next that says when it was sent

    def __enter__(self) -> "Bus":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hear_out()
        # First, or Zenoh reports what still comes for a session that is closing.
        for held in (*self._tokens.values(), *self._held):
            held.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
        self._session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types

    def declare_ready(self) -> None:
        """Tell the launcher that the nodes hear their inputs and are heard by their readers; waits for the latter."""
        for node in self._plan.nodes:
            for reader in node.readers:
                if reader not in node.absent and reader not in self._plan.members:
                    self._wait_for_reader(node, reader)
        for name in self._plan.members:
            key = control_key(self._plan.flow, "ready", name)
            self._tokens[name] = self._session.liveliness().declare_token(key)
        self.ready = True

    def declare_gone(self, nodes: Iterable[str]) -> None:
        """Tell the launcher that nothing more comes from some of the nodes."""
        for node in nodes:
            if node in self._tokens:
                self._tokens.pop(node).undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types

    def hear_out(self) -> None:
        """End the threads that samples come on, once they have brought what has come."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
        for lane in self._lanes.values():
            lane.end()
        until = time.monotonic() + HEARING_OUT
        for lane in self._lanes.values():
            lane.wait_for_end(until)
        self._subscribers.clear()

    def put(self, event: Event) -> None:
        """Add an event of this process's own; safe in a signal handler."""
        self._inbox.put(event)

    @property
    def held(self) -> int:
        """What has come and waits to be looked at, in bytes."""
        return self._inbox.held + sum(lane.held for lane in self._lanes.values())

    def _new_inbox(self, budget: int) -> Inbox[Event]:
        # Live the newest counts; in a replay no more is on its way than there is room for, unless someone forges.
        return Inbox(budget, weight_of_event, self._drop, oldest_first=not self._plan.replay)

    def _drop(self, event: Event) -> None:
        if isinstance(event, Arrived):
            self.dropped[event.node, event.port] += not event.again  # else it is asked for once more
        elif not self._unheard:
            self._unheard = True
            log.warning("%s: more marks and requests come than it can take; dropped", self._plan.name)

    def _bring(self, event: Event) -> None:
        if self.at_once is None or not self.at_once(event):
            self._inbox.put(event)

    def events(self, timeout: float | None) -> Iterator[Event]:
        """Everything in the inbox, after waiting up to `timeout` s (None: forever) for the first."""
        try:
            yield self._inbox.get(timeout=timeout)
            while not self._inbox.empty():
                yield self._inbox.get_nowait()
        except queue.Empty:
            return

    def pending(self) -> bool:
        """Whether the inbox holds anything."""
        return not self._inbox.empty()

    def ask_again(self, node: str, port: str, first: int) -> None:
        """Ask the writer of a node's input for its samples from seq `first` on.

        They come as events, then HistoryAnswered; at the end, also when nobody answers, AskEnded.
        """
        wire = self._plan.arriving[node, port]
        key = control_key(self._plan.flow, "history", wire.writer, wire.key.rpartition("/")[2])
        lane = self._lanes.get((node, port))
        take = self._inbox.put if lane is None else lane.put
        ended = partial(take, AskEnded(node, port))
        handler = zenoh.handlers.Callback(callbacks.on_reply(node, port, take), ended, indirect=False)
        # Without this Zenoh keeps only the last of several replies under one key.
        every = zenoh.ConsolidationMode.NONE
        self._session.get(key, handler, payload=str(first), timeout=ANSWER_TIMEOUT, consolidation=every)

    def answer(self, asked: HistoryAsked, payloads: Iterable[bytes], end: Again) -> None:
        """Send samples again to the one who asked."""
        out = self._plan.members[asked.node].outputs[asked.port]
        key = control_key(self._plan.flow, "history", asked.node, asked.port)
        encoding = zenoh.Encoding(MEDIA_TYPE).with_schema(out.schema)
        with asked.query as query:
            for payload in payloads:
                query.reply(key, payload, encoding=encoding)
            query.reply(key, encode(end), encoding=zenoh.Encoding(MEDIA_TYPE).with_schema(callbacks.AGAIN))

    def answer_question(self, asked: SinkAsked, answer: bytes | None) -> None:
        """Send a sink's answer; without one, the tool is told that there is none."""
        with asked.query as query:
            if answer is None:
                query.reply_err(f"{asked.node} has no answer to this")
            else:
                query.reply(query.key_expr, answer)

    def is_heard(self, node: str, port: str) -> bool:
        """Whether anybody outside may hear what is sent on an output port."""
        return (node, port) in self._heard

    def send(self, node: str, port: str, payload: bytes) -> None:
        """Publish a sample's bytes on a node's output port."""
        if self._is_timed():  # beside the sample, whose bytes are the recording's
            self._publishers[node, port].put(payload, attachment=sending_now())
        else:
            self._publishers[node, port].put(payload)

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
        """Publish how far a node has come."""
        self._words["progress", progress.node].put(encode(progress))

    def send_marks(self, progress: Progress) -> None:
        """Publish how far a node has come to those of its readers that wait for it."""
        self._words["marks", progress.node].put(encode(progress))

    @property
    def hears_left_out(self) -> bool:
        """Whether anybody hears what is said to be left out: a recorder may not be linked yet after a kill."""
        return bool(self._late.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool

    def send_left_out(self, note: LeftOut) -> None:
        """Publish that a sample was not handled."""
        self._late.put(encode(note))

    def send_counters(self, counters: Counters) -> None:
        """Publish what became of a node's samples."""
        self._words["counters", counters.node].put(encode(counters))

    def _listen(self) -> None:
        plan = self._plan
        puts: dict[tuple[str, str], Callable[[Event], None]] = {}
        # Writer -> its port -> the nodes here that read it, and their own ports.
        by_writer: dict[str, dict[str, list[tuple[str, str]]]] = {}
        for at, wire in plan.arriving.items():
            if plan.replay:
                lane = Lane(wire.key, self._new_inbox(share(INBOX, len(plan.arriving))), self._bring)
                self._lanes[at], puts[at] = lane, lane.put
                handler = zenoh.handlers.Callback(callbacks.on_sample(*at, lane.put, self._threads), indirect=False)
                self._subscribers.append(self._session.declare_subscriber(wire.key, handler))
            else:
                puts[at] = self._bring
                self._subscribe(wire.key, callbacks.on_sample(*at, self._bring, self._threads))
            by_writer.setdefault(wire.writer, {}).setdefault(wire.key.rpartition("/")[2], []).append(at)
        for writer, ports in by_writer.items():
            readers = {node: plan.members[node] for reading in ports.values() for node, _ in reading}
            # Whoever has no readers keeps nobody waiting.
            awaited = not plan.replay and any(reader.outputs for reader in readers.values())
            for word in ("progress", "marks") if awaited else ("progress",):
                self._subscribe(control_key(plan.flow, word, writer), callbacks.on_progress(ports, puts))
            # That a writer's question arrives here shows that this side's subscriptions arrived there.
            for reader in readers:
                key = control_key(plan.flow, "edge", writer, reader)
                self._answer_with(key, callbacks.say_yes(key))
        for node in plan.nodes:
            self._listen_as(node)
        self._subscribe(control_key(plan.flow, "start"), lambda _: self._inbox.put(Started()))
        if plan.replay:
            self._subscribe(control_key(plan.flow, "window"), callbacks.on_window(self._inbox.put))
        machine = plan.nodes[0].machine
        for other in {wire.clock for wire in plan.arriving.values()} - {""}:
            self._subscribe(control_key(plan.flow, "clock", machine, other), callbacks.on_clock(self._inbox.put))

    def _listen_as(self, node: NodePlan) -> None:
        """Hear what is for one node: requests of its readers, questions and notes for a sink."""
        flow, name = node.flow, node.node
        for port, out in node.outputs.items():
            asked = callbacks.on_history_asked(name, port, self._inbox.put)
            self._answer_with(control_key(flow, "history", name, port), asked)
            for reader in self._plan.readers_outside(out):
                confirmed = callbacks.on_confirmed(name, port, reader, out.key, self._bring)
                self._subscribe(control_key(flow, "progress", reader), confirmed)
        if node.hears_notes:
            self._subscribe(control_key(flow, "late"), callbacks.on_note(name, self._inbox.put))
        if node.inputs and not node.outputs:
            self._answer_with(control_key(flow, "ask", name), callbacks.on_question(name, self._inbox.put))

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
        # Straight on Zenoh's receiving thread: a put into the inbox does not hold it up, nor does a node that is quick.
        handler = zenoh.handlers.Callback(callback, indirect=False)
        self._held.append(self._session.declare_subscriber(key, handler))

    def _answer_with(self, key: str, callback: Callable[[zenoh.Query], None]) -> None:
        handler = zenoh.handlers.Callback(callback, indirect=False)
        self._held.append(self._session.declare_queryable(key, handler))

    def _wait_for_reader(self, node: NodePlan, reader: str) -> None:
        key = control_key(node.flow, "edge", node.node, reader)
        deadline = time.monotonic() + node.ready_timeout_s
        while not any(reply.ok for reply in self._session.get(key, timeout=1.0)):
            if time.monotonic() > deadline:
                raise DataflowError(f"{reader} does not answer after {node.ready_timeout_s:g} s")
            time.sleep(POLL)

    def _publisher(self, key: str, schema: str) -> zenoh.Publisher:
        replay = self._plan.replay
        return self._session.declare_publisher(
            key,
            encoding=zenoh.Encoding(MEDIA_TYPE).with_schema(schema),
            congestion_control=zenoh.CongestionControl.BLOCK if replay else zenoh.CongestionControl.DROP,
            express=not replay,  # live: the newest sample at once; replay: throughput
        )

    def _watch_listeners(self) -> None:
        """Follow whether tools listen to what only members read."""
        for node in self._plan.nodes:
            for port, out in node.outputs.items():
                if not self._plan.readers_outside(out):
                    at = (node.node, port)
                    self._heard.discard(at)
                    watch = callbacks.on_matching(partial(self._heard.add, at), partial(self._heard.discard, at))
                    handler = zenoh.handlers.Callback(watch, indirect=False)
                    self._held.append(self._publishers[at].declare_matching_listener(handler))

    def _control_publisher(self, *parts: str) -> zenoh.Publisher:
        return self._session.declare_publisher(
            control_key(self._plan.flow, *parts), congestion_control=zenoh.CongestionControl.BLOCK
        )
