"""Radars' point clouds in bags: the sign of Doppler, frames, what is told of the bins, and clouds without Doppler."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow import command
from caneflow.algorithms.radar.doppler_bins import doppler_bins
from caneflow.messages import RadarPoints
from caneflow.recording import Recording

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install caneflow[rosbag2]")

from caneflow.bridges.point_clouds import Bins, cloud_of, has_doppler
from caneflow.bridges.ros_types import RosTypes

KIND = "sensor_msgs/msg/PointCloud2"
START = 1_700_000_000_000_000_000  # ns
ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("snr_db", "<f4"), ("v_doppler_mps", "<f4"), ("pad", "<f4")])
BINS = Bins(0.02, 0.125, 2.0)
Run = tuple[int, str, str]


@pytest.fixture(scope="module")
def types() -> RosTypes:
    return RosTypes("jazzy")


def cloud(
    types: RosTypes, stamp: int, rows: np.ndarray, names: tuple[str, ...] = ROW.names or (), **changed: Any
) -> Any:
    field, header, time = (
        types["sensor_msgs/msg/PointField"],
        types["std_msgs/msg/Header"],
        types["builtin_interfaces/msg/Time"],
    )
    dtype = rows.dtype
    assert dtype.fields is not None
    fields = [field(name=name, offset=dtype.fields[name][1], datatype=7, count=1) for name in names if name != "pad"]
    whole = {
        "header": header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="radar"),
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "is_bigendian": False,
        "point_step": dtype.itemsize,
        "row_step": dtype.itemsize * len(rows),
        "data": np.frombuffer(rows.tobytes(), np.uint8),
        "is_dense": True,
    }
    return types[KIND](**{**whole, **changed})


def rows_of(count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    for axis in "xyz":
        rows[axis] = random.uniform(-4, 4, count)
    rows["snr_db"] = random.uniform(5, 30, count)
    rows["v_doppler_mps"] = 0.125 * random.integers(-10, 11, count)
    return rows


def test_what_recedes_in_ros_is_negative_here(types: RosTypes) -> None:
    rows = rows_of(7, 1)
    rows["x"][3] = np.nan
    found = cloud_of(cloud(types, START, rows), START, BINS)
    kept = np.arange(7) != 3
    assert np.array_equal(found.doppler, -rows["v_doppler_mps"][kept])
    assert np.array_equal(found.position[:, 1], rows["y"][kept])
    assert found.snr is not None and np.array_equal(found.snr, rows["snr_db"][kept])
    assert found.noise is None
    other = cloud_of(cloud(types, START, rows), START, BINS, approaching=True)
    assert np.array_equal(other.doppler, -found.doppler)
    assert len(cloud_of(cloud(types, START, rows[:0]), START, BINS).doppler) == 0


def test_clouds_of_other_layouts(types: RosTypes) -> None:
    """Big-endian, several rows with a gap behind each, and what does not add up."""
    rows = rows_of(6, 2)
    big = rows.astype(ROW.newbyteorder(">"))
    turned = cloud_of(cloud(types, START, big, is_bigendian=True), START, BINS)
    assert np.array_equal(turned.position[:, 0], rows["x"])
    padded = b"".join(rows[first : first + 3].tobytes() + bytes(5) for first in (0, 3))
    layout: dict[str, Any] = {
        "height": 2,
        "width": 3,
        "row_step": 3 * ROW.itemsize + 5,
        "data": np.frombuffer(padded, np.uint8),
    }
    gapped = cloud_of(cloud(types, START, rows, **layout), START, BINS)
    assert np.array_equal(gapped.position[:, 2], rows["z"])
    wrongs: list[dict[str, Any]] = [{"width": 7}, {"point_step": 4}, {"row_step": 1}]
    for wrong in wrongs:
        with pytest.raises(ValueError, match="do not fit"):
            cloud_of(cloud(types, START, rows, **wrong), START, BINS)
    assert not has_doppler(cloud(types, START, rows, ("x", "y", "z", "snr_db")))


def test_bins_are_told_by_the_values() -> None:
    values = 0.0973 * np.array([0, 1, -3, 7, 12, -2]) + 1e-7
    bins = doppler_bins(values)
    assert bins is not None
    assert bins == pytest.approx((0.0973, 0.0973 * 16), rel=1e-4)
    assert doppler_bins(np.zeros(4)) is None


def test_a_bag_brings_its_radar_in(
    types: RosTypes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    given = [rows_of(20, seed) for seed in range(6)]
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        radar = writer.add_connection("/radar/points", KIND, typestore=types.store)
        lidar = writer.add_connection("/lidar/points", KIND, typestore=types.store)
        for number, rows in enumerate(given):
            stamp = START + 100_000_000 * number
            writer.write(radar, stamp + 5, types.encoded(KIND, cloud(types, stamp, rows)))
            writer.write(lidar, stamp + 6, types.encoded(KIND, cloud(types, stamp, rows, ("x", "y", "z"))))

    def run(*words: str) -> Run:
        monkeypatch.setattr(sys, "argv", ["caneflow", "import", "rosbag", str(tmp_path / "bag"), *words])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    status, out, _ = run("-o", str(tmp_path / "x.mcap"))
    assert status == 0
    assert "6 frames of a radar's points, Doppler steps of 0.125 to 2.00 m/s, told from the points" in out
    assert "not used: /lidar/points, 6 of sensor_msgs/msg/PointCloud2" in out
    with Recording(tmp_path / "x.mcap") as recording:
        found = [each.decoded() for each in recording.samples()]
    assert [each.stamp for each in found] == [START + 100_000_000 * number for number in range(6)]
    for sample, rows in zip(found, given, strict=True):
        assert isinstance(sample, RadarPoints)
        assert np.array_equal(sample.doppler, -rows["v_doppler_mps"])
    status, _, err = run("-o", str(tmp_path / "y.mcap"), "--points", "/lidar/points")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "--points /lidar/points: has no field of Doppler" in err
