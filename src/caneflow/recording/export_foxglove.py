"""A recording as an MCAP file that Foxglove and Rerun show by themselves: poses, transforms, pictures, numbers."""

import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caneflow.messages import Pose, RadarFrame, Sample, json_schema
from caneflow.recording.errors import RecordingError
from caneflow.recording.radar_images import RadarImages
from caneflow.recording.reader import Recorded, Recording

WORLD = "R0"  # the frame that poses are in
MISSING = "foxglove-sdk is not installed; it comes with `pip install caneflow[foxglove]`"


def export_foxglove(source: Recording, output: Path) -> Counter[str]:
    """Write what `source` holds to `output`; how many messages went to each topic.

    A pose becomes a `PoseInFrame` in R0 on `/<node>/<port>` and a `FrameTransform` from R0 to `<node>`; a radar stream
    its range-Doppler map as a `RawImage`, ten a second; any other stream JSON with the message's numbers, arrays left
    out. Log time is the stamp.

    Raises RecordingError without foxglove-sdk, and for a file that cannot be written.
    """
    try:
        import foxglove
    except ImportError as error:
        raise RecordingError(MISSING) from error
    context = foxglove.Context()
    try:
        writer = foxglove.open_mcap(output, allow_overwrite=True, context=context)
    except (OSError, RuntimeError) as error:
        raise RecordingError(f"{output}: cannot be written: {error}") from error
    try:
        with writer:
            return _written(source, context)
    except RuntimeError as error:  # a full disk, which shows when the file is ended
        raise RecordingError(f"{output}: cannot be written: {error}") from error


def _written(source: Recording, context: Any) -> Counter[str]:
    written: Counter[str] = Counter()
    writers: dict[str, Callable[[Recorded], int]] = {}
    for sample in source.samples():
        if sample.kind is not None:
            topic = f"/{sample.node}/{sample.port}"
            if topic not in writers:
                writers[topic] = _writer(sample, topic, context)
            written[topic] += writers[topic](sample)
    return written


def _writer(first: Recorded, topic: str, context: Any) -> Callable[[Recorded], int]:
    """What writes the samples of one stream; it returns how many messages came of a sample."""
    if first.kind is Pose:
        return _poses(first.node, topic, context)
    if first.kind is RadarFrame:
        return _maps(first.node, topic, context)
    assert first.kind is not None
    return _numbers(first.kind, topic, context)


def _poses(node: str, topic: str, context: Any) -> Callable[[Recorded], int]:
    from foxglove import channels, messages

    poses = channels.PoseInFrameChannel(topic, context=context)
    transforms = channels.FrameTransformChannel(f"{topic}/tf", context=context)

    def write(sample: Recorded) -> int:
        pose = sample.decoded()
        assert isinstance(pose, Pose)
        (x, y, z), (w, *turn) = pose.position, pose.orientation
        at = messages.Timestamp(*divmod(pose.stamp, 10**9))
        turned = messages.Quaternion(x=turn[0], y=turn[1], z=turn[2], w=w)
        place = messages.Pose(position=messages.Vector3(x=x, y=y, z=z), orientation=turned)
        poses.log(messages.PoseInFrame(timestamp=at, frame_id=WORLD, pose=place), log_time=pose.stamp)
        transform = messages.FrameTransform(
            timestamp=at,
            parent_frame_id=WORLD,
            child_frame_id=node,
            translation=messages.Vector3(x=x, y=y, z=z),
            rotation=turned,
        )
        transforms.log(transform, log_time=pose.stamp)
        return 1

    return write


def _maps(node: str, topic: str, context: Any) -> Callable[[Recorded], int]:
    from foxglove import channels, messages

    channel = channels.RawImageChannel(topic, context=context)
    images = RadarImages()

    def write(sample: Recorded) -> int:
        frame = sample.decoded()
        assert isinstance(frame, RadarFrame)
        image = images.take(frame)
        if image is None:
            return 0
        height, width = image.grey.shape
        message = messages.RawImage(
            timestamp=messages.Timestamp(*divmod(image.stamp, 10**9)),
            frame_id=node,
            width=width,
            height=height,
            encoding="mono8",
            step=width,
            data=image.grey.tobytes(),
        )
        channel.log(message, log_time=image.stamp)
        return 1

    return write


def _numbers(kind: type[Sample], topic: str, context: Any) -> Callable[[Recorded], int]:
    import foxglove

    described = json.dumps(json_schema(kind)).encode()
    schema = foxglove.Schema(name=kind.schema, encoding="jsonschema", data=described)
    channel = foxglove.Channel(topic, message_encoding="json", schema=schema, context=context)

    def write(sample: Recorded) -> int:
        channel.log(numbers_of(sample.decoded()), log_time=sample.stamp)
        return 1

    return write


def numbers_of(message: Sample) -> dict[str, Any]:
    """The fields of `message` as JSON has them: arrays and infinite values are left out."""
    values = {name: getattr(message, name) for name in message.__struct_fields__}
    return {
        name: msgspec.to_builtins(value)
        for name, value in values.items()
        if not (value is None or isinstance(value, np.ndarray) or (isinstance(value, float) and math.isinf(value)))
    }
