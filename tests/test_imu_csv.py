"""Tables of IMU readings: units, columns by name, rows that are left out, and the recording made of them."""

import importlib.util
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, decode
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv import COLUMNS, UNITS, ImuTable, Reading, assignments
from caneflow.recording import Recording
from tools.import_imu_csv import MOST, imu_csv

CHECKS = Path(__file__).parents[1].parent / "shared" / "checks"
NAMES = {"time": "t", **{name: name for name in COLUMNS[1:7]}}
HEADER = "t,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"

Import = Callable[..., str]


def table(
    *rows: str, units: dict[str, str] | None = None, header: str = HEADER, most: dict[str, float] | None = None
) -> ImuTable:
    return ImuTable([header, *rows], columns=NAMES, units=units or {}, most=most)


def test_a_row_becomes_a_reading_in_si_units() -> None:
    units = {"time": "ms", "gyro": "deg/s", "accel": "g"}
    rows = table("1000,180,0,-90,0,0,1", "1002.5,0,0,0,1,0,0", units=units)
    first, second = rows.readings()
    assert first == Reading(0, (math.pi, 0.0, -0.5 * math.pi), (0.0, 0.0, 9.80665), None)
    assert second.stamp == 2_500_000
    assert str(rows.refusals) == "no row refused"


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


def test_columns_are_found_by_name_or_by_a_beginning_that_no_other_has() -> None:
    header = "Time (s),Gyro X (deg/s),Gyro Y (deg/s),Gyro Z (deg/s),Time"
    columns = {"time": "Time", "gyro_x": "Gyro X", "gyro_y": "Gyro Y", "gyro_z": "Gyro Z"}
    (reading,) = ImuTable([header, "9,1,2,3,4"], columns=columns, units={}).readings()
    assert reading == Reading(0, (1.0, 2.0, 3.0), None, None)
    with pytest.raises(ProtocolError, match="gyro_x: 3 columns of the name 'Gyro'; there are 'Time \\(s\\)'"):
        ImuTable([header], columns={**columns, "gyro_x": "Gyro"}, units={})
    with pytest.raises(ProtocolError, match="gyro_y: no column of the name 'gyro y'"):
        ImuTable([header], columns={**columns, "gyro_y": "gyro y"}, units={})


def test_a_time_of_many_digits_keeps_its_nanoseconds() -> None:
    readings = table("1700000000.123456789,0,0,0,0,0,1", "1700000000.123456790,0,0,0,0,0,1").readings()
    assert [reading.stamp for reading in readings] == [0, 1]


@pytest.mark.parametrize(
    ("row", "cause"),
    [
        ("0.5,1,2,3,4,5,6", "not later than the row before"),
        ("1,1,2,3,4,5,6", "not later than the row before"),
        ("2,1,2,3,4,5", "with too few cells"),
        ("2", "with too few cells"),
        ("2,1,2,3,4,5,x", "with a cell that is no number"),
        ("2,1,2,3,4,5,", "with a cell that is no number"),
        ("later,1,2,3,4,5,6", "with a cell that is no number"),
        ("2,1,2,nan,4,5,6", "with a number that is not finite"),
        ("2,1,2,3,4,1e308,6", "with a number that is not finite"),
        ("inf,1,2,3,4,5,6", "with a time that is no time"),
        ("1e25,1,2,3,4,5,6", "with a time that is no time"),
        ("1e99999999,1,2,3,4,5,6", "with a time that is no time"),
        ('2,"1,2,3,4,5,6', "with a cell that is no number"),
    ],
)
def test_a_bad_row_is_left_out_counted_and_named(row: str, cause: str) -> None:
    rows = table("1,0,0,0,0,0,1", row, "", "3,0,0,0,0,0,1", units={"accel": "g"})
    assert [reading.stamp for reading in rows.readings()] == [0, 2_000_000_000]
    assert str(rows.refusals) == f"1 row refused: 1 {cause} (first in line 3)"


