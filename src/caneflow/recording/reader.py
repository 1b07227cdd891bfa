"""Reads a recording in the order of its stamps, in bounded memory; one that a kill cut short as well."""

import heapq
import json
import os
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, Self
from weakref import WeakValueDictionary

from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from caneflow.messages import SAMPLES, MessageError, Sample, decode, stream_of
from caneflow.recording.errors import RecordingError
from caneflow.recording.layout import DAMAGE, MAGIC, Block, Content, Layout, content_of, layout_of
from caneflow.recording.platform import Platform

TRUTH = ("truth", "pose")  # node and port of the ground truth, where there is any
MAX_RIG_DEPTH = 16
EXPECTED = "a recording is an MCAP file as `caneflow run --record` writes it"

# Blocks by file and offset, while somebody reads them: a host in one process has a reader per source of the graph.
_contents: WeakValueDictionary[tuple[tuple[int, ...], int], Content] = WeakValueDictionary()


@dataclass(frozen=True, kw_only=True)
class Stream:
    """What one node said on one port."""

    key: str
    node: str
    port: str
    schema: str  # its name, e.g. "caneflow.Imu/1"
    count: int  # samples
    first_stamp: int | None  # ns; None when there is no sample
    last_stamp: int | None  # ns
    first_seq: int | None = None
    last_seq: int | None = None


class Recorded(NamedTuple):
    """One sample as it was recorded; whether its payload can be decoded is for the reader to find out."""

    key: str
    node: str
    port: str
    kind: type[Sample] | None  # None: a schema that this version of caneflow does not know
    stamp: int  # ns, when the sensor measured
    seq: int
    log_time: int  # ns, when it was received
    payload: bytes

    def decoded(self) -> Sample:
        """The sample itself; raises RecordingError, naming stream and number, when it breaks the contract."""
        if self.kind is None:
            raise RecordingError(f"{self.key}: holds messages that this version of caneflow does not know")
        try:
            return decode(self.payload, self.kind)
        except MessageError as error:
            raise RecordingError(f"{self.key}: sample {self.seq}: {error}") from error


class Recording:
    """A recording, open for reading; several iterations may be under way at a time, in one thread.

    complete: False for a file whose writer was killed (or still writes); everything up to the cut is there.
    metadata: flow, version, run, source.  rig: as it was recorded.
    platform: on what it was computed; None when it does not say.
    streams: by (node, port), in the order in which they were recorded first.
    control: number of messages by key, of what the flow said about itself.

    Raises RecordingError, here and in every method, for a file that is no recording or that is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        try:
            self._layout = _sound_layout(self.path, self._file)
            about = os.fstat(self._file.fileno())
            self._file_id = (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns)
            self._lasts: dict[tuple[int, str], int] = {}  # by offset and key: the last stamp, ns
            self.complete = self._layout.complete
            self.metadata, self.rig = _about(self.path, self._layout)
            self.platform = Platform.read(self.metadata)
            self.streams, self.control = self._streams()
        except BaseException:
            self._file.close()
            raise

    @property
    def flow(self) -> str:
        """The name of the flow that was recorded."""
        return self.metadata["flow"]

    def span(self) -> tuple[int, int] | None:
        """Stamps (ns) of the first and last sample of all streams; None when there is no sample."""
        first = [stream.first_stamp for stream in self.streams.values() if stream.first_stamp is not None]
        last = [stream.last_stamp for stream in self.streams.values() if stream.last_stamp is not None]
        return (min(first), max(last)) if first else None

    def samples(
        self,
        streams: Iterable[tuple[str, str]] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Recorded]:
        """Samples with start_ns <= stamp < end_ns: by stamp, then by the order of `streams`, then by seq.

        Streams are (node, port); None means all. When a sample was received plays no part in the order.
        Within one stream it is the file's, which is that of the stamps unless its producer broke the contract.
        """
        wanted = [self.stream(*name) for name in (self.streams if streams is None else streams)]
        for stream in wanted:
            self._require_samples(stream)
        each = [self._samples_of(stream, start_ns, end_ns) for stream in wanted]
        if len(each) == 1:
            return each[0]
        return heapq.merge(*each, key=attrgetter("stamp"))  # equal stamps: in the order of the arguments

    def said(self, key: str) -> Iterator[bytes]:
        """The payloads of a control key such as `cane/@/late`, in the order of the file."""
        for block in self._blocks(key):
            content = self._content(block)
            for *_, begin, finish in content.messages[key]:
                yield content.data[begin:finish]

    def stream(self, node: str, port: str) -> Stream:
        """The stream that `node` said on `port`; raises RecordingError, naming those there are."""
        try:
            return self.streams[node, port]
        except KeyError:
            there = ", ".join("/".join(name) for name in self.streams) or "none"
            raise RecordingError(f"{self.path}: no stream {node}/{port}; there are {there}") from None

    def streams_of(self, kind: type[Sample]) -> list[Stream]:
        """The streams with samples of `kind`, ground truth aside."""
        return [s for name, s in self.streams.items() if s.schema == kind.schema and s.count and name != TRUTH]

    def close(self) -> None:
        """Close the file; iterations under way end with an error."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _samples_of(self, stream: Stream, start: int | None, end: int | None) -> Iterator[Recorded]:
        """The samples of one stream. Holds one block at a time, which is what bounds the memory."""
        key, node, port, kind = stream.key, stream.node, stream.port, SAMPLES.get(stream.schema)
        blocks = self._blocks(key)
        if start is not None:
            del blocks[: bisect_left(blocks, start, key=lambda block: self._last(block, key))]
        for block in blocks:
            content = self._content(block)
            for stamp, seq, log_time, begin, finish in content.messages[key]:
                if start is not None and stamp < start:
                    continue
                if end is not None and stamp >= end:
                    return
                yield Recorded(key, node, port, kind, stamp, seq, log_time, content.data[begin:finish])

    def _blocks(self, key: str) -> list[Block]:
        return [block for block in self._layout.blocks if key in block.topics]

    def _content(self, block: Block) -> Content:
        """The messages of `block`, unpacked once for all that are in it at a time."""
        at = self._file_id, block.offset
        content = _contents.get(at)
        if content is None:
            try:
                content = content_of(self._file, block, self._layout.declared)
            except DAMAGE as error:
                raise RecordingError(_damaged(self.path, block.offset)) from error
            _contents[at] = content
        return content

    def _streams(self) -> tuple[dict[tuple[str, str], Stream], dict[str, int]]:
        streams: dict[tuple[str, str], Stream] = {}
        others: dict[str, int] = {}
        for key, channel in self._topics().items():
            try:
                node, port = stream_of(key)
            except ValueError:
                others[key] = self._layout.counts[key]
                continue
            if (node, port) in streams:
                raise RecordingError(
                    f"{self.path}: both {streams[node, port].key} and {key} are in it; a recording is of one flow"
                )
            (first, first_seq), (last, last_seq) = self._ends(key)
            streams[node, port] = Stream(
                key=key,
                node=node,
                port=port,
                schema=self._schema(channel).name,
                count=self._layout.counts[key],
                first_stamp=first,
                last_stamp=last,
                first_seq=first_seq,
                last_seq=last_seq,
            )
        return streams, others

    def _topics(self) -> dict[str, Channel]:
        """One channel for each topic, in the order of their numbers."""
        topics: dict[str, Channel] = {}
        for _, channel in sorted(self._layout.declared.channels.items()):
            topics.setdefault(channel.topic, channel)
        return topics

    def _ends(self, key: str) -> tuple[tuple[int, int] | tuple[None, None], tuple[int, int] | tuple[None, None]]:
        """Stamp and seq of the first and the last sample, found without reading what lies between."""
        blocks = self._blocks(key)
        if not blocks:
            return (None, None), (None, None)
        first, last = self._content(blocks[0]).messages[key][0], self._content(blocks[-1]).messages[key][-1]
        return first[:2], last[:2]

    def _last(self, block: Block, key: str) -> int:
        """Stamp of the last sample of `key` in `block`, which is kept: a search looks at few blocks many times."""
        at = block.offset, key
        if at not in self._lasts:
            messages = self._content(block).messages
            self._lasts.update({(block.offset, topic): entries[-1][0] for topic, entries in messages.items()})
        return self._lasts[at]

    def _schema(self, channel: Channel) -> Schema:
        nothing = Schema(id=0, name="", encoding="", data=b"")
        return self._layout.declared.schemas.get(channel.schema_id, nothing)

    def _require_samples(self, stream: Stream) -> None:
        """Raise RecordingError unless the stream's channel says that it holds samples as caneflow sends them."""
        channel = self._topics()[stream.key]
        schema = self._schema(channel)
        found = channel.message_encoding, schema.encoding
        if found != (MessageEncoding.MessagePack, SchemaEncoding.JSONSchema):
            raise RecordingError(
                f"{self.path}: {stream.key} is {found[0] or 'of no encoding'} with "
                f"{f'schema {schema.name} ({found[1]})' if schema.id else 'no schema'}; "
                "a sample is msgpack with a schema such as caneflow.Imu/1 (jsonschema)"
            )


