"""Tables of IMU readings as loggers write them, and recordings of them: text, columns, units, times, joining."""

import importlib.util
import math
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, decode
from caneflow.physics import GRAVITY
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
    shared_out,
)
from caneflow.protocols.imu_csv.joining import interpolated
from caneflow.protocols.imu_csv.repairs import Repairs, followed
from caneflow.protocols.imu_csv.units import gravity_turn
from caneflow.recording import Recording
from tools.import_imu_csv import MOST, imu_csv

CHECKS = Path(__file__).parents[1].parent / "shared" / "checks"
NAMES = {"time": "t", **{name: name for name in COLUMNS[1:7]}}
HEADER = "t,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
SI = {"time": "s", "gyro": "rad/s", "accel": "m/s^2"}
MS = 1_000_000  # ns

Import = Callable[..., tuple[int, str]]
Floats = NDArray[np.float64]


def table(*rows: str, header: str = HEADER, columns: dict[str, str] | None = None, **options: object) -> ImuTable:
    given: dict[str, object] = {"units": SI, **options}
    return ImuTable([header, *rows], columns=columns or NAMES, **given)  # type: ignore[arg-type]


def readings(*tables: ImuTable) -> list[Reading]:
    return list(Joined(tables).readings())


def stamps_ms(*tables: ImuTable) -> list[float]:
    return [reading.stamp / MS for reading in readings(*tables)]


def rest(times: Sequence[object]) -> list[str]:
    """A row at rest for each time; no two readings alike."""
    return [f"{time},{k % 7 * 0.001},0,0,{0.01 * (k % 11)},0,9.81" for k, time in enumerate(times)]


def test_a_row_becomes_a_reading_in_si_units() -> None:
    units = {"time": "ms", "gyro": "deg/s", "accel": "g"}
    rows = table("1000,180,0,-90,0,0,1", "1002.5,0,0,0,1,0,0", units=units)
    first, second = readings(rows)
    assert first.stamp == 0
    assert first.gyro == pytest.approx((math.pi, 0.0, -0.5 * math.pi))
    assert first.accel == (0.0, 0.0, GRAVITY)
    assert first[3:] == (None, None, None)
    assert second.stamp == 2_500_000
    assert str(rows.refusals) == "no row left out"


@pytest.mark.parametrize(
    ("quantity", "unit", "value", "expected"),
    [
        ("gyro", "mdeg/s", 180_000.0, math.pi),
        ("accel", "mg", 500.0, 4.903325),
        ("mag", "G", 0.5, 50.0),
        ("mag", "nT", 48_000.0, 48.0),
        ("mag", "mT", 0.048, 48.0),
        ("mag", "T", 48e-6, 48.0),
        ("mag", "mG", 480.0, 48.0),
    ],
)
def test_units_are_those_of_the_wire(quantity: str, unit: str, value: float, expected: float) -> None:
    assert value * UNITS[quantity][unit] == pytest.approx(expected)


# Columns


def test_columns_are_found_by_title_by_a_beginning_that_no_other_has_or_by_number() -> None:
    header = "Time (s),Gyro X (deg/s),Gyro Y (deg/s),Gyro Z (deg/s),Time"
    columns = {"time": "Time", "gyro_x": "Gyro X", "gyro_y": "3", "gyro_z": "Gyro Z"}
    (reading,) = readings(table("9,1,2,3,4", header=header, columns=columns, units={"gyro": "rad/s"}))
    assert reading == Reading(0, (1.0, 2.0, 3.0))
    with pytest.raises(ProtocolError, match="gyro_x: 3 columns of the name 'Gyro'; there are 'Time \\(s\\)'"):
        table(header=header, columns={**columns, "gyro_x": "Gyro"})
    with pytest.raises(ProtocolError, match="gyro_y: no column of the name 'gyro y'"):
        table(header=header, columns={**columns, "gyro_y": "gyro y"})
    with pytest.raises(ProtocolError, match="gyro_y: no column 9; there are 5, the first is 1"):
        table(header=header, columns={**columns, "gyro_y": "9"})


NUMBERS = {"time": "2", "gyro_x": "3", "gyro_y": "4", "gyro_z": "5"}


@pytest.mark.parametrize(
    "above",
    [
        [],
        ["count,time,gx,gy,gz"],
        ["# logger 1.2", "", "count,time,gx,gy,gz", "-,s,rad/s,rad/s,rad/s"],
        ["Sensor: 12", "Rate, 100, Hz", "n;o;t"],
    ],
)
def test_columns_by_number_need_no_header(above: list[str]) -> None:
    rows = ImuTable([*above, "0,0.5,1,2,3", "1,0.51,4,5,6"], columns=NUMBERS, units=SI)
    assert readings(rows) == [Reading(0, (1.0, 2.0, 3.0)), Reading(10 * MS, (4.0, 5.0, 6.0))]
    assert str(rows.refusals) == "no row left out"


