"""`caneflow export`: a recording, or a stream of it, in a form that other programs read."""

import csv
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TextIO, TypeAlias

import msgspec
import typer
from msgspec import inspect

from caneflow.messages import SAMPLES, Pose, Sample
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.recording import TRUTH, Recorded, Recording, RecordingError, Stream
from caneflow.recording.untyped_rows import untyped_rows


class Format(StrEnum):
    """What can be written."""

    TUM = "tum"
    CSV = "csv"
    FOXGLOVE = "foxglove"
    ROSBAG2 = "rosbag2"
    PARQUET = "parquet"


COVARIANCES = ".covariance.txt"  # in place of a tum file's suffix: the file beside it
Shape: TypeAlias = tuple[int, ...]
FIXED: dict[tuple[type[Sample], str], Shape] = {(Pose, "covariance"): (6, 6)}  # arrays that fit into a row

TEXT = (Format.TUM, Format.CSV)  # readable, to standard output too
ONE_STREAM = (*TEXT, Format.PARQUET)  # the others hold the whole recording


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to take from.", show_default=False)],
    form: Annotated[
        Format,
        typer.Option(
            "--format",
            help="tum: a line per pose, `t x y z qx qy qz qw` in s and m, as evo reads it; covariances go to a file "
            "beside it. csv: a row per sample; stamp in ns, the rest in SI units and rad. "
            "parquet: the same with arrays, for polars, pandas and DuckDB. "
            "foxglove: an MCAP file for Foxglove, Lichtblick, PlotJuggler and Rerun. rosbag2: a folder for ros2 bag. "
            "Both hold ROS 2 messages: Imu, MagneticField, Odometry, PoseStamped, PoseWithCovarianceStamped, "
            "TwistWithCovarianceStamped, tf, and the range-Doppler map as Image.",
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
        typer.Option(
            metavar="NODE/PORT", help="tum, csv, parquet: stream to write; by default the only one that fits."
        ),
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="foxglove, rosbag2: frame of the poses; by default odom, for a room map."),
    ] = None,
    tf: Annotated[
        str | None,
        typer.Option(metavar="NODE/PORT", help="foxglove, rosbag2: poses that fill /tf, where several could."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write one stream of a recording (tum, csv, parquet), or all of it for other viewers (foxglove, rosbag2).

    Example: caneflow export track.mcap --format tum -o track.tum
    """
    if form not in ONE_STREAM:
        _export_whole(recording, form, output, stream, Naming(world, tf), overwrite=overwrite)
        return
    if world is not None or tf is not None:
        raise RecordingError(f"--format {form}: has no frames; --world and --tf are for foxglove and rosbag2")
    if form not in TEXT and output is None:
        raise RecordingError(f"--format {form}: needs -o, the file to write")
    with whole(output, inputs=[recording], overwrite=overwrite) as path, Recording(recording) as source:
        chosen = _chosen(source, form, stream)
        if path is not None and form is Format.PARQUET:
            from caneflow.recording.export_parquet import export_parquet  # here, as it brings its own library

            print(f"{export_parquet(source, chosen, path):8d}  {chosen.node}/{chosen.port}")
            return
        samples = source.samples([(chosen.node, chosen.port)])
        if form is Format.CSV:
            with _opened(path) as text:
                if chosen.schema in SAMPLES:
                    write_csv(samples, text)
                else:
                    schema = source.json_schema(chosen.node, chosen.port)
                    csv.writer(text, lineterminator="\n").writerows(untyped_rows(samples, schema))
        else:
            beside = output.with_suffix(COVARIANCES) if output and path and path.name == output.name else None
            with whole(beside, inputs=[recording], overwrite=overwrite) as covariances, _opened(path) as text:
                write_tum(samples, text, covariances)


@contextmanager
def _opened(path: Path | None) -> Iterator[TextIO]:
    """The file to write, or standard output."""
    if path is None:
        yield sys.stdout
    else:
        with path.open("w", encoding="utf-8", newline="") as text:
            yield text


class Naming(NamedTuple):
    """How frames are called, and which poses move them."""

    world: str | None
    tf: str | None


def _export_whole(
    recording: Path, form: Format, output: Path | None, stream: str | None, naming: Naming, *, overwrite: bool
) -> None:
    if output is None:
        raise RecordingError(
            f"--format {form}: needs -o, the {'folder' if form is Format.ROSBAG2 else 'file'} to write"
        )
    if stream is not None:
        raise RecordingError(f"--format {form}: takes the whole recording; --stream is for tum, csv and parquet")
    is_folder = form is Format.ROSBAG2
    with (
        whole(output, inputs=[recording], overwrite=overwrite, folder=is_folder) as path,
        Recording(recording) as source,
    ):
        if form is Format.FOXGLOVE:
            from caneflow.recording.export_foxglove import export_foxglove  # here, as each brings its own library

            written = export_foxglove(source, path, world=naming.world, tf=naming.tf)
        else:
            from caneflow.recording.export_rosbag2 import export_rosbag2

            written = export_rosbag2(source, path, world=naming.world, tf=naming.tf)
        topics = {"/".join(topic.split("/")[1:3]) for topic in written}
        left_out = [f"{node}/{port}" for node, port in source.streams if f"{node}/{port}" not in topics]
    for topic, count in written.items():
        print(f"{count:8d}  {topic}")
    if left_out:
        print(f"left out {', '.join(left_out)}: {form} has no form for it")


def write_tum(samples: Iterable[Recorded], text: TextIO, covariances: Path | None = None) -> None:
    """Write poses as lines of `t x y z qx qy qz qw`: s to the ns, m, quaternion with w last.

    To `covariances`, unless no pose has one: lines of t and the 36 elements for x y z vx vy vz, row by row.
    """
    with ExitStack() as stack:
        beside: TextIO | None = None
        for sample in samples:
            pose = sample.decoded()
            assert isinstance(pose, Pose)
            w, x, y, z = pose.orientation
            seconds = f"{pose.stamp // 10**9}.{pose.stamp % 10**9:09d}"
            print(seconds, *pose.position, x, y, z, w, file=text)
            if covariances is None or pose.covariance is None:
                continue
            if beside is None:
                beside = stack.enter_context(covariances.open("w", encoding="utf-8"))
                print("# t (s), then the covariance of x y z (m), vx vy vz (m/s), row by row", file=beside)
            print(seconds, *pose.covariance.reshape(-1).tolist(), file=beside)


def write_csv(samples: Iterable[Recorded], text: TextIO) -> None:
    """Write a row per sample: vectors as a column per element, absent values empty, arrays left out."""
    rows = csv.writer(text, lineterminator="\n")
    columns: dict[str, Shape] | None = None
    for sample in samples:
        message = sample.decoded()
        if columns is None:
            columns, arrays = _columns(type(message))
            if arrays:
                print(
                    f"{sample.key}: left out {', '.join(arrays)}: an array does not fit into a row",
                    file=sys.stderr,
                )
            rows.writerow(name for field, shape in columns.items() for name in _names(field, shape))
        rows.writerow(value for field, shape in columns.items() for value in _values(getattr(message, field), shape))


def _chosen(source: Recording, form: Format, stream: str | None) -> Stream:
    if stream is not None:
        node, _, port = stream.partition("/")
        chosen = source.stream(node, port)
        if form is Format.TUM and chosen.schema != Pose.schema:
            raise RecordingError(f"{source.path}: {stream} holds {chosen.schema}; tum takes {Pose.schema}")
        return chosen
    there = [
        each
        for each in source.streams.values()
        if each.count and (form is not Format.TUM or each.schema == Pose.schema)
    ]
    fitting = [each for each in there if (each.node, each.port) != TRUTH]
    if len(fitting) != 1:
        kind = "stream of poses" if form is Format.TUM else "stream with samples"
        names = ", ".join(f"{each.node}/{each.port}" for each in there)
        raise RecordingError(
            f"{source.path}: choose what to write with --stream: {names}" if there else f"{source.path}: has no {kind}"
        )
    return fitting[0]


def _columns(kind: type[Sample]) -> tuple[dict[str, Shape], list[str]]:
    """By field the shape of its value, (): a plain one; and the fields that are arrays of no fixed shape."""
    columns: dict[str, Shape] = {}
    arrays: list[str] = []
    for field in msgspec.structs.fields(kind):
        match _inner(inspect.type_info(field.type)):
            case inspect.CustomType():
                if (shape := FIXED.get((kind, field.name))) is None:
                    arrays.append(field.name)
                else:
                    columns[field.name] = shape
            case inspect.TupleType(item_types=items):
                columns[field.name] = (len(items),)
            case _:
                columns[field.name] = ()
    return columns, arrays


def _inner(described: inspect.Type) -> inspect.Type:
    """The type without its description, and without `| None`."""
    match described:
        case inspect.Metadata(type=inner):
            return _inner(inner)
        case inspect.UnionType(types=options):
            return next(_inner(option) for option in options if not isinstance(option, inspect.NoneType))
    return described


def _names(field: str, shape: Shape) -> list[str]:
    return ["_".join((field, *map(str, index))) for index in product(*map(range, shape))]


def _values(value: Any, shape: Shape) -> Sequence[Any]:
    if not shape:
        return [value]
    if value is None:
        return [None] * prod(shape)
    return list(value) if len(shape) == 1 else value.reshape(-1).tolist()
