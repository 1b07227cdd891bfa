"""Samples to msgpack and back, checked by type on the way in. No pickle, ever."""

import math
from functools import cache
from typing import Any, TypeVar

import msgspec
import numpy as np

from caneflow.messages import arrays
from caneflow.messages.errors import MessageError
from caneflow.messages.sample import Sample

MAX_PAYLOAD = 32 * 2**20  # bytes; a 4 MB frame is the largest that anybody asked for
MAX_SEQ = 2**40  # 35 years at 1 kHz; what is counted as lost must fit into a message as well, however often
MOST_LEVELS = 32  # of maps and lists in a message whose type is not known
MEDIA_TYPE = "application/msgpack"

S = TypeVar("S", bound=msgspec.Struct)


def encode(message: msgspec.Struct) -> bytes:
    """`message` as one msgpack map with string keys; absent optional fields are left out."""
    return _encoder.encode(message)


def decode(payload: bytes, kind: type[S]) -> S:
    """The message of type `kind` in `payload`.

    Raises MessageError for anything else: truncated, trailing bytes, missing or ill-typed fields, NaN where
    it is not allowed, wrong shapes, too large. Unknown keys are ignored.
    """
    if len(payload) > MAX_PAYLOAD:
        raise MessageError(f"{len(payload)} bytes; at most {MAX_PAYLOAD} are taken")
    try:
        message: S = _decoder(kind).decode(payload)
    except (MessageError, MemoryError):
        raise
    except Exception as error:  # of msgspec; or of a check that a user's own message makes of itself
        raise MessageError(str(error) or type(error).__name__) from error
    if isinstance(message, Sample) and not 0 <= message.seq <= MAX_SEQ:
        raise MessageError(f"seq is {'missing' if message.seq == -1 else message.seq}; it counts 0, 1, 2 ...")
    return message


def fields_in(payload: bytes, kind: type[Sample] | None) -> dict[str, Any]:
    """The fields of a sample by name, for people and files; raises MessageError as `decode` does.

    kind: None when this process does not know the type. Then they are as msgpack has them: lists, maps, arrays; what
    was left out because it is the default is not there.
    """
    message = decode(payload, kind or Sample)
    if kind is not None:
        return {name: getattr(message, name) for name in message.__struct_fields__}
    fields: dict[str, Any] = _fields.decode(payload)  # it is a map with string keys, or it would not be a sample
    if _is_deeper(fields, MOST_LEVELS):
        raise MessageError(f"nested more than {MOST_LEVELS} levels deep")
    return fields


def plain(value: Any) -> Any:
    """`value` of a field as JSON has it: an infinite value is its name, a complex one its two parts."""
    match value:
        case float() if not math.isfinite(value):
            return str(value)
        case complex():
            return [value.real, value.imag]
        case np.ndarray():
            return plain(value.tolist())
        case list() | tuple():
            return [plain(each) for each in value]
        case dict():
            return {str(key): plain(each) for key, each in value.items()}
    return msgspec.to_builtins(value)


def require_sound(kind: type[Sample]) -> None:
    """Raise MessageError unless `kind`, of a user's own, can travel as the wire has it."""
    options = kind.__struct_config__
    if not kind.schema:
        raise MessageError(f'{kind.__name__} has no schema; give it one, e.g. schema = "mine.{kind.__name__}/1"')
    if options.array_like or not {"stamp", "seq"} <= set(kind.__struct_encode_fields__):
        raise MessageError(f"{kind.__name__} is not a map with stamp and seq; leave out array_like and rename")
    if not options.frozen or options.forbid_unknown_fields:
        raise MessageError(
            f"{kind.__name__} is not frozen, or forbids unknown fields; a message is frozen, and may grow"
        )
    try:
        _decoder(kind)
        json_schema(kind)
    except Exception as error:  # msgspec has several ways to say which type it cannot take
        raise MessageError(f"{kind.__name__} cannot travel: {str(error) or type(error).__name__}") from error


def with_number(message: Sample, seq: int) -> Sample:
    """`message` as number `seq` of its stream: a host's privilege, only who publishes it knows its number."""
    msgspec.structs.force_setattr(message, "seq", seq)
    return message


def numbered(message: Sample, seq: int) -> bytes:
    """`message` encoded as number `seq` of its stream."""
    return _encoder.encode(with_number(message, seq))


def json_schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """The JSON Schema of `kind`, self-contained, as stored in recordings and printed by `caneflow schema`."""
    (top,), components = msgspec.json.schema_components(
        (kind,), schema_hook=_array_schema, ref_template="#/$defs/{name}"
    )
    schema = dict(components.pop(top["$ref"].rpartition("/")[2]))
    if components:  # structs within it
        schema["$defs"] = components
    schema.update(
        {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": getattr(kind, "schema", kind.__name__),
        }
    )
    if issubclass(kind, Sample):  # the host gives the number, so the class has a default; on the wire it must be there
        schema["properties"] = {
            **schema["properties"],
            "seq": {
                "type": "integer",
                "minimum": 0,
                "description": "0, 1, 2 ... per stream and run; a gap is a loss",
            },
        }
        schema["required"] = ["stamp", "seq", *(name for name in schema["required"] if name != "stamp")]
    return schema


@cache
def _decoder(kind: type[S]) -> msgspec.msgpack.Decoder[S]:
    return msgspec.msgpack.Decoder(kind, ext_hook=_from_ext)


def _from_ext(code: int, data: memoryview) -> arrays.Array:
    if code != arrays.EXT_TYPE:
        raise MessageError(f"msgpack ext type {code}; the wire has only {arrays.EXT_TYPE}, an array")
    return arrays.from_bytes(data)


def _is_deeper(value: object, levels: int) -> bool:
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return levels < 0 or any(_is_deeper(each, levels - 1) for each in inside)


def _to_ext(value: object) -> msgspec.msgpack.Ext:
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(arrays.EXT_TYPE, arrays.to_bytes(value))
    if isinstance(value, np.generic):  # a numpy scalar that an algorithm returned where a number is meant
        raise MessageError(f"a {type(value).__name__} where a plain number is meant; call .item() on it")
    raise MessageError(f"a {type(value).__name__} cannot travel")


def _array_schema(kind: type) -> dict[str, Any]:
    if kind is np.ndarray:
        return {"description": "msgpack ext type 1: dtype letter, rank, uint32 sizes, elements; little-endian"}
    raise MessageError(f"the wire has nothing for a {kind.__name__}")


_fields = msgspec.msgpack.Decoder(dict[str, Any], ext_hook=_from_ext)
_encoder = msgspec.msgpack.Encoder(enc_hook=_to_ext)
