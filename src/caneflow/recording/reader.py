"""Reads a recording in the order of its stamps, in bounded memory; one that a kill cut short as well."""

import heapq
import json
import os
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from itertools import islice, takewhile
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, Self, TypeAlias
from weakref import WeakValueDictionary

import numpy as np
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from numpy.typing import NDArray

from caneflow.errors import not_installed
from caneflow.messages import SAMPLES, MessageError, Sample, decode, stream_of
from caneflow.messages.codec import fields_in
from caneflow.messages.rig import Rig, overlaid, read_rig
from caneflow.near_files import near_file
from caneflow.printable import printable
from caneflow.recording.columns import flat, structured
from caneflow.recording.continuity import Continuity
from caneflow.recording.errors import RecordingError
from caneflow.recording.layout import (
    DAMAGE,
    MAGIC,
    Block,
    Content,
    Entry,
    Layout,
    TooMuchError,
    content_of,
    layout_of,
)
from caneflow.recording.platform import Platform
from caneflow.recording.writer import FORMAT_VERSION

DataFrame: TypeAlias = Any  # of polars or pandas, neither of which is needed here

TRUTH = ("truth", "pose")  # node and port of the ground truth, where there is any
MAX_RIG = 2**20  # characters of JSON
MAX_RIG_DEPTH = 16
MAX_SCHEMA_DEPTH = 64
MAX_HELD = 2**26  # bytes of unpacked blocks in use at a time, one per stream; a payload that is given out adds its own
COUNTED = (
    2**16
)  # bytes of a block that is worth adding up: smaller ones of all streams there can be are as much as that
MOST_PASSES = 16  # through a file, by streams that lie far apart in time
GLANCE_BLOCKS = 64  # a minute of a live recording
GLANCE_BYTES = 2**23  # unpacked: most of a minute of a cane
MOST_NAMED = 50  # streams in an error message
EXPECTED = "a recording is an MCAP file as `caneflow run --record` writes it"

End: TypeAlias = tuple[int, int] | tuple[None, None]  # stamp (ns) and seq
NEVER: End = (None, None)

# Blocks by file and offset, while someone reads them: a host in one process has a reader per source of the graph.
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
    kind: type[Sample] | None  # None: a type that this process does not know, as a user's own
    stamp: int  # ns, when the sensor measured
    seq: int
    log_time: int  # ns, when it was received
    payload: bytes

    def decoded(self) -> Sample:
        """The sample itself; raises RecordingError, naming stream and number, when it breaks the contract."""
        if self.kind is None:
            raise RecordingError(f"{self.key}: holds messages of a type that is not known here")
        try:
            return decode(self.payload, self.kind)
        except MessageError as error:
            raise RecordingError(f"{self.key}: sample {self.seq}: {error}") from error

    def fields(self) -> dict[str, Any]:
        """Its fields by name, of any type; raises RecordingError as `decoded` does for those that are known."""
        try:
            return fields_in(self.payload, self.kind)
        except MessageError as error:
            raise RecordingError(f"{self.key}: sample {self.seq}: {error}") from error


@dataclass
class _Effort:
    """How many blocks may still be unpacked: streams far apart in time each go through all of them by themselves."""

    left: int

    def spend(self) -> bool:
        """Whether there is one left; it is gone then."""
        self.left -= 1
        return self.left >= 0


