"""Arrays of bytes in a C source: how a chip's maker hands out firmware and configuration. No I/O here."""

import re
from collections.abc import Mapping
from typing import Final

from caneflow.protocols.errors import ProtocolError

LONGEST: Final = 4_000_000  # characters of a source
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_ARRAY = re.compile(r"\buint8_t\s+(\w+)\s*\[[^\]]*\]\s*=\s*\{([^{}]*)\}")
_NUMBER = re.compile(r"\(?\s*(?:\(\s*uint8_t\s*\)\s*)?(0[xX][0-9a-fA-F]{1,2}|\d{1,3})[uU]?\s*\)?")


def byte_arrays(source: str) -> Mapping[str, bytes]:
    """Every `uint8_t NAME[] = {...}` of `source` by its name; raises ProtocolError for one that holds no bytes."""
    if len(source) > LONGEST:
        raise ProtocolError(f"a C source of {len(source)} characters; expected at most {LONGEST}")
    return {name: _bytes_of(name, body) for name, body in _ARRAY.findall(_COMMENT.sub(" ", source))}


def _bytes_of(name: str, body: str) -> bytes:
    values: list[int] = []
    for word in filter(None, (each.strip() for each in body.split(","))):
        number = _NUMBER.fullmatch(word)
        value = int(number[1], 0 if number[1][:2] in ("0x", "0X") else 10) if number else 256
        if value > 255:
            raise ProtocolError(f"{name}: element {len(values)} is {word[:20]!r}; expected a byte")
        values.append(value)
    return bytes(values)
