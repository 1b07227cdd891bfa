"""What a node runs: an Operator turns messages into messages, a Source brings them in.

Neither owns a socket or a thread, and an operator owns no clock: time is `message.stamp`. So any host can run
the very same class.
"""

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from caneflow.errors import CaneflowError
from caneflow.messages import Sample
from caneflow.messages.rig import Rig

Brought: TypeAlias = "Generator[tuple[str, Sample | Encoded] | Quiet, None, None]"
Emitted: TypeAlias = Iterable[tuple[str, Sample]]  # (output port, message), in the order in which they leave

ANY_PORT = "*"  # in `inputs`: every port that is not named takes this type


class Refused(CaneflowError):
    """Raised by `handle` for a message that is well-formed but of no use: counted, named once, life goes on.

    Raise it before anything is changed: nothing is undone. What cannot be foreseen need not be checked: a message for
    which the arithmetic overflows, or from which no valid output follows, is refused by the host, and all undone.
    """


class Encoded(NamedTuple):
    """A sample that has its bytes already, as a recording holds it."""

    kind: type[Sample]
    stamp: int  # ns
    seq: int
    payload: bytes


class Quiet(NamedTuple):
    """Said by a source instead of a sample: none with a stamp at or before `until` (ns) will come."""

    until: int


@dataclass(frozen=True, kw_only=True)
class NoSettings:
    """For a program that has nothing to set."""


@dataclass(frozen=True, kw_only=True)
class Context:
    """What a host hands to a program besides its settings."""

    node: str  # its name in the graph
    rig: Rig
    ports: Mapping[str, type[Sample]]  # what the graph wires to it (operator, sink: inputs; source: outputs)
    random: np.random.Generator  # from the graph's seed and the node's name: other nodes do not change it
    keys: Mapping[str, str] = field(default_factory=dict)  # by the same ports: <flow>/<node>/<port> of the stream
    replay: bool = False  # the sources are recordings: nothing may be lost, everybody waits
    takes_over: bool = False  # in the place of a process that ended: what that one had taken does not come again


class InFlow(NamedTuple):
    """How a graph uses a program, as far as a check of the file knows it."""

    node: str
    rig: Mapping[str, Any]  # as written
    writers: Mapping[str, Any]  # by input port the settings of the node that writes it; None: not known


class Objection(NamedTuple):
    """What a program finds wrong with the graph around it."""

    path: tuple[str, ...]  # in the file, e.g. ("rig", "rangers")
    text: str
    warning: bool = False


class Operator(ABC):
    """Messages in, messages out, in event time: no socket, no thread, no clock."""

    inputs: ClassVar[Mapping[str, type[Sample]]] = {}
    outputs: ClassVar[Mapping[str, type[Sample]]] = {}
    optional_inputs: ClassVar[frozenset[str]] = frozenset()  # ports that a graph may leave open
    optional_outputs: ClassVar[frozenset[str]] = frozenset()  # ports that nobody needs to read
    Settings: ClassVar[type[Any]] = NoSettings  # a frozen dataclass or pydantic model

    @abstractmethod
    def __init__(self, settings: Any, context: Context) -> None: ...

    @classmethod
    def objections(cls, flow: InFlow) -> Iterable[Objection]:
        """What `caneflow check` should say of the graph around the program, beyond types and settings."""
        return ()

    @abstractmethod
    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield what follows from `message`.

        Messages come by (stamp, port order, seq), each once. What is yielded carries the stamp of the
        measurement that caused it; stamps of one output port strictly increase.
        """

    def finish(self) -> Emitted:
        """Yield what is left when every input has ended."""
        return ()


class Source(ABC):
    """Samples out of the world: a device or a recording."""

    outputs: ClassVar[Mapping[str, type[Sample]]] = {}
    ordered: ClassVar[bool] = False  # stamps increase over all ports together, not only on each
    Settings: ClassVar[type[Any]] = NoSettings

    @abstractmethod
    def __init__(self, settings: Any, context: Context) -> None: ...

    @abstractmethod
    def samples(self) -> Brought:
        """Yield (output port, sample) as they come, each stamped when it was taken; block while there is none.

        Closed (GeneratorExit at the yield) when the flow ends: put what must be stopped into `finally`.
        """


class Sink(ABC):
    """Takes every sample of many streams as it comes, out of event time: a recorder, a view."""

    Settings: ClassVar[type[Any]] = NoSettings

    @abstractmethod
    def __init__(self, settings: Any, context: Context) -> None: ...

    @abstractmethod
    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Take one sample, with its bytes as sent and the time of reception (ns)."""

    def note(self, key: str, payload: bytes, time: int) -> None:  # noqa: B027 - most sinks have no use for it
        """Take what a node says that it left out (`@/late`), at `time` (ns); only a recorder is told."""

    def asked(self, question: bytes, time: int) -> bytes | None:
        """The answer to a tool's question (`@/ask/<node>`), at `time` (ns); None: it is none for this sink."""
        return None

    @abstractmethod
    def idle(self, time: int) -> None:
        """Called when nothing has come for a while, with the time (ns)."""

    @abstractmethod
    def finish(self) -> None:
        """Called once, when every stream has ended or the flow is stopped."""


Program: TypeAlias = type[Operator] | type[Source] | type[Sink]
