"""Bags that rosbags wrote, as recordings: values, stamps, frames, and what is said of the rest."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caneflow import command
from caneflow.algorithms.rotations import Quaternion, Vector
from caneflow.messages import Imu, Pose, numbered
from caneflow.recording import Recording, RecordingWriter

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install caneflow[rosbag2]")

from caneflow.bridges.frames import Transform, frames_of
from caneflow.bridges.ros_messages import RosMessages
from caneflow.bridges.ros_samples import FieldsByTime, FixedFrames, imu_of, pose_of
from caneflow.bridges.ros_types import RosTypes
from caneflow.messages.rig import Rig

START = 1_700_000_000_000_000_000  # ns
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


@pytest.fixture(scope="module")
def types() -> RosTypes:
    return RosTypes("jazzy")


class Written(NamedTuple):
    """One message of a bag that is to be written."""

    topic: str
    kind: str
    at: int  # ns, when the bag got it
    message: Any


def bag(path: Path, types: RosTypes, messages: list[Written]) -> Path:
    """A rosbag2 folder with `messages`."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections: dict[str, Any] = {}
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, at, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types.store)
            writer.write(connections[topic], at, types.encoded(kind, message))
    return path


def imu_message(types: RosTypes, stamp: int, **changed: Any) -> Any:
    """A sensor_msgs/Imu at rest in the frame `imu`; `changed`: fields of the sample."""
    made = RosMessages(types, frames_of(Rig())).pictures("imu", "imu", Imu)[0].make
    message = made(Imu(**{"stamp": stamp, "gyro": (0.1, 0.2, 0.3), "accel": (0, 0, 9.81), **changed}))
    message.header.frame_id = "imu"
    return message


def field_message(types: RosTypes, stamp: int, tesla: tuple[float, float, float], frame: str = "imu") -> Any:
    made = RosMessages(types, frames_of(Rig())).pictures("imu", "imu", Imu)[1].make
    message = made(Imu(stamp=stamp, gyro=(0, 0, 0), mag=(1e6 * tesla[0], 1e6 * tesla[1], 1e6 * tesla[2])))
    message.header.frame_id = frame
    return message


def fixed_message(types: RosTypes, *edges: tuple[str, str, Vector, Rotation]) -> Any:
    """A tf2_msgs/TFMessage; an edge is parent, child, translation (m) and rotation."""
    build = RosMessages(types, frames_of(Rig()))._build
    return build.transforms(
        START, [Transform(parent, child, place, wxyz(turn)) for parent, child, place, turn in edges]
    )


