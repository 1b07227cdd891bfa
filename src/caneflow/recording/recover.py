"""Makes a sound recording of one whose writer was killed, or that was damaged: all that can still be read."""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer

from caneflow import __version__
from caneflow.recording.errors import RecordingError
from caneflow.recording.layout import Layout, content_of, walked
from caneflow.recording.reader import require_mcap
from caneflow.recording.writer import CHUNK_SIZE


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What a recovery found."""

    complete: bool  # the file had not been cut
    damaged: int  # chunks that could not be read, and were left out
    messages: dict[str, int]  # saved, by key


def recover(path: str | Path, output: str | Path) -> Recovered:
    """Copy every message of `path` up to its cut, and its metadata, to the sound file `output`.

    Raises RecordingError when `path` is no MCAP file, nothing of it is left, or `output` cannot be written.
    """
    path, output = Path(path), Path(output)
    try:
        with path.open("rb") as source:
            require_mcap(path, source)
            layout = walked(source)
            if not layout.metadata and not layout.blocks:
                raise RecordingError(f"{path}: was cut before its first message; there is nothing to recover")
            if output.exists() and output.samefile(path):
                raise RecordingError(f"{output}: is the file to recover; give the sound one another name")
            with output.open("wb") as target:
                _copy(source, layout, target)
    except OSError as error:
        raise RecordingError(f"{error.filename or output}: {error.strerror or error}") from error
    return Recovered(complete=layout.complete, damaged=len(layout.damaged), messages=dict(layout.counts))


def _copy(source: BinaryIO, layout: Layout, target: BinaryIO) -> None:
    writer = Writer(target, chunk_size=CHUNK_SIZE)
    writer.start(library=f"caneflow {__version__}")
    for name, metadata in layout.metadata.items():
        writer.add_metadata(name, metadata)
    schemas = {0: 0}  # 0: a channel without a schema
    for number, schema in sorted(layout.declared.schemas.items()):
        schemas[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
    channels: dict[str, int] = {}
    for _, channel in sorted(layout.declared.channels.items()):
        if channel.topic not in channels:
            schema_id = schemas.get(channel.schema_id, 0)
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
    for block in layout.blocks:
        content = content_of(source, block, layout.declared)
        # By their place in the block, so that messages of several topics keep the order in which they came.
        entries = ((entry, topic) for topic, each in content.messages.items() for entry in each)
        for (stamp, seq, log_time, start, end), topic in sorted(entries, key=lambda item: item[0][3]):
            writer.add_message(channels[topic], log_time, content.data[start:end], stamp, seq)
    writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without a return type
