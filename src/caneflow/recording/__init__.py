"""What a flow said, kept in a file: MCAP in and out, as docs/recordings.md lays it out."""

from caneflow.recording.errors import RecordingError
from caneflow.recording.platform import Platform
from caneflow.recording.reader import TRUTH, Recorded, Recording, Stream
from caneflow.recording.recover import NothingLeftError, Recovered, recover
from caneflow.recording.writer import Compression, Origin, RecordingWriter

__all__ = [
    "TRUTH",
    "Compression",
    "NothingLeftError",
    "Origin",
    "Platform",
    "Recorded",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "Recovered",
    "Stream",
    "recover",
]
