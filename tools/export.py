"""`caneflow export`: a stream of a recording in a form that other programs read."""

import csv
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TextIO

import msgspec
import numpy as np
import typer

from caneflow.messages import MessageError, Pose, Sample, decode
from caneflow.recording import Recorded, Recording, RecordingError, Stream

TRUTH = ("truth", "pose")


class Format(StrEnum):
    """What can be written."""

    TUM = "tum"
    CSV = "csv"


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to take from.", show_default=False)],
    form: Annotated[
        Format,
        typer.Option(
            "--format",
            help="tum: a line per pose, `t x y z qx qy qz qw` in s and m, as evo reads it. "
            "csv: a row per sample, stamp in ns, the rest in the units of docs/messages.md.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="File to write; by default the terminal.")
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option(
            metavar="NODE/PORT", help="Stream to write; by default the only one that fits, ground truth aside."
        ),
    ] = None,
) -> None:
    """Write one stream of a recording as text.

    Example: caneflow export track.mcap --format tum -o track.tum
    """
    with Recording(recording) as source:
        chosen = _chosen(source, form, stream)
        samples = source.samples([(chosen.node, chosen.port)])
        with _writing_to(output) as text:
            if form is Format.TUM:
                write_tum(samples, text)
            else:
                write_csv(samples, text)


def write_tum(samples: Iterable[Recorded], text: TextIO) -> None:
    """Write poses as lines of `t x y z qx qy qz qw`: stamp in s to the ns, m, quaternion with w last."""
    for sample in samples:
        pose = _decoded(sample)
        assert isinstance(pose, Pose)
        w, x, y, z = pose.orientation
        seconds = f"{pose.stamp // 10**9}.{pose.stamp % 10**9:09d}"
        print(seconds, *pose.position, x, y, z, w, file=text)


def write_csv(samples: Iterable[Recorded], text: TextIO) -> None:
    """Write a row per sample: vectors as one column per element, arrays left out, absent values empty."""
    rows = csv.writer(text, lineterminator="\n")
    columns: dict[str, int | None] | None = None
    for sample in samples:
        message = _decoded(sample)
        if columns is None:
            columns, arrays = _columns(type(message))
            if arrays:
                print(f"{sample.key}: left out {', '.join(arrays)}: arrays do not fit into a row", file=sys.stderr)
            rows.writerow(name for field, n in columns.items() for name in _names(field, n))
        rows.writerow(value for field, n in columns.items() for value in _values(getattr(message, field), n))


def _columns(kind: type[Sample]) -> tuple[dict[str, int | None], list[str]]:
    """Number of elements (None: a plain value) by field, and the fields that are arrays; from the type alone."""
    columns: dict[str, int | None] = {}
    arrays: list[str] = []
    for field in msgspec.structs.fields(kind):
        if _in_type(field.type, np.ndarray):
            arrays.append(field.name)
        else:
            columns[field.name] = _tuple_length(msgspec.inspect.type_info(field.type))
    return columns, arrays


def _tuple_length(described: msgspec.inspect.Type) -> int | None:
    match described:
        case msgspec.inspect.TupleType(item_types=items):
            return len(items)
        case msgspec.inspect.UnionType(types=options):
            return next((n for option in options if (n := _tuple_length(option)) is not None), None)
        case msgspec.inspect.Metadata(type=inner):
            return _tuple_length(inner)
    return None
