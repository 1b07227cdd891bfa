"""Our streams as channels of foxglove-sdk, for its server and for its files: the same conversion in both.

Each topic of `RosMessages` is a channel of CDR with `ros2msg`, which Foxglove, Lichtblick, PlotJuggler and Rerun all
read. What ROS has no message for is beside a pose in protobuf: `foxglove.Odometry` on `<topic>/foxglove`, and the
track so far, with the 2-sigma ellipse of its end, as `foxglove.SceneUpdate` on `<topic>/track`. Streams without a ROS
message are JSON, without their long arrays.
"""

import json
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from caneflow.algorithms.rotations import conjugate, rotate
from caneflow.bridges.errors import BridgeError
from caneflow.bridges.frames import IMU
from caneflow.bridges.ros_messages import (
    DIAGNOSTICS,
    DIAGNOSTICS_TYPE,
    TF_TYPE,
    RosMessages,
    motion_covariance,
    place_covariance,
)
from caneflow.errors import not_installed
from caneflow.messages import Grid, Pose, Sample, json_schema
from caneflow.messages.control import FlowStatus

MISSING = not_installed("foxglove-sdk", "foxglove")
MOST_ELEMENTS = 100  # of an array in JSON: the zones of a range sensor, the table of the nearest obstacles
TRACK_PERIOD = 1_000_000_000  # ns between two tracks: each is sent whole
TRACK_STEP = 0.05  # m between two points of a track
MOST_POINTS = 20_000  # of a track: 1 km of points; then every other one goes, and the step is doubled
TRACK_WIDTH = 0.03  # m


class Output(NamedTuple):
    """One channel that a stream fills."""

    topic: str
    channel: Any
    encode: Callable[[Any], bytes | None]  # a sample as the channel's bytes; None: nothing of this one


