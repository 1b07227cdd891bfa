"""`caneflow import imu-csv`: a recording of a table of IMU readings."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, Imu, bounds, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv import COLUMNS, UNITS, ImuTable, Reading, assignments
from caneflow.recording import RecordingWriter

GIVEN_UNITS = "; ".join(f"{quantity}: {', '.join(units)}" for quantity, units in UNITS.items())

MOST = {"gyro": bounds.TURN_RATE, "accel": bounds.ACCELERATION, "mag": bounds.MAGNETIC_FIELD}  # that a sample may have


def imu_csv(
    table: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Text, one reading a line, column names first.", show_default=False),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    columns: Annotated[
        str,
        typer.Option(
            metavar="NAME=COLUMN,...",
            help="Which column is time, gyro_x, gyro_y, gyro_z, accel_x ..., mag_x ...; by its name in the file "
            "or a beginning that no other has. Time and gyro there must be.",
            show_default=False,
        ),
    ],
    units: Annotated[
        str,
        typer.Option(metavar="NAME=UNIT,...", help=f"In which unit; the first if not told. {GIVEN_UNITS}."),
    ] = "",
    key: Annotated[
        str, typer.Option(metavar="FLOW/NODE/PORT", help="Under which name it is recorded.")
    ] = "cane/imu/imu",
    delimiter: Annotated[str, typer.Option(metavar="CHAR", help="What stands between cells; or tab.")] = ",",
    overwrite: Overwrite = False,
) -> None:
    r"""Make a recording of a table of IMU readings, for example a logger's CSV file.

    Stamps are the table's time, 0 at its first usable row. Rows that lack
    a number, or whose time is not later than the row before's, are left out, and counted.

    Example, the walk of a foot-mounted sensor:

    caneflow import imu-csv short_walk.csv -o walk.mcap \
    --units gyro=deg/s,accel=g \
    --columns "time=Time,\
    gyro_x=Gyroscope X,gyro_y=Gyroscope Y,gyro_z=Gyroscope Z,\
    accel_x=Accelerometer X,accel_y=Accelerometer Y,accel_z=Accelerometer Z"
    """
    flow, stream = _flow_and_key(key)
    delimiter = "\t" if delimiter == "tab" else delimiter
    if len(delimiter) != 1 or delimiter in '"\r\n':
        raise CaneflowError(f"--delimiter {delimiter!r}: expected one character, or tab")
    try:
        wanted = assignments(columns, COLUMNS)
        told = assignments(units, UNITS) if units else {}
    except ProtocolError as error:
        raise CaneflowError(f"--columns or --units: {error}") from error
    with (
        whole(output, inputs=[table], overwrite=overwrite) as recording,
        table.open(encoding="utf-8-sig", errors="replace", newline="") as lines,
    ):
        try:
            rows = ImuTable(lines, columns=wanted, units=told, delimiter=delimiter, most=MOST)
        except ProtocolError as error:
            raise CaneflowError(f"{table}: {error}") from error
        count, last = _write(recording, flow, stream, table, rows)
    rate = f"{(count - 1) * 1e9 / last:.2f} Hz, {last / 1e9:.1f} s" if last else "no rate"
    print(f"{output}: {count} samples, {rate}; {rows.refusals}")


def _write(output: Path, flow: str, key: str, table: Path, rows: ImuTable) -> tuple[int, int]:
    """The number of samples written, and the last stamp (ns)."""
    readings = rows.readings()
    first = next(readings, None)
    if first is None:
        raise CaneflowError(f"{table}: no row that can be used; {rows.refusals}")
    seq = last = 0
    with RecordingWriter(output, flow=flow, source="imported", rig={}) as writer:
        for seq, sample in enumerate(_samples(chain([first], readings))):
            last = sample.stamp
            writer.write(key, Imu, numbered(sample, seq), stamp=last, seq=seq, log_time=last)
    return seq + 1, last


def _samples(readings: Iterator[Reading]) -> Iterator[Imu]:
    for stamp, gyro, accel, mag in readings:
        yield Imu(stamp=stamp, gyro=gyro, accel=accel, mag=mag)


def _flow_and_key(key: str) -> tuple[str, str]:
    parts = key.split("/")
    if len(parts) != 3 or not all(NAME.fullmatch(part) for part in parts):
        raise CaneflowError(f"--key {key!r}: expected flow/node/port, each {NAME_RULE}")
    return parts[0], sample_key(*parts)


command = imu_csv
