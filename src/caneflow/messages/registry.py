"""Message types by their schema: ours and the user's. A type is registered by being defined."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from caneflow.messages.errors import MessageError

if TYPE_CHECKING:
    from caneflow.messages.sample import Sample

SCHEMA = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*/[1-9]\d*", re.ASCII)  # what `caneflow.Imu/1` and `mine.Range/1` are
SCHEMA_RULE = "names, then a slash and a version, e.g. mine.Range/1"

SAMPLES: dict[str, type["Sample"]] = {}  # what was defined so far; imported from caneflow.messages: ours at least


class _Definition(NamedTuple):
    """Where a type was defined."""

    file: str
    name: str
    line: int

    def __str__(self) -> str:
        return f"{self.name} in {self.file}:{self.line}"


_definitions: dict[str, _Definition] = {}  # by schema


def register(kind: type["Sample"], file: str, line: int) -> None:
    """Note `kind`, which was defined at `line` of `file`, under its schema.

    Raises MessageError for what is not a schema's name, and for a second type under one. The same type of the same
    file takes the place of the one before: its file was imported again.
    """
    if not SCHEMA.fullmatch(kind.schema):
        raise MessageError(f"{kind.__qualname__}: schema {kind.schema!r} is not valid; expected {SCHEMA_RULE}")
    here = _Definition(str(Path(file).resolve()), kind.__qualname__, line)
    there = _definitions.setdefault(kind.schema, here)
    if there[:2] != here[:2]:
        raise MessageError(f"schema {kind.schema} is defined twice, as {there} and as {here}; import it from one file")
    _definitions[kind.schema] = here
    SAMPLES[kind.schema] = kind