class FoxgloveChannels:
    """The channels of one server or file; `context` is the one that it was opened with."""

    def __init__(self, context: Any, messages: RosMessages) -> None:
        self._context = context
        self._ros = messages
        self._streams: dict[str, list[Output]] = {}  # by node/port
        self._static = self._cdr(messages.static_topic, TF_TYPE)
        self._diagnostics: Any = None
        self._last: dict[int, tuple[bytes, int]] = {}  # by the id of a channel that lasts: its message and log time

    def declare(self, node: str, port: str, kind: type[Sample] | None) -> list[Output]:
        """Make the channels of a stream, so that clients see them before its first sample."""
        name = f"{node}/{port}"
        if name not in self._streams:
            if kind is None:
                return []
            self._streams[name] = self._outputs(node, port, kind)
        return self._streams[name]

    def is_heard(self, node: str, port: str, kind: type[Sample] | None) -> bool:
        """Whether a channel of the stream is subscribed to."""
        return any(output.channel.has_sinks() for output in self.declare(node, port, kind))

    def take(self, node: str, port: str, sample: Sample) -> list[str]:
        """Log what the sample becomes on the channels that are subscribed to; on which topics that was."""
        topics = []
        for topic, channel, encode in self.declare(node, port, type(sample)):
            if channel.has_sinks() and (data := encode(sample)) is not None:
                channel.log(data, log_time=sample.stamp)
                topics.append(topic)
        return topics

    def take_unknown(self, node: str, port: str, schema: str, payload: bytes) -> None:
        """Log a sample of a message whose class is not known here: the fields that its bytes hold, as JSON."""
        name = f"{node}/{port}"
        if name not in self._streams:
            kind = sdk().Schema(name=schema or "unknown", encoding="jsonschema", data=b'{"type": "object"}')
            channel = sdk().Channel(f"/{name}", message_encoding="json", schema=kind, context=self._context)
            self._streams[name] = [Output(f"/{name}", channel, json_of)]
        for _, channel, encode in self._streams[name]:
            if channel.has_sinks() and (data := encode(payload)) is not None:
                channel.log(data, log_time=json.loads(data).get("stamp"))

    def tell_rig(self, stamp: int) -> None:
        """Log what is bolted on (/tf_static), at `stamp` (ns)."""
        data = self._ros.types.encoded(TF_TYPE, self._ros.static(stamp))
        self._last[self._static.id()] = data, stamp
        self._static.log(data, log_time=stamp)

    def tell_status(self, status: FlowStatus, stamp: int) -> None:
        """Log how nodes and wires are (/diagnostics), at `stamp` (ns)."""
        if self._diagnostics is None:
            self._diagnostics = self._cdr(DIAGNOSTICS, DIAGNOSTICS_TYPE)
        if self._diagnostics.has_sinks():
            message = self._ros.diagnostics(status, stamp)
            self._diagnostics.log(self._ros.types.encoded(DIAGNOSTICS_TYPE, message), log_time=stamp)

    def say_again(self, channel: int) -> None:
        """Send the last message of a channel that lasts once more, for a client that came after it.

        To all that listen: the server's clients are numbered apart from what a channel can be told to write to.
        """
        if channel in self._last:
            data, stamp = self._last[channel]
            self._static.log(data, log_time=stamp)

    def _outputs(self, node: str, port: str, kind: type[Sample]) -> list[Output]:
        pictures = self._ros.pictures(node, port, kind)
        if not pictures:
            return [self._numbers(f"/{node}/{port}", kind)]
        outputs = [Output(topic, self._cdr(topic, cdr), self._as_cdr(cdr, make)) for topic, cdr, make in pictures]
        if kind is Pose:
            outputs += self._scenes(pictures[0].topic, node)
        if kind is Grid:
            outputs.append(self._grids(pictures[0].topic))
        return outputs

    def _cdr(self, topic: str, kind: str) -> Any:
        foxglove = sdk()
        text = self._ros.types.definition(kind)
        schema = foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
        return foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=self._context)

    def _as_cdr(self, kind: str, make: Callable[[Any], Any]) -> Callable[[Any], bytes | None]:
        encoded = self._ros.types.encoder(kind)

        def encode(sample: Any) -> bytes | None:
            message = make(sample)
            return None if message is None else encoded(message)

        return encode

    def _scenes(self, topic: str, node: str) -> list[Output]:
        """Of a pose: what Foxglove has beyond ROS."""
        from foxglove import messages

        world = self._ros.frames.world
        track = _Track(world, node)
        return [
            self._protobuf(f"{topic}/foxglove", messages.Odometry, lambda pose: _odometry(pose, world)),
            self._protobuf(f"{topic}/track", messages.SceneUpdate, track.take),
        ]

    def _grids(self, topic: str) -> Output:
        """Of a grid: all its slices, which ROS has no message for."""
        from foxglove import messages

        world = self._ros.frames.world
        return self._protobuf(f"{topic}/foxglove", messages.Grid, lambda grid: _grid(grid, world))

    def _protobuf(self, topic: str, kind: Any, encode: Callable[[Any], bytes | None]) -> Output:
        schema = kind.get_schema()
        channel = sdk().Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
        return Output(topic, channel, encode)

    def _numbers(self, topic: str, kind: type[Sample]) -> Output:
        foxglove = sdk()
        schema = foxglove.Schema(name=kind.schema, encoding="jsonschema", data=json.dumps(json_schema(kind)).encode())
        channel = foxglove.Channel(topic, message_encoding="json", schema=schema, context=self._context)
        return Output(topic, channel, lambda sample: json.dumps(numbers_of(sample)).encode())


def sdk() -> Any:
    """The library; raises BridgeError where it is not installed."""
    try:
        import foxglove
    except ImportError as error:
        raise BridgeError(MISSING) from error
    return foxglove


def numbers_of(message: Sample) -> dict[str, Any]:
    """The fields of `message` as JSON has them: long arrays, complex ones and infinite values are left out."""
    values = {name: getattr(message, name) for name in message.__struct_fields__}
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else msgspec.to_builtins(value)
        for name, value in values.items()
        if not (value is None or _is_too_much(value) or (isinstance(value, float) and math.isinf(value)))
    }


def _is_too_much(value: object) -> bool:
    return isinstance(value, np.ndarray) and (value.size > MOST_ELEMENTS or value.dtype.kind == "c")


def json_of(payload: bytes) -> bytes | None:
    """The plain fields of a msgpack map as JSON; None: it is not a map."""
    try:
        fields = msgspec.msgpack.decode(payload)
        plain = {name: value for name, value in fields.items() if not isinstance(value, msgspec.msgpack.Ext | bytes)}
        return msgspec.json.encode(plain)
    except (msgspec.MsgspecError, AttributeError, ValueError, TypeError):
        return None


