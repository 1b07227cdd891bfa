"""Foxglove's server, heard by a client that knows the protocol only; recordings played against a clock; parameters."""

import contextlib
import json
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, DopplerTarget, GroundSpeed, Imu, Pose, Sample, encode, numbered
from caneflow.messages.control import FlowStatus, NodeStatus
from caneflow.messages.rig import Rig
from caneflow.recording import Recording, RecordingWriter
from caneflow.recording.playback import FASTEST, Playback, PlaybackState
from caneflow.runtime import Context
from caneflow.runtime.hosts.attached.flow_events import Came
from tests.flows import wait_for
from tools.foxglove import Foxglove, FoxgloveServer, FoxgloveSettings, Naming, flat

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: pip install caneflow[foxglove]")
client_library = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
closed = pytest.importorskip("websockets.exceptions").ConnectionClosed
typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed: pip install caneflow[foxglove]")

START = 1_700_000_000_000_000_000  # ns
STEP = 10_000_000  # ns
NAMING = Naming(None, None)
PLAY, PAUSE = 0, 1
KINDS: dict[str, type[Sample] | None] = {"imu/imu": Imu, "fusion/pose": Pose, "doppler/target": DopplerTarget}


class Client:
    """A viewer: reads on a thread of its own, and subscribes to what it is told to."""

    def __init__(self, address: str) -> None:
        self._open = contextlib.ExitStack()
        connection = client_library.connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None)
        self.socket = self._open.enter_context(connection)
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.heard: dict[str, list[tuple[int, bytes]]] = {}
        self.parameters: list[dict[str, Any]] = []
        self.states: list[tuple[int, int, float]] = []
        self.times: list[int] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._open.close()
        self._thread.join()

    def subscribe(self, *topics: str) -> None:
        wait_for(lambda: set(topics) <= self.channels.keys(), f"channels {topics}; there are {list(self.channels)}")
        ids = [self.channels[topic]["id"] for topic in topics]
        self.say({"op": "subscribe", "subscriptions": [{"id": each, "channelId": each} for each in ids]})

    def say(self, words: dict[str, Any]) -> None:
        self.socket.send(json.dumps(words))

    def control(self, command: int, speed: float = 1.0, at: int | None = None) -> None:
        self.socket.send(struct.pack("<BBfBQI", 3, command, speed, at is not None, at or 0, 4) + b"mine")

    def messages(self, topic: str) -> list[Any]:
        """Decoded by the schema that the server gives for it."""
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return [json.loads(data) for _, data in self.heard.get(topic, [])]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        store.register(typesys.get_types_from_msg(channel["schema"], channel["schemaName"]))
        return [store.deserialize_cdr(data, channel["schemaName"]) for _, data in self.heard.get(topic, [])]

    def _read(self) -> None:
        with contextlib.suppress(ConnectionError, closed):
            for message in self.socket:
                if isinstance(message, str):
                    self._take_words(json.loads(message))
                else:
                    self._take_bytes(message)

    def _take_bytes(self, message: bytes) -> None:
        if message[0] == 1:
            channel, stamp = struct.unpack_from("<IQ", message, 1)
            (topic,) = [name for name, each in self.channels.items() if each["id"] == channel]
            self.heard.setdefault(topic, []).append((stamp, message[13:]))
        elif message[0] == 2:
            self.times.append(struct.unpack_from("<Q", message, 1)[0])
        elif message[0] == 5:
            self.states.append(struct.unpack_from("<BQf", message, 1))

    def _take_words(self, words: dict[str, Any]) -> None:
        if words["op"] == "serverInfo":
            self.info = words
        elif words["op"] == "advertise":
            self.channels |= {each["topic"]: each for each in words["channels"]}
        elif words["op"] == "parameterValues":
            self.parameters += words["parameters"]


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with FoxgloveServer("cane", Rig(), KINDS, 0, NAMING) as made:
        yield made


@pytest.fixture
def client(server: FoxgloveServer) -> Iterator[Client]:
    made = Client(server.address)
    yield made
    made.close()


def came(node: str, port: str, sample: Sample, seq: int = 0) -> Came:
    return Came(node, port, type(sample), sample.schema, numbered(sample, seq), sample.stamp + 5)


def pose(index: int = 0) -> Pose:
    return Pose(
        stamp=START + index * STEP, position=(2.0, 0.5, 0.0), velocity=(0, 0, 0), orientation=(1, 0, 0, 0),
        method="best",
    )  # fmt: skip


