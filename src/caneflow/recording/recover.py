"""Makes a sound recording of one whose writer was killed, or that was damaged: all that can still be read."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer

from caneflow import __version__
from caneflow.recording.errors import RecordingError
from caneflow.recording.layout import Layout, TooMuchError, content_of, walked
from caneflow.recording.reader import Recording, require_mcap, rig_in
from caneflow.recording.writer import CHUNK_SIZE, FORMAT_VERSION


class NothingLeftError(RecordingError):
    """A file of which no recording can be made."""


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """What a recovery found."""

    complete: bool  # the file had not been cut
    damaged: int  # chunks that could not be read, and were left out
    messages: dict[str, int]  # saved, by key
    replaced: tuple[str, ...] = ()  # metadata records that could not be read, and were made up


def recover(path: str | Path, output: str | Path) -> Recovered:
    """Copy every message of `path` up to its cut, and its metadata, to the sound file `output`.

    Raises NothingLeftError, without a file, when the rest of `path` is not a recording; RecordingError when it is
    no MCAP file, or when `output` cannot be written.
    """
    path, output = Path(path), Path(output)
    try:
        with path.open("rb") as source:
            require_mcap(path, source)
            layout = walked(source)
            if output.exists() and output.samefile(path):
                raise RecordingError(f"{output}: is the file to recover; give the sound one another name")
            replaced = tuple(_with_metadata(path, layout))
            with output.open("wb") as target:
                _copy(source, layout, target)
        _require_readable(path, output)
    except TooMuchError as error:
        raise RecordingError(f"{path}: {error}") from error
    except OSError as error:
        raise RecordingError(f"{error.filename or output}: {error.strerror or error}") from error
    damaged = len(layout.damaged)
    return Recovered(complete=layout.complete, damaged=damaged, messages=dict(layout.counts), replaced=replaced)


def _with_metadata(path: Path, layout: Layout) -> Iterator[str]:
    """Make up the metadata that was lost: the flow's name from the keys, an empty rig; the names of those records."""
    about = layout.metadata.get("caneflow", {})
    if "flow" not in about:
        if not layout.blocks:
            raise NothingLeftError(f"{path}: was cut before its first message; there is nothing to recover")
        flow = next(topic.partition("/")[0] for topic in layout.counts)
        layout.metadata["caneflow"] = {"flow": flow, "version": FORMAT_VERSION, "run": "", "source": "live", **about}
        yield "caneflow"
    try:
        rig_in(path, layout.metadata["rig"]["json"])
    except (KeyError, RecordingError):
        if not layout.blocks:
            raise NothingLeftError(f"{path}: has neither a rig nor a message; there is nothing to recover") from None
        layout.metadata["rig"] = {"json": "{}"}
        yield "rig"


def _require_readable(path: Path, output: Path) -> None:
    """Remove `output` and raise NothingLeftError if it does not read back from end to end."""
    try:
        with Recording(output) as written:
            written.examined()
            for key in written.control:
                deque(written.said(key), maxlen=0)
    except RecordingError as error:
        output.unlink()
        why = str(error).removeprefix(f"{output}: ")
        raise NothingLeftError(f"{path}: what is left of it is not a recording: {why}") from error


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