@pytest.mark.parametrize(
    "above",
    [
        ["# logger 1.2, serial 7", "# rate 100 Hz", HEADER],
        ["Device: X, 3", "", HEADER, "s,rad/s,rad/s,rad/s,g,g,g"],
        ["# " + HEADER],
        ["#" + HEADER, "% another comment"],
        ['"' + HEADER.replace(",", '","') + '"'],
    ],
)
def test_what_stands_above_the_rows_is_passed_over(above: list[str]) -> None:
    rows = ImuTable([*above, "1,0,0,0,0,0,1", "# paused", "1.01,0,0,0,0,0,1"], columns=NAMES, units={})
    assert [reading.stamp for reading in readings(rows)] == [0, 10 * MS]
    assert str(rows.refusals) == "no row left out"
    assert readings(rows)[0].accel == pytest.approx((0, 0, GRAVITY))  # by the row of units, or by size


def test_a_header_that_comes_again_is_not_a_lost_row() -> None:
    rows = table("0,0,0,0,0,0,9", HEADER, "0.01,0,0,0,0,0,9")
    assert len(readings(rows)) == 2
    assert not rows.refusals.counts


def test_quaternions_and_linear_acceleration() -> None:
    columns = {**NAMES, **{f"orientation_{axis}": f"q{axis}" for axis in "wxyz"}}
    columns |= {f"linear_accel_{axis}": f"l{axis}" for axis in "xyz"}
    header = HEADER + ",qw,qx,qy,qz,lx,ly,lz"
    rows = table(
        "0,0,0,0,0,0,1,0.7071,0,0,0.7071,0,0,0.1",
        "0.01,0,0,0,0,0,1,0,0,0,0,0,0,0.1",
        "0.02,0,0,0,0,0,1,0.7071,0,0,-0.7071,0,0,0.1",
        header=header,
        columns=columns,
        units={"accel": "g"},
    )
    first, second, third = readings(rows)
    half = math.sqrt(0.5)
    assert first.orientation == pytest.approx((half, 0, 0, half), abs=1e-12)
    assert second.orientation is None  # what a chip gives before its fusion runs
    assert third.orientation == pytest.approx((half, 0, 0, -half), abs=1e-12)
    assert first.linear_accel == pytest.approx((0, 0, 0.1 * GRAVITY))  # in the accelerometer's unit
    assert any("1 are not unit quaternions" in note for note in rows.notes)


@pytest.mark.parametrize(
    ("columns", "units", "message"),
    [
        ({"time": "t"}, {}, "no column is told for gyro_x, gyro_y, gyro_z"),
        ({**NAMES, "gyro_w": "t"}, {}, "'gyro_w': not a column; expected one of time, gyro_x"),
        ({k: v for k, v in NAMES.items() if k != "accel_y"}, {}, "no column is told for accel_y"),
        ({k: v for k, v in NAMES.items() if k != "time"}, {}, "no column is told for time"),
        (NAMES, {"gyro": "rpm"}, "gyro: no unit 'rpm'; there are rad/s, deg/s"),
        (NAMES, {"speed": "m/s"}, "'speed': not a quantity"),
    ],
)
def test_what_is_told_wrongly_is_an_error_that_says_what_would_be_right(
    columns: dict[str, str], units: dict[str, str], message: str
) -> None:
    with pytest.raises(ProtocolError, match=re.escape(message)):
        ImuTable([HEADER], columns=columns, units=units)


def test_an_empty_file_has_no_columns() -> None:
    with pytest.raises(ProtocolError, match="no column of the name 't'"):
        ImuTable([], columns=NAMES, units={})


def test_assignments_leave_commas_and_signs_in_names_alone() -> None:
    told = assignments("time=Time [s, UTC], gyro_x=w=x,gyro_y=b", COLUMNS)
    assert told == {"time": "Time [s, UTC]", "gyro_x": "w=x", "gyro_y": "b"}


@pytest.mark.parametrize("text", ["", "Time", "tyme=Time", "x,time=Time"])
def test_what_is_no_assignment_is_refused(text: str) -> None:
    with pytest.raises(ProtocolError, match="expected name=value, where name is one of time, gyro"):
        assignments(text, COLUMNS)


def test_an_assignment_twice_is_refused() -> None:
    with pytest.raises(ProtocolError, match="time is there twice"):
        assignments("time=a,time=b", COLUMNS)


# Cells


