"""What one node needs to know to run, wherever it runs: made by the launcher, read by the node's process."""

from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from caneflow.messages import SAMPLES, Sample
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.stages.byte_budget import SENT
from caneflow.runtime.user_files import kind_at

P = TypeVar("P", bound=msgspec.Struct)


class InputPlan(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """One input port."""

    key: str
    schema: str  # of the port's type, e.g. "caneflow.Imu/1"
    kind_at: str = ""  # where that type is defined: "module:Class" or "/path/file.py:Class". "": one of ours
    writer: str  # the node at the other end
    clock: str = ""  # the machine whose clock its stamps are on, when that is not this one
    length: int | None = None  # how many samples may wait; the oldest is dropped beyond. None: all
    max_lag_ms: float | None = None  # live: how long the graph waits for this input. None: forever
    max_age_ms: float | None = None  # live: older samples are dropped. None: never
    left_out: tuple[int, ...] = ()  # stamps (ns) of samples that the recorded live run did not handle
    budget: int = SENT  # bytes that its writer may keep of it
    external: bool = False  # its writer is a program of someone else's: it comes and goes, and cannot be asked

    @cached_property
    def kind(self) -> type[Sample]:
        """The type that the port takes."""
        return kind_at(self.kind_at) if self.kind_at else SAMPLES[self.schema]

    @cached_property
    def left_out_stamps(self) -> frozenset[int]:
        """`left_out`, for looking up."""
        return frozenset(self.left_out)


class OutputPlan(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """One output port."""

    key: str
    schema: str
    kind_at: str = ""  # where its type is defined, as in InputPlan
    readers: tuple[str, ...] = ()  # the nodes that read it, the recorder among them
    budget: int = SENT  # bytes that may be sent and not yet confirmed by every reader
    awaited: bool = True  # one of them puts it in order with other streams: it waits to hear how far this one has come

    @cached_property
    def kind(self) -> type[Sample]:
        """The type that the port gives."""
        return kind_at(self.kind_at) if self.kind_at else SAMPLES[self.schema]


class Links(msgspec.Struct, frozen=True, kw_only=True):
    """Where a node listens and whom it dials; exactly one side of every edge dials (readers dial writers)."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    identity: str = ""  # of the node's session, by which the launcher knows it from a tool's


class NodePlan(msgspec.Struct, frozen=True, kw_only=True):
    """One node of a run."""

    flow: str
    node: str
    process: str = ""  # that it shares with other nodes; "": it has one for itself
    module: str | None = None  # `python -m` name of the program
    file: str | None = None  # or a user's own file
    settings: dict[str, Any] = {}
    rig: dict[str, Any] = {}
    seed: int = 0
    replay: bool = False  # sources are recordings: nothing may be lost, everybody waits
    inputs: dict[str, InputPlan] = {}
    outputs: dict[str, OutputPlan] = {}
    hears_notes: bool = False  # a recorder also takes what nodes say they left out
    links: Links = Links()
    machine: str = ""  # that the node runs on, when there are several
    absent: tuple[str, ...] = ()  # readers on machines that are not there: the node does not wait for them
    takes_over: bool = False  # in the place of a process that ended: what that one had taken is not missing
    state_folder: str | None = None  # where snapshots are kept; None: beside the plan
    ready_timeout_s: float = 20.0

    @property
    def external(self) -> bool:
        """Whether it is a program of someone else's, which no launcher starts."""
        return self.module is None and self.file is None

    @property
    def runs_in(self) -> str:
        """The name of its process."""
        return self.process or self.node

    @property
    def readers(self) -> tuple[str, ...]:
        """The nodes that read an output."""
        return tuple(dict.fromkeys(reader for out in self.outputs.values() for reader in out.readers))

    def encoded(self) -> bytes:
        """The plan as the node's process reads it."""
        return msgspec.json.encode(self)

    @classmethod
    def read(cls, path: Path) -> "NodePlan":
        """The plan in `path`; raises DataflowError when there is none."""
        return _read(path, cls)


class ProcessPlan(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """One process of a run: the nodes that share it, their links being the same ones."""

    name: str
    nodes: tuple[NodePlan, ...]  # at least one

    def encoded(self) -> bytes:
        """The plan as the process reads it."""
        return msgspec.json.encode(self)

    @classmethod
    def read(cls, path: Path) -> "ProcessPlan":
        """The plan in `path`; raises DataflowError when there is none."""
        return _read(path, cls)

    @classmethod
    def of(cls, plan: NodePlan) -> "ProcessPlan":
        """The process of a node that has one for itself."""
        return cls(name=plan.node, nodes=(plan,))

    @cached_property
    def members(self) -> dict[str, NodePlan]:
        """The plans of its nodes by name."""
        return {plan.node: plan for plan in self.nodes}

    @property
    def is_group(self) -> bool:
        """Whether several nodes share it."""
        return len(self.nodes) > 1

    @property
    def flow(self) -> str:
        """The name of the flow."""
        return self.nodes[0].flow

    @property
    def replay(self) -> bool:
        """Whether the sources of the flow are recordings."""
        return self.nodes[0].replay

    @property
    def links(self) -> Links:
        """Where the process listens and whom it dials."""
        return self.nodes[0].links

    @cached_property
    def arriving(self) -> dict[tuple[str, str], InputPlan]:
        """By node and port the inputs whose writers are in other processes."""
        return {
            (plan.node, port): wire
            for plan in self.nodes
            for port, wire in plan.inputs.items()
            if wire.writer not in self.members
        }

    def readers_outside(self, out: OutputPlan) -> tuple[str, ...]:
        """The nodes in other processes that read an output."""
        return tuple(reader for reader in out.readers if reader not in self.members)


def _read(path: Path, kind: type[P]) -> P:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError) as error:
        raise DataflowError(f"{path}: {error}; a node is started by `caneflow run`") from error
