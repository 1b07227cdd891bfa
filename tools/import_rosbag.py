"""`caneflow import rosbag`: a recording of a bag of ROS 1 or ROS 2, without ROS."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from caneflow.algorithms.rotations import Quaternion, conjugate
from caneflow.bridges.errors import BridgeError
from caneflow.bridges.frames import RADAR, Transform
from caneflow.bridges.ros_messages import IMU_TYPE, MAG_TYPE, ODOMETRY_TYPE, TF_STATIC
from caneflow.bridges.ros_samples import (
    FieldsByTime,
    FixedFrames,
    field_of,
    frame_of,
    imu_of,
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
from caneflow.recording import TRUTH, RecordingWriter
from caneflow.runtime.dataflow.loading import read_rig

PAIR_WITHIN = 20_000_000  # ns between an IMU's sample and the magnetic field that is taken with it
UNSET = 86_400_000_000_000  # ns: a stamp of 0 in a bag of a later day was never set
IMU_STREAM = ("imu", "imu")


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
    rig: Annotated[Path | None, typer.Option(metavar="YAML", help="Rig to store in the recording.")] = None,
    distro: Annotated[
        str, typer.Option(help=f"Definitions to use where the bag has none: {', '.join(DISTROS)}.")
    ] = DEFAULT_DISTRO,
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a bag: its IMU as imu/imu, an odometry as truth/pose.

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
        topics = Topics(bag, reader)
        chosen = Chosen(
            topics.only(IMU_TYPE, "--imu", imu),
            topics.only(MAG_TYPE, "--mag", mag),
            topics.only(ODOMETRY_TYPE, "--truth", truth) if truth else None,
        )
        if chosen.imu is None and chosen.truth is None:
            raise CaneflowError(f"{bag}: holds no {IMU_TYPE}, and no --truth is named; there are {topics.listed()}")
        lines = _write(path, flow, Bag(bag, reader), chosen, laid_over)
    print(f"{output}: {lines[0]}")
    for line in [*lines[1:], *topics.unused(chosen)]:
        print(line)


class Chosen(NamedTuple):
    """The topics that are taken."""

    imu: str | None
    mag: str | None
    truth: str | None


class Topics:
    """What a bag holds, by topic."""

    def __init__(self, path: Path, reader: Any) -> None:
        self._path = path
        self._kinds = {topic: about.msgtype or "several types" for topic, about in reader.topics.items()}
        self._counts = {topic: about.msgcount for topic, about in reader.topics.items()}

    def only(self, kind: str, option: str, wanted: str | None) -> str | None:
        """The topic `wanted`, or the only one of `kind`; raises CaneflowError when it is of another, or of several."""
        there = sorted(topic for topic, its in self._kinds.items() if its == kind and self._counts[topic])
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
        self._path = path
        self._reader = reader

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
            raise BridgeError(f"{self._path}: cannot be read further: {type(error).__name__}: {error}") from error


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


def _write(path: Path, flow: str, bag: Bag, chosen: Chosen, laid_over: dict[str, Any]) -> list[str]:
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
    rig = overlaid(rig_of(fixed, body, RADAR) if body else {}, laid_over)
    with RecordingWriter(path, flow=flow, source="imported", rig=rig) as writer:
        imu, truth = _Stream(writer, flow, IMU_STREAM), _Stream(writer, flow, TRUTH)
        with_mag = 0
        for topic, at, message in bag.messages(chosen.imu, chosen.truth):
            if topic == chosen.imu:
                mag = fields.nearest(stamp_of(message), PAIR_WITHIN)
                with_mag += mag is not None
                imu.add(message, at, lambda message=message, mag=mag: imu_of(message, mag=mag))  # type: ignore[misc]
            else:
                child = str(message.child_frame_id).removeprefix("/")
                there = frames.body_in(child)
                truth.add(message, at, lambda message=message, there=there: pose_of(message, there))  # type: ignore[misc]
    counts = (
        f"{imu.count} samples of the IMU, {with_mag} with a magnetic field; {truth.count} poses of the ground truth"
    )
    return [counts, *imu.lines(), *truth.lines(), *frames.said]


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
