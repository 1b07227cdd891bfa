"""`caneflow import rosbag`: a recording of a bag of ROS 1 or ROS 2, without ROS."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from caneflow.algorithms.radar.doppler_bins import doppler_bins
from caneflow.algorithms.rotations import Quaternion, conjugate
from caneflow.bridges.errors import BridgeError
from caneflow.bridges.frames import RADAR, Transform
from caneflow.bridges.point_clouds import CLOUD_TYPE, DOPPLER, Bins, cloud_of, doppler_of, has_doppler
from caneflow.bridges.ros_messages import IMU_TYPE, MAG_TYPE, ODOMETRY_TYPE, TF_STATIC
from caneflow.bridges.ros_samples import (
    FieldsByTime,
    FixedFrames,
    field_of,
    frame_of,
    imu_of,
    points_rig_of,
    pose_of,
    rig_of,
    stamp_of,
)
from caneflow.bridges.ros_types import DEFAULT_DISTRO, DISTROS, MISSING, RosTypes
from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, Sample, numbered, sample_key
from caneflow.messages.rig import overlaid
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.recording import TRUTH, RecordingWriter
from caneflow.runtime.dataflow.loading import read_rig

PAIR_WITHIN = 20_000_000  # ns between an IMU's sample and the magnetic field that is taken with it
UNSET = 86_400_000_000_000  # ns: a stamp of 0 in a bag of a later day was never set
IMU_STREAM, POINTS_STREAM = ("imu", "imu"), ("radar", "points")
CARRIER = 60.25e9  # Hz, by which the length of a frame is told from its Doppler steps; at 77 GHz it is 4 ms of 20 less
STILL_STEP, STILL_LIMIT = 0.1, 3.0  # m/s, where nothing moved
LONGEST_FRAME = 0.1  # s


def rosbag(
    bag: Annotated[
        Path,
        typer.Argument(
            metavar="BAG", help="Folder of ROS 2 (sqlite3, MCAP), .mcap file, or .bag of ROS 1.", show_default=False
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    imu: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="sensor_msgs/Imu to take; by default the only one.")
    ] = None,
    mag: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="sensor_msgs/MagneticField to take; by default the only one.")
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="nav_msgs/Odometry to take as ground truth; by default none."),
    ] = None,
    points: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC", help="sensor_msgs/PointCloud2 with Doppler to take; by default the only one that has it."
        ),
    ] = None,
    approaching: Annotated[
        bool, typer.Option("--approaching", help="The clouds' Doppler is positive for what approaches, not recedes.")
    ] = False,
    rig: Annotated[Path | None, typer.Option(metavar="YAML", help="Rig to store in the recording.")] = None,
    distro: Annotated[
        str, typer.Option(help=f"Definitions to use where the bag has none: {', '.join(DISTROS)}.")
    ] = DEFAULT_DISTRO,
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a bag: its IMU as imu/imu, a radar's points as radar/points, an odometry as truth/pose.

    Stamps are those of the messages' headers. The body frame is the IMU's own; magnetic fields and truth are brought
    into it by the bag's /tf_static. Topics that are not used are listed, and so are messages that cannot be used.

    Example: caneflow import rosbag walk_bag --truth /odom -o walk.mcap
    """
    if not NAME.fullmatch(flow):
        raise CaneflowError(f"--flow {flow!r}: expected {NAME_RULE}")
    if distro not in DISTROS:
        raise CaneflowError(f"--distro {distro!r}: expected one of {', '.join(DISTROS)}")
    laid_over = {} if rig is None else read_rig(rig)
    with whole(output, inputs=[bag, rig], overwrite=overwrite) as path, _opened(bag, distro) as reader:
        topics, opened = Topics(bag, reader), Bag(bag, reader)
        chosen = Chosen(
            topics.only(IMU_TYPE, "--imu", imu),
            topics.only(MAG_TYPE, "--mag", mag),
            topics.only(ODOMETRY_TYPE, "--truth", truth) if truth else None,
            _cloud_topic(topics, opened, points),
        )
        if not any((chosen.imu, chosen.truth, chosen.points)):
            raise CaneflowError(
                f"{bag}: holds no {IMU_TYPE} and no radar's points, and no --truth is named; "
                f"there are {topics.listed()}"
            )
        lines = _write(path, flow, opened, chosen, laid_over, approaching=approaching)
    print(f"{output}: {lines[0]}")
    for line in [*lines[1:], *topics.unused(chosen)]:
        print(line)


class Chosen(NamedTuple):
    """The topics that are taken."""

    imu: str | None
    mag: str | None
    truth: str | None
    points: str | None


