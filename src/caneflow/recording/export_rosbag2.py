"""A recording as a rosbag2 folder that `ros2 bag` plays: what bridges/ros_messages.py makes of its streams."""

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from caneflow.bridges.frames import frames_of
from caneflow.bridges.ros_messages import TF_TYPE, Picture, RosMessages, tf_stream
from caneflow.bridges.ros_types import RosTypes
from caneflow.errors import not_installed
from caneflow.messages import SAMPLES
from caneflow.recording.errors import RecordingError
from caneflow.recording.reader import Recording

MISSING = not_installed("rosbags", "rosbag2")
BAG_VERSION: Final = 8  # what Humble and all later releases read
DISTRO: Final = "humble"  # the oldest that is meant to read it; the types used here are the same up to Lyrical


def export_rosbag2(source: Recording, output: Path, *, world: str | None = None, tf: str | None = None) -> Counter[str]:
    """Write what `source` holds to the folder `output`; how many messages went to each topic.

    Topics, types and frames are those of `RosMessages`; times are the stamps. Streams that ROS has no message for are
    left out. `world`: the name of R0; `tf`: the stream (node/port) that fills /tf, where several could.

    Raises RecordingError for a folder that exists or cannot be made, and without rosbags.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
    except ImportError as error:
        raise RecordingError(MISSING) from error
    types = RosTypes(DISTRO)

    written: Counter[str] = Counter()
    connections: dict[str, Any] = {}
    try:
        with Writer(output, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            for topic, kind, stamp, message in _messages(source, types, world, tf):
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=types.store)
                bag.write(connections[topic], stamp, types.encoded(kind, message))
                written[topic] += 1
    except (WriterError, OSError) as error:
        cause = getattr(error, "strerror", None) or error
        raise RecordingError(f"{output}: cannot be written: {cause}") from error
    except RecordingError:
        shutil.rmtree(output, ignore_errors=True)
        raise
    return written


def _messages(
    source: Recording, types: RosTypes, world: str | None, tf: str | None
) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, stamp (ns) and ROS message of everything that has one; what is bolted on comes first."""
    bridge = bridge_of(source, types, world, tf)
    span = source.span()
    if span is not None:
        yield bridge.static_topic, TF_TYPE, span[0], bridge.static(span[0])
    pictures: dict[str, list[Picture]] = {}
    for sample in source.samples():
        if sample.key not in pictures:
            pictures[sample.key] = bridge.pictures(sample.node, sample.port, sample.kind)
        if here := pictures[sample.key]:
            message = sample.decoded()
            for topic, kind, make in here:
                if (made := make(message)) is not None:
                    yield topic, kind, sample.stamp, made


def bridge_of(source: Recording, types: RosTypes, world: str | None, tf: str | None) -> RosMessages:
    """The ROS messages of a recording; raises RecordingError for a stream `tf` that it does not hold."""
    if tf is not None:
        node, _, port = tf.partition("/")
        source.stream(node, port)
    kinds = {f"{each.node}/{each.port}": SAMPLES.get(each.schema) for each in source.streams.values() if each.count}
    return RosMessages(types, frames_of(source.validated_rig(), world), tf=tf_stream(kinds, tf))
