"""What can come to a process: samples, marks, requests, orders."""

from typing import TypeAlias

import msgspec
import zenoh

from caneflow.messages import Sample
from caneflow.messages.control import Clock, PortMark
from caneflow.runtime.program import Encoded
from caneflow.runtime.stages.byte_budget import PER_REQUEST, PER_SAMPLE


class Arrived(msgspec.Struct, frozen=True, gc=False):
    """A sample, not yet looked at."""

    node: str  # the member of this process that it is for, here and below
    port: str  # of that node
    payload: bytes
    schema: str  # "" when the writer did not say
    again: bool = False  # it was asked for
    sent_at: int = 0  # ns: when the writer put it, as it says beside the sample; 0: it did not say


class Marked(msgspec.Struct, frozen=True, gc=False):
    """A writer's progress, on the port that reads from it."""

    node: str
    port: str
    mark: PortMark


class HistoryAnswered(msgspec.Struct, frozen=True, gc=False):
    """A writer has sent again what it still has of a stream."""

    node: str
    port: str
    first: int  # seq of the oldest sample that it still has
    mark: PortMark


class AskEnded(msgspec.Struct, frozen=True, gc=False):
    """A request of this node's for samples is over: all that came of it was put before this."""

    node: str
    port: str


class HistoryAsked(msgspec.Struct, frozen=True, gc=False):
    """A reader asks for samples of an output port again."""

    node: str
    port: str
    first: int  # seq of the first one it wants
    query: zenoh.Query


class SinkAsked(msgspec.Struct, frozen=True, gc=False):
    """A tool asks a sink something."""

    node: str
    question: bytes
    query: zenoh.Query


class Confirmed(msgspec.Struct, frozen=True, gc=False):
    """A reader will not ask for a sample or any before it."""

    node: str
    port: str
    reader: str
    seq: int


class LeftOutNoted(msgspec.Struct, frozen=True, gc=False):
    """What some node says that it left out, for a node that is told."""

    node: str
    key: str
    payload: bytes


class Timed(msgspec.Struct, frozen=True, gc=False):
    """The launcher's word on another machine's clock."""

    clock: Clock


class Brought(msgspec.Struct, frozen=True, gc=False):
    """What a source of this process has brought, while that is not quick."""

    node: str
    port: str
    sample: Sample | Encoded


class SourcesEnd(msgspec.Struct, frozen=True, gc=False):
    """The flow ends, and others have to end before this process: its sources end now."""


class SourcesEnded(msgspec.Struct, frozen=True, gc=False):
    """They have; what they brought last lies before this."""


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


Event: TypeAlias = (
    Arrived
    | HistoryAnswered
    | AskEnded
    | HistoryAsked
    | SinkAsked
    | Confirmed
    | LeftOutNoted
    | Marked
    | Timed
    | Brought
    | SourcesEnd
    | SourcesEnded
    | Broken
    | Started
    | Opened
    | Stopped
)


def weight_of_event(event: Event) -> int:
    """What an event takes in the inbox, in bytes; 0: it is the launcher's or this process's own."""
    kind = type(event)
    if kind is Arrived:
        return PER_SAMPLE + len(event.payload) + len(event.schema)  # type: ignore[union-attr]  # the kind says it
    match event:
        case Started() | Stopped() | SourcesEnd() | SourcesEnded() | Broken() | AskEnded():
            return 0
        case LeftOutNoted():
            return PER_SAMPLE + len(event.payload)
        case HistoryAsked():
            return PER_REQUEST
        case SinkAsked():
            return PER_REQUEST + len(event.question)
        case _:
            return PER_SAMPLE
