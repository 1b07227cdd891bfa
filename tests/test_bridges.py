"""What our messages become in ROS, against the same values computed by scipy's rotations and plain matrices."""

import math
import struct
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caneflow.algorithms.rotations import Vector
from caneflow.bridges.frames import frames_of, quaternion_of
from caneflow.bridges.radar_images import SCANS, RadarImages
from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame, Sample
from caneflow.messages.control import Delays, EdgeStatus, FlowStatus, NodeStatus
from caneflow.messages.rig import Rig

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install caneflow[ros2]")

from caneflow.bridges.ros_messages import RosMessages, tf_stream
from caneflow.bridges.ros_types import RosTypes

STAMP = 1_700_000_000_123_456_789  # ns
BORESIGHTS = [(0, 1, 0), (1, 0, 0), (0, 0, 1), (0, 0, -1), (0, -1, 0), (0.6, 0.48, -0.64), (0, 0.96, -0.28)]
TURN = (0.1, -0.7, 0.5, 0.5)  # w x y z, of norm 1


@pytest.fixture(scope="module")
def types() -> RosTypes:
    return RosTypes("jazzy")


def messages_of(types: RosTypes, sample: Sample, node: str = "fusion", rig: Rig | None = None) -> dict[str, Any]:
    """Every ROS message of one sample, by topic."""
    bridge = RosMessages(types, frames_of(rig or Rig()), tf="fusion/out")
    made = {each.topic: each.make(sample) for each in bridge.pictures(node, "out", type(sample))}
    return {topic: message for topic, message in made.items() if message is not None}


def pose(covariance: Any = None, **changed: Any) -> Pose:
    values: dict[str, Any] = {"position": (2.0, 0.5, 0.9), "velocity": (0.3, -0.4, 0.1), "orientation": TURN}
    return Pose(stamp=STAMP, method="best", covariance=covariance, **{**values, **changed})


def rotation(quaternion: Any) -> Rotation:
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


BODY = Rotation.from_quat([*TURN[1:], TURN[0]])
SPREAD = np.random.default_rng(5).normal(size=(6, 6))
COVARIANCE = SPREAD @ SPREAD.T


@pytest.mark.parametrize("boresight", BORESIGHTS)
def test_base_link_looks_along_the_boresight_and_stands_as_upright_as_it_can(boresight: Vector) -> None:
    frames = frames_of(Rig(boresight=boresight))
    w, *vector = frames.mounting
    x, y, z = Rotation.from_quat([*vector, w]).as_matrix().T
    assert x == pytest.approx(np.array(boresight), abs=1e-15)
    assert np.cross(x, y) == pytest.approx(z, abs=1e-15)
    # Of all axes at right angles to the boresight, none is nearer to the body's z: its share is what the boresight
    # leaves of it.
    assert z[2] == pytest.approx(math.sqrt(max(0.0, 1 - boresight[2] ** 2)), abs=1e-15)


def test_a_rotation_as_a_quaternion_turns_as_its_matrix() -> None:
    # Half turns about each axis are where a formula that divides by w fails.
    turns = [*Rotation.random(50, random_state=1), *Rotation.from_rotvec(math.pi * np.eye(3)), Rotation.identity()]
    for turn in turns:
        w, x, y, z = quaternion_of(turn.as_matrix())
        assert (Rotation.from_quat([x, y, z, w]) * turn.inv()).magnitude() == pytest.approx(0, abs=1e-7)


def test_a_pose_in_each_of_its_forms(types: RosTypes) -> None:
    boresight = (0.6, 0.48, -0.64)
    made = messages_of(types, pose(COVARIANCE), rig=Rig(boresight=boresight))
    assert set(made) == {"/fusion/out", "/fusion/out/odom", "/fusion/out/with_covariance", "/tf"}
    odometry = made["/fusion/out/odom"]
    turn = rotation(odometry.pose.pose.orientation)
    assert turn.apply([1, 0, 0]) == pytest.approx(BODY.apply(boresight))
    assert xyz(odometry.pose.pose.position) == [2.0, 0.5, 0.9]
    assert turn.apply(xyz(odometry.twist.twist.linear)) == pytest.approx(np.array([0.3, -0.4, 0.1]))
    place = odometry.pose.covariance.reshape(6, 6)
    assert place[:3, :3] == pytest.approx(COVARIANCE[:3, :3])
    motion = odometry.twist.covariance.reshape(6, 6)
    back = turn.as_matrix()
    assert back @ motion[:3, :3] @ back.T == pytest.approx(COVARIANCE[3:, 3:])
    for covariance in (place, motion):
        assert covariance[3:, 3:] == pytest.approx(1e6 * np.eye(3)), "turning is not observed"
        assert not covariance[:3, 3:].any()
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == divmod(STAMP, 10**9)
    for topic in ("/fusion/out", "/fusion/out/with_covariance"):
        same = made[topic].pose if topic == "/fusion/out" else made[topic].pose.pose
        assert xyz(same.position) == [2.0, 0.5, 0.9]
        assert (rotation(same.orientation) * turn.inv()).magnitude() == pytest.approx(0, abs=1e-7)
    assert made["/fusion/out/with_covariance"].pose.covariance == pytest.approx(odometry.pose.covariance)