class Recording:
    """A recording, open for reading; several iterations may be under way at a time, in one thread.

    complete: False for a file whose writer was killed (or still writes); everything up to the cut is there.
    metadata: flow, version, run, source.  rig: as it was recorded.
    platform: on what it was computed; None when it does not say.
    streams: by (node, port), in the order in which they were recorded first.
    control: number of messages by key, of what the flow said about itself.

    Raises RecordingError, here and in every method, for a file that is not a recording or that is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._file = self.path.open("rb")
        except OSError as error:
            why = f"{error.strerror or error}{near_file(self.path)}"
            raise RecordingError(f"{self.path}: cannot be read: {why}") from error
        try:
            self._layout = _sound_layout(self.path, self._file)
            about = os.fstat(self._file.fileno())
            self._file_id = (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns)
            self._blocks = _by_topic(self._layout)
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

    def validated_rig(self, below: Mapping[str, Any] | None = None) -> Rig:
        """The rig, laid over `below`; raises RecordingError, naming every value that is not right."""
        try:
            return read_rig(overlaid(dict(below or {}), self.rig))
        except MessageError as error:
            raise RecordingError(f"{self.path}: {error}") from error

    def span(self) -> tuple[int, int] | None:
        """The smallest and the largest stamp (ns) at the ends of all streams; None when there is no sample."""
        ends = ((stream.first_stamp, stream.last_stamp) for stream in self.streams.values())
        stamps = [stamp for pair in ends for stamp in pair if stamp is not None]
        return (min(stamps), max(stamps)) if stamps else None

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
        effort = _Effort(MOST_PASSES * len(self._layout.blocks))
        each = [self._samples_of(stream, start_ns, end_ns, effort) for stream in wanted]
        if len(each) == 1:
            return each[0]
        return heapq.merge(*each, key=attrgetter("stamp"))  # equal stamps: in the order of the arguments

    def array(
        self, stream: str | tuple[str, str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> NDArray[np.void]:
        """The samples of `stream` ("imu/imu") with start_ns <= stamp < end_ns, one row each, a column per field.

        A structured numpy array: `rows["stamp"]` (int64, ns), `rows["gyro"]` (n, 3), `rows["scans"]` (n, bins) for
        frames of one scan, else (n, scans, bins). What a sample lacks is NaN, a field that none has is left out.

        Raises RecordingError also when arrays change their shape: take a part by stamps, or `samples`.
        """
        node, _, port = stream.partition("/") if isinstance(stream, str) else (stream[0], "", stream[1])
        samples = [each.decoded() for each in self.samples([(node, port)], start_ns=start_ns, end_ns=end_ns)]
        try:
            return structured(samples)
        except ValueError as error:
            raise RecordingError(f"{self.path}: {node}/{port}: {error}") from error

    def frame(
        self, stream: str | tuple[str, str], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> "DataFrame":
        """The same as a data frame of polars or, where that is not installed, of pandas.

        A vector is a column per element (`gyro_0`, `gyro_1`, `gyro_2`); arrays such as scans are left out.

        Raises RecordingError also where neither polars nor pandas is installed.
        """
        columns = flat(self.array(stream, start_ns=start_ns, end_ns=end_ns))
        for library in ("polars", "pandas"):
            if find_spec(library) is not None:
                return import_module(library).DataFrame(columns)
        raise RecordingError(f"no pandas here, and {not_installed('polars', 'parquet')}")

    def examined(
        self,
        streams: Iterable[tuple[str, str]] | None = None,
        *,
        end_ns: int | None = None,
        glance: bool = False,
    ) -> dict[tuple[str, str], Continuity]:
        """How the samples of each of `streams` (None: all) follow each other, up to a first stamp >= `end_ns`.

        `glance`: only a few blocks of a long file are looked at, spread evenly over it.
        """
        found = {name: Continuity(self.stream(*name).key) for name in (self.streams if streams is None else streams)}
        left = {each.key: each for each in found.values()}
        for block in self._spread() if glance else self._layout.blocks:
            content = None
            for key in block.topics & left.keys():
                content = content or self._content(block)
                entries, data = content.messages[key], content.data
                within = entries if end_ns is None else _before(end_ns, entries)
                left[key].take_all((seq, stamp, data[begin:finish]) for stamp, seq, _, begin, finish in within)
                if len(within) < len(entries):
                    del left[key]
        return found

    def _spread(self) -> list[Block]:
        """So many blocks, evenly spread, that looking at them takes a moment, however long the file is."""
        blocks = self._layout.blocks
        unpacked = sum(block.unpacked for block in blocks)
        return blocks[:: max(1, -(-len(blocks) // GLANCE_BLOCKS), -(-unpacked // GLANCE_BYTES))]

    def said(self, key: str) -> Iterator[bytes]:
        """The payloads of a control key such as `cane/@/late`, in the order of the file."""
        for block in self._blocks.get(key, []):
            content = self._content(block)
            for *_, begin, finish in content.messages[key]:
                yield content.data[begin:finish]

    def stream(self, node: str, port: str) -> Stream:
        """The stream that `node` said on `port`; raises RecordingError, naming those there are."""
        try:
            return self.streams[node, port]
        except KeyError:
            raise RecordingError(f"{self.path}: no stream {node}/{port}; there are {self.named()}") from None

    def json_schema(self, node: str, port: str) -> dict[str, Any]:
        """The JSON Schema of a stream's messages as it was recorded; {} when there is none to be read."""
        channel = self._topics()[self.stream(node, port).key]
        try:
            schema = json.loads(self._schema(channel).data)
        except (ValueError, RecursionError):
            return {}
        return schema if isinstance(schema, dict) and not _is_deeper(schema, MAX_SCHEMA_DEPTH) else {}

    def named(self) -> str:
        """The names of the streams, for a line; of very many only the first."""
        names = ["/".join(name) for name in self.streams]
        more = [f"and {len(names) - MOST_NAMED} more"] if len(names) > MOST_NAMED else []
        return ", ".join([*names[:MOST_NAMED], *more]) or "none"

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

    def _samples_of(self, stream: Stream, start: int | None, end: int | None, effort: "_Effort") -> Iterator[Recorded]:
        """The samples of one stream. Holds one block at a time, which is what bounds the memory."""
        key, node, port, kind = stream.key, stream.node, stream.port, SAMPLES.get(stream.schema)
        blocks = self._blocks.get(key, [])
        first = 0 if start is None else bisect_left(blocks, start, key=lambda block: self._last(block, key))
        for block in islice(blocks, first, None):
            content = self._content(block, effort)
            for stamp, seq, log_time, begin, finish in content.messages[key]:
                if start is not None and stamp < start:
                    continue
                if end is not None and stamp >= end:
                    return
                yield Recorded(key, node, port, kind, stamp, seq, log_time, content.data[begin:finish])

    def _content(self, block: Block, effort: "_Effort | None" = None) -> Content:
        """The messages of `block`, unpacked once for all that are in it at a time."""
        at = self._file_id, block.offset
        content = _contents.get(at)
        if content is None:
            if effort is not None and not effort.spend():
                raise RecordingError(
                    f"{self.path}: its streams lie too far apart in time to be read together; read them one by one"
                )
            try:
                content = content_of(self._file, block, self._layout.declared)
            except TooMuchError as error:
                raise RecordingError(f"{self.path}: {error}") from error
            except DAMAGE as error:
                raise RecordingError(_damaged(self.path, block.offset)) from error
            held = sum(each.memory for each in _contents.values()) if content.memory > COUNTED else 0
            if held and held + content.memory > MAX_HELD:
                raise RecordingError(
                    f"{self.path}: its streams lie so far apart in the file that more than {MAX_HELD >> 20} MiB of it "
                    "would be in use at a time; a recording has them side by side"
                )
            _contents[at] = content
        return content

    def _streams(self) -> tuple[dict[tuple[str, str], Stream], dict[str, int]]:
        streams: dict[tuple[str, str], Stream] = {}
        others: dict[str, int] = {}
        firsts, lasts = self._ends()
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
            (first, first_seq), (last, last_seq) = firsts.get(key, NEVER), lasts.get(key, NEVER)
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

    def _ends(self) -> tuple[dict[str, End], dict[str, End]]:
        """Stamp and seq of each topic's first and last sample, found without reading what lies between."""
        edges = {block.offset: block for blocks in self._blocks.values() for block in (blocks[0], blocks[-1])}
        firsts: dict[str, End] = {}
        lasts: dict[str, End] = {}
        for _, block in sorted(edges.items()):  # each is unpacked once, for all streams that begin or end there
            for key, entries in self._content(block).messages.items():
                firsts.setdefault(key, entries[0][:2])
                lasts[key] = entries[-1][:2]
        return firsts, lasts

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
    try:
        layout = layout_of(file)
    except TooMuchError as error:
        raise RecordingError(f"{path}: {error}") from error
    if layout.damaged:
        raise RecordingError(_damaged(path, layout.damaged[0]))
    return layout


