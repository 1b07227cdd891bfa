"""What a flow says about itself, under `<flow>/@/...`: progress, counters, states. Never part of the result."""

from typing import Any

import msgspec


class PortMark(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """How far one output stream has come."""

    last_seq: int  # of the last sample sent; -1: none yet. The mark counts once that sample has arrived
    watermark: int  # ns: no sample with a stamp at or before it will be sent any more


class Again(msgspec.Struct, frozen=True, gc=False):
    """The end of a writer's answer to a reader that asked for samples again."""

    first: int  # seq of the oldest sample that the writer still has: what lies before it is lost
    mark: PortMark


class Progress(msgspec.Struct, frozen=True, gc=False):
    """`@/progress/<node>`: how far a node has come. Sent when it is idle, and under load regularly.

    `@/marks/<node>`: the same, live and at once, heard by the node's readers only: they wait for it.
    """

    node: str
    handled: int  # ns: everything up to this stamp has been handled
    ports: dict[str, PortMark]
    confirmed: dict[str, int] = {}  # by input key the last seq that this node will not ask for again


class Window(msgspec.Struct, frozen=True, gc=False):
    """`@/window`: up to which stamp (ns) the sources of a replay may send."""

    until: int


class LeftOut(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """`@/late`: samples of one input that a live node did not handle, so that a replay leaves them out as well."""

    node: str
    port: str
    reason: str  # late, dropped, lost
    first_seq: int
    last_seq: int  # the same, but for lost ones
    stamp: int = -1  # ns; -1: never came, so it is not known


class InputCounts(msgspec.Struct, kw_only=True, gc=False):
    """What became of the samples of one input: at any time received is the sum of all the others but lost."""

    received: int = 0
    handled: int = 0
    refused: int = 0  # broke the contract, went back in time, or could not be used
    repeated: int = 0  # had come before
    lost: int = 0  # never came: gaps in seq
    dropped: int = 0  # fell out of a full queue, or were too old (max_age_ms)
    late: int = 0  # came after the graph had gone on without them (max_lag_ms)
    left_out: int = 0  # replayed, but not handled when the recording was made
    waiting: int = 0


class Delays(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """How long the last samples of one input took, in s; None: nothing to tell it by."""

    latency_p50: float | None = None  # from the writer's put to the reader's hand, on both machines' clocks
    latency_p99: float | None = None
    age_p50: float | None = None  # live: from the measurement (its stamp) to the reader's hand
    age_p99: float | None = None
    handled: float | None = None  # live: from the measurement of the last one that was handled, to then
    silent: float | None = None  # since the last one came


class Counters(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """`@/counters/<node>`: once a second and at the end."""

    node: str
    inputs: dict[str, InputCounts]
    outputs: dict[str, int]  # samples sent
    refused: int = 0  # what a source brought and that could not be sent
    unsent: dict[str, int] = {}  # the same by output port
    delays: dict[str, Delays] = {}  # by input port; from processes only
    ended: bool = False  # everything has come, and what followed is sent
    held: int = 0  # bytes of samples: sent and not confirmed, or waiting to be handled
    let_go: int = 0  # samples sent that can no longer be had again, though some reader has not confirmed them


class Clock(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """`@/clock/<here>/<there>`: how far the clock of another machine is from this one's."""

    here: str  # the machine that says it
    there: str
    at: int  # ns, this machine's clock: when `offset` held
    offset: float  # s, their clock less this one's
    drift: float  # s/s, positive when theirs is faster
    uncertainty: float  # s, of the offset
    delay: float  # s, the shortest round trip of late
    steps: int = 0  # how often one of the two was set


class NodeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One node of a running flow, as its launcher knows it."""

    node: str
    program: str
    state: str  # starting, ready, ending (to be started again), waiting (for its restart), failed
    pid: int
    restarts: int  # after failures
    uptime: float  # s since its process was started
    cpu: float | None  # of one core, over the last second or so; 1.0 is a whole one
    memory: int | None  # bytes, resident
    sent: dict[str, int]  # by output port
    rates: dict[str, float | None]  # Hz, by output port
    counted: float | None  # s since it last said its counters; None: never yet
    said: str  # the last line that it wrote
    process: str = ""  # the name of its process, when others share it: its `cpu` and `memory` stand with the first
    listen: tuple[str, ...] = ()  # Zenoh endpoints
    machine: str = ""  # its name in the file; "" when the flow has only one
    connect: tuple[str, ...] = ()  # whom it dials: its launcher, and the writers of its inputs
    held: int = 0  # bytes of samples that it keeps: sent and not confirmed, or waiting to be handled
    let_go: int = 0  # samples sent that can no longer be had again, though some reader has not confirmed them
    asked: int = 0  # restarts that someone asked for, not among the others
    settings: dict[str, Any] = {}  # that it was given; those that it was not have their defaults


class EdgeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One wire of a running flow, as its reader counts it. Losses are by place: where to look."""

    writer: str  # node/port
    reader: str  # node.port
    schema: str
    sent: int
    received: int
    handled: int
    waiting: int  # in the queue
    rate: float | None  # Hz, received
    sender: int  # lost there: what a source brought and that could not be sent
    wire: int  # lost there: numbers that never came
    decode: int  # lost there: broke the contract, or the program refused it
    queue: int  # lost there: fell out of a full queue, or was too old (max_age_ms)
    late: int  # lost there: the graph had gone on without it (max_lag_ms)
    repeated: int  # came twice; no loss
    delays: Delays


class FlowStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to a query on `@/status`: what one launcher knows of its nodes."""

    flow: str
    version: str  # of caneflow
    host: str  # the machine's own name
    pid: int  # of the launcher
    uptime: float  # s
    replay: bool
    clock: int  # ns, Unix epoch: when it answered, on its machine's clock
    machine: str  # its name in the file; "" when the flow has only one
    nodes: list[NodeStatus]
    edges: list[EdgeStatus]
    rig: dict[str, Any] = {}  # that its nodes were given
    endpoint: str = ""  # where other programs attach: the first that the flow listens at for them, else its own socket
