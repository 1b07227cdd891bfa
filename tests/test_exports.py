"""What `caneflow export` writes for Foxglove and ROS 2, opened by the libraries of those."""

import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow import command
from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame, Sample, numbered
from caneflow.recording import RecordingWriter
from caneflow.recording.radar_images import SCANS, RadarImages

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
        pose = Pose(stamp=stamp, position=position, velocity=(0, 0, 0), orientation=TURN, method="best")
        yield "fusion/pose", pose, seq


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


def test_foxglove_opens_it(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: pip install caneflow[foxglove]")
    protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
    from mcap.reader import make_reader

    out = tmp_path / "walk.foxglove.mcap"
    status, told, err = caneflow("export", recording, "--format", "foxglove", "-o", out)
    assert (status, err) == (0, "")
    assert "     100  /fusion/pose\n" in told
    by_topic: dict[str, list[tuple[Any, Any, Any]]] = {}
    with out.open("rb") as file:
        reader = make_reader(file, decoder_factories=[protobuf.DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            decoded = (
                json.loads(message.data)
                if channel.message_encoding == "json"
                else protobuf.DecoderFactory().decoder_for("protobuf", schema)(message.data)
            )
            by_topic.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
    kinds = {topic: (each[0][0], len(each)) for topic, each in by_topic.items()}
    assert kinds == {
        "/imu/imu": ("caneflow.Imu/1", 100),
        "/radar/frame": ("foxglove.RawImage", 4),
        "/ground_speed/speed": ("caneflow.GroundSpeed/1", 100),
        "/fusion/pose": ("foxglove.PoseInFrame", 100),
        "/fusion/pose/tf": ("foxglove.FrameTransform", 100),
    }
    _, stamp, pose = by_topic["/fusion/pose"][7]
    assert stamp == START + 70_000_000
    assert (pose.timestamp.seconds, pose.timestamp.nanos) == divmod(stamp, 10**9)
    assert (pose.frame_id, pose.pose.position.x, pose.pose.position.y) == ("R0", 0.07, -2.0)
    turned = pose.pose.orientation
    assert (turned.w, turned.x, turned.y, turned.z) == TURN
    _, _, transform = by_topic["/fusion/pose/tf"][7]
    assert (transform.parent_frame_id, transform.child_frame_id, transform.translation.z) == ("R0", "fusion", 0.5)
    _, _, image = by_topic["/radar/frame"][-1]
    assert (image.encoding, image.width, image.height, len(image.data)) == ("mono8", 40, SCANS, 40 * SCANS)
    assert by_topic["/imu/imu"][0][2]["gyro"] == [0.25, 0, -1]
    assert "quality" not in by_topic["/ground_speed/speed"][0][2], "JSON has no infinity"


def test_ros_2_opens_it(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed: caneflow[rosbag2]")
    out = tmp_path / "bag"
    status, told, err = caneflow("export", recording, "--format", "rosbag2", "-o", out)
    assert (status, err) == (0, "")
    assert "     100  /imu/imu/mag\n" in told
    found: dict[str, list[tuple[int, Any]]] = {}
    with highlevel.AnyReader([out]) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    assert kinds == {
        "/imu/imu": "sensor_msgs/msg/Imu",
        "/imu/imu/mag": "sensor_msgs/msg/MagneticField",
        "/radar/frame": "sensor_msgs/msg/Image",
        "/ground_speed/speed": "geometry_msgs/msg/TwistStamped",
        "/fusion/pose": "geometry_msgs/msg/PoseStamped",
    }
    counts = {topic: len(each) for topic, each in found.items()}
    assert counts == {
        "/imu/imu": 100,
        "/imu/imu/mag": 100,
        "/radar/frame": 4,
        "/ground_speed/speed": 90,
        "/fusion/pose": 100,
    }
    (stamp, imu), (_, bare) = found["/imu/imu"][:2]
    assert stamp == START
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec, imu.header.frame_id) == (START // 10**9, 0, "body")
    assert (imu.angular_velocity.z, imu.linear_acceleration.z) == (-1.0, 9.75)
    assert (imu.orientation.w, imu.orientation.y) == (0.5, -0.5)
    assert (imu.orientation_covariance[0], imu.linear_acceleration_covariance[0]) == (0, 0)
    assert (bare.orientation_covariance[0], bare.linear_acceleration_covariance[0]) == (-1, -1), "ROS for: not there"
    assert found["/imu/imu/mag"][0][1].magnetic_field.z == pytest.approx(-40e-6)
    pose = found["/fusion/pose"][7][1]
    assert (pose.header.frame_id, pose.pose.position.x, pose.pose.orientation.z) == ("R0", 0.07, 0.5)
    image = found["/radar/frame"][0][1]
    assert (image.width, image.height, image.encoding, image.data.size) == (40, SCANS, "mono8", 40 * SCANS)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["foxglove"], "--format foxglove: needs -o, the file to write"),
        (["rosbag2"], "--format rosbag2: needs -o, the folder to write"),
        (
            ["rosbag2", "-o", "bag", "--stream", "imu/imu"],
            "--format rosbag2: takes the whole recording; --stream is for tum and csv",
        ),
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


@pytest.mark.parametrize(("form", "package"), [("foxglove", "foxglove"), ("rosbag2", "rosbags.rosbag2")])
def test_a_library_that_is_missing_is_named(
    caneflow: Callable[..., Run],
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    form: str,
    package: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    status, _, err = caneflow("export", recording, "--format", form, "-o", tmp_path / "out")
    assert status == 2
    assert f"it comes with `pip install caneflow[{form}]`" in err


def test_a_bag_that_is_there_is_not_written_over(caneflow: Callable[..., Run], recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: caneflow[rosbag2]")
    status, _, err = caneflow("export", recording, "--format", "rosbag2", "-o", tmp_path)
    assert status == 2
    expected = "is an existing folder; expected a new name, or --overwrite for a folder of rosbag2"
    assert err == f"caneflow export: {tmp_path}: {expected}\n"
