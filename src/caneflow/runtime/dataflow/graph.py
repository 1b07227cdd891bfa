"""A graph that has been checked: what the launcher starts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from caneflow.messages import Sample
from caneflow.runtime.program import Program


@dataclass(frozen=True, kw_only=True)
class Queue:
    """Which samples wait on an input when its reader is slower than its writer; for live runs."""

    mode: Literal["latest", "fifo", "all"]
    length: int  # samples; the oldest is dropped beyond it


@dataclass(frozen=True, kw_only=True)
class Wire:
    """What an input port reads."""

    node: str  # the writer
    port: str  # its output
    kind: type[Sample]  # what travels
    queue: Queue
    max_lag_ms: float | None  # live: how long the reader waits for it; None: forever
    max_age_ms: float | None  # live: older samples are dropped; None: none

    @property
    def stream(self) -> str:
        """As the file spells it: `node/output`."""
        return f"{self.node}/{self.port}"


@dataclass(frozen=True, kw_only=True)
class Restart:
    """What becomes of a node when its process ends."""

    policy: Literal["never", "on-failure", "always"]
    max_restarts: int  # that count; then the node has failed for good
    window_s: float  # s: a node that is up for so long has its earlier ends forgotten
    delay_s: float  # s before the first restart; doubles with each one that counts
    max_delay_s: float  # s


@dataclass(frozen=True, kw_only=True)
class Machine:
    """One computer of the flow, by its Zenoh endpoints."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    linked: tuple[str, ...] = ()  # the machines that it has a link with
    records: bool = False  # it may read every stream


@dataclass(frozen=True, kw_only=True)
class Node:
    """One node: what runs, where, with what."""

    name: str
    run: str  # as written; empty for an external node
    module: str | None  # to start with `python -m`
    file: Path | None  # or to start as a file
    program: Program | None  # None: external
    machine: str | None  # None: there is only one
    process: str | None  # that it shares with others; None: it has one for itself
    inputs: dict[str, Wire]  # in the order of the program's table, which is the order at equal stamps
    outputs: dict[str, type[Sample]]
    settings: Any  # the program's Settings, checked; None: external
    settings_map: dict[str, Any]  # the same as plain values, to be checked again by the node's process
    restart: Restart
    external: bool
    ready_timeout_s: float  # s


@dataclass(frozen=True, kw_only=True)
class Graph:
    """A whole dataflow.yaml."""

    flow: str
    seed: int
    rig: dict[str, Any]  # as written
    machines: dict[str, Machine]
    nodes: dict[str, Node]  # in the order of the file
    results: tuple[str, ...]  # outputs, `node/port`, that are for people and recordings
    path: Path
    router: str | None = None  # the endpoint of a Zenoh router that every machine dials
    insecure: bool = False  # machines talk in the clear, with whoever reaches them
    links: Literal["unix", "tcp"] = "unix"  # between the processes of one machine
    leader: str | None = None  # the machine whose launcher starts and ends the others; None: there is only one
    warnings: tuple[str, ...] = field(default=())

    def order(self) -> tuple[str, ...]:
        """The names of the nodes, writers before their readers, otherwise in the order of the file."""
        done: dict[str, None] = {}
        while len(done) < len(self.nodes):
            done.update(
                (name, None)
                for name, node in self.nodes.items()
                if name not in done and all(wire.node in done for wire in node.inputs.values())
            )
        return tuple(done)

    @property
    def wires(self) -> list[tuple[str, str, Wire]]:
        """Every (reader, its port, what it reads)."""
        return [(node.name, port, wire) for node in self.nodes.values() for port, wire in node.inputs.items()]
