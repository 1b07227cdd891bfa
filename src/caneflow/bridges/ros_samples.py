"""ROS messages as our samples: the other direction of ros_messages.py, for bags and for live topics."""

import math
from bisect import bisect_left
from collections.abc import Iterable
from typing import Any

import numpy as np

from caneflow.algorithms.rotations import IDENTITY, Quaternion, Vector, conjugate, multiply, rotate
from caneflow.bridges.frames import Transform, matrix_of
from caneflow.bridges.ros_messages import ABSENT, NOT_OBSERVED
from caneflow.messages import Imu, Pose
from caneflow.messages.bounds import UNIT_TOLERANCE

METHOD = "ros2"  # of a pose that came from a nav_msgs/Odometry
WORN = 0.1  # how far a quaternion's norm may be from 1 and still be taken as a rotation that was rounded


def stamp_of(message: Any) -> int:
    """When the message says that it was measured, in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def frame_of(message: Any) -> str:
    """The frame of the message's header; old drivers write a slash before its name."""
    return str(message.header.frame_id).removeprefix("/")


def imu_of(message: Any, *, mag: Vector | None = None, turn: Quaternion | None = None) -> Imu:
    """The sample of a sensor_msgs/Imu, with the magnetic field `mag` (uT, in the message's frame) beside it.

    `turn` turns vectors of the message's frame into those of the body. Raises ValueError for a message that no sensor
    sends, and for one without a rate of turn.
    """
    if message.angular_velocity_covariance[0] == ABSENT:
        raise ValueError("it has no angular velocity")
    gyro = _vector(message.angular_velocity)
    accel = None if message.linear_acceleration_covariance[0] == ABSENT else _vector(message.linear_acceleration)
    orientation = None if message.orientation_covariance[0] == ABSENT else _rotation(message.orientation)
    if turn is not None:
        gyro = rotate(turn, gyro)
        accel = None if accel is None else rotate(turn, accel)
        mag = None if mag is None else rotate(turn, mag)
        orientation = None if orientation is None else multiply(orientation, conjugate(turn))
    return Imu(stamp=stamp_of(message), gyro=gyro, accel=accel, mag=mag, orientation=orientation)


def field_of(message: Any, turn: Quaternion | None = None) -> Vector | None:
    """The field (uT) of a sensor_msgs/MagneticField, in the frame into which `turn` turns; None: it has none."""
    x, y, z = _vector(message.magnetic_field)
    if not math.isfinite(x + y + z):
        return None
    field = (1e6 * x, 1e6 * y, 1e6 * z)
    return field if turn is None else rotate(turn, field)


def pose_of(message: Any, body: Transform | None = None) -> Pose:
    """The pose of a nav_msgs/Odometry, whose child frame `body` is placed in; None: the child frame is the body.

    The velocity of the body's origin includes what the child frame's turning adds. Where both covariances are all zero,
    which is ROS for unknown, the pose has none; one of them alone is taken for not observed. Raises ValueError for a
    message that no estimator sends.
    """
    turn = _rotation(message.pose.pose.orientation)
    if turn is None:
        raise ValueError("its orientation is not a rotation")
    linear, angular = _vector(message.twist.twist.linear), _vector(message.twist.twist.angular)
    position = _vector(message.pose.pose.position)
    orientation = turn
    if body is not None:
        lever = rotate(turn, body.translation)
        position = (position[0] + lever[0], position[1] + lever[1], position[2] + lever[2])
        swing = np.cross(angular, body.translation).tolist()
        linear = (linear[0] + swing[0], linear[1] + swing[1], linear[2] + swing[2])
        orientation = multiply(turn, body.rotation)
    return Pose(
        stamp=stamp_of(message),
        position=position,
        velocity=rotate(turn, linear),
        orientation=orientation,
        method=METHOD,
        covariance=_covariance(message, turn),
    )