@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " "])
def test_the_separator_is_found(separator: str) -> None:
    lines = [line.replace(",", separator) for line in [HEADER, *rest(("0.00", "0.01", "0.02"))]]
    rows = ImuTable(lines, columns=NAMES, units={})
    assert rows.separator == separator
    assert stamps_ms(rows) == [0, 10, 20]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas(separator: str) -> None:
    lines = [line.replace(",", separator).replace(".", ",") for line in [HEADER, *rest(("1000.00", "1000.01"))]]
    lines[2] = lines[2].replace("1000,01", "1.000,01")
    rows = ImuTable(lines, columns=NAMES, units={}, separator=separator)
    first, second = readings(rows)
    assert second.stamp == 10 * MS
    assert first.accel == (0.0, 0.0, 9.81)
    assert second.gyro == (0.001, 0.0, 0.0)


@pytest.mark.parametrize(
    ("row", "cause"),
    [
        ("2,1,2,3,4,5", "with too few cells"),
        ("2", "with too few cells"),
        ("2,1,2,3,4,5,x", "with a cell that is not a number"),
        ("later,1,2,3,4,5,6", "with a time that is not a time"),
        ("inf,1,2,3,4,5,6", "with a time that is not a time"),
        ("1e25,1,2,3,4,5,6", "with a time that is not a time"),
        ("1e99999999,1,2,3,4,5,6", "with a time that is not a time"),
        ("2,,,,,,", "without a reading"),
        ('2,"1,2,3,4,5,6', "with a cell that is not a number"),
    ],
)
def test_a_bad_row_is_left_out_counted_and_named(row: str, cause: str) -> None:
    rows = table("1,0,0,0,0,0,1", row, "", "3,0,0,0,0,0,1")
    assert stamps_ms(rows) == [0, 2000]
    assert str(rows.refusals) == f"1 row left out: 1 {cause} (first in line 3)"
    assert rows.rows == 3


@pytest.mark.parametrize("cells", [",,", "nan,NaN,nan", "null,null,null", "N/A,N/A,N/A", "1,,3", "inf,1,1", "-,-,-"])
def test_a_reading_without_a_vector_is_kept_without_it(cells: str) -> None:
    rows = table("0,1,2,3,4,5,6", f"0.01,1,2,3,{cells}", "0.02,1,2,3,4,5,6")
    assert [reading.accel for reading in readings(rows)] == [(4.0, 5.0, 6.0), None, (4.0, 5.0, 6.0)]
    assert not rows.refusals.counts


def test_a_row_that_no_sensor_can_say_is_counted() -> None:
    """Beyond the bounds that a sample has, in the table's units: 5000 g and 10^8 deg/s."""
    units = {"gyro": "deg/s", "accel": "g"}
    rows = table(
        "0,0,0,0,0,0,1", "0.01,0,1e8,0,0,0,1", "0.02,0,0,0,0,0,-5000", "0.03,0,0,0,1,0,0", units=units, most=MOST
    )
    assert stamps_ms(rows) == [0, 30]
    assert str(rows.refusals) == (
        "2 rows left out: 1 with gyro beyond 1e+06 rad/s (first in line 3), "
        "1 with accel beyond 4000 m/s^2 (first in line 4)"
    )


cells = st.one_of(st.floats().map(repr), st.text(max_size=5), st.integers(-(10**6), 10**6).map(str))


@given(lines=st.lists(st.lists(cells, max_size=9).map(",".join), max_size=30))
@settings(deadline=None)
def test_whatever_the_rows_are_each_is_a_sound_reading_or_told(lines: list[str]) -> None:
    lines = [line.replace("\n", "").replace("\r", "") for line in lines]
    try:
        rows = table(*lines, most=MOST, separator=",", units={})
    except IndistinctTimesError:
        return
    found = readings(rows)
    stamps = [reading.stamp for reading in found]
    assert stamps == sorted(set(stamps))
    assert not stamps or stamps[0] == 0
    for reading in found:
        Imu(**reading._asdict())  # checks itself


# Encodings


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_the_encoding_is_found(encoding: str) -> None:
    text = "\N{DEGREE SIGN}/s," + HEADER + "\n0,1,2,3\n"
    content = text.encode(encoding)
    assert content.decode(encoding_of(content)).lstrip("\ufeff") == text


# Units


@pytest.mark.parametrize(
    ("step", "unit"),
    [("0.01", "s"), ("10", "ms"), ("0.8", "ms"), ("0.2", "s"), ("10000", "us"), ("2500000", "ns"), ("1.16e-7", "d")],
)
def test_the_unit_of_time_is_that_in_which_the_step_is_an_imus(step: str, unit: str) -> None:
    rows = table(*rest([float(step) * k for k in range(300)]), units={})
    assert rows.units["time"].unit == unit
    expected = float(step) * UNITS["time"][unit]
    assert np.diff([reading.stamp for reading in readings(rows)]) == pytest.approx(expected, abs=2)


