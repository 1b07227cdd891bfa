"""ROS 2 topics over Zenoh as a source: an IMU, such as a phone's, and an odometry, such as a motion capture's.

out  imu  : Imu   one per sensor_msgs/Imu on `imu`, with the magnetic field that was measured nearest to it
out  pose : Pose  one per nav_msgs/Odometry on `odometry`, for the origin of the IMU

Stamps are those of the headers, on the clock of the machine that published. ROS itself is not needed.
"""

import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Milliseconds, Time
from caneflow.algorithms.rotations import IDENTITY, Quaternion, Vector
from caneflow.bridges import ros_messages
from caneflow.bridges.errors import BridgeError
from caneflow.bridges.frames import IMU, quaternion_of
from caneflow.bridges.rmw_zenoh import LATCHED_QOS, MOST_DOMAINS, ROUTER, STREAM_QOS, SUBSCRIPTION, Participant
from caneflow.bridges.ros_messages import IMU_TYPE, MAG_TYPE, ODOMETRY_TYPE, TF_STATIC, TF_TYPE
from caneflow.bridges.ros_samples import FixedFrames, field_of, imu_of, pose_of, stamp_of
from caneflow.bridges.ros_types import DEFAULT_DISTRO, DISTROS, RosTypes
from caneflow.messages import Imu, Pose, Sample
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mounting import mounting
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.neighbours import Foreign, Neighbour
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

ANY_HASH = "*"  # in a key: Humble has none, later releases have one per type
RETRY = 0.5  # s between two attempts to reach the router
SILENCE = 0.5  # s without a message after which is said that nothing comes
MARGIN = 1_000_000_000  # ns that a message may be slower than the slowest so far
MOST_FIELDS = 200  # that are remembered: 2 s at 100 Hz
MOST_WAITING = 5000  # messages; what comes beyond is dropped here


@dataclass(frozen=True, kw_only=True)
class Ros2SourceSettings:
    """Where ROS is, and which of its topics are taken."""

    __pydantic_config__ = {"extra": "forbid"}

    router: str | None = None  # an endpoint of Zenoh; without it and listen: where rmw_zenohd listens on this machine
    listen: str | None = None  # be the router, at this endpoint of this machine
    domain: Annotated[int, Ge(0), Le(MOST_DOMAINS)] = 0  # ROS_DOMAIN_ID
    distro: str = DEFAULT_DISTRO  # whose types are spoken
    imu: str | None = None  # topic of sensor_msgs/Imu
    mag: str | None = None  # topic of sensor_msgs/MagneticField, in the axes of the IMU
    odometry: str | None = None  # topic of nav_msgs/Odometry
    mounting: str = "+x+y+z"  # the axes of their IMU that are the body's x, y, z
    body: str = IMU  # the frame that poses are of: /tf_static says where it is in the odometry's child frame
    pair_within_ms: Milliseconds = 20.0  # ms between a sample and its magnetic field, and that is waited for it
    start_timeout_s: Time = 10.0  # s to reach the router

    def __post_init__(self) -> None:
        if self.imu is None and self.odometry is None:
            raise ValueError("imu and odometry: expected at least one topic, e.g. imu: /imu/data")
        if self.mag is not None and self.imu is None:
            raise ValueError("mag: belongs to the samples of imu, which has no topic")
        if self.router is not None and self.listen is not None:
            raise ValueError("router and listen: expected one of them; with listen this is the router")
        if self.distro not in DISTROS:
            raise ValueError(f"distro is {self.distro!r}; expected one of {', '.join(DISTROS)}")
        for topic in filter(None, (self.imu, self.mag, self.odometry)):
            if not topic.startswith("/") or topic.endswith("/") or set("*$?#") & set(topic) or "//" in topic:
                raise ValueError(f"{topic!r}: not a topic; expected e.g. /imu/data")
        try:
            mounting(self.mounting)
        except ProtocolError as error:
            raise ValueError(f"mounting: {error}") from error


class Heard(NamedTuple):
    """A message as it came."""

    kind: str
    payload: bytes
    arrival: int  # ns


