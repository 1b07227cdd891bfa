"""Tables of IMUs as phones and loggers lay them out: titles, files, dates and units, read for what they are."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, decode
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv import ImuTable, Joined, shared_out
from caneflow.protocols.imu_csv.units import judged_linear
from caneflow.recording import Recording
from tools.import_imu_csv import imu_csv

COUNT, RATE = 100, 100.0
TIME = np.arange(COUNT) / RATE  # s
GYRO = np.stack([0.5 * np.sin(6.0 * TIME), 0.3 * np.cos(6.0 * TIME), 0.2 + 0.0 * TIME], axis=1)  # rad/s
LINEAR = np.stack([2.0 * np.sin(9.0 * TIME), np.cos(9.0 * TIME), 0.5 * np.sin(8.0 * TIME)], axis=1)  # m/s^2
ACCEL = LINEAR + np.stack([2.0 * np.sin(TIME), 0.0 * TIME, 9.8 * np.cos(0.2 * TIME)], axis=1)


def told(vector: str, titles: Sequence[str]) -> dict[str, str]:
    return {f"{vector}_{axis}": title for axis, title in zip("xyz", titles, strict=True)}


def lines(header: str, times: Sequence[object], *vectors: np.ndarray, separator: str = ",") -> list[str]:
    rows = np.hstack(vectors)
    return [
        header,
        *(separator.join([str(t), *(f"{v:.6f}" for v in row)]) for t, row in zip(times, rows, strict=True)),
    ]


def gyro_stamps(header: str, times: Sequence[object], time: str, **options: object) -> tuple[list[int], np.ndarray]:
    columns = {"time": time, **told("gyro", ["gx", "gy", "gz"])}
    table = ImuTable(lines(header, times, GYRO), columns=columns, units={}, **options)  # type: ignore[arg-type]
    found = list(Joined([table]).readings())
    return [reading.stamp for reading in found], np.array([reading.gyro for reading in found])


def run(arguments: Sequence[str]) -> tuple[int, str]:
    """Exit status of `caneflow import imu-csv`, and what it says, or its one line of error."""
    app = typer.Typer()
    app.command()(imu_csv)
    result = CliRunner().invoke(app, list(arguments))
    if isinstance(result.exception, CaneflowError):
        return 2, str(result.exception)
    return result.exit_code, result.output


EVERY_10_MS = [10_000_000 * i for i in range(COUNT)]


@pytest.mark.parametrize(
    "pattern",
    [
        "2024-05-31 18-08-{s:02d}_{ms:03d}",  # AndroSensor
        "2024-05-31T18.08.{s:02d}.{ms:03d}",  # MetaBase
        "2024-05-31_18-08-{s:02d}_{us:06d}",
        "31-May-2024 18:08:{s:02d}.{ms:03d}",  # MATLAB Mobile
        "31.05.2024 18:08:{s:02d},{us:06d}",
        "2024-05-31 18:08:{s:02d}.{ms:03d} +0200",  # SensorLog
        "20240531 1808{s:02d}.{ms:03d}",
        "18-08-{s:02d}_{us:06d}",
        "Fri May 31 2024 18:08:{s:02d}.{ms:03d} PM",
    ],
)
def test_dates_and_clocks_as_loggers_write_them(pattern: str) -> None:
    times = [pattern.format(s=37 + i // 100, ms=10 * (i % 100), us=10_000 * (i % 100)) for i in range(COUNT)]
    quoted = [f'"{time}"' for time in times]
    stamps, gyro = gyro_stamps("t,gx,gy,gz", quoted, "t")
    assert stamps == EVERY_10_MS
    np.testing.assert_allclose(gyro, GYRO, atol=1e-6)


@pytest.mark.parametrize(("title", "mark"), [("%time", "%time"), ("#timestamp [ns]", "#timestamp"), ("# t", "# t")])
def test_a_title_behind_a_mark_of_comments_is_found_as_it_is_written(title: str, mark: str) -> None:
    times = [1_717_171_717_000_000_000 + 10_000_000 * i for i in range(COUNT)]
    assert gyro_stamps(f"{title},gx,gy,gz", times, mark)[0] == EVERY_10_MS
    assert gyro_stamps(f"{title},gx,gy,gz", times, mark.lstrip("#% "))[0] == EVERY_10_MS


def test_the_first_column_of_a_data_frame_has_no_title() -> None:
    """Pandas writes its index under an empty title: the others are not one further left."""
    rows = [f"{i},{0.01 * i:.2f},{','.join(f'{v:.6f}' for v in rates)}" for i, rates in enumerate(GYRO)]
    columns = {"time": "t", **told("gyro", ["gx", "gy", "gz"])}
    found = list(Joined([ImuTable([",t,gx,gy,gz", *rows], columns=columns, units={})]).readings())
    assert [reading.stamp for reading in found] == EVERY_10_MS
    np.testing.assert_allclose([reading.gyro for reading in found], GYRO, atol=1e-6)


@pytest.mark.parametrize("separator", [",", "\t", " ", ";"])
def test_a_serial_monitors_time_before_each_line_is_a_column(separator: str) -> None:
    rows = [
        f"18:08:{37 + t:06.3f} -> " + separator.join(f"{v:.6f}" for v in r) for t, r in zip(TIME, GYRO, strict=True)
    ]
    table = ImuTable(rows, columns={"time": "1", **told("gyro", "234")}, units={})
    found = list(Joined([table]).readings())
    assert [reading.stamp for reading in found] == EVERY_10_MS
    np.testing.assert_allclose([reading.gyro for reading in found], GYRO, atol=1e-6)


def test_capital_letters_count_only_where_titles_differ_in_nothing_else() -> None:
    columns = {"time": "t", **told("gyro", ["gx", "gy", "gz"])}
    table = ImuTable(lines("T,GX,GY,GZ", TIME.tolist(), GYRO), columns=columns, units={})
    assert table.layout.vectors["gyro"] == (1, 2, 3)
    table = ImuTable(lines("t,GX,gx,gy,gz,x", TIME.tolist(), GYRO, GYRO[:, :2]), columns=columns, units={})
    assert table.layout.vectors["gyro"] == (2, 3, 4)


@pytest.mark.parametrize(("tick", "hertz"), [(1e-4, 100.0), (1e-4, 40.0), (1e-6, 60.0), (1e-6, 120.0)])
def test_the_time_of_an_xsens_is_of_the_unit_that_makes_a_rate_of_it(tick: float, hertz: float) -> None:
    """An MTw or MTi counts 100 us under the title under which a DOT counts 1 us."""
    times = [1_234_567 + round(i / hertz / tick) for i in range(COUNT)]
    stamps = gyro_stamps("SampleTimeFine,gx,gy,gz", times, "SampleTimeFine")[0]
    assert stamps[-1] == pytest.approx(1e9 * (COUNT - 1) / hertz, abs=1e9 * tick)


@pytest.mark.parametrize("epoch", ["{:.4f}", "{:.9E}", "{:.6f}"])
@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_an_epoch_is_one_in_any_unit_and_notation(epoch: str, unit: float) -> None:
    begin = 1_717_171_717.0 if "E" not in epoch else 0.0  # ten digits do not hold one
    times = [epoch.format((begin + t) * unit) for t in TIME]
    stamps, _ = gyro_stamps("timestamp,gx,gy,gz", times, "timestamp")
    np.testing.assert_allclose(stamps, EVERY_10_MS, atol=1.1e5)  # ns: a double holds 0.24 us of such an epoch in s


@pytest.mark.parametrize(("accel_unit", "scale"), [("g", 9.80665), ("mg", 9.80665e-3), ("m/s^2", 1.0)])
@pytest.mark.parametrize(("unit", "linear_scale"), [("g", 9.80665), ("mg", 9.80665e-3), ("m/s^2", 1.0)])
def test_linear_acceleration_is_in_the_unit_in_which_the_rest_is_gravity(
    accel_unit: str, scale: float, unit: str, linear_scale: float
) -> None:
    found = judged_linear(LINEAR / linear_scale, ACCEL / scale, accel_unit=accel_unit, told=None, stated=None)
    assert (found.unit, found.doubt) == (unit, "")


def test_linear_acceleration_that_says_nothing_is_doubtful_beside_g() -> None:
    noise = np.random.default_rng(1).normal(0.0, 1e-4, LINEAR.shape)
    found = judged_linear(noise, ACCEL / 9.80665, accel_unit="g", told=None, stated=None)
    assert found.unit == "g"
    assert "--units linear_accel=UNIT settles it" in found.doubt
    assert judged_linear(noise, ACCEL, accel_unit="m/s^2", told=None, stated=None).doubt == ""
    assert judged_linear(noise, None, accel_unit=None, told=None, stated=None).unit == "m/s^2"


def test_a_file_may_be_named_with_its_ending_or_its_folder() -> None:
    files = ["Gyroscope", "TotalAcceleration"]
    for name in ("TotalAcceleration", "TotalAcceleration.csv", "walk/TotalAcceleration.csv"):
        columns = {"time": "t", **told("gyro", "xyz"), **told("accel", [f"{name}:{axis}" for axis in "xyz"])}
        first, second = shared_out(columns, files)
        assert first == {"time": "t", **told("gyro", "xyz")}
        assert second == {"time": "t", **told("accel", "xyz")}, "x is not the gyro's there"
    assert shared_out({"gyro_x": "Gyroscope.csv:x"}, ["Gyroscope"]) == [{"gyro_x": "x"}]
    assert shared_out({"gyro_x": "acc:x"}, ["Gyroscope"]) == [{"gyro_x": "acc:x"}], "a title with a colon"


def test_the_file_that_is_left_has_the_columns_of_the_same_name() -> None:
    columns = {**told("gyro", "xyz"), **told("accel", ["b.csv:x", "b.csv:y", "b.csv:z"])}
    assert shared_out(columns, ["a", "b"]) == [told("gyro", "xyz"), told("accel", "xyz")]
    with pytest.raises(ProtocolError, match="told for another vector too"):
        shared_out(columns, ["a", "b", "c"])


def test_a_phone_with_a_file_per_sensor_is_one_recording(tmp_path: Path) -> None:
    """Sensor Logger: the same titles in each file, z y x, an epoch in ns; no vector gets lost without a word."""
    stamps = [1_717_171_717_000_000_000 + 10_000_000 * i for i in range(COUNT)]
    for name, values in (("Gyroscope", GYRO), ("TotalAcceleration", ACCEL), ("Accelerometer", LINEAR)):
        text = "\n".join(lines("time,z,y,x", stamps, values[:, ::-1])) + "\n"
        (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
    paths = [str(tmp_path / f"{name}.csv") for name in ("Gyroscope", "TotalAcceleration", "Accelerometer")]
    columns = {"time": "time", **told("gyro", "xyz")}
    columns |= told("accel", [f"TotalAcceleration.csv:{axis}" for axis in "xyz"])
    columns |= told("linear_accel", [f"Accelerometer.csv:{axis}" for axis in "xyz"])
    output = tmp_path / "phone.mcap"
    command = [*paths, "-o", str(output), "--columns", ",".join(f"{k}={v}" for k, v in columns.items())]
    assert run(command)[0] == 0
    with Recording(output) as recording:
        samples = [decode(sample.payload, Imu) for sample in recording.samples()]
    for name, expected in (("gyro", GYRO), ("accel", ACCEL), ("linear_accel", LINEAR)):
        np.testing.assert_allclose([getattr(sample, name) for sample in samples], expected, atol=1e-5)
    status, said = run([*paths[:2], *command[3:], "--overwrite"])
    assert status == 2
    assert len(samples) == COUNT
    assert "linear_accel" in said
