"""ROS 2 over Zenoh: tokens, keys and attachments byte for byte; topics that a session hears; topics as a source."""

import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext

from caneflow.algorithms.rotations import Vector
from caneflow.bridges.frames import frames_of
from caneflow.bridges.rmw_zenoh import (
    LATCHED_QOS,
    PUBLISHER,
    STREAM_QOS,
    Participant,
    attachment,
    dds_type,
    gid_of,
    read_attachment,
)
from caneflow.bridges.ros_messages import RosMessages
from caneflow.bridges.ros_types import NO_HASH, RosTypes
from caneflow.messages import GroundSpeed, Imu, Pose, Sample
from caneflow.messages.control import FlowStatus
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Encoded, Quiet
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.neighbours import Foreign, Neighbour
from caneflow.runtime.hosts.links.session import open_session
from drivers.ros2 import Conversion, Heard, Pairing, Ros2Source, Ros2SourceSettings
from tests.flows import free_port, wait_for
from tools.ros2 import Ros2, Ros2Bridge, Ros2Settings

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install caneflow[ros2]")
pytest.importorskip("xxhash", reason="xxhash is not installed: pip install caneflow[ros2]")

START = 1_700_000_000_000_000_000  # ns
NODE = Participant(7, "f00d", "/left", "caneflow_cane")
IMU = "sensor_msgs/msg/Imu"
HASH = "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"  # as ROS Kilted's own .json has it


def test_keys_and_tokens_are_those_of_rmw_zenoh() -> None:
    assert dds_type(IMU) == "sensor_msgs::msg::dds_::Imu_"
    assert NODE.key("/imu/imu", IMU, HASH) == f"7/imu/imu/sensor_msgs::msg::dds_::Imu_/{HASH}"
    assert NODE.token() == "@ros2_lv/7/f00d/0/0/NN/%/%left/caneflow_cane"
    expected = f"@ros2_lv/7/f00d/0/3/MP/%/%left/caneflow_cane/%imu%imu/sensor_msgs::msg::dds_::Imu_/{HASH}/::,10:,:,:,,"
    assert NODE.entity_token(3, PUBLISHER, "/imu/imu", IMU, HASH, STREAM_QOS) == expected
    assert "/NN/%/%/" in Participant(0, "1", "", "n").token(), "Zenoh takes no empty part"


def test_type_hashes_are_published_ones_and_humble_has_none() -> None:
    assert RosTypes("jazzy").hash(IMU) == RosTypes("kilted").hash(IMU) == HASH
    assert RosTypes("humble").hash(IMU) == NO_HASH == "TypeHashNotSupported"


def test_an_attachment_is_what_zenoh_itself_would_write() -> None:
    gid = bytes(range(16))
    for number, sent in ((1, START), (2**40, 2**63 - 1), (0, 0)):
        ours = attachment(number, sent, gid)
        assert ours == struct.pack("<qqB", number, sent, 16) + gid
        assert len(ours) == 33
        fields = (zenoh.ext.Int64(number), zenoh.ext.Int64(sent), gid)
        assert ours == zenoh.ext.z_serialize(fields).to_bytes()
        assert read_attachment(ours) == (number, sent, gid)


@pytest.mark.parametrize("length", [0, 15, 17])
def test_a_malformed_attachment_cannot_be_made(length: int) -> None:
    with pytest.raises(ValueError, match="16 bytes"):
        attachment(1, START, bytes(length))


def test_attachments_of_the_first_jazzy_are_read_and_broken_ones_are_not() -> None:
    gid = bytes(range(16))
    fields = zenoh.ext.z_serialize(
        ("sequence_number", zenoh.ext.Int64(5), "source_timestamp", zenoh.ext.Int64(START), "source_gid", gid)
    ).to_bytes()
    assert len(fields) == 77
    assert read_attachment(fields) == (5, START, gid)
    whole = attachment(5, START, gid)
    for data in (b"", whole[:32], whole + b"\0", fields[:-1], fields + b"\0", whole[:16] + b"\x11" + gid):
        assert read_attachment(data) is None