def test_what_is_told_of_time_holds_and_the_doubt_is_named() -> None:
    rows = table(*rest(range(0, 500, 10)), units={"time": "s"})
    assert stamps_ms(rows)[1] == 10_000
    (doubt,) = (line for line in rows.doubts() if line.startswith("time"))
    assert "by their size the numbers are ms" in doubt
    slow = table(*rest([0.2 * k for k in range(50)]), units={})
    assert any("5 Hz is slow, 5e+03 Hz possible too; --units time=UNIT settles it" in line for line in slow.doubts())
    counting = table(*rest(range(100)), units={})
    assert any("sample numbers? --rate HZ" in line for line in counting.doubts())


@pytest.mark.parametrize(("magnitude", "unit"), [(9.79, "m/s^2"), (0.98, "g"), (1003.0, "mg")])
def test_the_unit_of_an_accelerometer_is_that_in_which_it_feels_gravity(magnitude: float, unit: str) -> None:
    rows = table(*(f"{k / 100},0,0,0,0,0,{magnitude}" for k in range(50)), units={})
    assert rows.units["accel"].unit == unit
    assert 9.5 < readings(rows)[0].accel[2] < 10.0  # type: ignore[index]  # it has one


def test_a_size_that_no_unit_explains_is_a_doubt_with_what_settles_it() -> None:
    rows = table(*(f"{k / 100},0,0,0,0,0,16384" for k in range(50)), units={})
    assert any("--units accel=UNIT settles it" in line for line in rows.doubts())


@pytest.mark.parametrize(
    ("unit", "value"), [("uT", 48.0), ("nT", 48e3), ("mT", 0.048), ("T", 48e-6), ("mG", 480.0), ("G", 0.48)]
)
def test_the_unit_of_a_compass_is_that_in_which_it_feels_the_earth(unit: str, value: float) -> None:
    columns = {**NAMES, **{f"mag_{axis}": f"m{axis}" for axis in "xyz"}}
    rows = table(
        *(f"{row},0,0,{value}" for row in rest(range(0, 500, 10))), header=HEADER + ",mx,my,mz", columns=columns
    )
    assert rows.units["mag"].unit == unit
    assert readings(rows)[0].mag == pytest.approx((0, 0, 48.0))


def swung(scale: float, seconds: float = 20.0) -> tuple[Floats, Floats, Floats]:
    """A sensor that swings about x by +-0.3 rad at 0.5 Hz: times, gyro in rad/s times `scale`, accel; both noisy."""
    rng = np.random.default_rng(3)
    times = np.arange(0, seconds, 0.01)
    angle, rate = 0.3 * np.sin(np.pi * times), 0.3 * np.pi * np.cos(np.pi * times)
    zero = np.zeros_like(times)
    gyro = np.stack([rate, zero, zero], axis=1) + 0.01 * rng.standard_normal((len(times), 3))
    accel = 9.81 * np.stack([zero, np.sin(angle), np.cos(angle)], axis=1) + 0.3 * rng.standard_normal((len(times), 3))
    return times, scale * gyro, accel


def test_slow_turns_in_degrees_are_told_by_gravity() -> None:
    """54 deg/s at most: as radians it would be a plausible walk, but gravity would turn 57 times as fast."""
    times, gyro, accel = swung(1.0)
    assert gravity_turn(times, gyro, accel) == pytest.approx(1.0, abs=0.1)
    assert gravity_turn(times, np.degrees(gyro), accel) == pytest.approx(math.radians(1.0), rel=0.1)
    still = np.tile([0.05, 0.0, 0.0], (len(times), 1))  # an offset, at rest: says nothing
    assert gravity_turn(times, still, np.tile([0, 0, 9.81], (len(times), 1))) is None


@pytest.mark.parametrize(
    ("scale", "unit"), [(1.0, "rad/s"), (0.5 * math.degrees(1.0), "deg/s"), (3e3 * 57.3, "mdeg/s")]
)
def test_the_unit_of_a_gyro(scale: float, unit: str) -> None:
    times, gyro, accel = swung(scale)
    rows = [",".join(map(repr, map(float, (t, *g, *a)))) for t, g, a in zip(times, gyro, accel, strict=True)]
    assert table(*rows, units={}).units["gyro"].unit == unit


