"""Our messages as ROS messages: which topics a stream fills, and what each holds. No other file names a ROS field.

A stream has one `Picture` for each topic that it fills. A picture is made only when someone wants it, so that what
nobody hears costs nothing.

| stream | topic | message |
|---|---|---|
| Imu | /imu/imu | sensor_msgs/Imu in imu_link |
| | .../mag | sensor_msgs/MagneticField in T |
| Pose | /fusion/pose | geometry_msgs/PoseStamped of base_link |
| | .../odom | nav_msgs/Odometry, with both covariances |
| | .../with_covariance | geometry_msgs/PoseWithCovarianceStamped |
| | /tf | tf2_msgs/TFMessage: world -> base_footprint -> base_link, of one stream |
| GroundSpeed | .../twist | geometry_msgs/TwistWithCovarianceStamped in base_footprint |
| RadarFrame | /radar/frame | sensor_msgs/Image: the range-Doppler map, ten a second |
| Grid | /surroundings/grid | nav_msgs/OccupancyGrid: of each column of slices the one most likely occupied |
| | .../floor_missing | nav_msgs/OccupancyGrid: where the floor is missing |
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, rotate
from caneflow.bridges.frames import BASE, FOOTPRINT, IMU, RADAR, Frames, Transform, matrix_of
from caneflow.bridges.radar_images import RadarImages
from caneflow.bridges.ros_types import RosTypes
from caneflow.messages import Grid, GroundSpeed, Imu, Pose, RadarFrame, Sample
from caneflow.messages.control import FlowStatus

NOT_OBSERVED: Final = 1e6  # variance of what is not observed, as on our own wire
UNKNOWN_CELL: Final = 128  # of a grid: log-odds of 0
ABSENT: Final = -1.0  # the first element of a covariance, where the whole quantity is not there (sensor_msgs/Imu)
TF, TF_STATIC, DIAGNOSTICS = "/tf", "/tf_static", "/diagnostics"
TRUTH = "truth"  # the node of the ground truth

IMU_TYPE = "sensor_msgs/msg/Imu"
MAG_TYPE = "sensor_msgs/msg/MagneticField"
IMAGE_TYPE = "sensor_msgs/msg/Image"
POSE_TYPE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST_TYPE = "geometry_msgs/msg/TwistWithCovarianceStamped"
GRID_TYPE = "nav_msgs/msg/OccupancyGrid"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TF_TYPE = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"

LEVELS = {"ready": 0, "starting": 1, "waiting": 1, "failed": 2}  # of a node's state: OK, WARN, ERROR
LOSS_PLACES = ("sender", "wire", "decode", "queue", "late")  # where a wire can lose samples

Make = Callable[[Any], Any]


class Picture(NamedTuple):
    """What a stream becomes on one topic."""

    topic: str
    kind: str  # e.g. nav_msgs/msg/Odometry
    make: Make  # from a sample to the ROS message; None: there is none of this sample


class RosMessages:
    """The ROS messages of one flow, in the types of one distribution."""

    def __init__(self, types: RosTypes, frames: Frames, *, namespace: str = "", tf: str | None = None) -> None:
        """`namespace`: what goes before every topic but /diagnostics, e.g. /cane. `tf`: what `tf_stream` gives."""
        self.types = types
        self.frames = frames
        self._namespace = namespace
        self._tf = tf
        self._makers: dict[type[Sample], Callable[[str, str, str], list[Picture]]] = {
            Imu: self._imu_pictures,
            Pose: self._pose_pictures,
            GroundSpeed: self._speed_pictures,
            RadarFrame: self._frame_pictures,
            Grid: self._grid_pictures,
        }
        self._build = _Builders(types)

    def pictures(self, node: str, port: str, kind: type[Sample] | None) -> list[Picture]:
        """The topics that the stream `node`/`port` of messages `kind` fills; none for what ROS has no message for."""
        make = self._makers.get(kind) if kind is not None else None
        return make(node, port, f"{self._namespace}/{node}/{port}") if make else []

    @property
    def static_topic(self) -> str:
        """The topic of `static`, whose one message is kept for those that come late."""
        return f"{self._namespace}{TF_STATIC}"

    def static(self, stamp: int) -> Any:
        """The tf2_msgs/TFMessage of what is bolted on; `stamp` in ns."""
        return self._build.transforms(stamp, self.frames.fixed())

    def diagnostics(self, status: FlowStatus, stamp: int) -> Any:
        """How nodes and wires are, as diagnostic_msgs/DiagnosticArray; `stamp` in ns."""
        return self._build.diagnostics(status, stamp)

    def _imu_pictures(self, node: str, port: str, topic: str) -> list[Picture]:
        return [Picture(topic, IMU_TYPE, self._build.imu), Picture(f"{topic}/mag", MAG_TYPE, self._build.field)]

    def _pose_pictures(self, node: str, port: str, topic: str) -> list[Picture]:
        if self._tf is None and node != TRUTH:
            self._tf = f"{node}/{port}"
        fills_tf = self._tf == f"{node}/{port}"
        child = BASE if fills_tf else f"{node}/{BASE}"
        frames, build = self.frames, self._build
        pictures = [
            Picture(topic, POSE_TYPE, lambda pose: build.pose(pose, frames)),
            Picture(f"{topic}/odom", ODOMETRY_TYPE, lambda pose: build.odometry(pose, frames, child)),
            Picture(f"{topic}/with_covariance", POSE_COVARIANCE_TYPE, lambda pose: build.uncertain(pose, frames)),
        ]
        if fills_tf:
            tree = f"{self._namespace}{TF}"
            pictures.append(Picture(tree, TF_TYPE, lambda pose: build.moving(pose, frames)))
        return pictures

    def _speed_pictures(self, node: str, port: str, topic: str) -> list[Picture]:
        return [Picture(f"{topic}/twist", TWIST_TYPE, self._build.twist)]

    def _frame_pictures(self, node: str, port: str, topic: str) -> list[Picture]:
        images = RadarImages()
        return [Picture(topic, IMAGE_TYPE, lambda frame: self._build.image(frame, images))]

    def _grid_pictures(self, node: str, port: str, topic: str) -> list[Picture]:
        world, build = self.frames.world, self._build
        return [
            Picture(topic, GRID_TYPE, lambda grid: build.occupied(grid, world)),
            Picture(f"{topic}/floor_missing", GRID_TYPE, lambda grid: build.floor_missing(grid, world)),
        ]


def tf_stream(streams: Mapping[str, type[Sample] | None], chosen: str | None = None) -> str | None:
    """Which of `streams` (node/port) fills /tf: `chosen`, or the only one with poses that is not ground truth.

    "": none, because several could. None: there is none yet; the first that comes will.
    """
    poses = [name for name, kind in streams.items() if kind is Pose and name.partition("/")[0] != TRUTH]
    return chosen or (poses[0] if len(poses) == 1 else "" if poses else None)


class _Builders:
    """One function for each ROS message, with its classes looked up once."""

    def __init__(self, types: RosTypes) -> None:
        self._time = types["builtin_interfaces/msg/Time"]
        self._header = types["std_msgs/msg/Header"]
        self._vector3 = types["geometry_msgs/msg/Vector3"]
        self._point = types["geometry_msgs/msg/Point"]
        self._quaternion = types["geometry_msgs/msg/Quaternion"]
        self._pose = types["geometry_msgs/msg/Pose"]
        self._pose_covariance = types["geometry_msgs/msg/PoseWithCovariance"]
        self._twist = types["geometry_msgs/msg/Twist"]
        self._twist_covariance = types["geometry_msgs/msg/TwistWithCovariance"]
        self._transform = types["geometry_msgs/msg/Transform"]
        self._transform_stamped = types["geometry_msgs/msg/TransformStamped"]
        self._types = types
        self._unknown = np.zeros(9)  # there, of unknown accuracy
        self._absent = np.array([ABSENT, *(0.0,) * 8])
        # One pose fills several topics: what they share is made once.
        self._placed_of: Pose | None = None
        self._placed: Any = None

    def imu(self, imu: Imu) -> Any:
        return self._types[IMU_TYPE](
            header=self.header(imu.stamp, IMU),
            orientation=self.quaternion(imu.orientation or (1.0, 0.0, 0.0, 0.0)),
            orientation_covariance=self._unknown if imu.orientation else self._absent,
            angular_velocity=self.vector(imu.gyro),
            angular_velocity_covariance=self._unknown,
            linear_acceleration=self.vector(imu.accel or (0.0, 0.0, 0.0)),
            linear_acceleration_covariance=self._unknown if imu.accel else self._absent,
        )

    def field(self, imu: Imu) -> Any:
        if imu.mag is None:
            return None
        x, y, z = imu.mag
        return self._types[MAG_TYPE](
            header=self.header(imu.stamp, IMU),
            magnetic_field=self.vector((1e-6 * x, 1e-6 * y, 1e-6 * z)),  # T
            magnetic_field_covariance=self._unknown,
        )

    def pose(self, pose: Pose, frames: Frames) -> Any:
        return self._types[POSE_TYPE](
            header=self.header(pose.stamp, frames.world), pose=self.uncertain_place(pose, frames).pose
        )

    def odometry(self, pose: Pose, frames: Frames, child: str) -> Any:
        back = conjugate(frames.base(pose.orientation))
        linear, angular = self.vector(rotate(back, pose.velocity)), self.vector((0.0, 0.0, 0.0))
        return self._types[ODOMETRY_TYPE](
            header=self.header(pose.stamp, frames.world),
            child_frame_id=child,
            pose=self.uncertain_place(pose, frames),
            twist=self._twist_covariance(
                twist=self._twist(linear=linear, angular=angular), covariance=motion_covariance(pose, back)
            ),
        )

    def uncertain(self, pose: Pose, frames: Frames) -> Any:
        if pose.covariance is None:
            return None
        return self._types[POSE_COVARIANCE_TYPE](
            header=self.header(pose.stamp, frames.world),
            pose=self.uncertain_place(pose, frames),
        )

    def moving(self, pose: Pose, frames: Frames) -> Any:
        return self.transforms(pose.stamp, frames.moving(pose.position, pose.orientation))

    def twist(self, speed: GroundSpeed) -> Any:
        if not speed.valid:
            return None
        along, left = speed.velocity or (speed.speed, 0.0)
        twist = self._twist(linear=self.vector((along, left, 0.0)), angular=self.vector((0.0, 0.0, 0.0)))
        return self._types[TWIST_TYPE](
            header=self.header(speed.stamp, FOOTPRINT),
            twist=self._twist_covariance(twist=twist, covariance=_speed_covariance(speed)),
        )

    def image(self, frame: RadarFrame, images: RadarImages) -> Any:
        try:
            image = images.take(frame)
        except ValueError:  # scans of which no map can be made
            return None
        if image is None:
            return None
        height, width = image.grey.shape
        return self._types[IMAGE_TYPE](
            header=self.header(image.stamp, RADAR),
            height=height,
            width=width,
            encoding="mono8",
            is_bigendian=0,
            step=width,
            data=image.grey.reshape(-1),
        )

    def occupied(self, grid: Grid, world: str) -> Any:
        known = grid.occupancy != UNKNOWN_CELL
        highest = np.where(known, grid.occupancy, 0).max(axis=0)
        return self._map(grid, np.where(known.any(axis=0), highest, UNKNOWN_CELL), world)

    def floor_missing(self, grid: Grid, world: str) -> Any:
        return None if grid.floor_missing is None else self._map(grid, grid.floor_missing, world)

    def _map(self, grid: Grid, cells: Any, world: str) -> Any:
        """Of `cells` (H, W), whose first index runs along x: ROS has rows along x, and its width is their length."""
        odds = grid.unit * (cells.astype(float) - UNKNOWN_CELL)
        percent = np.rint(100 / (1 + np.exp(-np.clip(odds, -50, 50)))).astype(np.int8)
        percent[cells == UNKNOWN_CELL] = -1  # unknown, in ROS
        header = self.header(grid.stamp, world)
        x, y = (float(grid.cell * index) for index in grid.origin)
        corner = self._pose(position=self._point(x=x, y=y, z=0.0), orientation=self.quaternion((1.0, 0.0, 0.0, 0.0)))
        about = self._types["nav_msgs/msg/MapMetaData"](
            map_load_time=header.stamp,
            resolution=float(grid.cell),
            width=cells.shape[0],
            height=cells.shape[1],
            origin=corner,
        )
        return self._types[GRID_TYPE](header=header, info=about, data=np.ascontiguousarray(percent.T).reshape(-1))

    def transforms(self, stamp: int, transforms: Sequence[Transform]) -> Any:
        return self._types[TF_TYPE](
            transforms=[
                self._transform_stamped(
                    header=self.header(stamp, each.parent),
                    child_frame_id=each.child,
                    transform=self._transform(
                        translation=self.vector(each.translation), rotation=self.quaternion(each.rotation)
                    ),
                )
                for each in transforms
            ]
        )

    def diagnostics(self, status: FlowStatus, stamp: int) -> Any:
        rows = [
            self._row(
                LEVELS.get(node.state, 1),
                f"{status.flow}: {node.node}",
                f"{node.state}, {node.restarts} restarts",
                node.program,
                {
                    "pid": node.pid,
                    "cpu": node.cpu,
                    "memory": node.memory,
                    **{f"sent {p}": n for p, n in node.sent.items()},
                },
            )
            for node in status.nodes
        ]
        for edge in status.edges:
            losses = {place: lost for place in LOSS_PLACES if (lost := getattr(edge, place))}
            if losses:
                said = ", ".join(f"{lost} lost ({place})" for place, lost in losses.items())
                counts = {"sent": edge.sent, "received": edge.received, "handled": edge.handled, **losses}
                rows.append(self._row(1, f"{status.flow}: {edge.writer} > {edge.reader}", said, "", counts))
        return self._types[DIAGNOSTICS_TYPE](header=self.header(stamp, ""), status=rows)

    def _row(self, level: int, name: str, message: str, hardware: str, values: Mapping[str, object]) -> Any:
        pair = self._types["diagnostic_msgs/msg/KeyValue"]
        pairs = [pair(key=key, value=str(value)) for key, value in values.items() if value is not None]
        row = self._types["diagnostic_msgs/msg/DiagnosticStatus"]
        return row(level=level, name=name, message=message, hardware_id=hardware, values=pairs)

    def uncertain_place(self, pose: Pose, frames: Frames) -> Any:
        """The geometry_msgs/PoseWithCovariance of a pose."""
        if pose is not self._placed_of:
            x, y, z = map(float, pose.position)
            turn = self.quaternion(frames.base(pose.orientation))
            place = self._pose(position=self._point(x=x, y=y, z=z), orientation=turn)
            self._placed = self._pose_covariance(pose=place, covariance=place_covariance(pose))
            self._placed_of = pose
        return self._placed

    def header(self, stamp: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp, 10**9)
        return self._header(stamp=self._time(sec=seconds, nanosec=nanoseconds), frame_id=frame)

    def vector(self, values: Vector) -> Any:
        x, y, z = values
        return self._vector3(x=float(x), y=float(y), z=float(z))

    def quaternion(self, values: Quaternion) -> Any:
        w, x, y, z = values
        return self._quaternion(x=float(x), y=float(y), z=float(z), w=float(w))


def place_covariance(pose: Pose) -> Any:
    """36 elements, row by row: x, y, z, then rotation; all zero: unknown."""
    if pose.covariance is None:
        return np.zeros(36)
    return _whole(pose.covariance[:3, :3])


def motion_covariance(pose: Pose, back: Quaternion) -> Any:
    """36 elements in the child frame, into which `back` turns; of no covariance only the rotation is not observed."""
    if pose.covariance is None:
        return _whole(np.zeros((3, 3)))
    turn = matrix_of(back)
    return _whole(turn @ pose.covariance[3:, 3:] @ turn.T)


def _speed_covariance(speed: GroundSpeed) -> Any:
    covariance = _NOTHING_OBSERVED.copy()
    if speed.velocity is None:
        covariance[0, 0] = speed.quality**2
    else:
        xx, xy, yy = speed.velocity_cov or (0.0, 0.0, 0.0)
        covariance[:2, :2] = (xx, xy), (xy, yy)
    return covariance.reshape(-1)


def _whole(block: Any) -> Any:
    """The 36 elements of a covariance with `block` (3, 3) first, and behind it what is not observed."""
    covariance = _NOTHING_OBSERVED.copy()
    covariance[:3, :3] = block
    return covariance.reshape(-1)


_NOTHING_OBSERVED = np.diag([NOT_OBSERVED] * 6)