def test_of_no_covariance_nothing_is_claimed(types: RosTypes) -> None:
    made = messages_of(types, pose())
    assert "/fusion/out/with_covariance" not in made
    odometry = made["/fusion/out/odom"]
    assert not odometry.pose.covariance.any(), "all zero is ROS for: unknown"
    assert np.diag(odometry.twist.covariance.reshape(6, 6)).tolist() == [0, 0, 0, 1e6, 1e6, 1e6]


def test_the_tree_gives_the_pose_with_a_level_footprint_below_it(types: RosTypes) -> None:
    made = messages_of(types, pose(), rig=Rig(boresight=(0, 0.96, -0.28)))
    ground, link = made["/tf"].transforms
    names = [(each.header.frame_id, each.child_frame_id) for each in (ground, link)]
    assert names == [("odom", "base_footprint"), ("base_footprint", "base_link")]
    level, tilt = rotation(ground.transform.rotation), rotation(link.transform.rotation)
    assert level.apply([0, 0, 1]) == pytest.approx(np.array([0, 0, 1]))
    assert ground.transform.translation.z == 0
    whole = level * tilt
    assert (whole * rotation(made["/fusion/out"].pose.orientation).inv()).magnitude() == pytest.approx(0, abs=1e-7)
    # tilt turns about no vertical axis: x of base_link stays in the plane x-z of base_footprint.
    assert tilt.apply([1, 0, 0])[1] == pytest.approx(0, abs=1e-12)
    position = np.array(xyz(ground.transform.translation)) + level.apply(xyz(link.transform.translation))
    assert position == pytest.approx(np.array([2.0, 0.5, 0.9]))


def test_what_is_bolted_on(types: RosTypes) -> None:
    boresight, antenna = (0.6, 0.48, -0.64), (0.01, 0.2, -0.03)
    bridge = RosMessages(types, frames_of(Rig(boresight=boresight, antenna=antenna)), namespace="/left")
    imu, radar = bridge.static(STAMP).transforms
    assert bridge.static_topic == "/left/tf_static"
    assert [(each.header.frame_id, each.child_frame_id) for each in (imu, radar)] == [
        ("base_link", "imu_link"),
        ("base_link", "radar_link"),
    ]
    into_base = rotation(imu.transform.rotation)
    assert into_base.apply(boresight) == pytest.approx(np.array([1, 0, 0]), abs=1e-12)
    assert xyz(radar.transform.translation) == pytest.approx(into_base.apply(antenna))


def test_poses_of_others_have_frames_of_their_own(types: RosTypes) -> None:
    made = messages_of(types, pose(), node="truth")
    assert made["/truth/out/odom"].child_frame_id == "truth/base_link"
    assert "/tf" not in made


def test_which_stream_moves_the_frames() -> None:
    kinds: dict[str, type[Sample] | None] = {"imu/imu": Imu, "truth/pose": Pose, "fusion/pose": Pose}
    assert tf_stream(kinds) == "fusion/pose"
    assert tf_stream({**kinds, "other/pose": Pose}) == "", "not one of two by chance"
    assert tf_stream({**kinds, "other/pose": Pose}, "other/pose") == "other/pose"
    assert tf_stream({"truth/pose": Pose}) is None


def test_the_world_of_a_room_is_a_map() -> None:
    room = Rig.model_validate({"sensors": {"south": {"position": [0, 0, 1], "azimuth": 0}}})
    assert [frames_of(Rig()).world, frames_of(room).world, frames_of(room, "hall").world] == ["odom", "map", "hall"]


def test_an_imu_says_what_it_lacks(types: RosTypes) -> None:
    bare = messages_of(types, Imu(stamp=STAMP, gyro=(0.25, 0.0, -1.0)), node="imu")
    assert set(bare) == {"/imu/out"}, "no field without a magnetometer"
    message = bare["/imu/out"]
    assert (message.orientation_covariance[0], message.linear_acceleration_covariance[0]) == (-1, -1)
    whole = Imu(stamp=STAMP, gyro=(0.25, 0.0, -1.0), accel=(0, 0, 9.75), mag=(20.0, 0.0, -40.0), orientation=TURN)
    made = messages_of(types, whole, node="imu")
    message = made["/imu/out"]
    assert not any((*message.orientation_covariance, *message.linear_acceleration_covariance))
    assert (message.orientation.w, *xyz(message.orientation)) == TURN
    assert (xyz(message.angular_velocity), xyz(message.linear_acceleration)) == ([0.25, 0, -1], [0, 0, 9.75])
    assert xyz(made["/imu/out/mag"].magnetic_field) == pytest.approx([20e-6, 0, -40e-6])
    assert {each.header.frame_id for each in made.values()} == {"imu_link"}