@pytest.mark.parametrize(
    ("title", "unit"),
    [("Gyro X (\N{DEGREE SIGN}/s)", "deg/s"), ("gyr_x [rad/s]", "rad/s"), ("gx_dps", "deg/s"), ("gx (mdps)", "mdeg/s")],
)
def test_a_title_states_the_unit(title: str, unit: str) -> None:
    rows = table(
        "0,1,2,3",
        header=f"t,{title},b,c",
        columns={"time": "1", "gyro_x": title, "gyro_y": "b", "gyro_z": "c"},
        units={},
    )
    assert rows.units["gyro"] == (unit, "as the table states", "")


# Times


def test_a_time_of_many_digits_keeps_its_nanoseconds() -> None:
    rows = table("1700000000.123456789,0,0,0,0,0,1", "1700000000.123456790,0,0,0,0,0,2")
    assert [reading.stamp for reading in readings(rows)] == [0, 1]


@pytest.mark.parametrize(
    ("first", "second", "expected_ms"),
    [
        ("2024-05-01T12:00:00.000", "2024-05-01T12:00:00.010", 10),
        ("2024-05-01T12:00:00.000Z", "2024-05-01T12:00:00.010Z", 10),
        ("2024-05-01 12:00:00,000", "2024-05-01 12:00:00,010", 10),
        ("2024-05-01T12:00:00+02:00", "2024-05-01T10:00:00.25Z", 250),
        ("2024-02-28T23:59:59.999", "2024-02-29T00:00:00.001", 2),
        ("20240501T120000.000", "20240501T120000.010", 10),
        ("2024/05/01 12:00:00.1234567", "2024/05/01 12:00:00.1334567", 10),
        ("12:00:00.000", "12:00:00.010", 10),
        ("12:00:00:000", "12:00:00:010", 10),
        ("11:59:59.990 AM", "12:00:00.000 PM", 10),
        ("01:02.500", "01:02.510", 10),
        ("01-May-2024 12:00:00.010", "01-May-2024 12:00:00.020", 10),
        ("05/01/2024 12:00:00.010 PM", "05/01/2024 12:00:00.020 PM", 10),
    ],
)
def test_dates_and_clock_times(first: str, second: str, expected_ms: float) -> None:
    lines = [line.replace(",", ";") for line in (HEADER, "T,0,0,0,0,0,9.8", "U,0,0,0,0,0,9.9")]
    lines = [line.replace("T;", first + ";").replace("U;", second + ";") for line in lines]
    assert stamps_ms(ImuTable(lines, columns=NAMES, units={}, separator=";")) == [0, expected_ms]


