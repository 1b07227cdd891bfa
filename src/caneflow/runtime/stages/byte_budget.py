"""How many bytes a node may hold, of what it has sent and of what is sent to it: a process stays below 250 MB.

A bare node takes about 75 MB. Counted is what a sample takes in memory, not only its payload.
"""

from functools import cache

import msgspec

from caneflow.messages import Sample

SENT = 16 * 2**20  # bytes of all outputs: samples that some reader has not confirmed yet
WAITING = 2 * SENT  # bytes of all inputs: decoded samples that wait for their turn, or for one that is missing
INBOX = 2 * SENT  # bytes of all inputs: samples that the node has not looked at yet
CONTROL = 8 * 2**20  # bytes of marks, requests and orders that the node of a replay has not looked at yet
PER_SAMPLE = 512  # bytes that a sample takes beside its payload
PER_REQUEST = 10_000  # bytes that a request that waits for its answer takes, with what Zenoh keeps for it (measured)
PER_MESSAGE = 768  # bytes that a decoded sample takes beside its arrays
SMALL = (int, float, bool)  # types of fields that PER_MESSAGE holds


def share(total: int, streams: int) -> int:
    """The part (bytes) of one of `streams` streams."""
    return total // max(1, streams)


def weight(payload: bytes) -> int:
    """What a sample that is kept as it was sent takes, in bytes."""
    return PER_SAMPLE + len(payload)


def weight_of(message: Sample) -> int:
    """What a decoded sample takes, in bytes."""
    total = PER_MESSAGE
    for name in _large_fields(type(message)):
        value = getattr(message, name)
        total += getattr(value, "nbytes", 0) or (len(value) if isinstance(value, str | bytes | list | dict) else 0)
    return total


@cache
def _large_fields(kind: type[Sample]) -> tuple[str, ...]:
    """The fields of a message that may be large."""
    fields = msgspec.structs.fields(kind)
    return tuple(field.name for field in fields if _may_be_large(msgspec.inspect.type_info(field.type)))


def _may_be_large(kind: msgspec.inspect.Type) -> bool:
    match kind:
        case msgspec.inspect.UnionType(types):
            return any(_may_be_large(each) for each in types)
        case msgspec.inspect.TupleType(item_types):
            return any(_may_be_large(each) for each in item_types)
        case msgspec.inspect.Metadata(inner):
            return _may_be_large(inner)
        case _:
            small = msgspec.inspect
            return not isinstance(kind, small.IntType | small.FloatType | small.BoolType | small.NoneType)