def wxyz(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return w, x, y, z


def rest(types: RosTypes, count: int = 3) -> Iterator[Written]:
    for seq in range(count):
        stamp = START + seq * 10_000_000
        yield Written("/imu", "sensor_msgs/msg/Imu", stamp + 7, imu_message(types, stamp))


def samples(path: Path) -> dict[str, list[Any]]:
    with Recording(path) as recording:
        found: dict[str, list[Any]] = {}
        for each in recording.samples():
            found.setdefault(f"{each.node}/{each.port}", []).append(each.decoded())
        return found


def test_our_own_export_comes_back_equal(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    boresight, antenna = (0.6, 0.48, -0.64), (0.01, 0.2, -0.03)
    spread = np.random.default_rng(5).normal(size=(6, 6))
    turn = wxyz(Rotation.random(random_state=3))
    path, walk = tmp_path / "back.mcap", tmp_path / "walk.mcap"
    with RecordingWriter(
        walk, flow="cane", source="live", rig={"boresight": list(boresight), "antenna": list(antenna)}
    ) as writer:
        for seq in range(5):
            stamp = START + seq * 10_000_000
            whole = seq % 2 == 0
            imu = Imu(
                stamp=stamp, gyro=(0.1 * seq, -1 / 3, 0.2), accel=(0.1, 0.2, 9.7) if whole else None,
                mag=(20.1, -3.3, -40.7), orientation=turn if whole else None,
            )  # fmt: skip
            pose = Pose(
                stamp=stamp, position=(0.1 * seq, -2.0, 0.5), velocity=(0.3, -0.2, 0.1), orientation=turn,
                method="best", covariance=spread @ spread.T if whole else None,
            )  # fmt: skip
            for key, sample in (("cane/imu/imu", imu), ("cane/fusion/pose", pose)):
                writer.write(key, type(sample), numbered(sample, seq), stamp=stamp, seq=seq, log_time=stamp)
    assert caneflow("export", walk, "--format", "rosbag2", "-o", tmp_path / "bag")[0] == 0
    status, said, _ = caneflow("import", "rosbag", tmp_path / "bag", "--truth", "/fusion/pose/odom", "-o", path)
    assert status == 0
    assert said.startswith(f"{path}: 5 samples of the IMU, 5 with a magnetic field; 5 poses of the ground truth\n")
    before, after = samples(walk), samples(path)
    for was, now in zip(before["imu/imu"], after["imu/imu"], strict=True):
        assert (now.stamp, now.gyro, now.accel, now.orientation) == (was.stamp, was.gyro, was.accel, was.orientation)
        assert now.mag == pytest.approx(was.mag, rel=1e-15)
    for was, now in zip(before["fusion/pose"], after["truth/pose"], strict=True):
        assert now.stamp == was.stamp
        for name in ("position", "velocity", "orientation"):
            assert getattr(now, name) == pytest.approx(getattr(was, name), abs=1e-12)
        assert (now.covariance is None) == (was.covariance is None)
        if was.covariance is not None:
            for block in (slice(0, 3), slice(3, 6)):
                assert now.covariance[block, block] == pytest.approx(was.covariance[block, block])
            assert not now.covariance[:3, 3:].any(), "the message holds nothing between position and velocity"
    with Recording(path) as recording:
        assert recording.rig["boresight"] == pytest.approx(boresight)
        assert recording.rig["antenna"] == pytest.approx(antenna)
        assert recording.metadata["source"] == "imported"


def test_stamps_are_the_headers_and_what_has_none_is_told(
    caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path
) -> None:
    stamps = [START, START + 10_000_000, START + 10_000_000, START + 5_000_000, 0, START + 20_000_000]
    messages = [
        Written("/imu", "sensor_msgs/msg/Imu", START + 30_000_000 + 10_000_000 * index, imu_message(types, stamp))
        for index, stamp in enumerate(stamps)
    ]
    folder = bag(tmp_path / "bag", types, messages)
    status, said, _ = caneflow("import", "rosbag", folder, "-o", tmp_path / "rec.mcap")
    assert status == 0
    assert "imu/imu: 2 messages left out: not newer than the one before\n" in said
    assert "imu/imu: 1 messages left out: without a stamp\n" in said
    with Recording(tmp_path / "rec.mcap") as recording:
        taken = [(each.stamp - START, each.log_time - each.stamp, each.seq) for each in recording.samples()]
    assert taken == [(0, 30_000_000, 0), (10_000_000, 30_000_000, 1), (20_000_000, 60_000_000, 2)]


def test_what_a_driver_does_not_know_is_left_open(types: RosTypes) -> None:
    message = imu_message(types, START, orientation=None, accel=None)
    assert (imu_of(message).orientation, imu_of(message).accel) == (None, None)
    message = imu_message(types, START, orientation=(1, 0, 0, 0))
    message.orientation.w = 0.0  # zeros throughout, as many drivers send that have no orientation
    assert imu_of(message).orientation is None
    message.orientation.w = 1.01  # rounded somewhere
    assert imu_of(message).orientation == (1, 0, 0, 0)
    message.angular_velocity_covariance = np.array([-1.0] + [0.0] * 8)
    with pytest.raises(ValueError, match="no angular velocity"):
        imu_of(message)
    message = imu_message(types, START)
    message.angular_velocity.x = float("nan")
    with pytest.raises(ValueError, match="gyro"):
        imu_of(message)


def test_a_field_of_another_frame_is_turned_and_the_nearest_is_taken(
    caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path
) -> None:
    quarter = Rotation.from_euler("z", 90, degrees=True)  # x of the magnetometer is y of the IMU
    fixed = fixed_message(types, ("imu", "mag", (0, 0, 0), quarter))
    messages = [
        Written("/tf_static", "tf2_msgs/msg/TFMessage", START, fixed),
        *rest(types, 4),
    ]
    for late in (1_000_000, 12_000_000):
        field = field_message(types, START + late, (3e-5, 0, late * 1e-12), "mag")
        messages.append(Written("/mag", "sensor_msgs/msg/MagneticField", START + late, field))
    folder = bag(tmp_path / "bag", types, sorted(messages, key=lambda each: each.at))
    assert caneflow("import", "rosbag", folder, "-o", tmp_path / "rec.mcap")[0] == 0
    fields = [each.mag for each in samples(tmp_path / "rec.mcap")["imu/imu"]]
    assert fields[:3] == [pytest.approx((0, 30, z), abs=1e-12) for z in (1, 12, 12)]
    assert fields[3] == pytest.approx((0, 30, 12), abs=1e-12), "18 ms away"


def test_fields_further_than_asked_are_not_taken() -> None:
    fields = FieldsByTime([(100, (1, 0, 0)), (50, (2, 0, 0))])
    assert [fields.nearest(stamp, 20) for stamp in (20, 30, 74, 76, 120, 121)] == [
        None, (2, 0, 0), None, None, (1, 0, 0), None,
    ]  # fmt: skip
    assert fields.nearest(75, 25) == (2, 0, 0)
    assert FieldsByTime([]).nearest(0, 10) is None


def test_truth_of_a_turning_robot_is_brought_to_its_imu(types: RosTypes) -> None:
    """The IMU sits 0.5 m ahead of the robot's middle; the robot turns at 2 rad/s while it drives at 1 m/s."""
    body = Transform("base_link", "imu", (0.5, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    quarter = wxyz(Rotation.from_euler("z", 90, degrees=True))
    middle = Pose(
        stamp=START, position=(1.0, 2.0, 0.0), velocity=(0.0, 1.0, 0.0), method="best",
        orientation=quarter,
    )  # fmt: skip
    made = RosMessages(types, frames_of(Rig(boresight=(1, 0, 0))), tf="")
    message = made.pictures("robot", "pose", Pose)[1].make(middle)
    message.twist.twist.angular.z = 2.0
    pose = pose_of(message, body)
    assert pose.position == pytest.approx((1.0, 2.5, 0.0))  # ahead is y0
    assert pose.velocity == pytest.approx((-1.0, 1.0, 0.0))  # and its left is -x0: 2 rad/s times 0.5 m
    assert pose.covariance is None


def test_a_covariance_of_one_kind_says_that_the_other_is_not_observed(types: RosTypes) -> None:
    made = RosMessages(types, frames_of(Rig(boresight=(1, 0, 0))), tf="").pictures("robot", "pose", Pose)[1].make
    pose = Pose(stamp=START, position=(0, 0, 0), velocity=(0, 0, 0), orientation=(1, 0, 0, 0), method="best")
    message = made(pose)
    message.pose.covariance = np.diag([0.1, 0.2, 0.3, 0, 0, 0]).reshape(-1)
    covariance = pose_of(message).covariance
    assert covariance is not None
    assert np.diag(covariance).tolist() == [0.1, 0.2, 0.3, 1e6, 1e6, 1e6]


def test_frames_are_found_over_several_steps_and_against_their_direction(types: RosTypes) -> None:
    turns = [Rotation.random(random_state=seed) for seed in range(3)]
    fixed = FixedFrames()
    fixed.take(fixed_message(types, ("base", "mast", (1, 2, 3), turns[0]), ("mast", "imu", (0.1, 0, 0), turns[1])))
    fixed.take(fixed_message(types, ("base", "lidar", (0, 0, 1), turns[2])))
    there = fixed.between("lidar", "imu")
    assert there is not None
    w, *vector = there.rotation
    expected = turns[2].inv() * turns[0] * turns[1]
    assert (Rotation.from_quat([*vector, w]) * expected.inv()).magnitude() == pytest.approx(0, abs=1e-7)
    place = turns[2].inv().apply(np.array([1, 2, 3]) + turns[0].apply([0.1, 0, 0]) - [0, 0, 1])
    assert there.translation == pytest.approx(place)
    assert fixed.between("lidar", "wheel") is None


def test_of_several_topics_one_has_to_be_named(caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path) -> None:
    second = [each._replace(topic="/foot/imu") for each in rest(types)]
    folder = bag(tmp_path / "bag", types, [*rest(types), *second])
    out = tmp_path / "rec.mcap"
    expected = f"caneflow import: {folder}: 2 topics of sensor_msgs/msg/Imu; choose one with --imu: /foot/imu, /imu\n"
    assert caneflow("import", "rosbag", folder, "-o", out) == (2, "", expected)
    assert not out.exists()
    status, said, _ = caneflow("import", "rosbag", folder, "--imu", "/imu", "-o", out)
    assert (status, "not used: /foot/imu, 3 of sensor_msgs/msg/Imu\n" in said) == (0, True)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--imu", "/odom"], "--imu /odom: no such topic; topics of sensor_msgs/msg/Imu: /imu"),
        (["--truth", "/imu"], "--truth /imu: is sensor_msgs/msg/Imu; topics of nav_msgs/msg/Odometry: none"),
        (["--flow", "A b"], "--flow 'A b': expected "),
        (["--distro", "noetic"], "--distro 'noetic': expected one of humble, jazzy, kilted, lyrical"),
    ],
)
def test_what_cannot_be_taken_is_one_line(
    caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path, options: list[str], said: str
) -> None:
    folder = bag(tmp_path / "bag", types, list(rest(types)))
    status, out, err = caneflow("import", "rosbag", folder, *options, "-o", tmp_path / "rec.mcap")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert said in err


def test_what_is_no_bag_is_one_line(caneflow: Callable[..., Run], tmp_path: Path) -> None:
    (tmp_path / "empty.bag").write_bytes(b"")
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n\x01\x02")
    (tmp_path / "folder").mkdir()
    for name in ("empty.bag", "torn.mcap", "folder", "missing"):
        status, out, err = caneflow("import", "rosbag", tmp_path / name, "-o", tmp_path / "rec.mcap")
        assert (status, out, err.count("\n")) == (2, "", 1), err
        assert str(tmp_path / name) in err
    assert not (tmp_path / "rec.mcap").exists()


def test_a_damaged_bag_leaves_nothing_half_done(caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", types, list(rest(types, 200)))
    (held,) = folder.glob("*.mcap")
    data = bytearray(held.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    held.write_bytes(bytes(data))
    status, _, err = caneflow("import", "rosbag", folder, "-o", tmp_path / "rec.mcap")
    assert (status, err.count("\n")) == (2, 1), err
    assert not (tmp_path / "rec.mcap").exists()


def test_the_rig_of_a_file_is_stored(caneflow: Callable[..., Run], types: RosTypes, tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", types, list(rest(types)))
    (tmp_path / "rig.yaml").write_text("boresight: [1, 0, 0]\nhand_height: 0.9\n")
    options = ["--rig", tmp_path / "rig.yaml", "-o", tmp_path / "rec.mcap"]
    assert caneflow("import", "rosbag", folder, *options)[0] == 0
    with Recording(tmp_path / "rec.mcap") as recording:
        assert recording.rig == {"boresight": [1, 0, 0], "hand_height": 0.9}