class Topics:
    """What a bag holds, by topic."""

    def __init__(self, path: Path, reader: Any) -> None:
        self._path = path
        self._kinds = {topic: about.msgtype or "several types" for topic, about in reader.topics.items()}
        self._counts = {topic: about.msgcount for topic, about in reader.topics.items()}

    def only(self, kind: str, option: str, wanted: str | None) -> str | None:
        """The topic `wanted`, or the only one of `kind`; raises CaneflowError when it is of another, or of several."""
        there = self.of(kind)
        if wanted is not None and wanted not in there:
            found = f"is {self._kinds[wanted]}" if wanted in self._kinds else "no such topic"
            raise CaneflowError(
                f"{self._path}: {option} {wanted}: {found}; topics of {kind}: {', '.join(there) or 'none'}"
            )
        if wanted is None and len(there) > 1:
            raise CaneflowError(
                f"{self._path}: {len(there)} topics of {kind}; choose one with {option}: {', '.join(there)}"
            )
        return wanted or next(iter(there), None)

    def of(self, kind: str) -> list[str]:
        """The topics of a kind that hold something."""
        return sorted(topic for topic, its in self._kinds.items() if its == kind and self._counts[topic])

    def listed(self) -> str:
        """All topics with their types, for a line."""
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self._kinds.items())) or "none"

    def unused(self, chosen: Chosen) -> Iterator[str]:
        """A line for each topic that is not taken."""
        for topic, kind in sorted(self._kinds.items()):
            if topic not in (*chosen, TF_STATIC):
                yield f"not used: {topic}, {self._counts[topic]} of {kind}"


class Bag:
    """The messages of a bag, decoded."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader

    def first(self, topic: str) -> list[Any]:
        """The first message of a topic; none where there is none."""
        return [message for _, _, message in islice(self.messages(topic), 1)]

    def messages(self, *topics: str | None) -> Iterator[tuple[str, int, Any]]:
        """Topic, the bag's own time (ns) and message; raises BridgeError where the bag is damaged."""
        wanted = [each for each in self._reader.connections if each.topic in topics]
        if not wanted:
            return
        try:
            for connection, at, raw in self._reader.messages(connections=wanted):
                yield connection.topic, at, self._reader.deserialize(raw, connection.msgtype)
        except CaneflowError:
            raise
        except Exception as error:  # readers of damaged files raise whatever they stumble over
            raise BridgeError(f"{self.path}: cannot be read further: {type(error).__name__}: {error}") from error


def _cloud_topic(topics: Topics, bag: Bag, wanted: str | None) -> str | None:
    """The topic of clouds that is taken; raises CaneflowError for one without Doppler, and when several have it."""
    if wanted is not None:
        topics.only(CLOUD_TYPE, "--points", wanted)
    with_doppler = [topic for topic in topics.of(CLOUD_TYPE) if any(map(has_doppler, bag.first(topic)))]
    if wanted is not None and wanted not in with_doppler:
        raise CaneflowError(f"{bag.path}: --points {wanted}: has no field of Doppler; known are {', '.join(DOPPLER)}")
    if wanted is None and len(with_doppler) > 1:
        raise CaneflowError(
            f"{bag.path}: {len(with_doppler)} topics of points with Doppler; choose one with --points: "
            f"{', '.join(with_doppler)}"
        )
    return wanted or next(iter(with_doppler), None)


@contextmanager
def _opened(bag: Path, distro: str) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
    except ImportError as error:
        raise BridgeError(MISSING) from error
    if not bag.exists():
        raise CaneflowError(f"{bag}: no such file or folder")
    try:
        reader = AnyReader([bag], default_typestore=RosTypes(distro).store)
        reader.open()
    except Exception as error:  # likewise
        said = " ".join(str(error).split()) or type(error).__name__
        raise BridgeError(f"{bag}: not a bag of ROS 1 or ROS 2: {said}") from error
    try:
        yield reader
    finally:
        reader.close()


class _Stream:
    """One stream of the recording: numbers its samples, and counts what cannot be one."""

    def __init__(self, writer: RecordingWriter, flow: str, name: tuple[str, str]) -> None:
        self._writer = writer
        self._key = sample_key(flow, *name)
        self.name = "/".join(name)
        self.count = 0
        self.refused: Counter[str] = Counter()
        self._last = -1

    def add(self, message: Any, at: int, make: Callable[[], Sample]) -> None:
        """Write what `make` gives for `message`, which the bag received `at` (ns)."""
        stamp = stamp_of(message)
        if stamp == 0 and at > UNSET:
            self.refused["without a stamp"] += 1
        elif stamp <= self._last:
            self.refused["not newer than the one before"] += 1
        else:
            try:
                sample = make()
            except ValueError as error:
                self.refused[str(error)] += 1
                return
            payload = numbered(sample, self.count)
            self._writer.write(self._key, type(sample), payload, stamp=stamp, seq=self.count, log_time=at)
            self.count, self._last = self.count + 1, stamp

    def lines(self) -> Iterator[str]:
        """What was left out, by cause."""
        for cause, count in self.refused.items():
            yield f"{self.name}: {count} messages left out: {cause}"