def test_a_gid_is_the_hash_of_the_token_low_half_first() -> None:
    import xxhash

    token = NODE.token()
    high, low = struct.unpack(">QQ", xxhash.xxh3_128(token.encode()).digest())  # the digest is big-endian
    assert gid_of(token) == struct.pack("<QQ", low, high)


@pytest.fixture
def router() -> Iterator[str]:
    """The address of a router of Zenoh in this process."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_session(mode="router", listen=[endpoint], more={"timestamping/enabled": True}):
        yield endpoint


class Listener:
    """Someone in ROS's network who hears everything of domain 7."""

    def __init__(self, endpoint: str) -> None:
        self.session = open_session(mode="peer", connect=[endpoint])
        self.heard: dict[str, list[tuple[bytes, bytes]]] = {}

    def listen(self, topic: str) -> None:
        def take(sample: zenoh.Sample) -> None:
            attached = sample.attachment
            self.heard.setdefault(topic, []).append(
                (sample.payload.to_bytes(), b"" if attached is None else attached.to_bytes())
            )

        self.session.declare_subscriber(f"7{topic}/*/*", take)

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get("@ros2_lv/7/**", timeout=2.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


@pytest.fixture
def listener(router: str) -> Iterator[Listener]:
    made = Listener(router)
    yield made
    made.session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types


def pose(index: int) -> Pose:
    return Pose(
        stamp=START + index * 10_000_000, position=(2.0, 0.5, 0.1 * index), velocity=(0, 0, 0),
        orientation=(1, 0, 0, 0), method="best",
    )  # fmt: skip


def test_a_listener_gets_every_message_with_its_number_and_the_publishers_gid(router: str, listener: Listener) -> None:
    topics = ["/left/fusion/pose", "/left/fusion/pose/odom", "/left/tf"]
    for topic in topics:
        listener.listen(topic)
    settings = Ros2Settings(router=router, domain=7, namespace="/left", world="hall")
    with Ros2Bridge(settings, "cane", Rig(), {"fusion/pose": Pose}, waits=True) as bridge:
        for index in range(50):
            bridge.take("fusion", "pose", Pose, lambda index=index: pose(index))  # type: ignore[misc]
        wait_for(lambda: all(len(listener.heard.get(topic, ())) == 50 for topic in topics), "50 messages on each topic")
        tokens = listener.tokens()
    types = RosTypes()
    for topic in topics:
        (token,) = [each for each in tokens if f"/{topic.replace('/', '%')}/" in each]
        told = [read_attachment(attached) for _, attached in listener.heard[topic]]
        assert [each and each.number for each in told] == list(range(1, 51))
        assert {each and each.gid for each in told} == {gid_of(token)}
    odometry = [types.decoded("nav_msgs/msg/Odometry", cdr) for cdr, _ in listener.heard[topics[1]]]
    assert [each.header.stamp.nanosec for each in odometry] == [index * 10_000_000 for index in range(50)]
    assert {(each.header.frame_id, each.pose.pose.position.x) for each in odometry} == {("hall", 2.0)}
    (static,) = [each for each in tokens if "%tf_static" in each]
    assert static.endswith(f"/{LATCHED_QOS}")
    wait_for(lambda: not listener.tokens(), "the tokens have gone with the bridge")


def test_what_nobody_hears_is_not_even_decoded(
    router: str, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caneflow.runtime.hosts.links.neighbours.SETTLING", 0.0)
    decoded = []

    def decode(index: int) -> Sample:
        decoded.append(index)
        return pose(index)

    def take(index: int) -> bool:
        bridge.take("fusion", "pose", Pose, lambda: decode(index))
        return bool(decoded)

    with Ros2Bridge(Ros2Settings(router=router, domain=7), "cane", Rig(), {"fusion/pose": Pose}, waits=True) as bridge:
        assert not take(0)
        listener.listen("/fusion/pose")
        wait_for(lambda: take(1), "someone listens")
        assert set(decoded) == {1}


def test_a_node_publishes_what_is_wired_to_it(router: str, listener: Listener) -> None:
    listener.listen("/speed/out/twist")
    wires: dict[str, type[Sample]] = {"speed": GroundSpeed}
    context = Context(
        node="ros2", rig=Rig(), ports=wires, random=np.random.default_rng(1), keys={"speed": "cane/speed/out"},
        replay=True,
    )  # fmt: skip
    sink = Ros2(Ros2Settings(router=router, domain=7), context)
    try:
        speed = GroundSpeed(stamp=START, speed=0.5, quality=0.1, rays=3, valid=True)
        sink.take("cane/speed/out", speed, b"", START)
        wait_for(lambda: listener.heard.get("/speed/out/twist"), "the speed")
    finally:
        sink.finish()


def test_a_router_that_is_not_there_is_one_line() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(DataflowError, match=endpoint):
        Ros2Bridge(Ros2Settings(router=endpoint), "cane", Rig(), {}, waits=False)


def test_a_router_of_ours_is_for_this_machine_alone() -> None:
    with pytest.raises(DataflowError, match="open to other machines"):
        Neighbour(listen="tcp/0.0.0.0:7447")


@pytest.mark.parametrize(
    "wrong",
    [
        {"distro": "noetic"},
        {"namespace": "left"},
        {"namespace": "/left/"},
        {"world": "a b"},
        {"router": "tcp/127.0.0.1:1", "listen": "tcp/127.0.0.1:2"},
    ],
)
def test_settings_that_ros_does_not_know_are_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Ros2Settings(**wrong)  # type: ignore[arg-type]


def test_a_sample_waits_for_its_field_and_not_longer_than_told() -> None:
    pairing = Pairing(within=20)
    field: Callable[[int], Vector] = lambda value: (float(value), 0.0, 0.0)  # noqa: E731
    pairing.take(100, 1000, "first")
    assert list(pairing.due(1010)) == []
    pairing.take_field(95, field(1))
    assert list(pairing.due(1010)) == [], "a nearer one may still come"
    pairing.take_field(103, field(2))
    assert list(pairing.due(1010)) == [("first", field(2))]
    pairing.take(110, 1020, "second")
    pairing.take(200, 1025, "third")
    assert list(pairing.due(1039)) == []
    assert list(pairing.due(1040)) == [("second", field(2))]
    assert list(pairing.due(1045)) == [("third", None)], "the last field is 97 ns away"


def cdr(sample: Sample, kind: str, **changed: Any) -> Heard:
    """What a ROS node would send of `sample`, as it comes."""
    types = RosTypes()
    pictures = RosMessages(types, frames_of(Rig(boresight=(1, 0, 0))), tf="").pictures("n", "p", type(sample))
    message = next(each.make(sample) for each in pictures if each.kind == kind)
    for name, value in changed.items():
        setattr(message, name, value)
    return Heard(kind, types.encoded(kind, message), sample.stamp + 3)


def imu(stamp: int = START) -> Imu:
    return Imu(stamp=stamp, gyro=(0.1, 0.2, 0.3), accel=(1, 2, 3), mag=(10, 20, 30), orientation=(1, 0, 0, 0))


def test_a_phone_lies_in_the_body_as_its_mounting_says() -> None:
    conversion = Conversion(Ros2SourceSettings(imu="/imu", mag="/mag", mounting="-y+x+z"))
    field, sample = cdr(imu(), "sensor_msgs/msg/MagneticField"), cdr(imu(), IMU)
    assert list(conversion.taken(field)) == []
    ((port, made),) = conversion.taken(sample)
    assert (port, made.stamp) == ("imu", START)
    assert isinstance(made, Imu)
    assert made.gyro == pytest.approx((-0.2, 0.1, 0.3))
    assert made.accel == pytest.approx((-2, 1, 3))
    assert made.mag == pytest.approx((-20, 10, 30))
    # The phone is level and faces along x0: its -y is the body's x, so that one points along -y0.
    w, x, y, z = made.orientation or (0, 0, 0, 0)
    assert (w * w - z * z, 2 * w * z) == pytest.approx((0, -1))
    assert (x, y) == pytest.approx((0, 0))


def test_without_a_magnetometer_nothing_waits() -> None:
    conversion = Conversion(Ros2SourceSettings(imu="/imu"))
    ((_, made),) = conversion.taken(cdr(imu(), IMU))
    assert made == Imu(stamp=START, gyro=(0.1, 0.2, 0.3), accel=(1, 2, 3), orientation=(1, 0, 0, 0))


def test_poses_wait_until_it_is_known_where_the_imu_is() -> None:
    conversion = Conversion(Ros2SourceSettings(odometry="/odom"))
    heard = cdr(pose(1), "nav_msgs/msg/Odometry", child_frame_id="base_link")
    assert list(conversion.taken(heard)) == []
    (cause,) = conversion.refused
    assert cause == "/tf_static has not said how imu_link lies in base_link"
    types = RosTypes()
    fixed = RosMessages(types, frames_of(Rig(boresight=(1, 0, 0)))).static(START)
    tf = "tf2_msgs/msg/TFMessage"
    assert list(conversion.taken(Heard(tf, types.encoded(tf, fixed), START))) == []
    ((port, made),) = conversion.taken(heard)
    assert isinstance(made, Pose)
    assert (port, made.position, made.method) == ("pose", (2.0, 0.5, 0.1), "ros2")


def test_what_is_no_message_is_counted_and_nothing_more() -> None:
    conversion = Conversion(Ros2SourceSettings(imu="/imu"))
    for payload in (b"", b"\x00\x01\x00\x00", b"\xff" * 400, cdr(imu(), IMU).payload[:100]):
        assert list(conversion.taken(Heard(IMU, payload, START))) == []
    unset = cdr(Imu(stamp=0, gyro=(0, 0, 0)), IMU)
    assert list(conversion.taken(unset)) == []
    assert sum(conversion.refused.values()) == 5
    assert conversion.refused["it has no stamp"] == 1


def test_a_source_hears_a_topic_whatever_its_hash(router: str) -> None:
    settings = Ros2SourceSettings(router=router, domain=7, imu="/phone/imu")
    source = Ros2Source(settings, Context(node="imu", rig=Rig(), ports={"imu": Imu}, random=np.random.default_rng(1)))
    samples = source.samples()
    with Neighbour(router=router) as phone:
        outlet = phone.outlet(NODE.key("/phone/imu", IMU, NO_HASH))
        found: list[Sample | Encoded] = []
        end = time.monotonic() + 60
        while not found and time.monotonic() < end:
            outlet.put(cdr(imu(), IMU).payload, attachment(1, START, bytes(16)))  # nobody hears the first ones
            said = next(samples)
            if not isinstance(said, Quiet):
                found.append(said[1])
        samples.close()
    assert found == [Imu(stamp=START, gyro=(0.1, 0.2, 0.3), accel=(1, 2, 3), orientation=(1, 0, 0, 0))]


def test_a_neighbours_last_words_reach_those_that_come_later(router: str) -> None:
    heard: list[Foreign] = []
    with Neighbour(router=router) as early, Neighbour(router=router) as late:
        early.outlet("7/tf_static", kept=True).put(b"once", b"")
        late.hear("7/tf_static", heard.append, kept=True)
        wait_for(lambda: heard, "what was said before")
    assert heard[0].payload == b"once"


def test_status_is_told_when_somebody_hears_it(router: str, listener: Listener) -> None:
    listener.listen("/diagnostics")
    status = FlowStatus(
        flow="cane", version="1", host="here", pid=1, uptime=1.0, replay=False, clock=0, machine="", nodes=[], edges=[],
    )  # fmt: skip
    with Ros2Bridge(Ros2Settings(router=router, domain=7), "cane", Rig(), {}, waits=True) as bridge:
        bridge.tell_status(status)
        wait_for(lambda: listener.heard.get("/diagnostics"), "diagnostics")