@pytest.mark.parametrize(
    ("columns", "units", "message"),
    [
        ({"time": "t"}, {}, "no column is told for gyro_x, gyro_y, gyro_z"),
        ({**NAMES, "gyro_w": "t"}, {}, "'gyro_w' is no column; there are time, gyro_x"),
        ({k: v for k, v in NAMES.items() if k != "accel_y"}, {}, "no column is told for accel_y"),
        ({k: v for k, v in NAMES.items() if k != "time"}, {}, "no column is told for time"),
        (NAMES, {"gyro": "rpm"}, "gyro: no unit 'rpm'; there are rad/s, deg/s"),
        (NAMES, {"speed": "m/s"}, "'speed' is no quantity"),
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


def test_a_row_that_no_sensor_can_say_is_counted() -> None:
    """Beyond the bounds that a sample has, in the table's units: 5000 g and 10^8 deg/s."""
    units = {"gyro": "deg/s", "accel": "g"}
    rows = table(
        "0,0,0,0,0,0,1", "0.01,0,1e8,0,0,0,1", "0.02,0,0,0,0,0,-5000", "0.03,0,0,0,1,0,0", units=units, most=MOST
    )
    assert [reading.stamp for reading in rows.readings()] == [0, 30_000_000]
    assert str(rows.refusals) == (
        "2 rows refused: 1 with gyro beyond 1e+06 rad/s (first in line 3), "
        "1 with accel beyond 4000 m/s^2 (first in line 4)"
    )


cells = st.one_of(st.floats().map(repr), st.text(max_size=5), st.integers(-(10**6), 10**6).map(str))


@given(lines=st.lists(st.lists(cells, max_size=9).map(",".join), max_size=30))
@settings(deadline=None)
def test_whatever_the_rows_are_each_is_a_sound_reading_or_counted(lines: list[str]) -> None:
    rows = table(*lines, most=MOST)
    readings = list(rows.readings())
    stamps = [reading.stamp for reading in readings]
    assert stamps == sorted(set(stamps))
    assert not stamps or stamps[0] == 0
    for reading in readings:
        Imu(stamp=reading.stamp, gyro=reading.gyro, accel=reading.accel)  # checks itself
    assert len(readings) + rows.refusals.counts.total() == sum(1 for line in lines if line.strip())


@pytest.fixture
def run_import() -> Import:
    """What `caneflow import imu-csv` says; its error is raised."""

    def run(*arguments: object) -> str:
        app = typer.Typer()
        app.command()(imu_csv)
        result = CliRunner().invoke(app, list(map(str, arguments)))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.output

    return run


def written(path: Path, *rows: str) -> Path:
    path.write_text("\ufeff" + "\r\n".join([HEADER, *rows]) + "\r\n", encoding="utf-8")
    return path


COLUMNS_TOLD = ",".join(f"{name}={column}" for name, column in NAMES.items())


def test_the_recording_has_the_tables_readings(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", "10,1,2,3,0,0,1", "10,1,2,3,0,0,1", "10.01,4,5,6,0,1,0", "10.02,0,0,0,0,0,1")
    output = tmp_path / "a.mcap"
    said = run_import(source, "-o", output, "--columns", COLUMNS_TOLD, "--units", "accel=g", "--key", "foot/left/imu")
    assert said == (
        f"{output}: 3 samples, 100.00 Hz, 0.0 s; 1 row refused: 1 not later than the row before (first in line 3)\n"
    )
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


def test_a_table_without_a_usable_row_makes_no_recording(run_import: Import, tmp_path: Path) -> None:
    source = written(tmp_path / "a.csv", "1,2", "x,1,2,3,4,5,6")
    with pytest.raises(CaneflowError, match=r"no row that can be used; 2 rows refused: 1 with too few cells"):
        run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD)
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--key", "imu", "expected flow/node/port"),
        ("--key", "Cane/imu/imu", "expected flow/node/port"),
        ("--delimiter", ";;", "expected one character, or tab"),
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
    said = run_import(source, "-o", tmp_path / "a.mcap", "--columns", COLUMNS_TOLD, "--delimiter", "tab")
    assert "1 samples, no rate; no row refused" in said