class FixedFrames:
    """What /tf_static has told: which frames are bolted to each other, and how."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Transform]] = {}

    def take(self, message: Any) -> None:
        """Learn the transforms of a tf2_msgs/TFMessage; what is not a rotation is left out."""
        for each in message.transforms:
            rotation = _rotation(each.transform.rotation)
            if rotation is not None:
                parent, child = frame_of(each), str(each.child_frame_id).removeprefix("/")
                there = Transform(parent, child, _vector(each.transform.translation), rotation)
                self._edges.setdefault(parent, {})[child] = there
                self._edges.setdefault(child, {})[parent] = inverse(there)

    def between(self, parent: str, child: str) -> Transform | None:
        """Where `child` is in `parent`, over any number of frames; None: they are not bolted to each other."""
        found = {parent: Transform(parent, parent, (0.0, 0.0, 0.0), IDENTITY)}
        waiting = [parent]
        while waiting and child not in found:
            frame = waiting.pop(0)
            for name, step in self._edges.get(frame, {}).items():
                if name not in found:
                    found[name] = chained(found[frame], step)
                    waiting.append(name)
        return found.get(child)


def chained(first: Transform, second: Transform) -> Transform:
    """The child of `second` in the parent of `first`."""
    x, y, z = first.translation
    a, b, c = rotate(first.rotation, second.translation)
    return Transform(first.parent, second.child, (x + a, y + b, z + c), multiply(first.rotation, second.rotation))


def inverse(transform: Transform) -> Transform:
    """The parent of `transform` in its child."""
    back = conjugate(transform.rotation)
    x, y, z = rotate(back, transform.translation)
    return Transform(transform.child, transform.parent, (-x, -y, -z), back)


class FieldsByTime:
    """Magnetic fields by their stamps, to be found for the samples of an IMU."""

    def __init__(self, fields: Iterable[tuple[int, Vector]]) -> None:
        """`fields`: stamp (ns) and field (uT), in any order."""
        ordered = sorted(fields)
        self._stamps = [stamp for stamp, _ in ordered]
        self._fields = [field for _, field in ordered]

    def nearest(self, stamp: int, within: int) -> Vector | None:
        """The field that was measured nearest to `stamp`, at most `within` ns from it."""
        at = bisect_left(self._stamps, stamp)
        near = [index for index in (at - 1, at) if 0 <= index < len(self._stamps)]
        best = min(near, key=lambda index: abs(self._stamps[index] - stamp), default=None)
        return None if best is None or abs(self._stamps[best] - stamp) > within else self._fields[best]


def rig_of(fixed: FixedFrames, body: str, radar: str) -> dict[str, Any]:
    """The boresight and the antenna of a rig, as /tf_static has them; nothing where it does not know the radar."""
    there = fixed.between(body, radar)
    if there is None:
        return {}
    boresight, antenna = rotate(there.rotation, (1.0, 0.0, 0.0)), there.translation
    return {"boresight": [round(x, 12) for x in boresight], "antenna": [round(x, 12) for x in antenna]}


def points_rig_of(fixed: FixedFrames, body: str, cloud: str) -> dict[str, Any]:
    """How the frame of a radar's clouds lies on the body, as /tf_static has it; nothing where it does not."""
    there = fixed.between(body, cloud)
    if there is None:
        return {}
    places = rig_of(fixed, body, cloud)
    return {**places, "radar_orientation": [round(x, 12) for x in there.rotation]}


def _covariance(message: Any, turn: Quaternion) -> Any:
    place = np.array(message.pose.covariance, float).reshape(6, 6)[:3, :3]
    motion = np.array(message.twist.covariance, float).reshape(6, 6)[:3, :3]
    if not (place.any() or motion.any()):
        return None
    matrix = matrix_of(turn)
    whole = np.zeros((6, 6))
    whole[:3, :3] = place if place.any() else NOT_OBSERVED * np.eye(3)
    whole[3:, 3:] = matrix @ motion @ matrix.T if motion.any() else NOT_OBSERVED * np.eye(3)
    return whole


def _vector(vector: Any) -> Vector:
    return float(vector.x), float(vector.y), float(vector.z)


def _rotation(quaternion: Any) -> Quaternion | None:
    """Unit quaternion w x y z; None for what is not a rotation, such as the zeros of a driver that knows none."""
    w, x, y, z = float(quaternion.w), float(quaternion.x), float(quaternion.y), float(quaternion.z)
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1) <= WORN:  # written so that NaN is none
        return None
    return (w, x, y, z) if abs(norm - 1) <= UNIT_TOLERANCE else (w / norm, x / norm, y / norm, z / norm)