def _write(
    path: Path, flow: str, bag: Bag, chosen: Chosen, laid_over: dict[str, Any], *, approaching: bool
) -> list[str]:
    """Write the recording; what there is to say of it, the counts first."""
    fixed = FixedFrames()
    for _, _, message in bag.messages(TF_STATIC):
        fixed.take(message)
    body = next((frame_of(message) for _, _, message in bag.messages(chosen.imu)), None)
    frames = _Frames(fixed, body)
    fields = FieldsByTime(
        (stamp_of(message), field)
        for _, _, message in bag.messages(chosen.mag)
        if (field := field_of(message, frames.turn(frame_of(message)))) is not None
    )
    cloud_frame = next((frame_of(message) for message in bag.first(chosen.points)), None) if chosen.points else None
    bins = _bins(bag, chosen.points)
    known = rig_of(fixed, body, RADAR) if body else {}
    if body and cloud_frame:
        known = {**known, **points_rig_of(fixed, body, cloud_frame)}
    rig = overlaid(known, laid_over)
    with RecordingWriter(path, flow=flow, source="imported", rig=rig) as writer:
        imu, truth = _Stream(writer, flow, IMU_STREAM), _Stream(writer, flow, TRUTH)
        clouds = _Stream(writer, flow, POINTS_STREAM)
        with_mag = 0
        for topic, at, message in bag.messages(chosen.imu, chosen.truth, chosen.points):
            if topic == chosen.imu:
                mag = fields.nearest(stamp_of(message), PAIR_WITHIN)
                with_mag += mag is not None
                imu.add(message, at, lambda message=message, mag=mag: imu_of(message, mag=mag))  # type: ignore[misc]
            elif topic == chosen.points:
                clouds.add(message, at, lambda message=message: made_cloud(message, bins, approaching))  # type: ignore[misc]
            else:
                child = str(message.child_frame_id).removeprefix("/")
                there = frames.body_in(child)
                truth.add(message, at, lambda message=message, there=there: pose_of(message, there))  # type: ignore[misc]
    counts = (
        f"{imu.count} samples of the IMU, {with_mag} with a magnetic field; {truth.count} poses of the ground truth"
    )
    if chosen.points:
        counts += (
            f"; {clouds.count} frames of a radar's points, Doppler steps of {bins.step:.3f} to {bins.limit:.2f} m/s, "
            "told from the points"
        )
        if body and cloud_frame and "radar_orientation" not in rig:
            frames.said[f"{TF_STATIC} does not say how {cloud_frame} lies on {body}: set rig.radar_orientation"] = None
    return [counts, *imu.lines(), *clouds.lines(), *truth.lines(), *frames.said]


def made_cloud(message: Any, bins: Bins, approaching: bool) -> Sample:
    """The sample of a cloud; raises ValueError for one that does not add up."""
    return cloud_of(message, stamp_of(message), bins, approaching=approaching)


def _bins(bag: Bag, topic: str | None) -> Bins:
    """Of the radar's Doppler, by all its points: a cloud does not say it."""
    speeds = []
    for _, _, message in bag.messages(topic) if topic else ():
        try:
            speeds.append(doppler_of(message))
        except ValueError:  # counted when it is written
            continue
    found = doppler_bins(np.concatenate(speeds)) if speeds else None
    step, limit = found or (STILL_STEP, STILL_LIMIT)
    return Bins(min(SPEED_OF_LIGHT / CARRIER / (2.0 * step), LONGEST_FRAME), step, limit)


class _Frames:
    """How the frames of other messages lie to the body, which is the IMU's; says once what is not known."""

    def __init__(self, fixed: FixedFrames, body: str | None) -> None:
        self._fixed = fixed
        self._body = body
        self.said: dict[str, None] = {}  # lines
        self._there: dict[str, Transform | None] = {}

    def body_in(self, frame: str) -> Transform | None:
        """Where the body is in `frame`; None: they are one, or taken for one."""
        if frame not in self._there:
            self._there[frame] = self._found(frame)
        return self._there[frame]

    def turn(self, frame: str) -> Quaternion | None:
        """The rotation of vectors of `frame` into those of the body; None: they are one, or taken for one."""
        there = self.body_in(frame)
        return None if there is None else conjugate(there.rotation)

    def _found(self, frame: str) -> Transform | None:
        if self._body is None or frame == self._body:
            return None
        found = self._fixed.between(frame, self._body)
        if found is None:
            self.said[f"{TF_STATIC} does not say how {self._body} lies in {frame}: taken for the same frame"] = None
        return found


command = rosbag
