"""Every message that crosses a process, and its encoding: the contract of docs/messages.md."""

from caneflow.messages.codec import MAX_PAYLOAD, MEDIA_TYPE, decode, encode, json_schema, numbered, with_number
from caneflow.messages.errors import MessageError
from caneflow.messages.keys import NAME, NAME_RULE, control_key, sample_key, stream_of
from caneflow.messages.samples import (
    SAMPLES,
    DopplerBlock,
    DopplerTarget,
    GroundSpeed,
    Imu,
    Pose,
    RadarFrame,
    Sample,
)

__all__ = [
    "MAX_PAYLOAD",
    "MEDIA_TYPE",
    "NAME",
    "NAME_RULE",
    "SAMPLES",
    "DopplerBlock",
    "DopplerTarget",
    "GroundSpeed",
    "Imu",
    "MessageError",
    "Pose",
    "RadarFrame",
    "Sample",
    "control_key",
    "decode",
    "encode",
    "json_schema",
    "numbered",
    "sample_key",
    "stream_of",
    "with_number",
]