def test_a_viewer_sees_every_topic_at_once_and_gets_what_it_subscribes_to(
    server: FoxgloveServer, client: Client
) -> None:
    wait_for(lambda: client.info, "serverInfo")
    assert (client.info["name"], "parameters" in client.info["capabilities"]) == ("cane", True)
    client.subscribe("/fusion/pose/odom", "/doppler/target")
    assert {"/imu/imu", "/imu/imu/mag", "/fusion/pose", "/tf", "/tf_static"} <= client.channels.keys()
    target = DopplerTarget(stamp=START, range_rate=0.25, signed=True, amplitude=0.1, snr=20.0, valid=True)

    def arrived() -> bool:
        server.take(came("doppler", "target", target))  # until the subscription has reached the server
        return bool(client.heard.get("/doppler/target"))

    wait_for(arrived, "a target")
    for index in range(30):
        server.take(came("fusion", "pose", pose(index), index))
    wait_for(lambda: len(client.heard.get("/fusion/pose/odom", ())) == 30, "30 poses")
    assert [stamp for stamp, _ in client.heard["/fusion/pose/odom"]] == [START + index * STEP for index in range(30)]
    odometry = client.messages("/fusion/pose/odom")[0]
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (2.0, 0.5)
    assert client.messages("/doppler/target")[0]["range_rate"] == 0.25
    assert client.heard.keys() == {"/fusion/pose/odom", "/doppler/target"}, "only what was asked for"


def test_what_nobody_shows_is_not_decoded(server: FoxgloveServer) -> None:
    server.take(Came("imu", "imu", Imu, Imu.schema, b"not msgpack", START))  # would be refused, if it were looked at


def test_what_lasts_is_said_again_to_those_that_come_later(server: FoxgloveServer) -> None:
    server.tell_rig(START)
    for _ in range(2):
        late = Client(server.address)
        try:
            late.subscribe("/tf_static")
            wait_for(lambda late=late: late.heard.get("/tf_static"), "/tf_static")  # type: ignore[misc]
            (message,) = late.messages("/tf_static")
            assert [each.child_frame_id for each in message.transforms] == ["imu_link", "radar_link"]
        finally:
            late.close()


def test_settings_can_be_read_and_not_set(server: FoxgloveServer, client: Client) -> None:
    node = NodeStatus(
        node="fusion", program="operators.fusion", state="ready", pid=7, restarts=0, uptime=1.0, cpu=None, memory=None,
        sent={}, rates={}, counted=None, said="", settings={"method": "best", "luenberger": {"poles": [0.5, 2]}},
    )  # fmt: skip
    status = FlowStatus(
        flow="cane", version="1", host="here", pid=1, uptime=1.0, replay=False, clock=0, machine="", nodes=[node],
        edges=[], rig={"hand_height": 0.9},
    )  # fmt: skip
    server.tell_status(status)
    client.say({"op": "getParameters", "parameterNames": [], "id": "all"})
    wait_for(lambda: len(client.parameters) == 3, "three parameters")
    values = {each["name"]: each["value"] for each in client.parameters}
    assert values == {"fusion.method": "best", "fusion.luenberger.poles": [0.5, 2], "rig.hand_height": 0.9}
    client.parameters.clear()
    client.say({"op": "setParameters", "parameters": [{"name": "fusion.method", "value": "naive"}], "id": "set"})
    client.say({"op": "getParameters", "parameterNames": ["fusion.method"], "id": "again"})
    wait_for(lambda: client.parameters, "the answer")
    assert {each["value"] for each in client.parameters} == {"best"}


def test_settings_of_any_shape_have_a_name_and_a_value() -> None:
    values = {"a": {"b": {"c": True}}, "list": [1, 2.5], "empty": [], "none": None, "words": ["x", "y"], "n": 3}
    assert flat(values) == {"a.b.c": True, "list": [1.0, 2.5], "words": "['x', 'y']", "n": 3}


def test_a_message_that_is_not_known_shows_its_plain_fields(server: FoxgloveServer, client: Client) -> None:
    block = DopplerBlock(stamp=START, samples=np.zeros(4, np.float32), sample_rate=1000.0, carrier=24e9)
    unknown = Came("mine", "block", None, "mine.Block/1", encode(block), START)
    server.take(unknown)
    client.subscribe("/mine/block")

    def arrived() -> bool:
        server.take(unknown)
        return bool(client.heard.get("/mine/block"))

    wait_for(arrived, "a message")
    server.take(unknown._replace(payload=b"\xc1"))
    message = client.messages("/mine/block")[0]
    assert {key: message[key] for key in ("stamp", "sample_rate", "carrier")} == {
        "stamp": START, "sample_rate": 1000.0, "carrier": 24e9,
    }  # fmt: skip
    assert "samples" not in message
    assert client.heard["/mine/block"][0][0] == START
    assert client.channels["/mine/block"]["schemaName"] == "mine.Block/1"


def test_a_port_that_is_taken_is_one_line(server: FoxgloveServer) -> None:
    with pytest.raises(CaneflowError, match=f"127.0.0.1:{server.port}: cannot be served on"):
        FoxgloveServer("other", Rig(), {}, server.port, NAMING)