class Pairing:
    """The samples of an IMU, each with the magnetic field that was measured nearest to it: the two topics race."""

    def __init__(self, within: int) -> None:
        """`within`: ns between the two, and that a sample waits for its field."""
        self._within = within
        self._fields: deque[tuple[int, Vector]] = deque(maxlen=MOST_FIELDS)
        self._waiting: deque[tuple[int, int, Any]] = deque()  # stamp, arrival, message

    @property
    def is_waiting(self) -> bool:
        """Whether a message waits."""
        return bool(self._waiting)

    def take_field(self, stamp: int, field: Vector) -> None:
        """Remember a field (uT) that was measured at `stamp` (ns)."""
        self._fields.append((stamp, field))

    def take(self, stamp: int, arrival: int, message: Any) -> None:
        """Let a message of the IMU wait for its field; `arrival` in ns."""
        self._waiting.append((stamp, arrival, message))

    def due(self, now: int) -> Iterator[tuple[Any, Vector | None]]:
        """Messages whose field has come, or will not come any more, in the order in which they came."""
        while self._waiting:
            stamp, arrival, message = self._waiting[0]
            later = any(at >= stamp for at, _ in self._fields)
            if not later and now - arrival < self._within:
                return
            self._waiting.popleft()
            yield message, self._nearest(stamp)

    def _nearest(self, stamp: int) -> Vector | None:
        at, field = min(self._fields, key=lambda each: abs(each[0] - stamp), default=(None, None))
        return field if at is not None and abs(at - stamp) <= self._within else None


class Conversion:
    """Messages of ROS into samples; counts by cause what cannot be one."""

    def __init__(self, settings: Ros2SourceSettings) -> None:
        self._settings = settings
        self._types = RosTypes(settings.distro)
        self._turn = _turn(settings.mounting)
        self._pairing = Pairing(round(1e6 * settings.pair_within_ms))
        self._fixed = FixedFrames()
        self.refused: dict[str, int] = {}
        self.slowest: int | None = None  # ns from a stamp to the arrival, at most so far

    def taken(self, heard: Heard) -> Iterator[tuple[str, Sample]]:
        """The samples that follow from one message."""
        try:
            message = self._types.decoded(heard.kind, heard.payload)
            match heard.kind:
                case ros_messages.TF_TYPE:
                    self._fixed.take(message)
                case ros_messages.MAG_TYPE:
                    if (field := field_of(message)) is not None:
                        self._pairing.take_field(stamp_of(message), field)
                case ros_messages.IMU_TYPE:
                    self._note(self._stamp(message), heard.arrival)
                    self._pairing.take(stamp_of(message), heard.arrival, message)
                case _:
                    self._note(self._stamp(message), heard.arrival)
                    yield "pose", self._pose(message)
        except (BridgeError, ValueError) as error:
            self._refuse(str(error))
        yield from self.due(heard.arrival)

    @property
    def is_waiting(self) -> bool:
        """Whether a sample of the IMU waits for its field."""
        return self._pairing.is_waiting

    def due(self, now: int) -> Iterator[tuple[str, Imu]]:
        """Samples of the IMU that have waited for their field long enough, at `now` (ns)."""
        for message, mag in self._pairing.due(now if self._settings.mag else now + 2**62):
            try:
                yield "imu", imu_of(message, mag=mag, turn=self._turn)
            except ValueError as error:
                self._refuse(str(error))

    def _pose(self, message: Any) -> Pose:
        child, body = str(message.child_frame_id).removeprefix("/"), self._settings.body
        if child == body:
            return pose_of(message)
        there = self._fixed.between(child, body)
        if there is None:
            raise ValueError(f"{TF_STATIC} has not said how {body} lies in {child}")
        return pose_of(message, there)

    def _stamp(self, message: Any) -> int:
        stamp = stamp_of(message)
        if stamp == 0:
            raise ValueError("it has no stamp")
        return stamp

    def _note(self, stamp: int, arrival: int) -> None:
        if self.slowest is None:
            log.info(
                "the first message came %.3f s after its stamp: delay, and what their clock is behind",
                (arrival - stamp) / 1e9,
            )
        self.slowest = max(arrival - stamp, self.slowest or arrival - stamp)

    def _refuse(self, cause: str) -> None:
        if cause not in self.refused:
            log.warning("a message is left out, as are others like it: %s", cause)
        self.refused[cause] = self.refused.get(cause, 0) + 1