def _sound_layout(path: Path, file: BinaryIO) -> Layout:
    require_mcap(path, file)
    layout = layout_of(file)
    if layout.damaged:
        raise RecordingError(_damaged(path, layout.damaged[0]))
    return layout


def require_mcap(path: Path, file: BinaryIO) -> None:
    """Raise RecordingError unless `file` starts as an MCAP file does."""
    start = file.read(len(MAGIC))
    if not start:
        raise RecordingError(f"{path}: is empty; {EXPECTED}")
    if start != MAGIC:
        found = (
            "was cut in its first bytes" if MAGIC.startswith(start) else f"is no MCAP file, it starts with {start!r}"
        )
        raise RecordingError(f"{path}: {found}; {EXPECTED}")


def _about(path: Path, layout: Layout) -> tuple[dict[str, str], dict[str, Any]]:
    """The metadata and the rig."""
    for name, key in (("caneflow", "flow"), ("rig", "json")):
        if key not in layout.metadata.get(name, {}):
            cut = "" if layout.complete else ", it was cut before there was any"
            raise RecordingError(f"{path}: has no metadata record {name!r} with {key!r}{cut}; {EXPECTED}")
    return layout.metadata["caneflow"], _rig_in(path, layout.metadata["rig"]["json"])


def _rig_in(path: Path, text: str) -> dict[str, Any]:
    try:
        rig = json.loads(text)
        json.dumps(rig, ensure_ascii=False).encode()  # half a surrogate pair is no text
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: the rig in it is no JSON: {error}") from error
    if not isinstance(rig, dict):
        raise RecordingError(f"{path}: the rig in it is no map, it is {text[:60]!r}")
    if _is_deeper(rig, MAX_RIG_DEPTH):
        raise RecordingError(f"{path}: the rig in it is nested more than {MAX_RIG_DEPTH} deep; that is no rig")
    return rig


def _is_deeper(value: object, depth: int) -> bool:
    """Whether maps and lists are nested more than `depth` deep in `value`."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return depth < 0 or any(_is_deeper(each, depth - 1) for each in inside)


def _damaged(path: Path, offset: int) -> str:
    return f"{path}: damaged at byte {offset}; `caneflow recover {path}` saves the rest"