def test_a_node_serves_what_is_wired_to_it() -> None:
    wires: dict[str, type[Sample]] = {"speed": GroundSpeed}
    context = Context(
        node="foxglove", rig=Rig(), ports=wires, random=np.random.default_rng(1), keys={"speed": "cane/speed/out"}
    )
    sink = Foxglove(FoxgloveSettings(port=0), context)
    client = Client(sink._server.address)
    try:
        client.subscribe("/speed/out/twist")
        speed = GroundSpeed(stamp=START, speed=0.5, quality=0.1, rays=3, valid=True)

        def arrived() -> bool:
            sink.take("cane/speed/out", speed, b"", START)
            return bool(client.heard.get("/speed/out/twist"))

        wait_for(arrived, "a speed")
    finally:
        client.close()
        sink.finish()


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    """1 s of an IMU at 100 Hz."""
    path = tmp_path / "walk.mcap"
    with RecordingWriter(path, flow="cane", source="live", rig={"hand_height": 0.9}) as writer:
        for seq in range(100):
            imu = Imu(stamp=START + seq * STEP, gyro=(float(seq), 0, 0))
            writer.write("cane/imu/imu", Imu, numbered(imu, seq), stamp=imu.stamp, seq=seq, log_time=imu.stamp)
    with Recording(path) as source:
        yield source


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_playback_keeps_its_place_through_pauses_speeds_and_jumps(recording: Recording) -> None:
    clock = Clock()
    playback = Playback(recording, lambda _: None, lambda _: None, clock)
    last = START + 99 * STEP

    def at() -> float:
        return (playback.state().at - START) / STEP

    assert playback.span == (START, last)
    clock.now += 5
    assert at() == 0, "it does not begin by itself"
    playback.control(playing=True, speed=2.0)
    clock.now += 0.1
    assert at() == pytest.approx(20)
    playback.control(playing=True, speed=0.5)
    clock.now += 0.1
    assert at() == pytest.approx(25)
    playback.control(playing=False, speed=0.5)
    clock.now += 5
    assert at() == pytest.approx(25)
    assert playback.control(playing=False, speed=1.0, at=START + 70 * STEP).at == START + 70 * STEP
    assert playback.control(playing=True, speed=1.0, at=0).at == START, "not before its beginning"
    clock.now += 60
    assert playback.state().at == last, "nor beyond its end"
    assert playback.control(playing=True, speed=float("nan")).speed == 1.0
    assert playback.control(playing=True, speed=1e9).speed == FASTEST


def test_a_recording_is_played_whole_then_from_where_a_viewer_jumps_to(recording: Recording) -> None:
    taken: list[int] = []
    ends: list[PlaybackState] = []
    playback = Playback(recording, lambda sample: taken.append(sample.seq), lambda state: ends.append(state))
    reader = threading.Thread(target=playback.run)
    playback.control(playing=True, speed=FASTEST)
    reader.start()
    try:
        wait_for(lambda: any(state.ended for state in ends), "the end")
        assert taken == list(range(100))
        assert ends[-1].at == START + 99 * STEP
        taken.clear()
        playback.control(playing=True, speed=FASTEST, at=START + 90 * STEP)
        wait_for(lambda: len(taken) == 10, "the last ten")
        taken.clear()
        wait_for(lambda: playback.state().ended, "the end again")
        playback.control(playing=True, speed=FASTEST)
        wait_for(lambda: len(taken) == 100, "all of it again: who plays at the end begins again")
    finally:
        playback.close()
        reader.join()


def test_a_viewer_drives_a_recording(recording: Recording) -> None:
    server: FoxgloveServer
    playback = Playback(
        recording, lambda sample: server.take_recorded(sample), lambda state: server.tell_playback(state)
    )
    with FoxgloveServer("walk", Rig(), {"imu/imu": Imu}, 0, NAMING, playback) as server:
        reader = threading.Thread(target=playback.run)
        reader.start()
        client = Client(server.address)
        try:
            wait_for(lambda: client.info, "serverInfo")
            ends = [client.info[name] for name in ("dataStartTime", "dataEndTime")]
            assert [each["sec"] * 10**9 + each["nsec"] for each in ends] == [START, START + 99 * STEP]
            client.subscribe("/imu/imu")
            server.tell_settings({}, recording.rig)
            client.say({"op": "getParameters", "parameterNames": [], "id": "all"})  # answered after the subscription
            wait_for(lambda: client.parameters, "the rig")
            assert "/imu/imu" not in client.heard, "nothing comes before it is played"
            client.control(PLAY, speed=FASTEST, at=START + 50 * STEP)
            wait_for(lambda: len(client.heard.get("/imu/imu", ())) == 50, "the second half")
            assert client.messages("/imu/imu")[0].angular_velocity.x == 50
            wait_for(lambda: any(status == 3 for status, *_ in client.states), "that it has ended")
            client.control(PAUSE)
            wait_for(lambda: len(client.states) >= 3, "an answer to each request, and the end")
            assert client.states[0][:2] == (0, START + 50 * STEP)
            assert client.times[-1] == START + 99 * STEP
        finally:
            client.close()
            playback.close()
            reader.join()


def test_json_of_a_map_leaves_bytes_out() -> None:
    from caneflow.bridges.foxglove_channels import json_of

    packed = msgspec.msgpack.encode({"a": 1, "b": b"\0", "c": [1.5]})
    assert json.loads(json_of(packed) or b"") == {"a": 1, "c": [1.5]}
    assert json_of(b"\x01") is None