@pytest.mark.parametrize(
    ("speed", "linear", "covariance"),
    [
        ({"speed": 0.5, "quality": 0.1}, [0.5, 0, 0], np.diag([0.01, 1e6, 1e6, 1e6, 1e6, 1e6])),
        (
            {"speed": 0.5, "quality": 0.1, "velocity": (0.4, -0.2), "velocity_cov": (0.02, 0.005, 0.03)},
            [0.4, -0.2, 0],
            np.block(
                [[np.array([[0.02, 0.005], [0.005, 0.03]]), np.zeros((2, 4))], [np.zeros((4, 2)), 1e6 * np.eye(4)]]
            ),
        ),
        (
            {"speed": 0.5, "quality": 0.1, "velocity": (0.4, 0), "velocity_cov": (0.02, 0, 1e6)},
            [0.4, 0, 0],
            np.diag([0.02, 1e6, 1e6, 1e6, 1e6, 1e6]),
        ),
    ],
)
def test_a_speed_over_ground(types: RosTypes, speed: dict[str, Any], linear: list[float], covariance: Any) -> None:
    made = messages_of(types, GroundSpeed(stamp=STAMP, rays=3, valid=True, **speed), node="speed")
    twist = made["/speed/out/twist"]
    assert twist.header.frame_id == "base_footprint"
    assert xyz(twist.twist.twist.linear) == linear
    assert twist.twist.covariance.reshape(6, 6) == pytest.approx(covariance)


def test_a_speed_that_is_not_valid_is_not_told(types: RosTypes) -> None:
    assert not messages_of(types, GroundSpeed(stamp=STAMP, speed=0, quality=math.inf, rays=0, valid=False))


def test_radar_pictures_begin_again_when_time_goes_back() -> None:
    def frame(index: int) -> RadarFrame:
        scans = np.full((1, 30), np.exp(0.9j * index), np.complex64)
        radar: dict[str, Any] = {
            "scan_period": 0.01,
            "range_start": 0.3,
            "range_step": 0.05,
            "carrier": 4.3e9,
            "bandwidth": 1.7e9,
        }
        return RadarFrame(stamp=index * 10_000_000, scans=scans, **radar)

    images = RadarImages()
    first = [images.take(frame(index)) for index in range(2 * SCANS)]
    again = [images.take(frame(index)) for index in range(2 * SCANS)]
    assert any(first)
    assert [each and each.stamp for each in again] == [each and each.stamp for each in first]
    assert all((a.grey == b.grey).all() for a, b in zip(first, again, strict=True) if a and b)


def test_diagnostics_of_nodes_and_of_wires_that_lose(types: RosTypes) -> None:
    node = NodeStatus(
        node="fusion", program="operators.fusion", state="waiting", pid=7, restarts=2, uptime=1.0, cpu=None,
        memory=None,
        sent={"pose": 5}, rates={}, counted=None, said="",
    )  # fmt: skip
    edge = EdgeStatus(
        writer="imu/imu", reader="fusion.imu", schema="caneflow.Imu/1", sent=9, received=7, handled=7, waiting=0,
        rate=None, sender=0, wire=2, decode=0, queue=0, late=0, repeated=0, delays=Delays(),
    )  # fmt: skip
    status = FlowStatus(
        flow="cane", version="1", host="here", pid=1, uptime=1.0, replay=False, clock=0, machine="", nodes=[node],
        edges=[edge],
    )  # fmt: skip
    array = RosMessages(types, frames_of(Rig())).diagnostics(status, STAMP)
    read = types.decoded(
        "diagnostic_msgs/msg/DiagnosticArray", types.encoded("diagnostic_msgs/msg/DiagnosticArray", array)
    )
    rows = [(row.level, row.name, row.message) for row in read.status]
    assert rows == [(1, "cane: fusion", "waiting, 2 restarts"), (1, "cane: imu/imu > fusion.imu", "2 lost (wire)")]
    assert ("sent pose", "5") in [(pair.key, pair.value) for pair in read.status[0].values]


def test_cdr_is_little_endian_with_its_header(types: RosTypes) -> None:
    made = messages_of(types, GroundSpeed(stamp=STAMP, speed=0.5, quality=0.1, rays=3, valid=True))
    cdr = types.encoded("geometry_msgs/msg/TwistWithCovarianceStamped", made["/fusion/out/twist"])
    assert cdr[:4] == b"\x00\x01\x00\x00"
    assert struct.unpack_from("<iI", cdr, 4) == divmod(STAMP, 10**9)