class Ros2Source(Source):
    """Hears topics of ROS 2 as one of its nodes."""

    outputs = {"imu": Imu, "pose": Pose}
    Settings = Ros2SourceSettings

    def __init__(self, settings: Ros2SourceSettings, context: Context) -> None:
        self._settings = settings
        self._name = f"caneflow_{context.node}"
        self._conversion = Conversion(settings)
        self._inbox: queue.Queue[Heard] = queue.Queue(MOST_WAITING)
        self._dropped = 0
        self._last = 0  # ns: the newest stamp that was sent, or until when nothing was promised

    def samples(self) -> Brought:
        """Samples as their messages come, until the flow ends."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        while (neighbour := self._joined(give_up)) is None:
            yield self._quiet()
            time.sleep(RETRY)
        with neighbour:
            self._listen(neighbour)
            try:
                while True:
                    yield from self._next()
            finally:
                self._report()

    def _joined(self, give_up: float) -> Neighbour | None:
        settings = self._settings
        router = settings.router or (None if settings.listen else ROUTER)
        try:
            return Neighbour(router=router, listen=settings.listen)
        except DataflowError:
            if time.monotonic() > give_up:
                raise
            return None

    def _listen(self, neighbour: Neighbour) -> None:
        """Subscribe, and say so as a node of ROS does."""
        node = Participant(self._settings.domain, neighbour.identity, "", self._name)
        neighbour.token(node.token())
        wanted = [(self._settings.imu, IMU_TYPE), (self._settings.mag, MAG_TYPE)]
        if self._settings.odometry is not None:
            wanted += [(TF_STATIC, TF_TYPE), (self._settings.odometry, ODOMETRY_TYPE)]
        types = RosTypes(self._settings.distro)
        for number, (topic, kind) in enumerate(wanted, 1):
            if topic is None:
                continue
            kept = topic == TF_STATIC
            qos = LATCHED_QOS if kept else STREAM_QOS
            neighbour.hear(node.key(topic, kind, ANY_HASH), self._taker(kind), kept=kept)
            neighbour.token(node.entity_token(number, SUBSCRIPTION, topic, kind, types.hash(kind), qos))

    def _taker(self, kind: str) -> Callable[[Foreign], None]:
        def take(foreign: Foreign) -> None:  # on Zenoh's thread: it does not wait
            try:
                self._inbox.put_nowait(Heard(kind, foreign.payload, time.time_ns()))
            except queue.Full:
                self._dropped += 1

        return take

    def _next(self) -> Brought:
        patience = min(SILENCE, self._settings.pair_within_ms / 1e3) if self._conversion.is_waiting else SILENCE
        try:
            heard = self._inbox.get(timeout=patience)
        except queue.Empty:
            came: list[tuple[str, Sample]] = list(self._conversion.due(time.time_ns()))
            if not came and not self._conversion.is_waiting:
                yield self._quiet()
        else:
            came = list(self._conversion.taken(heard))
        for port, sample in came:
            self._last = max(self._last, sample.stamp)
            yield port, sample

    def _quiet(self) -> Quiet:
        """Nothing older than what has come will come; nor, once their delay is known, what would be slower still."""
        if self._conversion.slowest is not None:
            self._last = max(self._last, time.time_ns() - self._conversion.slowest - MARGIN)
        return Quiet(self._last)

    def _report(self) -> None:
        for cause, count in self._conversion.refused.items():
            log.info("%d messages left out: %s", count, cause)
        if self._dropped:
            log.warning("%d messages dropped: this process was too slow for them", self._dropped)


def _turn(text: str) -> Quaternion | None:
    """The rotation of their vectors into those of the body; None: there is none."""
    mounted = mounting(text)
    columns = [mounted.turned(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    turn = quaternion_of(np.array(columns).T)
    return None if turn == IDENTITY else turn


if __name__ == "__main__":
    run(Ros2Source)