def _before(end: int, entries: list[Entry]) -> list[Entry]:
    """Those before the first whose stamp is at or after `end`."""
    return list(takewhile(lambda entry: entry[0] < end, entries))


def _by_topic(layout: Layout) -> dict[str, list[Block]]:
    blocks: defaultdict[str, list[Block]] = defaultdict(list)
    for block in layout.blocks:
        for topic in block.topics:
            blocks[topic].append(block)
    return dict(blocks)


def require_mcap(path: Path, file: BinaryIO) -> None:
    """Raise RecordingError unless `file` starts as an MCAP file does."""
    start = file.read(len(MAGIC))
    if not start:
        raise RecordingError(f"{path}: is empty; {EXPECTED}")
    if start != MAGIC:
        found = (
            "was cut in its first bytes"
            if MAGIC.startswith(start)
            else f"is not an MCAP file, it begins with {start!r}"
        )
        raise RecordingError(f"{path}: {found}; {EXPECTED}")


def _about(path: Path, layout: Layout) -> tuple[dict[str, str], dict[str, Any]]:
    """The metadata and the rig."""
    for name, key in (("caneflow", "flow"), ("rig", "json")):
        if key not in layout.metadata.get(name, {}):
            cut = "" if layout.complete else ", it was cut before there was any"
            raise RecordingError(f"{path}: has no metadata record {name!r} with {key!r}{cut}; {EXPECTED}")
    about = {key: printable(value) for key, value in layout.metadata["caneflow"].items()}
    version = about.get("version", "")
    if version.isdecimal() and version != FORMAT_VERSION:
        raise RecordingError(
            f"{path}: has version {version[:9]} of the layout; this version of caneflow reads version {FORMAT_VERSION}"
        )
    return about, rig_in(path, layout.metadata["rig"]["json"])


def rig_in(path: Path, text: str) -> dict[str, Any]:
    """The rig in the JSON `text`; raises RecordingError when there is none."""
    if len(text) > MAX_RIG:
        raise RecordingError(f"{path}: the rig in it has {len(text)} characters; at most {MAX_RIG} are read")
    try:
        rig = json.loads(text)
        json.dumps(rig, ensure_ascii=False).encode()  # half a surrogate pair is not text
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: the rig in it is not JSON: {error}") from error
    if not isinstance(rig, dict):
        raise RecordingError(f"{path}: the rig in it is not a map but {text[:60]!r}")
    if _is_deeper(rig, MAX_RIG_DEPTH):
        raise RecordingError(f"{path}: the rig in it is nested more than {MAX_RIG_DEPTH} deep; that is not a rig")
    return rig


def _is_deeper(value: object, depth: int) -> bool:
    """Whether maps and lists are nested more than `depth` deep in `value`."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return depth < 0 or any(_is_deeper(each, depth - 1) for each in inside)


def _damaged(path: Path, offset: int) -> str:
    return f"{path}: damaged at byte {offset}; `caneflow recover {path}` saves the rest"
