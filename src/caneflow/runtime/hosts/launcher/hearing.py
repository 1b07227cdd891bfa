"""What a launcher hears on its session: the words of its nodes, and whoever asks how the flow is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh

from caneflow.messages import MEDIA_TYPE, control_key, encode
from caneflow.messages.control import Counters, FlowStatus, Progress
from caneflow.runtime.hosts.launcher.congestion import closing_at_once

STATUS = "caneflow.FlowStatus/1"


@dataclass(frozen=True)
class Said:
    """A control message, not yet looked at."""

    kind: type[Progress] | type[Counters]
    payload: bytes


@dataclass(frozen=True)
class Ready:
    """A node hears and is heard."""

    node: str
    there: bool = True  # False: not any more


@dataclass(frozen=True)
class StatusAsked:
    """Someone wants to know how the flow is."""

    query: zenoh.Query


@contextmanager
def hearing(
    session: zenoh.Session, flow: str, put: Callable[[Said | Ready | StatusAsked], None], *, progress: bool
) -> Iterator[None]:
    """Put what the nodes of `flow` say, on Zenoh's thread, before anybody can know of this run.

    `progress`: how far they are as well; live, that a node has ended stands in its counters.
    """

    def said(kind: type[Progress] | type[Counters]) -> "zenoh.handlers.Callback[zenoh.Sample]":
        return zenoh.handlers.Callback(lambda sample: put(Said(kind, sample.payload.to_bytes())), indirect=False)

    def on_token(sample: zenoh.Sample) -> None:
        put(Ready(str(sample.key_expr).rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT))

    def on_query(query: zenoh.Query) -> None:
        put(StatusAsked(query))

    held: list[Any] = [
        closing_at_once(session),
        session.declare_subscriber(control_key(flow, "counters", "*"), said(Counters)),
        session.liveliness().declare_subscriber(
            control_key(flow, "ready", "*"), zenoh.handlers.Callback(on_token, indirect=False), history=True
        ),
        session.declare_queryable(
            control_key(flow, "status"),
            zenoh.handlers.Callback(on_query, indirect=False),
        ),
    ]
    if progress:
        held.append(session.declare_subscriber(control_key(flow, "progress", "*"), said(Progress)))
    yield
    held.clear()  # they end with the session


def answer_status(query: zenoh.Query, status: FlowStatus) -> None:
    """Tell whoever asked how the flow is."""
    with query:
        encoding = zenoh.Encoding(MEDIA_TYPE).with_schema(STATUS)
        query.reply(control_key(status.flow, "status"), encode(status), encoding=encoding)
