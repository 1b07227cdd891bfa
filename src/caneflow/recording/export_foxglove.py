"""A recording as an MCAP file for Foxglove, Lichtblick, PlotJuggler and Rerun: the channels of the live server."""

import json
from collections import Counter
from pathlib import Path

from caneflow.bridges.foxglove_channels import FoxgloveChannels, sdk
from caneflow.bridges.ros_types import RosTypes
from caneflow.messages import SAMPLES
from caneflow.recording.errors import RecordingError
from caneflow.recording.export_rosbag2 import bridge_of
from caneflow.recording.reader import Recording


def export_foxglove(
    source: Recording, output: Path, *, world: str | None = None, tf: str | None = None
) -> Counter[str]:
    """Write what `source` holds to `output`; how many messages went to each topic.

    The channels are those of `FoxgloveChannels`, log times are the stamps, and the rig is in the metadata. `world`: the
    name of R0; `tf`: the stream (node/port) that fills /tf, where several could.

    Raises RecordingError for a file that cannot be written, BridgeError without foxglove-sdk or rosbags.
    """
    foxglove = sdk()
    bridge = bridge_of(source, RosTypes(), world, tf)
    context = foxglove.Context()
    try:
        writer = foxglove.open_mcap(output, allow_overwrite=True, context=context)
    except (OSError, RuntimeError) as error:
        raise RecordingError(f"{output}: cannot be written: {error}") from error
    try:
        with writer:
            writer.write_metadata("rig", {"json": json.dumps(source.rig)})
            return _written(source, FoxgloveChannels(context, bridge))
    except RuntimeError as error:  # a full disk, which shows when the file is ended
        raise RecordingError(f"{output}: cannot be written: {error}") from error


def _written(source: Recording, channels: FoxgloveChannels) -> Counter[str]:
    span = source.span()
    if span is not None:
        channels.tell_rig(span[0])
    written: Counter[str] = Counter()
    for stream in source.streams.values():
        channels.declare(stream.node, stream.port, SAMPLES.get(stream.schema) if stream.count else None)
    for sample in source.samples():
        if sample.kind is not None:
            written.update(channels.take(sample.node, sample.port, sample.decoded()))
    return written
