"""`caneflow import imu-csv`: a recording of tables of IMU readings."""

import io
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, Imu, bounds, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.printable import printable
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv import (
    COLUMNS,
    UNITS,
    ImuTable,
    IndistinctTimesError,
    Joined,
    Reading,
    assignments,
    encoding_of,
    require_told,
    shared_out,
)
from caneflow.recording import RecordingWriter

GIVEN_UNITS = "; ".join(f"{quantity}: {', '.join(units)}" for quantity, units in UNITS.items())
SEPARATORS = {"tab": "\t", "space": " "}

MOST = {  # that a sample may have
    "gyro": bounds.TURN_RATE,
    "accel": bounds.ACCELERATION,
    "mag": bounds.MAGNETIC_FIELD,
    "linear_accel": bounds.LINEAR_ACCELERATION,
}
LOST_STATUS = 1  # of a table that lost more rows than
MOST_LOST = 0.01
FIRST_READINGS = 3  # that a dry run shows
SNIFFED = 1 << 16  # bytes that tell the encoding


def imu_csv(
    tables: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="Text, one reading a line; several files are joined by time.", show_default=False
        ),
    ],
    columns: Annotated[
        str,
        typer.Option(
            metavar="NAME=COLUMN,...",
            help="Which column is time, gyro_x, gyro_y, gyro_z, accel_x ..., mag_x ..., orientation_w ..., "
            "linear_accel_x ...; by its title, a beginning that no other title has, or its number, from 1. "
            "Of several files also FILE:COLUMN. Time (or --rate) and gyro are required.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="REC", help="Recording to write.", show_default=False)
    ] = None,
    units: Annotated[
        str,
        typer.Option(
            metavar="NAME=UNIT,...",
            help="Units of the columns; by default those that the table states or the numbers' size shows. "
            f"{GIVEN_UNITS}.",
        ),
    ] = "",
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            min=0.01,
            max=1e6,
            help="Hz of the readings, where time is a sample number; without a column for time, the rows are numbered.",
        ),
    ] = None,
    key: Annotated[
        str, typer.Option(metavar="FLOW/NODE/PORT", help="Key under which the samples are recorded.")
    ] = "cane/imu/imu",
    delimiter: Annotated[
        str | None,
        typer.Option(
            metavar="CHAR",
            help="Column separator: one character, `tab` or `space`; found if not given.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Say what would be taken for what, with the first readings; write nothing."),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    r"""Make a recording of tables of IMU readings, for example a logger's CSV files.

    Time may be a number (s, ms, us, ns, days, a sample number), a date or a clock time; decimal points or commas,
    UTF-8 or UTF-16, comments and a row of units are read. Stamps are 0 at the first reading. Equal stamps are spread,
    a counter that wraps or begins again is followed, a time far off is left out; a line says each. A reading
    without one of its vectors is kept without it. The last line counts the rows that are lost; exit status 1: more
    than 1 % are, or the times cannot tell readings apart.

    Example, the walk of a foot-mounted sensor, then a phone that writes a file per sensor:

    caneflow import imu-csv short_walk.csv -o walk.mcap \
    --columns "time=Time,\
    gyro_x=Gyroscope X,gyro_y=Gyroscope Y,gyro_z=Gyroscope Z,\
    accel_x=Accelerometer X,accel_y=Accelerometer Y,accel_z=Accelerometer Z"

    caneflow import imu-csv Gyroscope.csv Accelerometer.csv -o phone.mcap \
    --columns time=1,gyro_x=2,gyro_y=3,gyro_z=4,accel_x=2,accel_y=3,accel_z=4
    """
    flow, stream = _flow_and_key(key)
    separator = _separator(delimiter)
    if output is None and not dry_run:
        raise CaneflowError("no output; expected -o REC, or --dry-run")
    told, given = _told(columns, units)
    with whole(None if dry_run else output, inputs=tables, overwrite=overwrite) as recording:
        read = _read(tables, told, given, separator=separator, rate=rate)
        readings = _joined(tables, read, told)
        for line in _notes(tables, read, readings):
            print(line)
        if recording is not None:
            _write(recording, flow, stream, readings)
    if dry_run:
        for line in _taken(tables, read, readings):
            print(line)
    lost, rows = _lost(read, readings)
    print(f"{'would be' if dry_run else output}: {_summary(readings)}; {_losses(tables, read)}")
    if lost > MOST_LOST * rows:
        raise typer.Exit(LOST_STATUS)


def _told(columns: str, units: str) -> tuple[dict[str, str], dict[str, str]]:
    try:
        told = assignments(columns, COLUMNS)
        given = assignments(units, UNITS) if units else {}
    except ProtocolError as error:
        raise CaneflowError(f"--columns or --units: {error}") from error
    return told, given


def _read(
    paths: Sequence[Path],
    told: Mapping[str, str],
    units: Mapping[str, str],
    *,
    separator: str | None,
    rate: float | None,
) -> list[ImuTable]:
    """The tables; times that cannot tell readings apart end the command with status 1."""
    several = len(paths) > 1
    try:
        require_told(told, numbered=rate is not None)
        shares = shared_out(told, [path.stem for path in paths])
    except ProtocolError as error:
        raise CaneflowError(f"--columns: {error}") from error
    tables = []
    for path, share in zip(paths, shares, strict=True):
        with _opened(path) as lines:
            try:
                tables.append(
                    ImuTable(
                        lines, columns=share, units=units, separator=separator, rate=rate, most=MOST, is_part=several
                    )
                )
            except IndistinctTimesError as error:
                print(f"caneflow import imu-csv: {printable(str(path))}: {error}", file=sys.stderr)
                raise typer.Exit(LOST_STATUS) from error
            except ProtocolError as error:
                raise CaneflowError(f"{path}: {error}") from error
    return tables


def _opened(path: Path) -> io.TextIOWrapper:
    """The text in its encoding; it may come through a pipe, which is read once."""
    raw = io.BufferedReader(path.open("rb", buffering=0), SNIFFED)
    return io.TextIOWrapper(raw, encoding=encoding_of(raw.peek()), errors="replace")


def _joined(paths: Sequence[Path], tables: Sequence[ImuTable], told: Mapping[str, str]) -> Joined:
    try:
        readings = Joined(tables)
    except ProtocolError as error:
        raise CaneflowError(f"{', '.join(map(str, paths))}: {error}") from error
    missing = {name.rpartition("_")[0] for name in told if name != "time"} - readings.vectors.keys()
    if missing:
        raise CaneflowError(f"--columns: {', '.join(sorted(missing))}: in none of the files")
    if not len(readings):
        raise CaneflowError(f"{paths[0]}: no row that can be used; {_losses(paths, tables)}")
    return readings


def _notes(paths: Sequence[Path], tables: Sequence[ImuTable], readings: Joined) -> Iterator[str]:
    """A line for each doubtful unit and each repair."""
    for path, table in zip(paths, tables, strict=True):
        for note in (*table.doubts(), *table.notes):
            yield printable(f"{path}: {note}")
    yield from readings.notes


def _taken(paths: Sequence[Path], tables: Sequence[ImuTable], readings: Joined) -> Iterator[str]:
    """What each column is taken for, and the first readings."""
    for path, table in zip(paths, tables, strict=True):
        layout = table.layout
        separator = {"\t": "tab", " ": "spaces"}.get(table.separator, table.separator)
        yield printable(f"{path}: separator {separator}, the first reading in line {layout.first_row + 1}")
        columns = {"time": () if layout.time is None else (layout.time,), **layout.vectors}
        for quantity, indices in columns.items():
            titles = ", ".join(layout.title(index) for index in indices) or "the rows, numbered"
            judged = table.units.get(quantity)
            yield printable(f"  {quantity}: {titles}" + (f"; {judged.unit}, {judged.why}" if judged else ""))
    yield "the first readings, s, rad/s, m/s^2, uT:"
    for reading in islice(readings.readings(), FIRST_READINGS):
        vectors = zip(Reading._fields[1:], reading[1:], strict=True)
        shown = (f"{name} {' '.join(f'{v:.4g}' for v in vector)}" for name, vector in vectors if vector is not None)
        yield f"  {reading.stamp * 1e-9:.6f}  {', '.join(shown)}"


def _lost(tables: Sequence[ImuTable], readings: Joined) -> tuple[int, int]:
    """Rows that are lost, of all tables, and how many there were."""
    return sum(table.refusals.counts.total() for table in tables), sum(table.rows for table in tables)


def _losses(paths: Sequence[Path], tables: Sequence[ImuTable]) -> str:
    if len(tables) == 1:
        return f"{tables[0].refusals} of {tables[0].rows}" if tables[0].refusals.counts else str(tables[0].refusals)
    lost = [(path, table) for path, table in zip(paths, tables, strict=True) if table.refusals.counts]
    return "; ".join(printable(f"{path}: {t.refusals} of {t.rows}") for path, t in lost) or "no row left out"


def _summary(readings: Joined) -> str:
    count, last = len(readings), int(readings.stamps[-1] - readings.stamps[0])
    rate = f"{(count - 1) * 1e9 / last:.2f} Hz, {last / 1e9:.1f} s" if last else "no rate"
    return f"{count} samples, {rate}"


def _write(output: Path, flow: str, key: str, readings: Joined) -> None:
    with RecordingWriter(output, flow=flow, source="imported", rig={}) as writer:
        for seq, reading in enumerate(readings.readings()):
            sample = Imu(**reading._asdict())
            writer.write(key, Imu, numbered(sample, seq), stamp=sample.stamp, seq=seq, log_time=sample.stamp)


def _separator(delimiter: str | None) -> str | None:
    if delimiter is None:
        return None
    separator = SEPARATORS.get(delimiter, delimiter)
    if len(separator) != 1 or separator in '"\r\n':
        raise CaneflowError(f"--delimiter {delimiter!r}: expected one character, tab or space")
    return separator


def _flow_and_key(key: str) -> tuple[str, str]:
    parts = key.split("/")
    if len(parts) != 3 or not all(NAME.fullmatch(part) for part in parts):
        raise CaneflowError(f"--key {key!r}: expected flow/node/port, each {NAME_RULE}")
    return parts[0], sample_key(*parts)


command = imu_csv
