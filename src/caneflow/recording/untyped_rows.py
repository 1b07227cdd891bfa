"""Rows of a table for messages whose type is not known here, as a user's own: by the recorded JSON Schema."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from caneflow.messages.codec import plain
from caneflow.recording.reader import Recorded

MOST_ELEMENTS = 64  # of a vector that has a column for each


def untyped_rows(samples: Iterator[Recorded], schema: Mapping[str, Any]) -> Iterator[Sequence[Any]]:
    """The names of the columns, then a row per sample: vectors as a column per element, absent values None.

    What the wire leaves out because it is the default is in `schema`. Lists and maps are JSON, arrays their type and
    shape. Raises RecordingError for a sample that cannot be read.
    """
    first = next(samples, None)
    if first is None:
        return
    found = schema.get("properties")
    described = found if isinstance(found, dict) else {}
    lengths = {name: _length(described.get(name)) for name in ("stamp", "seq", *described, *first.fields())}
    defaults = {
        name: spec["default"] for name, spec in described.items() if isinstance(spec, dict) and "default" in spec
    }
    yield [column for name, n in lengths.items() for column in ([f"{name}_{i}" for i in range(n)] or [name])]
    for sample in (first, *samples):
        fields = sample.fields()
        yield [cell for name, n in lengths.items() for cell in _cells(fields.get(name, defaults.get(name)), n)]


def _length(spec: object) -> int:
    """How many elements the vectors of a field have, by its JSON Schema; 0: it is something else."""
    if not isinstance(spec, dict):
        return 0
    least, options = spec.get("minItems"), spec.get("anyOf")
    if isinstance(least, int) and least == spec.get("maxItems") and 0 < least <= MOST_ELEMENTS:
        return least
    return max(map(_length, options), default=0) if isinstance(options, list) else 0


def _cells(value: Any, length: int) -> Sequence[Any]:
    if length and isinstance(value, (list, tuple)) and len(value) == length:
        return [_cell(each) for each in value]
    return [_cell(value), *[None] * (length - 1)]


def _cell(value: Any) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return f"{value.dtype}{list(value.shape)}" if isinstance(value, np.ndarray) else json.dumps(plain(value))
