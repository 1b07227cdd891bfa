"""One node's place on the bus: its Zenoh session, its keys, and one inbox for everything that comes.

Zenoh's threads only put things into the inbox; what they mean is decided on the node's own thread.
"""

import logging
import queue
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import TypeAlias, TypeVar

import msgspec
import zenoh

from caneflow.messages import MEDIA_TYPE, MessageError, control_key, decode, encode
from caneflow.messages.control import Counters, LeftOut, PortMark, Progress, Window
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.links import open_session
from caneflow.runtime.plan import InputPlan, NodePlan

log = logging.getLogger(__name__)

C = TypeVar("C", bound=msgspec.Struct)

POLL = 0.01  # s between two looks at a condition that Zenoh does not signal


class Arrived(msgspec.Struct, frozen=True, gc=False):
    """A sample, not yet looked at."""

    port: str
    payload: bytes
    schema: str  # "" when the writer did not say


class Marked(msgspec.Struct, frozen=True, gc=False):
    """A writer's progress, on the port that reads from it."""

    port: str
    mark: PortMark


class Noted(msgspec.Struct, frozen=True, gc=False):
    """What a node says that it left out."""

    key: str
    payload: bytes


class Started(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word that every node is ready."""


class Opened(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word on how far the sources of a replay may send."""

    until: int


class Stopped(msgspec.Struct, frozen=True, gc=False):
    """The flow ends: SIGTERM, or Ctrl-C."""


Held: TypeAlias = "zenoh.Subscriber[None] | zenoh.Queryable[None] | zenoh.LivelinessToken"
Event: TypeAlias = Arrived | Noted | Marked | Started | Opened | Stopped


class Bus:
    """A node's session; a context manager, since a session that is not closed hangs its process."""

    def __init__(self, plan: NodePlan) -> None:
        self._plan = plan
        self._inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._session = open_session(listen=plan.links.listen, connect=plan.links.connect, replay=plan.replay)
        # Whatever must outlive its statement: a liveliness token that no variable holds is undeclared at once.
        self._held: list[Held] = []
        self._listen()
        self._publishers = {port: self._publisher(out.key, out.schema) for port, out in plan.outputs.items()}
        self._progress = self._control_publisher("progress", plan.node)
        self._counters = self._control_publisher("counters", plan.node)
        self._late = self._control_publisher("late")

    def __enter__(self) -> "Bus":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for held in self._held:  # first, or Zenoh reports what still comes for a session that is closing
            held.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
        self._session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types

    def declare_ready(self) -> None:
        """Tell the launcher that this node hears its inputs and is heard by its readers; waits for the latter."""
        for reader in self._plan.readers:
            self._wait_for_reader(reader)
        key = control_key(self._plan.flow, "ready", self._plan.node)
        self._held.append(self._session.liveliness().declare_token(key))

    def put(self, event: Event) -> None:
        """Add an event of this process's own; safe in a signal handler."""
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

    def send(self, port: str, payload: bytes) -> None:
        """Publish a sample's bytes on an output port."""
        self._publishers[port].put(payload)

    def send_progress(self, progress: Progress) -> None:
        """Publish how far this node has come."""
        self._progress.put(encode(progress))

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
            self._subscribe(wire.key, self._on_sample(port))
            by_writer.setdefault(wire.writer, {})[wire.key.rpartition("/")[2]] = port
        for writer, ports in by_writer.items():
            self._subscribe(control_key(plan.flow, "progress", writer), self._on_progress(ports))
            self._answer(control_key(plan.flow, "edge", writer, plan.node))
        self._subscribe(control_key(plan.flow, "start"), lambda _: self._inbox.put(Started()))
        if plan.replay:
            self._subscribe(control_key(plan.flow, "window"), self._on_window)
        if plan.hears_notes:
            self._subscribe(control_key(plan.flow, "late"), self._on_note)

    def _subscribe(self, key: str, callback: Callable[[zenoh.Sample], None]) -> None:
        # indirect=False: straight on Zenoh's receiving thread, which a put into the inbox does not hold up.
        handler = zenoh.handlers.Callback(callback, indirect=False)
        self._held.append(self._session.declare_subscriber(key, handler))

    def _answer(self, key: str) -> None:
        """Answer a writer's question on `key`: that its question arrives shows that this side's wishes did."""

        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(key, b"")

        self._held.append(self._session.declare_queryable(key, reply))

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
        def put(sample: zenoh.Sample) -> None:
            self._inbox.put(Arrived(port, sample.payload.to_bytes(), str(sample.encoding).rpartition(";")[2]))

        return put

    def _on_progress(self, ports: dict[str, str]) -> Callable[[zenoh.Sample], None]:
        def put(sample: zenoh.Sample) -> None:
            progress = _control(sample, Progress)
            for port, mark in progress.ports.items() if progress else ():
                if port in ports:
                    self._inbox.put(Marked(ports[port], mark))

        return put

    def _on_note(self, sample: zenoh.Sample) -> None:
        self._inbox.put(Noted(str(sample.key_expr), sample.payload.to_bytes()))

    def _on_window(self, sample: zenoh.Sample) -> None:
        window = _control(sample, Window)
        if window:
            self._inbox.put(Opened(window.until))


def check_schema(arrived: Arrived, wire: InputPlan) -> None:
    """Raise MessageError when the writer said another type than the port takes."""
    # A writer that says no schema (a C client: "zenoh/bytes;application/msgpack") is decoded by the port's type.
    if arrived.schema.startswith("caneflow.") and arrived.schema != wire.schema:
        raise MessageError(f"a {arrived.schema} came; the port takes {wire.schema}")


def _control(sample: zenoh.Sample, kind: type[C]) -> C | None:
    try:
        return decode(sample.payload.to_bytes(), kind)
    except MessageError as error:
        log.warning("%s: refused: %s", sample.key_expr, error)
        return None