@pytest.mark.parametrize("style", ["{h:02}:{m:02}:{s:06.3f}", "31.12.2024 {h:02}:{m:02}:{s:06.3f}", "{m:02}:{s:06.3f}"])
def test_a_clock_goes_on_after_midnight(style: str) -> None:
    seconds = [(86399.5 + k / 100) % 86400 for k in range(100)]
    cells = [style.format(h=int(s // 3600), m=int(s // 60 % 60), s=s % 60) for s in seconds]
    rows = table(*rest(cells), units={})
    assert stamps_ms(rows) == [10 * k for k in range(100)]
    assert any("wrap" in note for note in rows.notes)


def test_sample_numbers_with_a_rate_and_rows_without_time() -> None:
    numbered = table(*rest([7, 8, 10, 11]), rate=200.0, units={})
    assert stamps_ms(numbered) == [0, 5, 15, 20]
    untimed = {name: column for name, column in NAMES.items() if name != "time"}
    assert stamps_ms(table(*rest("abc"), columns=untimed, rate=50.0, units={})) == [0, 20, 40]
    packets = table(*rest([(k + 250) % 256 for k in range(300)]), rate=100.0, units={})
    assert stamps_ms(packets) == [10 * k for k in range(300)]


def clock(times: Sequence[int], wraps: Sequence[int] = ()) -> tuple[list[int | None], Repairs]:
    repairs = Repairs()
    return followed(times, wraps, repairs), repairs


STEP = 10  # of the times below, any unit


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize("lost", [0, 1, 5])
def test_a_wrap_is_followed(bits: int, lost: int) -> None:
    whole = [2**bits - 1000 + STEP * k for k in range(200) if not 100 <= k < 100 + lost]
    found, repairs = clock([time % 2**bits for time in whole], (2**bits,))
    assert found == whole
    assert list(repairs.counts.values()) == [1]


def test_a_clock_that_begins_again_goes_on_one_step_later_as_often_as_it_does() -> None:
    found, repairs = clock([STEP * (k % 70) for k in range(210)])
    assert found == [STEP * k for k in range(210)]
    assert list(repairs.counts.values()) == [2]


@pytest.mark.parametrize("place", range(2, 15))
def test_a_clock_that_begins_again_soon_does_so_too(place: int) -> None:
    times = [STEP * (k if k < place else k - place) for k in range(100)]
    found, repairs = clock(times)
    assert found == [STEP * k for k in range(100)]
    assert list(repairs.counts.values()) == [1]


@pytest.mark.parametrize("place", [0, 1, 2, 57, 198, 199])
@pytest.mark.parametrize("value", [10**12, -(10**12), 10**12 + 1])
def test_one_time_far_off_costs_its_reading_alone(place: int, value: int) -> None:
    times = [10**9 * k // 100 for k in range(200)]
    found, repairs = clock([*times[:place], value, *times[place + 1 :]])
    assert found == [*times[:place], None, *times[place + 1 :]]
    assert list(repairs.counts.values()) == [1]


@pytest.mark.parametrize("value", [700, -100])
def test_a_time_less_far_off_costs_its_reading_too(value: int) -> None:
    times = [STEP * k for k in range(200)]
    off = times[50] + value
    found, _ = clock([*times[:50], off, *times[51:]])
    expected = [*times[:50], None, *times[51:]]
    assert found == expected or found == [*times[:50], off, *times[51:]]  # within ten steps it is a late row
    assert found[51:] == times[51:]


def test_rows_that_come_late_are_put_in_order() -> None:
    rows = table(*rest((0.00, 0.01, 0.03, 0.02, 0.04, 0.05)))
    assert stamps_ms(rows) == [0, 10, 20, 30, 40, 50]
    assert readings(rows)[2].gyro[0] == 0.003
    assert any("put in order" in note for note in rows.notes)


@pytest.mark.parametrize("group", [2, 3, 10])
def test_equal_stamps_are_spread_evenly(group: int) -> None:
    rows = table(*rest([f"{0.01 * group * (k // group):.3f}" for k in range(120)]))
    assert stamps_ms(rows) == pytest.approx([10.0 * k for k in range(120)], abs=1e-3)
    assert any("stamp of the one before" in note for note in rows.notes)


def test_equal_stamps_before_a_gap_keep_their_usual_spacing() -> None:
    times = [0.02 * (k // 2) + (5.0 if k >= 50 else 0.0) for k in range(100)]
    found = stamps_ms(table(*rest([f"{time:.3f}" for time in times])))
    assert found[49] - found[48] == pytest.approx(10.0, abs=0.1)


def test_rows_written_twice_are_taken_once() -> None:
    lines = rest([f"{k / 100:.2f}" for k in range(50)])
    rows = table(*lines[:20], lines[19], *lines[20:])
    assert len(readings(rows)) == 50
    assert any("1 rows written twice" in note for note in rows.notes)
    assert not rows.refusals.counts


@pytest.mark.parametrize("seconds", [2, 20])
def test_whole_seconds_cannot_tell_readings_apart(seconds: int) -> None:
    with pytest.raises(IndistinctTimesError, match=r"too coarse to tell the readings apart; .* --rate HZ"):
        table(*rest([1714564800 + k // 100 for k in range(100 * seconds)]), units={})


def test_a_gap_is_told_with_its_length_and_place() -> None:
    rows = table(*rest([f"{(k if k < 100 else k + 300) / 100:.2f}" for k in range(200)]))
    assert stamps_ms(rows)[-1] == 4990
    assert [note for note in rows.notes if "gap" in note] == [
        "a gap of more than 5 readings; the longest of 3.01 s after line 101"
    ]


# Several sensors


def test_files_are_joined_at_the_gyros_times() -> None:
    gyro = ImuTable(["t,x,y,z", *(f"{k / 100:.2f},1,2,3" for k in range(100))], columns=GYRO, units=SI, is_part=True)
    accel = ImuTable(
        ["t,x,y,z", *(f"{0.003 + k / 50:.3f},{k},0,9.8" for k in range(60))], columns=ACCEL, units=SI, is_part=True
    )
    found = readings(gyro, accel)
    assert [reading.stamp for reading in found] == [10 * MS * k for k in range(100)]
    assert found[0].accel is None  # before the first
    assert found[50].accel == pytest.approx(((0.5 - 0.003) * 50, 0.0, 9.8))  # a straight line is met exactly
    assert Joined([gyro, accel]).notes == ["accel: 99 of 100 interpolated between readings of other times"]


GYRO = {"time": "t", "gyro_x": "x", "gyro_y": "y", "gyro_z": "z"}
ACCEL = {"time": "t", "accel_x": "x", "accel_y": "y", "accel_z": "z"}


def test_rows_of_one_sensor_each_are_joined_too() -> None:
    rows = table(*(f"{k / 200:.3f}," + (f"{k},0,0,,," if k % 2 == 0 else f",,,0,0,{9 + k / 1e3}") for k in range(100)))
    found = readings(rows)
    assert len(found) == 50
    assert found[10].accel == pytest.approx((0, 0, 9.02))
    assert not rows.refusals.counts


def test_nothing_is_interpolated_over_a_hole() -> None:
    stamps = np.array([0, 10, 20, 500, 510]) * MS
    values = np.arange(15.0).reshape(5, 3)
    at = np.array([15, 100, 505]) * MS
    found = interpolated(stamps, values, at)
    assert found[0] == pytest.approx((4.5, 5.5, 6.5))
    assert np.isnan(found[1]).all()
    assert found[2] == pytest.approx((10.5, 11.5, 12.5))


def test_a_quaternion_is_interpolated_within_one_half() -> None:
    values = np.array([[1.0, 0, 0, 0], [-1.0, 0, 0, -0.0]])
    (found,) = interpolated(np.array([0, 10]), values, np.array([5]))
    assert abs(found[0]) == 1.0


def test_clocks_that_do_not_overlap_are_an_error() -> None:
    gyro = ImuTable(["t,x,y,z", *(f"{k / 100},1,2,3" for k in range(100))], columns=GYRO, units=SI, is_part=True)
    accel = ImuTable(["t,x,y,z", *(f"{k / 100 + 50},1,2,3" for k in range(100))], columns=ACCEL, units=SI, is_part=True)
    with pytest.raises(ProtocolError, match="accel: its times do not overlap with the gyro's"):
        Joined([gyro, accel])


def test_columns_of_several_files() -> None:
    columns = GYRO | ACCEL  # the same titles
    by_name = shared_out(columns, ["Gyroscope", "Accelerometer"])
    assert by_name == [GYRO, ACCEL]
    with pytest.raises(ProtocolError, match="'x' is told for another vector too; expected FILE:COLUMN"):
        shared_out(columns, ["a", "b"])
    qualified = {**GYRO, "accel_x": "b:x", "accel_y": "b:y", "accel_z": "b:z"}
    first, second = shared_out(qualified, ["a", "b"])
    assert first == GYRO
    assert {name: second[name] for name in ACCEL} == ACCEL


# The command


@pytest.fixture
def run_import() -> Import:
    """Exit status of `caneflow import imu-csv`, and what it says; its error is raised."""

    def run(*arguments: object) -> tuple[int, str]:
        app = typer.Typer()
        app.command()(imu_csv)
        result = CliRunner().invoke(app, list(map(str, arguments)))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.output

    return run


def written(path: Path, *rows: str) -> Path:
    path.write_text("\ufeff" + "\r\n".join([HEADER, *rows]) + "\r\n", encoding="utf-8")
    return path


COLUMNS_TOLD = ",".join(f"{name}={column}" for name, column in NAMES.items())


def test_the_recording_has_the_tables_readings(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", "10,1,2,3,0,0,1", "10,1,2,3,0,0,1", "10.01,4,5,6,0,1,0", "10.02,0,0,0,0,0,1")
    output = tmp_path / "a.mcap"
    status, said = run_import(
        source, "-o", output, "--columns", COLUMNS_TOLD, "--units", "gyro=rad/s,accel=g", "--key", "foot/left/imu"
    )
    assert status == 0
    assert said.splitlines() == [
        f"{source}: 1 rows written twice, taken once (first in line 3)",
        f"{output}: 3 samples, 100.00 Hz, 0.0 s; no row left out",
    ]
    with Recording(output) as recording:
        assert recording.flow == "foot"
        assert recording.rig == {}
        assert recording.metadata["source"] == "imported"
        samples = [decode(sample.payload, Imu) for sample in recording.samples([("left", "imu")])]
    assert [sample.stamp for sample in samples] == [0, 10_000_000, 20_000_000]
    assert [sample.seq for sample in samples] == [0, 1, 2]
    assert samples[1].gyro == (4.0, 5.0, 6.0)
    assert samples[1].accel == (0.0, 9.80665, 0.0)
    assert samples[1].mag is None


def test_the_recording_keeps_the_contract(run_import: Import, tmp_path: Path, conform: ModuleType) -> None:
    source, output = written(tmp_path / "a.csv", *(f"{k / 100},1,2,3,0,0,1" for k in range(500))), tmp_path / "a.mcap"
    run_import(source, "-o", output, "--columns", COLUMNS_TOLD)
    faults, counts = conform.faults(str(output))
    assert faults == {}
    assert counts == {"cane/imu/imu": 500}


@pytest.fixture
def conform(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The contract's own check, where it is there."""
    if not (CHECKS / "conform.py").exists():
        pytest.skip("the check of the wire contract, shared/checks/conform.py, is not here")
    monkeypatch.syspath_prepend(str(CHECKS))
    spec = importlib.util.spec_from_file_location("conform", CHECKS / "conform.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.delitem(sys.modules, "wire_reader", raising=False)
    return module


def test_more_than_one_percent_lost_is_status_1(run_import: Import, tmp_path: Path) -> None:
    lines = rest([f"{k / 100:.2f}" for k in range(200)])
    for bad, expected in ((2, 0), (3, 1)):
        source = written(tmp_path / f"{bad}.csv", *lines, *["7,x"] * bad)
        status, said = run_import(source, "-o", tmp_path / f"{bad}.mcap", "--columns", COLUMNS_TOLD)
        assert status == expected
        assert said.splitlines()[-1].endswith(
            f"{bad} rows left out: {bad} with a cell that is not a number (first in line 202) of {200 + bad}"
        )


def test_a_dry_run_says_what_it_takes_for_what_and_writes_nothing(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", *(f"{10 * k},0,0,0,0,0,1" for k in range(50)))
    status, said = run_import(source, "--dry-run", "--columns", COLUMNS_TOLD)
    assert status == 0
    assert "accel: column 5 'accel_x', column 6 'accel_y', column 7 'accel_z'; g, median magnitude 1" in said
    assert "time: taken as ms (readings are 10 apart); --units time=ms confirms it" in said
    assert "  0.010000  gyro 0 0 0, accel 0 0 9.807" in said
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
    with pytest.raises(CaneflowError, match="no output; expected -o REC, or --dry-run"):
        run_import(source, "--columns", COLUMNS_TOLD)


def test_times_that_cannot_be_told_apart_are_status_1_and_no_recording(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", *rest(["12:00:00"] * 50))
    status, said = run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD)
    assert status == 1
    assert "too coarse" in said
    assert not (tmp_path / "a.mcap").exists()


def test_a_file_per_sensor(run_import: Import, tmp_path: Path) -> None:
    for name, z in (("Gyroscope", "0"), ("Accelerometer", "9.8")):
        rows = "".join(f"{k / 100:.2f};{k % 3};0;{z}\n".replace(".", ",") for k in range(100))
        (tmp_path / f"{name}.csv").write_text("Time (s);X;Y;Z\n" + rows, encoding="utf-16")
    columns = "time=Time,gyro_x=X,gyro_y=Y,gyro_z=Z,accel_x=X,accel_y=Y,accel_z=Z"
    files = [tmp_path / "Accelerometer.csv", tmp_path / "Gyroscope.csv"]
    status, said = run_import(*files, "-o", tmp_path / "a.mcap", "--columns", columns)
    assert status == 0
    assert "accel: 100 of 100 interpolated" in said
    with Recording(tmp_path / "a.mcap") as recording:
        samples = [decode(sample.payload, Imu) for sample in recording.samples([("imu", "imu")])]
    assert len(samples) == 100
    assert samples[4].gyro == (1.0, 0.0, 0.0)
    assert samples[4].accel == pytest.approx((1.0, 0.0, 9.8))


def test_a_table_without_a_usable_row_makes_no_recording(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", "1,2", "x,1,2,3,4,5,6")
    with pytest.raises(CaneflowError, match=r"no row that can be used; 2 rows left out: 1 with too few cells"):
        run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD)
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--key", "imu", "expected flow/node/port"),
        ("--key", "Cane/imu/imu", "expected flow/node/port"),
        ("--delimiter", ";;", "expected one character, tab or space"),
        ("--columns", "t", "expected name=value"),
        ("--units", "gyro=furlong", "a.csv: gyro: no unit 'furlong'"),
    ],
)
def test_a_wrong_option_is_one_line(run_import: Import, tmp_path: Path, option: str, value: str, message: str) -> None:
    source = written(tmp_path / "a.csv", "1,0,0,0,0,0,1")
    with pytest.raises(CaneflowError, match=message):
        run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD, option, value)


def test_the_table_is_not_overwritten_by_its_recording(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", "1,0,0,0,0,0,1")
    with pytest.raises(CaneflowError, match="is an input of this command"):
        run_import(source, "-o", source, "--columns", COLUMNS_TOLD)
    assert source.read_text(encoding="utf-8-sig").startswith(HEADER)


def test_other_delimiters(run_import: Import, tmp_path: Path) -> None:
    source = tmp_path / "a.txt"
    source.write_text(HEADER.replace(",", "\t") + "\n" + "0\t1\t2\t3\t0\t0\t1\n")
    _, said = run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD, "--delimiter", "tab")
    assert "1 samples, no rate; no row left out" in said
