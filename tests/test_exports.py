"""What `caneflow export` writes for Foxglove and ROS 2, opened by the libraries of those."""

import csv
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow import command
from caneflow.bridges.radar_images import SCANS, RadarImages
from caneflow.messages import DopplerTarget, Grid, GroundSpeed, Imu, Pose, RadarFrame, Sample, numbered
from caneflow.recording import RecordingWriter

START = 1_700_000_000_000_000_000  # ns
TURN = (0.5, 0.5, -0.5, 0.5)  # w x y z

Run = tuple[int, str, str]  # exit status, standard output, standard error


@pytest.fixture
def caneflow(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Run]:
    """The command, run in this process."""

    def run(*arguments: object) -> Run:
        monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            command.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    return run


def radar_frame(stamp: int, *, speed: float, bins: int = 40) -> RadarFrame:
    """A target in bin 10 that comes nearer at `speed` m/s, and nothing else."""
    scans = np.zeros((1, bins), dtype=np.complex64)
    carrier = 4.3e9
    scans[0, 10] = np.exp(2j * math.pi * 2 * speed * carrier / 299_792_458 * (stamp - START) * 1e-9)
    return RadarFrame(
        stamp=stamp,
        scans=scans,
        scan_period=0.01,
        range_start=0.3,
        range_step=0.05,
        carrier=carrier,
        bandwidth=1.7e9,
    )


def samples() -> Iterator[tuple[str, Sample, int]]:
    """1 s at 100 Hz: an IMU without a chip's orientation in every second sample, a radar, speeds, poses."""
    for seq in range(100):
        stamp = START + seq * 10_000_000
        whole = seq % 2 == 0
        yield (
            "imu/imu",
            Imu(
                stamp=stamp,
                gyro=(0.25, 0.0, -1.0),
                accel=(0.0, 0.0, 9.75) if whole else None,
                mag=(20.0, 0.0, -40.0),
                orientation=TURN if whole else None,
            ),
            seq,
        )
        yield "radar/frame", radar_frame(stamp, speed=1.0), seq
        valid = seq >= 10
        quality = 0.1 if valid else math.inf
        yield "ground_speed/speed", GroundSpeed(stamp=stamp, speed=0.5, quality=quality, rays=3, valid=valid), seq
        position = (0.01 * seq, -2.0, 0.5)
        spread = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
        pose = Pose(
            stamp=stamp, position=position, velocity=(0, 0, 0), orientation=TURN, method="best", covariance=spread
        )
        yield "fusion/pose", pose, seq
        target = DopplerTarget(stamp=stamp, range_rate=0.25, signed=True, amplitude=0.1, snr=20.0, valid=True)
        yield "doppler/target", target, seq


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        for stream, sample, seq in samples():
            received = sample.stamp + 5
            payload = numbered(sample, seq)
            writer.write(f"cane/{stream}", type(sample), payload, stamp=sample.stamp, seq=seq, log_time=received)
    return path


def test_a_map_shows_a_target_at_its_range_and_speed() -> None:
    images = RadarImages()
    made = [images.take(radar_frame(START + seq * 10_000_000, speed=1.0)) for seq in range(2 * SCANS)]
    image = [each for each in made if each is not None][-1]
    assert sum(each is not None for each in made) == math.ceil((SCANS + 1) / 10), "ten a second"
    row, column = np.unravel_index(image.grey.argmax(), image.grey.shape)
    assert column == 10
    # Rows count down from the fastest approach; half of them lie below 0 m/s.
    speed_per_row = 2 * image.fastest / SCANS
    assert (SCANS / 2 - 1 - row) * speed_per_row == pytest.approx(1.0, abs=speed_per_row)
    assert image.fastest == pytest.approx(299_792_458 / (4 * 4.3e9 * 0.01))
    assert image.grey.max() > 250


TOPICS = {  # of ROS messages, with how many there are of each
    "/imu/imu": ("sensor_msgs/msg/Imu", 100),
    "/imu/imu/mag": ("sensor_msgs/msg/MagneticField", 100),
    "/radar/frame": ("sensor_msgs/msg/Image", 4),
    "/ground_speed/speed/twist": ("geometry_msgs/msg/TwistWithCovarianceStamped", 90),
    "/fusion/pose": ("geometry_msgs/msg/PoseStamped", 100),
    "/fusion/pose/odom": ("nav_msgs/msg/Odometry", 100),
    "/fusion/pose/with_covariance": ("geometry_msgs/msg/PoseWithCovarianceStamped", 100),
    "/tf": ("tf2_msgs/msg/TFMessage", 100),
    "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
}

