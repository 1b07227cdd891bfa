"""What Zenoh brings, as events: callbacks for its threads, each of which hands an event to `put`."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias, TypeVar

import msgspec
import zenoh

from caneflow.messages import MessageError, decode
from caneflow.messages.codec import MAX_SEQ
from caneflow.messages.control import Again, Clock, PortMark, Progress, Window
from caneflow.runtime.hosts.links.session import KnownThreads, sent_at
from caneflow.runtime.hosts.process.events import (
    Arrived,
    Confirmed,
    Event,
    HistoryAnswered,
    HistoryAsked,
    LeftOutNoted,
    Marked,
    Opened,
    SinkAsked,
    Timed,
)

log = logging.getLogger(__name__)

C = TypeVar("C", bound=msgspec.Struct)
Put: TypeAlias = Callable[[Event], None]

AGAIN = "caneflow.Again/1"
ENCODINGS_KEPT = 8
LONGEST_ENCODING = 256  # characters


def on_sample(node: str, port: str, put: Put, threads: KnownThreads) -> Callable[[zenoh.Sample], None]:
    """Samples for an input port."""
    schemas: dict[str, str] = {}  # by encoding: there is one, or a few that are wrong

    def take(sample: zenoh.Sample) -> None:
        threads.know_this_one()
        encoding = str(sample.encoding)
        schema = schemas.get(encoding)
        if schema is None:
            schema = encoding.rpartition(";")[2]
            if len(schemas) < ENCODINGS_KEPT and len(encoding) < LONGEST_ENCODING:
                schemas[encoding] = schema
        put(Arrived(node, port, sample.payload.to_bytes(), schema, sent_at=sent_at(sample)))

    return take


def on_reply(node: str, port: str, put: Put) -> Callable[[zenoh.Reply], None]:
    """A writer's answer to a request for samples of an input port."""

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        schema = str(reply.ok.encoding).rpartition(";")[2]
        if schema != AGAIN:
            put(Arrived(node, port, reply.ok.payload.to_bytes(), schema, again=True))
        elif end := _control(reply.ok, Again):
            put(HistoryAnswered(node, port, end.first, end.mark))

    return take


def on_history_asked(node: str, port: str, put: Put) -> Callable[[zenoh.Query], None]:
    """A reader's request for samples of an output port."""

    def take(query: zenoh.Query) -> None:
        first = query.payload.to_bytes() if query.payload is not None else b""
        if first.isdigit() and len(first) <= len(str(MAX_SEQ)):  # else nobody of ours asks
            put(HistoryAsked(node, port, int(first), query))

    return take


def on_confirmed(node: str, port: str, reader: str, key: str, put: Put) -> Callable[[zenoh.Sample], None]:
    """What a reader of an output port, whose key is `key`, says that it will not ask for again."""

    def take(sample: zenoh.Sample) -> None:
        progress = _control(sample, Progress)
        if progress and key in progress.confirmed:
            put(Confirmed(node, port, reader, progress.confirmed[key]))

    return take


def on_progress(
    ports: Mapping[str, Sequence[tuple[str, str]]], puts: Mapping[tuple[str, str], Put]
) -> Callable[[zenoh.Sample], None]:
    """A writer's marks; `ports`: who reads which of its ports on which of their own, `puts`: where that goes."""

    def take(sample: zenoh.Sample) -> None:
        progress = _control(sample, Progress)
        marks: Mapping[str, PortMark] = progress.ports if progress else {}
        for port, mark in marks.items():
            for node, at in ports.get(port, ()):
                puts[node, at](Marked(node, at, mark))

    return take


def on_question(node: str, put: Put) -> Callable[[zenoh.Query], None]:
    """A tool's question to a sink."""

    def take(query: zenoh.Query) -> None:
        put(SinkAsked(node, query.payload.to_bytes() if query.payload is not None else b"", query))

    return take


def on_note(node: str, put: Put) -> Callable[[zenoh.Sample], None]:
    """What nodes left out, for a recorder."""
    return lambda sample: put(LeftOutNoted(node, str(sample.key_expr), sample.payload.to_bytes()))


def on_clock(put: Put) -> Callable[[zenoh.Sample], None]:
    """How far another machine's clock is from this one's."""

    def take(sample: zenoh.Sample) -> None:
        if clock := _control(sample, Clock):
            put(Timed(clock))

    return take


def on_window(put: Put) -> Callable[[zenoh.Sample], None]:
    """How far the sources of a replay may send."""

    def take(sample: zenoh.Sample) -> None:
        if window := _control(sample, Window):
            put(Opened(window.until))

    return take


def on_matching(begin: Callable[[], None], end: Callable[[], None]) -> Callable[[zenoh.MatchingStatus], None]:
    """That someone listens to a stream, or nobody any more."""
    return lambda status: begin() if status.matching else end()


def say_yes(key: str) -> Callable[[zenoh.Query], None]:
    """Answer whoever asks on `key`."""

    def take(query: zenoh.Query) -> None:
        with query:
            query.reply(key, b"")

    return take


def _control(sample: zenoh.Sample, kind: type[C]) -> C | None:
    try:
        return decode(sample.payload.to_bytes(), kind)
    except MessageError as error:
        log.warning("%s: refused: %s", sample.key_expr, error)
        return None