def _odometry(pose: Pose, world: str) -> bytes:
    """`foxglove.Odometry` of the body, whose velocity and covariance stay those of the sample, in the body's axes."""
    from foxglove import messages

    (x, y, z), (w, *turn) = pose.position, pose.orientation
    back = conjugate(pose.orientation)
    a, b, c = rotate(back, pose.velocity)
    covariances = {}
    if pose.covariance is not None:
        covariances = {
            "pose_covariance": place_covariance(pose).tolist(),
            "velocity_covariance": motion_covariance(pose, back).tolist(),
        }
    said = {"method": pose.method, **({"status": pose.status} if pose.status else {})}
    return messages.Odometry(
        timestamp=messages.Timestamp(*divmod(pose.stamp, 10**9)),
        frame_id=world,
        body_frame_id=IMU,
        pose=messages.Pose(
            position=messages.Vector3(x=x, y=y, z=z),
            orientation=messages.Quaternion(x=turn[0], y=turn[1], z=turn[2], w=w),
        ),
        linear_velocity=messages.Vector3(x=a, y=b, z=c),
        metadata=[messages.KeyValuePair(key=key, value=value) for key, value in said.items()],
        **covariances,
    ).encode()


def _grid(grid: Grid, world: str) -> bytes:
    """`foxglove.Grid` with a field per slice, named by its heights: 128 + log-odds, as the sample has them."""
    from foxglove import messages

    slices, columns, _ = grid.occupancy.shape
    heights = [f"{grid.bottom + index * grid.slice:.2f} m and up" for index in range(slices)]
    numeric = messages.PackedElementFieldNumericType.Uint8
    x, y = (float(grid.cell * index) for index in grid.origin)
    return messages.Grid(
        timestamp=messages.Timestamp(*divmod(grid.stamp, 10**9)),
        frame_id=world,
        pose=messages.Pose(
            position=messages.Vector3(x=x, y=y, z=0.0), orientation=messages.Quaternion(x=0, y=0, z=0, w=1)
        ),
        column_count=columns,
        cell_size=messages.Vector2(x=grid.cell, y=grid.cell),
        row_stride=slices * columns,
        cell_stride=slices,
        fields=[
            messages.PackedElementField(name=name, offset=index, type=numeric) for index, name in enumerate(heights)
        ],
        data=np.ascontiguousarray(grid.occupancy.transpose(2, 1, 0)).tobytes(),
    ).encode()


class _Track:
    """The way of one stream of poses so far, and how unsure its end is."""

    def __init__(self, world: str, node: str) -> None:
        self._world = world
        self._node = node
        self._begin()

    def _begin(self) -> None:
        self._points: list[tuple[float, float, float]] = []
        self._step = TRACK_STEP
        self._next_ns = 0
        self._last_ns = -1

    def take(self, pose: Pose) -> bytes | None:
        """`foxglove.SceneUpdate` with the whole track, once a second; begins again when time goes back."""
        if pose.stamp <= self._last_ns:
            self._begin()
        self._last_ns = pose.stamp
        if not self._points or math.dist(pose.position, self._points[-1]) >= self._step:
            self._points.append(pose.position)
        if len(self._points) > MOST_POINTS:
            self._points, self._step = self._points[::2], 2 * self._step
        if pose.stamp < self._next_ns:
            return None
        self._next_ns = pose.stamp + TRACK_PERIOD
        return self._scene(pose)

    def _scene(self, pose: Pose) -> bytes:
        from foxglove import messages

        colour = messages.Color(r=0.1, g=0.5, b=0.9, a=1.0)
        line = messages.LinePrimitive(
            thickness=TRACK_WIDTH,
            points=[messages.Point3(x=x, y=y, z=z) for x, y, z in self._points],
            color=colour,
        )
        lines = [line]
        if pose.covariance is not None:
            ring = [messages.Point3(x=x, y=y, z=pose.position[2]) for x, y in ellipse(pose)]
            lines.append(
                messages.LinePrimitive(
                    type=messages.LinePrimitiveLineType.LineLoop, thickness=TRACK_WIDTH / 2, points=ring, color=colour
                )
            )
        entity = messages.SceneEntity(
            timestamp=messages.Timestamp(*divmod(pose.stamp, 10**9)),
            frame_id=self._world,
            id=f"track of {self._node}",
            lines=lines,
        )
        return messages.SceneUpdate(entities=[entity]).encode()


def ellipse(pose: Pose, points: int = 36) -> list[tuple[float, float]]:
    """Where x, y (m) is 2 standard deviations from the pose's position, by its covariance."""
    assert pose.covariance is not None
    values, vectors = np.linalg.eigh(pose.covariance[:2, :2])
    angle = np.linspace(0, 2 * math.pi, points, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ring = (vectors * (2 * np.sqrt(np.maximum(values, 0)))) @ circle
    return [(pose.position[0] + x, pose.position[1] + y) for x, y in ring.T.tolist()]
