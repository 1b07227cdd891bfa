"""What someone who follows a flow is told: it begins, a sample comes, how it is, it ends."""

from typing import NamedTuple, TypeAlias

from caneflow.messages import Sample
from caneflow.messages.control import FlowStatus


class Began(NamedTuple):
    """The flow was found, for the first time or again."""

    flow: str
    status: FlowStatus


class Came(NamedTuple):
    """A sample of it."""

    node: str
    port: str
    kind: type[Sample] | None  # None: no message that this process knows
    schema: str  # its name; "": the writer did not say
    payload: bytes
    received: int  # ns


class Told(NamedTuple):
    """How it is, once a second."""

    status: FlowStatus
    unheard: int  # samples that this process had no room for, since it began


class Ended(NamedTuple):
    """It answers no more."""

    flow: str


Event: TypeAlias = Began | Came | Told | Ended