Found = dict[str, list[tuple[int, Any]]]  # by topic: log time (ns) and message


def bag_of(path: Path) -> Found:
    """The messages of a bag, by rosbags."""
    highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed: caneflow[rosbag2]")
    found: Found = {}
    with highlevel.AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert message.__msgtype__ == connection.msgtype
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def foxglove_of(path: Path) -> Found:
    """The messages of a file for Foxglove, each decoded by the schema that the file holds for it."""
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: pip install caneflow[foxglove]")
    protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    found: Found = {}
    stores: dict[int, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            match channel.message_encoding, schema.encoding:
                case "json", "jsonschema":
                    decoded = json.loads(message.data)
                case "cdr", "ros2msg":
                    if schema.id not in stores:
                        stores[schema.id] = get_typestore(Stores.EMPTY)
                        stores[schema.id].register(get_types_from_msg(schema.data.decode(), schema.name))
                    decoded = stores[schema.id].deserialize_cdr(message.data, schema.name)
                case _:
                    decoded = protobuf.DecoderFactory().decoder_for("protobuf", schema)(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


READERS = {"rosbag2": bag_of, "foxglove": foxglove_of}


def test_a_parquet_table_has_every_number_of_its_stream(
    caneflow: Callable[..., Run], recording: Path, tmp_path: Path
) -> None:
    polars = pytest.importorskip("polars", reason="polars is not installed: pip install caneflow[parquet]")
    tables = {}
    for stream in ("imu/imu", "radar/frame", "fusion/pose"):
        out = tmp_path / f"{stream.replace('/', '_')}.parquet"
        done = caneflow("export", recording, "--format", "parquet", "--stream", stream, "-o", out)
        assert done == (0, f"     100  {stream}\n", "")
        tables[stream] = polars.read_parquet(out)
    sent: dict[str, list[Sample]] = {stream: [] for stream in tables}
    for stream, sample, _ in samples():
        sent.get(stream, []).append(sample)
    imu, frame, pose = tables.values()
    assert imu["stamp"].to_list() == [sample.stamp for sample in sent["imu/imu"]]
    assert imu["seq"].to_list() == list(range(100))
    assert imu.row(0, named=True)["mag_2"] == -40.0
    assert imu["accel_2"].to_list() == [9.75, None] * 50, "null: every second sample has no acceleration"
    scans = frame["scans_re"].to_numpy() + 1j * frame["scans_im"].to_numpy()
    assert np.array_equal(scans, np.concatenate([sample.scans for sample in sent["radar/frame"]]))  # type: ignore[attr-defined]
    assert np.array_equal(pose["covariance"][7].to_numpy(), np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))


@pytest.mark.parametrize("form", READERS)
def test_ros_messages_come_out_as_they_went_in(
    caneflow: Callable[..., Run], recording: Path, tmp_path: Path, form: str
) -> None:
    status, told, err = caneflow("export", recording, "--format", form, "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "     100  /imu/imu/mag\n" in told
    found = READERS[form](tmp_path / "out")
    kinds = {topic: (found[topic][0][1].__msgtype__, len(found[topic])) for topic in TOPICS}
    assert kinds == TOPICS
    (stamp, imu), (_, bare) = found["/imu/imu"][:2]
    assert stamp == START
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec, imu.header.frame_id) == (START // 10**9, 0, "imu_link")
    assert (imu.angular_velocity.z, imu.linear_acceleration.z) == (-1.0, 9.75)
    assert (imu.orientation.w, imu.orientation.y) == (0.5, -0.5)
    assert (imu.orientation_covariance[0], imu.linear_acceleration_covariance[0]) == (0, 0)
    assert (bare.orientation_covariance[0], bare.linear_acceleration_covariance[0]) == (-1, -1), "ROS for: not there"
    assert found["/imu/imu/mag"][0][1].magnetic_field.z == pytest.approx(-40e-6)
    at, odometry = found["/fusion/pose/odom"][7]
    assert at == START + 70_000_000
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (0.07, -2.0)
    assert odometry.pose.covariance.reshape(6, 6)[1, :3].tolist() == [0, 0.02, 0]
    image = found["/radar/frame"][0][1]
    assert (image.width, image.height, image.encoding, image.data.size) == (40, SCANS, "mono8", 40 * SCANS)
    assert (image.header.frame_id, found["/ground_speed/speed/twist"][0][1].header.frame_id) == (
        "radar_link",
        "base_footprint",
    )


def test_foxglove_has_more_than_ros(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    assert caneflow("export", recording, "--format", "foxglove", "-o", tmp_path / "out")[0] == 0
    found = foxglove_of(tmp_path / "out")
    assert set(found) - set(TOPICS) == {"/fusion/pose/foxglove", "/fusion/pose/track", "/doppler/target"}
    stamp, odometry = found["/fusion/pose/foxglove"][7]
    assert (odometry.timestamp.seconds, odometry.timestamp.nanos) == divmod(stamp, 10**9)
    assert (odometry.frame_id, odometry.body_frame_id, odometry.pose.position.y) == ("odom", "imu_link", -2.0)
    turned = odometry.pose.orientation
    assert (turned.w, turned.x, turned.y, turned.z) == TURN
    assert np.reshape(odometry.pose_covariance, (6, 6))[1, :3].tolist() == [0, 0.02, 0]
    assert {pair.key: pair.value for pair in odometry.metadata} == {"method": "best"}
    target = found["/doppler/target"][0][1]
    assert (target["range_rate"], target["valid"]) == (0.25, True)


def test_a_track_keeps_its_way_and_the_ellipse_of_its_end(
    caneflow: Callable[..., Run], recording: Path, tmp_path: Path
) -> None:
    assert caneflow("export", recording, "--format", "foxglove", "-o", tmp_path / "out")[0] == 0
    ((_, first),) = foxglove_of(tmp_path / "out")["/fusion/pose/track"]
    line, ring = first.entities[0].lines
    assert [(point.x, point.y) for point in line.points] == [(0.0, -2.0)], "once a second, so only its beginning"
    across = [point.x for point in ring.points], [point.y for point in ring.points]
    assert [max(each) - min(each) for each in across] == pytest.approx([4 * math.sqrt(0.01), 4 * math.sqrt(0.02)])


@pytest.mark.parametrize("form", ["tum", "csv", *READERS])
def test_a_post_at_2_m_ahead_and_half_a_metre_to_the_left_is_found_there(
    caneflow: Callable[..., Run], tmp_path: Path, form: str
) -> None:
    """Whoever stands at x = 2 m, y = 0.5 m stands there in every form: no axis is swapped, no sign turned."""
    post = Pose(
        stamp=START, position=(2.0, 0.5, 0.0), velocity=(0, 0, 0), orientation=(1, 0, 0, 0), method="best",
        covariance=np.diag([0.01, 0.04, 0.09, 1, 1, 1]),
    )  # fmt: skip
    path, out = tmp_path / "post.mcap", tmp_path / "out"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        writer.write("cane/fusion/pose", Pose, numbered(post, 0), stamp=START, seq=0, log_time=START)
    assert caneflow("export", path, "--format", form, "-o", out)[0] == 0
    if form == "tum":
        assert out.read_text().split()[1:3] == ["2.0", "0.5"]
        beside = np.loadtxt(out.with_suffix(".covariance.txt"))
        assert (beside[0], np.diag(beside[1:].reshape(6, 6)).tolist()) == (START / 1e9, [0.01, 0.04, 0.09, 1, 1, 1])
    elif form == "csv":
        (row,) = csv.DictReader(out.read_text().splitlines())
        assert (row["position_0"], row["position_1"]) == ("2.0", "0.5")
        spread = [float(row[f"covariance_{each}_{each}"]) for each in range(6)]
        assert (spread, row["covariance_0_1"]) == ([0.01, 0.04, 0.09, 1, 1, 1], "0.0")
    else:
        found = READERS[form](out)
        ((_, tree),) = found["/tf"]
        there = [found["/fusion/pose"][0][1].pose.position, found["/fusion/pose/odom"][0][1].pose.pose.position]
        there.append(tree.transforms[0].transform.translation)
        if form == "foxglove":
            there.append(found["/fusion/pose/foxglove"][0][1].pose.position)
            there.append(found["/fusion/pose/track"][0][1].entities[0].lines[0].points[0])
        assert [(each.x, each.y) for each in there] == [(2.0, 0.5)] * len(there)


@pytest.mark.parametrize("form", READERS)
def test_a_post_in_a_grid_is_found_there(caneflow: Callable[..., Run], tmp_path: Path, form: str) -> None:
    """A post at x = 2, y = 0.5 m in a grid of 10 cm cells that begins at x = -1, y = -3: cell 30, 35 of its slices."""
    occupancy = np.full((3, 60, 80), 128, np.uint8)
    occupancy[:, 10:50, 10:70] = 100  # seen, and free
    occupancy[1, 30, 35] = 180
    missing = np.full((60, 80), 128, np.uint8)
    missing[40, 20] = 200  # a hole at x = 3, y = -1
    grid = Grid(
        stamp=START, occupancy=occupancy, unit=0.1, cell=0.1, bottom=0.0, slice=0.5, origin=(-10, -30),
        pose_stamp=START, floor_missing=missing,
    )  # fmt: skip
    path, out = tmp_path / "grid.mcap", tmp_path / "out"
    with RecordingWriter(path, flow="cane", source="live", rig={}) as writer:
        writer.write("cane/map/grid", Grid, numbered(grid, 0), stamp=START, seq=0, log_time=START)
    assert caneflow("export", path, "--format", form, "-o", out)[0] == 0
    found = READERS[form](out)
    for topic, place, odds in (("/map/grid", (2.0, 0.5), 5.2), ("/map/grid/floor_missing", (3.0, -1.0), 7.2)):
        ((_, message),) = found[topic]
        about = message.info
        row, column = divmod(int(message.data.argmax()), about.width)
        centre = [about.origin.position.x, about.origin.position.y]
        centre[0] += (column + 0.5) * about.resolution
        centre[1] += (row + 0.5) * about.resolution
        assert centre == pytest.approx([place[0] + 0.05, place[1] + 0.05])
        assert message.data.max() == round(100 / (1 + math.exp(-odds)))
    table = found["/map/grid"][0][1].data.reshape(80, 60)
    assert (table[0, 0], table[20, 20]) == (-1, round(100 / (1 + math.exp(2.8)))), "unknown, free"
    if form == "foxglove":
        ((_, message),) = found["/map/grid/foxglove"]
        cell = message.data.index(180)
        row, rest = divmod(cell, message.row_stride)
        column, field = divmod(rest, message.cell_stride)
        assert message.fields[field].name == "0.50 m and up"
        corner = message.pose.position
        place = (corner.x + column * message.cell_size.x, corner.y + row * message.cell_size.y)
        assert place == pytest.approx((2.0, 0.5))


def test_frames_can_be_named(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    options = ["--format", "rosbag2", "--world", "hall", "-o", tmp_path / "bag"]
    assert caneflow("export", recording, *options)[0] == 0
    assert bag_of(tmp_path / "bag")["/fusion/pose/odom"][0][1].header.frame_id == "hall"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["parquet", "--stream", "imu/imu"], "--format parquet: needs -o, the file to write"),
        (["foxglove"], "--format foxglove: needs -o, the file to write"),
        (["rosbag2"], "--format rosbag2: needs -o, the folder to write"),
        (
            ["rosbag2", "-o", "bag", "--stream", "imu/imu"],
            "--format rosbag2: takes the whole recording; --stream is for tum, csv and parquet",
        ),
        (["tum", "--world", "hall"], "--format tum: has no frames; --world and --tf are for foxglove and rosbag2"),
    ],
)
def test_what_cannot_be_written_is_one_line(
    caneflow: Callable[..., Run], recording: Path, options: list[str], said: str
) -> None:
    assert caneflow("export", recording, "--format", *options) == (2, "", f"caneflow export: {said}\n")


def test_the_recording_itself_is_kept(caneflow: Callable[..., Run], recording: Path) -> None:
    status, _, err = caneflow("export", recording, "--format", "foxglove", "-o", recording)
    said = f"caneflow export: {recording}: is an input of this command; expected another name for the output\n"
    assert (status, err) == (2, said)


@pytest.mark.parametrize(
    ("form", "package", "extra"),
    [
        ("foxglove", "foxglove", "foxglove"),
        ("rosbag2", "rosbags.rosbag2", "rosbag2"),
        ("parquet --stream imu/imu", "polars", "parquet"),
    ],
)
def test_a_library_that_is_missing_is_named(
    caneflow: Callable[..., Run],
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    form: str,
    package: str,
    extra: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    status, _, err = caneflow("export", recording, "--format", *form.split(), "-o", tmp_path / "out")
    assert status == 2
    assert f"`pip install 'caneflow[{extra}]'` brings it" in err


def test_a_bag_that_is_there_is_not_written_over(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: caneflow[rosbag2]")
    status, _, err = caneflow("export", recording, "--format", "rosbag2", "-o", tmp_path)
    assert status == 2
    expected = "is an existing folder; expected a new name, or --overwrite for a folder of rosbag2"
    assert err == f"caneflow export: {tmp_path}: {expected}\n"
