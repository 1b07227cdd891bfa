"""`caneflow export`: a recording, or a stream of it, in a form that other programs read."""

import csv
import sys
from collections.abc import Iterable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TextIO

import msgspec
import typer
from msgspec import inspect

from caneflow.messages import Pose, Sample
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.recording import TRUTH, Recorded, Recording, RecordingError, Stream


class Format(StrEnum):
    """What can be written."""

    TUM = "tum"
    CSV = "csv"
    FOXGLOVE = "foxglove"
    ROSBAG2 = "rosbag2"


TEXT = (Format.TUM, Format.CSV)  # one stream, readable; the others hold the whole recording


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to take from.", show_default=False)],
    form: Annotated[
        Format,
        typer.Option(
            "--format",
            help="tum: a line per pose, `t x y z qx qy qz qw` in s and m, as evo reads it. "
            "csv: a row per sample; stamp in ns, the rest in SI units and rad. "
            "foxglove: an MCAP file for Foxglove and Rerun, with poses, transforms, numbers and pictures of the "
            "range-Doppler map. rosbag2: a folder for ros2 bag, with sensor_msgs/Imu, geometry_msgs/PoseStamped, "
            "TwistStamped and sensor_msgs/Image.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="File or folder to write; tum and csv: by default standard output."
        ),
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option(metavar="NODE/PORT", help="tum, csv: stream to write; by default the only one that fits."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write one stream of a recording as text (tum, csv), or all of it for other viewers (foxglove, rosbag2).

    Example: caneflow export track.mcap --format tum -o track.tum
    """
    if form not in TEXT:
        _export_whole(recording, form, output, stream, overwrite=overwrite)
        return
    with whole(output, inputs=[recording], overwrite=overwrite) as path, Recording(recording) as source:
        chosen = _chosen(source, form, stream)
        samples = source.samples([(chosen.node, chosen.port)])
        write = write_tum if form is Format.TUM else write_csv
        if path is None:
            write(samples, sys.stdout)
        else:
            with path.open("w", encoding="utf-8", newline="") as text:
                write(samples, text)


def _export_whole(recording: Path, form: Format, output: Path | None, stream: str | None, *, overwrite: bool) -> None:
    if output is None:
        raise RecordingError(
            f"--format {form}: needs -o, the {'folder' if form is Format.ROSBAG2 else 'file'} to write"
        )
    if stream is not None:
        raise RecordingError(f"--format {form}: takes the whole recording; --stream is for tum and csv")
    is_folder = form is Format.ROSBAG2
    with (
        whole(output, inputs=[recording], overwrite=overwrite, folder=is_folder) as path,
        Recording(recording) as source,
    ):
        if form is Format.FOXGLOVE:
            from caneflow.recording.export_foxglove import export_foxglove  # here, as each brings its own library

            written = export_foxglove(source, path)
        else:
            from caneflow.recording.export_rosbag2 import export_rosbag2

            written = export_rosbag2(source, path)
        left_out = [f"{node}/{port}" for node, port in source.streams if f"/{node}/{port}" not in written]
    for topic, count in written.items():
        print(f"{count:8d}  {topic}")
    if left_out:
        print(f"left out {', '.join(left_out)}: {form} has no form for it")


def write_tum(samples: Iterable[Recorded], text: TextIO) -> None:
    """Write poses as lines of `t x y z qx qy qz qw`: s to the ns, m, quaternion with w last."""
    for sample in samples:
        pose = sample.decoded()
        assert isinstance(pose, Pose)
        w, x, y, z = pose.orientation
        print(f"{pose.stamp // 10**9}.{pose.stamp % 10**9:09d}", *pose.position, x, y, z, w, file=text)


def write_csv(samples: Iterable[Recorded], text: TextIO) -> None:
    """Write a row per sample: vectors as a column per element, absent values empty, arrays left out."""
    rows = csv.writer(text, lineterminator="\n")
    columns: dict[str, int] | None = None
    for sample in samples:
        message = sample.decoded()
        if columns is None:
            columns, arrays = _columns(type(message))
            if arrays:
                print(
                    f"{sample.key}: left out {', '.join(arrays)}: an array does not fit into a row",
                    file=sys.stderr,
                )
            rows.writerow(name for field, n in columns.items() for name in _names(field, n))
        rows.writerow(value for field, n in columns.items() for value in _values(getattr(message, field), n))


def _chosen(source: Recording, form: Format, stream: str | None) -> Stream:
    if stream is not None:
        node, _, port = stream.partition("/")
        chosen = source.stream(node, port)
        if form is Format.TUM and chosen.schema != Pose.schema:
            raise RecordingError(f"{source.path}: {stream} holds {chosen.schema}; tum takes {Pose.schema}")
        return chosen
    there = [
        each for each in source.streams.values() if each.count and (form is Format.CSV or each.schema == Pose.schema)
    ]
    fitting = [each for each in there if (each.node, each.port) != TRUTH]
    if len(fitting) != 1:
        kind = "stream of poses" if form is Format.TUM else "stream with samples"
        names = ", ".join(f"{each.node}/{each.port}" for each in there)
        raise RecordingError(
            f"{source.path}: choose what to write with --stream: {names}" if there else f"{source.path}: has no {kind}"
        )
    return fitting[0]


def _columns(kind: type[Sample]) -> tuple[dict[str, int], list[str]]:
    """By field how many elements its vector has (0: it is a plain value), and the fields that are arrays."""
    columns: dict[str, int] = {}
    arrays: list[str] = []
    for field in msgspec.structs.fields(kind):
        match _inner(inspect.type_info(field.type)):
            case inspect.CustomType():
                arrays.append(field.name)
            case inspect.TupleType(item_types=items):
                columns[field.name] = len(items)
            case _:
                columns[field.name] = 0
    return columns, arrays


def _inner(described: inspect.Type) -> inspect.Type:
    """The type without its description, and without `| None`."""
    match described:
        case inspect.Metadata(type=inner):
            return _inner(inner)
        case inspect.UnionType(types=options):
            return next(_inner(option) for option in options if not isinstance(option, inspect.NoneType))
    return described


def _names(field: str, length: int) -> list[str]:
    return [f"{field}_{index}" for index in range(length)] or [field]


def _values(value: Any, length: int) -> Sequence[Any]:
    if length == 0:
        return [value]
    return [None] * length if value is None else value
