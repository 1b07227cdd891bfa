"""A recording as a rosbag2 folder that `ros2 bag` plays: IMU, poses, speed, pictures of the radar's map."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from caneflow.messages import GroundSpeed, Imu, Pose, RadarFrame, Sample
from caneflow.recording.errors import RecordingError
from caneflow.recording.radar_images import RadarImages
from caneflow.recording.reader import Recording

WORLD, BODY = "R0", "body"  # frames: of poses, of what the IMU measures
MISSING = "rosbags is not installed; it comes with `pip install caneflow[rosbag2]`"
BAG_VERSION: Final = 8  # what Humble and all later releases read
UNKNOWN = -1.0  # the first element of a covariance says so of the whole quantity, in ROS

Converted: TypeAlias = tuple[str, str, Any]  # what is added to the topic, the type, the message


def export_rosbag2(source: Recording, output: Path) -> Counter[str]:
    """Write what `source` holds to the folder `output`; how many messages went to each topic.

    On `/<node>/<port>`: an IMU's samples as sensor_msgs/Imu (its magnetometer beside it on `.../mag`, in T), poses as
    geometry_msgs/PoseStamped in R0, valid speeds as geometry_msgs/TwistStamped along the boresight, a radar's
    range-Doppler map as sensor_msgs/Image, ten a second. Other streams are left out. Times are the stamps.

    Raises RecordingError without rosbags, and for a folder that is there or cannot be made.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError(MISSING) from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    written: Counter[str] = Counter()
    connections: dict[str, Any] = {}
    try:
        with Writer(output, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            for topic, kind, stamp, message in _messages(source, store.types):
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=store)
                bag.write(connections[topic], stamp, store.serialize_cdr(message, kind))
                written[topic] += 1
    except (WriterError, OSError) as error:
        cause = getattr(error, "strerror", None) or error
        raise RecordingError(f"{output}: cannot be written: {cause}") from error
    except RecordingError:
        shutil.rmtree(output, ignore_errors=True)
        raise
    return written


def _messages(source: Recording, types: Any) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, stamp (ns) and ROS message of everything that has one."""
    convert: dict[type[Sample], Callable[[Any, Any], Iterator[Converted]]] = {
        Imu: _imu,
        Pose: _pose,
        GroundSpeed: _speed,
    }
    images: dict[str, RadarImages] = {}
    for sample in source.samples():
        topic = f"/{sample.node}/{sample.port}"
        if sample.kind is RadarFrame:
            converted = _map(sample.decoded(), images.setdefault(topic, RadarImages()), types)
        elif sample.kind in convert:
            converted = convert[sample.kind](sample.decoded(), types)
        else:
            continue
        for suffix, kind, message in converted:
            yield topic + suffix, kind, sample.stamp, message


def _imu(imu: Imu, types: Any) -> Iterator[Converted]:
    unknown = np.zeros(9)
    unknown[0] = UNKNOWN
    known = np.zeros(9)  # all zeros: there, of unknown accuracy
    orientation = _quaternion(imu.orientation or (1.0, 0.0, 0.0, 0.0), types)
    yield (
        "",
        "sensor_msgs/msg/Imu",
        types["sensor_msgs/msg/Imu"](
            header=_header(imu.stamp, BODY, types),
            orientation=orientation,
            orientation_covariance=known if imu.orientation else unknown,
            angular_velocity=_vector(imu.gyro, types),
            angular_velocity_covariance=known,
            linear_acceleration=_vector(imu.accel or (0.0, 0.0, 0.0), types),
            linear_acceleration_covariance=known if imu.accel else unknown,
        ),
    )
    if imu.mag is not None:
        kind = "sensor_msgs/msg/MagneticField"
        field = _vector(tuple(1e-6 * each for each in imu.mag), types)  # T
        header = _header(imu.stamp, BODY, types)
        yield "/mag", kind, types[kind](header=header, magnetic_field=field, magnetic_field_covariance=known)


def _pose(pose: Pose, types: Any) -> Iterator[Converted]:
    x, y, z = pose.position
    place = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z), orientation=_quaternion(pose.orientation, types)
    )
    kind = "geometry_msgs/msg/PoseStamped"
    yield "", kind, types[kind](header=_header(pose.stamp, WORLD, types), pose=place)


def _speed(speed: GroundSpeed, types: Any) -> Iterator[Converted]:
    if speed.valid:
        twist = types["geometry_msgs/msg/Twist"](
            linear=_vector((speed.speed, 0.0, 0.0), types), angular=_vector((0.0, 0.0, 0.0), types)
        )
        kind = "geometry_msgs/msg/TwistStamped"
        yield "", kind, types[kind](header=_header(speed.stamp, "boresight", types), twist=twist)


def _map(frame: Sample, images: RadarImages, types: Any) -> Iterator[Converted]:
    assert isinstance(frame, RadarFrame)
    image = images.take(frame)
    if image is not None:
        height, width = image.grey.shape
        kind = "sensor_msgs/msg/Image"
        yield (
            "",
            kind,
            types[kind](
                header=_header(image.stamp, BODY, types),
                height=height,
                width=width,
                encoding="mono8",
                is_bigendian=0,
                step=width,
                data=image.grey.reshape(-1),
            ),
        )


def _header(stamp: int, frame: str, types: Any) -> Any:
    seconds, nanoseconds = divmod(stamp, 10**9)
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _vector(values: tuple[float, ...], types: Any) -> Any:
    x, y, z = values
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _quaternion(values: tuple[float, float, float, float], types: Any) -> Any:
    w, x, y, z = values
    return types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
