"""A stream as columns: every number of every sample, and NaN where there is none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.messages import Imu, Pose, RadarFrame, Sample, numbered
from caneflow.recording import Recording, RecordingError, RecordingWriter
from caneflow.recording.columns import flat, structured


def frame(stamp: int, scans: int, bins: int) -> RadarFrame:
    return RadarFrame(
        stamp=stamp,
        scans=np.full((scans, bins), stamp, dtype=np.int16),
        scan_period=0.01,
        range_start=0.0,
        range_step=0.01,
        carrier=4e9,
        bandwidth=1e9,
    )


def test_a_row_holds_what_its_sample_holds_and_nan_for_what_it_lacks() -> None:
    rows = structured(
        [
            Imu(stamp=10, seq=0, gyro=(1.0, 2.0, 3.0), accel=(0.0, 0.0, 9.8), calibration=(0, 1, 2, 3)),
            Imu(stamp=20, seq=1, gyro=(4.0, 5.0, 6.0)),
        ]
    )
    assert rows.dtype.names == ("stamp", "seq", "gyro", "accel", "calibration")  # the rest is in none of them
    assert rows["stamp"].tolist() == [10, 20]
    assert rows["gyro"].tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert rows["accel"][0].tolist() == [0.0, 0.0, 9.8]
    assert np.isnan(rows["accel"][1]).all()
    assert rows["calibration"][0].tolist() == [0, 1, 2, 3]
    assert np.isnan(rows["calibration"][1]).all()


def test_words_and_covariances_are_columns_too() -> None:
    still: dict[str, Any] = {"position": (0.0,) * 3, "velocity": (0.0,) * 3, "orientation": (1.0, 0.0, 0.0, 0.0)}
    rows = structured(
        [
            Pose(stamp=1, method="best", covariance=np.eye(6), status="held:gyro", **still),
            Pose(stamp=2, method="best", **still),
        ]
    )
    assert rows["status"].tolist() == ["held:gyro", ""]
    assert (rows["covariance"][0] == np.eye(6)).all()
    assert np.isnan(rows["covariance"][1]).all()


def test_frames_of_one_scan_are_scans_by_bins_and_of_several_keep_both() -> None:
    one = structured([frame(stamp, 1, 5) for stamp in (1, 2, 3)])["scans"]
    assert one.shape == (3, 5)
    assert one.dtype == np.int16
    assert one[:, 0].tolist() == [1, 2, 3]
    assert structured([frame(stamp, 4, 5) for stamp in (1, 2)])["scans"].shape == (2, 4, 5)


def test_arrays_that_change_their_shape_are_no_column() -> None:
    with pytest.raises(ValueError, match=r"scans has the shapes \(1, 5\), \(1, 6\)"):
        structured([frame(1, 1, 5), frame(2, 1, 6)])


def test_a_table_has_a_column_per_element_and_no_arrays() -> None:
    assert list(flat(structured([frame(1, 1, 8)]))) == [
        "stamp", "seq", "scan_period", "range_start", "range_step", "carrier", "bandwidth",
    ]  # fmt: skip
    table = flat(structured([Imu(stamp=10, seq=0, gyro=(1.0, 2.0, 3.0))]))
    assert {name: column.tolist() for name, column in table.items()} == {
        "stamp": [10], "seq": [0], "gyro_0": [1.0], "gyro_1": [2.0], "gyro_2": [3.0],
    }  # fmt: skip


def recorded(path: Path, samples: list[Sample]) -> Path:
    kind = type(samples[0])
    with RecordingWriter(path, flow="f", source="live", rig={}) as writer:
        for seq, sample in enumerate(samples):
            payload = numbered(sample, seq)
            writer.write("f/a/b", kind, payload, stamp=sample.stamp, seq=seq, log_time=sample.stamp)
    return path


def test_a_recording_gives_a_stream_or_a_part_of_it(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mcap", [Imu(stamp=stamp, gyro=(0.0, 0.0, float(stamp))) for stamp in range(5)])
    with Recording(path) as recording:
        assert recording.array("a/b")["gyro"][:, 2].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
        assert recording.array(("a", "b"), start_ns=1, end_ns=3)["seq"].tolist() == [1, 2]
        with pytest.raises(RecordingError, match="no stream a/c; there are a/b"):
            recording.array("a/c")


def test_a_frame_is_that_of_a_library_that_is_there_or_the_line_that_installs_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Frames:
        """As polars and pandas: a DataFrame is made of named columns."""

        DataFrame = dict

    path = recorded(tmp_path / "a.mcap", [Imu(stamp=7, gyro=(1.0, 2.0, 3.0))])
    with Recording(path) as recording:
        monkeypatch.setattr("caneflow.recording.reader.find_spec", lambda name: None)
        with pytest.raises(RecordingError, match=r"pip install 'caneflow\[parquet\]'"):
            recording.frame("a/b")
        monkeypatch.setattr("caneflow.recording.reader.find_spec", lambda name: name == "pandas" or None)
        monkeypatch.setattr("caneflow.recording.reader.import_module", lambda name: Frames)
        assert list(recording.frame("a/b")) == ["stamp", "seq", "gyro_0", "gyro_1", "gyro_2"]
