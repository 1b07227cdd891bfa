"""What a flow says about itself, under `<flow>/@/...`: progress, counters, states. Never part of the result."""

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
    """`@/progress/<node>`: how far a node has come. Sent when it is idle, and under load regularly."""

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
    """What became of the samples of one input: received is the sum of all the others but lost."""

    received: int = 0
    handled: int = 0
    refused: int = 0  # broke the contract, went back in time, or could not be used
    repeated: int = 0  # had come before
    lost: int = 0  # never came: gaps in seq
    dropped: int = 0  # fell out of a full queue, or were too old (max_age_ms)
    late: int = 0  # came after the graph had gone on without them (max_lag_ms)
    left_out: int = 0  # replayed, but not handled when the recording was made
    waiting: int = 0


class Counters(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """`@/counters/<node>`: once a second and at the end."""

    node: str
    inputs: dict[str, InputCounts]
    outputs: dict[str, int]  # samples sent
    refused: int = 0  # what a source brought and that could not be sent
