"""Where things are in an MCAP file: by its summary, or by a walk over its records when there is none."""

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise, repeat
from typing import BinaryIO, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Metadata, MetadataIndex, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from caneflow.printable import printable

MAGIC = MCAP0_MAGIC  # at the start and at the end of the file
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the payload
MESSAGE_START = struct.Struct("<BQHIQQ")  # a message's record up to its payload
FOOTER_LENGTH = RECORD.size + 20 + len(MAGIC)
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, size unpacked, check sum, length of the packing's name
LENGTH = struct.Struct("<Q")
CHECKED_FOOTER = RECORD.size + 16  # bytes of the footer that its check sum covers
MESSAGE = int(Opcode.MESSAGE)  # comparing with the enum's member takes as long as unpacking a message
MAX_BARE = 2**20  # bytes of messages outside any chunk that are taken as one block
# A chunk of ours has 256 kB and one message more, so 32 MiB at most; but 60 kB of a hostile file unpack to gigabytes.
MAX_CHUNK = 2**26  # bytes, unpacked
# Of 31 bytes each, of which an honest one takes 4 in a chunk, as numbers and stamps go on: so many in one of L bytes.
FEW_MESSAGES = 256  # and L more
MAX_MESSAGES = 2**18  # but never more
ENTRY_MEMORY = 250  # bytes of memory for each
MAX_UNPACKED = 2**30  # bytes that all chunks of a file unpack to, and UNPACKED_RATIO times its size more
UNPACKED_RATIO = 1000
MAX_CHANNELS = 1024  # a flow has some ten
MAX_DECLARED = 2**24  # bytes of all channels and schemas together
MAX_METADATA = 1024  # records
MAX_NAME = 1024  # bytes of a topic or of a schema's name
UNPACKS_TO_MUCH = (
    f"unpacks to more than {MAX_UNPACKED >> 30} GiB and {UNPACKED_RATIO} times its size; no recording is packed so well"
)
READ = {Opcode.CHUNK, Opcode.MESSAGE, Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL}  # the others are not needed

# Stamp, seq, log time; where in the block's data the payload starts and ends. Plain, as there are thousands.
Entry: TypeAlias = tuple[int, int, int, int, int]

# What mcap, its two decompressors and struct raise on bytes that are not what they should be.
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    LookupError,
    MemoryError,
    OverflowError,
    RuntimeError,
    ValueError,
)


@dataclass(frozen=True)
class Block:
    """A stretch of the file with messages: one chunk, or messages that lie outside any chunk."""

    offset: int  # byte at which its first record starts
    length: int  # bytes
    unpacked: int  # bytes
    topics: frozenset[str]  # which have messages in it


class TooMuchError(Exception):
    """A file that holds more than a recording can, or unpacks to more than its size can account for."""


@dataclass
class Declarations:
    """Channels and schemas by their numbers in the file; their names are printable."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    _known: set[bytes] = field(default_factory=set)  # records as they were read: many files repeat them in each chunk
    _size: int = 0  # bytes of those

    def note(self, opcode: int, body: bytes) -> None:
        """Take in a record, if it declares something.

        Raises ValueError when it declares it otherwise than before, TooMuchError when there are too many.
        """
        if opcode not in (Opcode.CHANNEL, Opcode.SCHEMA):
            return
        record = bytes((opcode,)) + body
        if record in self._known:
            return
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(body))
            channel.topic, channel.message_encoding = _name(channel.topic), _name(channel.message_encoding)
            if self.channels.setdefault(channel.id, channel) != channel:
                raise ValueError(f"channel {channel.id} is declared in two ways")
        else:
            schema = Schema.read(_stream(body))
            schema.name, schema.encoding = _name(schema.name), _name(schema.encoding)
            if self.schemas.setdefault(schema.id, schema) != schema:
                raise ValueError(f"schema {schema.id} is declared in two ways")
        self._known.add(record)
        self._size += len(record)
        if max(len(self.channels), len(self.schemas)) > MAX_CHANNELS or self._size > MAX_DECLARED:
            raise TooMuchError(
                f"declares more than {MAX_CHANNELS} channels or {MAX_DECLARED >> 20} MiB of them and their schemas, "
                "which is more than a recording of a flow has"
            )


@dataclass
class Layout:
    """What is where in one file."""

    complete: bool  # ends with its footer, as a file does whose writer was not killed
    declared: Declarations = field(default_factory=Declarations)
    blocks: list[Block] = field(default_factory=list)  # in the order of the file
    counts: Counter[str] = field(default_factory=Counter)  # messages by topic
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damaged: list[int] = field(default_factory=list)  # bytes at which records start that cannot be read


class Content:
    """The messages of one block: by topic, each in the order of the file."""

    def __init__(self, data: bytes, declared: Declarations, length: int) -> None:
        """Find the messages in `data`, which takes `length` bytes in the file; note in `declared` what it declares."""
        self.data = data
        self.messages: defaultdict[str, list[Entry]] = defaultdict(list)
        of_channel: dict[int, list[Entry]] = {}
        at, end = 0, len(data)
        most = min(FEW_MESSAGES + length, MAX_MESSAGES)
        for _ in repeat(None, most):
            if at >= end:
                break
            body = at + RECORD.size
            if at + MESSAGE_START.size <= end:  # in one go, as nearly all are messages
                opcode, length, number, seq, log_time, stamp = MESSAGE_START.unpack_from(data, at)
            else:
                opcode, length = RECORD.unpack_from(data, at)
            at = body + length
            if at > end:
                raise ValueError(f"a record reaches {at - end} bytes beyond its block")
            if opcode != MESSAGE:
                if opcode not in READ:
                    raise ValueError(f"a record of kind {opcode} among messages")
                declared.note(opcode, data[body:at])
                of_channel.clear()
                continue
            if length < MESSAGE_HEAD.size:
                raise ValueError(f"a message of {length} bytes; its head alone has {MESSAGE_HEAD.size}")
            entries = of_channel.get(number)
            if entries is None:
                entries = of_channel[number] = self.messages[declared.channels[number].topic]
            entries.append((stamp, seq, log_time, body + MESSAGE_HEAD.size, at))
        if at < end:
            raise ValueError(f"more than {most} records in {length} bytes")

    @property
    def memory(self) -> int:
        """Bytes that it takes, about."""
        return len(self.data) + ENTRY_MEMORY * sum(map(len, self.messages.values()))


def layout_of(file: BinaryIO) -> Layout:
    """Where things are in `file`, by the summary at its end, or else by a walk. Needs the magic at its start.

    Raises TooMuchError for a file that holds more than a recording can.
    """
    try:
        by_summary = _summarised(file)
    except DAMAGE:
        by_summary = None
    return by_summary or walked(file)


def content_of(file: BinaryIO, block: Block, declared: Declarations) -> Content:
    """The messages of `block`. Raises one of DAMAGE when its bytes are not sound."""
    if block.length > MAX_CHUNK:
        raise ValueError(f"a chunk of {block.length} bytes; at most {MAX_CHUNK} are taken")
    data = _unpacked(_read_at(file, block.offset, block.length))
    if len(data) != block.unpacked:
        raise ValueError(f"a chunk of {len(data)} bytes; the index says {block.unpacked}")
    content = Content(data, declared, block.length)
    if missing := block.topics - content.messages.keys():
        raise ValueError(f"no message of {', '.join(missing)}")
    return content


def walked(file: BinaryIO) -> Layout:
    """Where things are in `file`, found record by record, up to its end or to where it was cut.

    Raises TooMuchError for a file that holds more than a recording can.
    """
    layout = Layout(complete=False, declared=_summarised_declarations(file))
    in_chunks = in_summary = False
    budget = _most_unpacked(file)
    for opcode, offset, raw in _stretches(file):
        if opcode == Opcode.FOOTER:
            layout.complete = True
        elif in_summary:
            continue
        elif opcode == Opcode.DATA_END:
            in_summary = True
        elif opcode == Opcode.CHUNK or (opcode == MESSAGE and not in_chunks):
            in_chunks = opcode == Opcode.CHUNK
            budget -= _says_unpacked(raw)
            if budget < 0:
                raise TooMuchError(UNPACKS_TO_MUCH)
            _add_block(layout, offset, raw)
        elif opcode == MESSAGE:  # outside the chunks of a file that has chunks: something else, damaged
            layout.damaged.append(offset)
        else:
            _add_other(layout, opcode, offset, raw)
    return layout


def _summarised_declarations(file: BinaryIO) -> Declarations:
    """What the summary declares, if there is one: the chunk that did so first may be damaged."""
    try:
        by_summary = _summarised(file)
    except DAMAGE:
        by_summary = None
    return by_summary.declared if by_summary else Declarations()


def _stretches(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Opcode, offset and bytes of every record; neighbouring messages outside any chunk are taken together."""
    messages, start = bytearray(), 0
    for opcode, offset, raw in _records(file):
        if messages and (opcode != MESSAGE or len(messages) >= MAX_BARE):
            yield MESSAGE, start, bytes(messages)
            messages.clear()
        if opcode == MESSAGE:
            start = start if messages else offset
            messages += raw
        else:
            yield opcode, offset, raw
    if messages:
        yield MESSAGE, start, bytes(messages)


def _add_other(layout: Layout, opcode: int, offset: int, raw: bytes) -> None:
    try:
        _note(layout, opcode, raw[RECORD.size :])
    except DAMAGE:
        layout.damaged.append(offset)


def _add_block(layout: Layout, offset: int, raw: bytes) -> None:
    try:
        content = Content(_unpacked(raw), layout.declared, len(raw))
    except DAMAGE:
        layout.damaged.append(offset)
        return
    if content.messages:
        layout.blocks.append(Block(offset, len(raw), len(content.data), frozenset(content.messages)))
        layout.counts.update({topic: len(entries) for topic, entries in content.messages.items()})


def _note(layout: Layout, opcode: int, body: bytes) -> None:
    """Take in a record without messages."""
    if opcode == Opcode.METADATA:
        metadata = Metadata.read(_stream(body))
        about = {_name(key): value for key, value in metadata.metadata.items()}
        layout.metadata[_name(metadata.name)] = about
        if len(layout.metadata) > MAX_METADATA:
            raise TooMuchError(f"has more than {MAX_METADATA} records of metadata; a recording has two")
    else:
        layout.declared.note(opcode, body)


def _records(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Opcode, offset and bytes of every whole record; the footer only when the file goes on to its magic.

    Of a record that nobody needs, or that is too large for anything but damage, the bytes are its head alone.
    """
    size = file.seek(0, 2)
    at = len(MAGIC)
    while at + RECORD.size <= size:
        file.seek(at)
        head = file.read(RECORD.size)
        opcode, length = RECORD.unpack(head)
        if opcode == 0 or length > size - at - len(head):  # 0: what some file systems leave after a power cut
            return
        file.seek(at)
        raw = file.read(len(head) + (length if opcode in READ and length <= MAX_CHUNK else 0))
        after = at + len(head) + length
        if opcode == Opcode.FOOTER and (after + len(MAGIC) > size or _read_at(file, after, len(MAGIC)) != MAGIC):
            return
        yield opcode, at, raw
        if opcode == Opcode.FOOTER:
            return
        at = after


def _read_at(file: BinaryIO, offset: int, length: int) -> bytes:
    """`length` bytes from `offset` on, which a damaged or hostile file may put anywhere; raises ValueError."""
    if not 0 <= length <= file.seek(0, 2) - offset:
        raise ValueError(f"{length} bytes from byte {offset} on are not there")
    file.seek(offset)
    return file.read(length)


def _summarised(file: BinaryIO) -> Layout | None:
    """The layout that the summary gives; None when there is none, or none that says where each topic is."""
    size = file.seek(0, 2)
    if size < len(MAGIC) + FOOTER_LENGTH:
        return None
    file.seek(size - FOOTER_LENGTH)
    end = file.read(FOOTER_LENGTH)
    if end[0] != Opcode.FOOTER or not end.endswith(MAGIC):
        return None
    footer = Footer.read(_stream(end[RECORD.size :]))
    if not len(MAGIC) <= footer.summary_start <= size - FOOTER_LENGTH:
        return None
    summary = _read_at(file, footer.summary_start, size - FOOTER_LENGTH - footer.summary_start)
    if footer.summary_crc not in (0, zlib.crc32(end[:CHECKED_FOOTER], zlib.crc32(summary))):
        return None
    return _from_summary(file, summary)


def _from_summary(file: BinaryIO, summary: bytes) -> Layout | None:
    layout = Layout(complete=True)
    statistics: Statistics | None = None
    indexes: list[ChunkIndex] = []
    at = 0
    unread = file.seek(0, 2)  # bytes of metadata that there can be in all
    while at < len(summary):
        opcode, length = RECORD.unpack_from(summary, at)
        body = summary[at + RECORD.size : at + RECORD.size + length]
        at += RECORD.size + length
        if opcode == Opcode.STATISTICS:
            statistics = Statistics.read(_stream(body))
        elif opcode == Opcode.CHUNK_INDEX:
            indexes.append(ChunkIndex.read(_stream(body)))
        elif opcode == Opcode.METADATA_INDEX:
            index = MetadataIndex.read(_stream(body))
            unread -= index.length
            if unread < 0:
                return None
            _note(layout, Opcode.METADATA, _read_at(file, index.offset, index.length)[RECORD.size :])
        else:
            layout.declared.note(opcode, body)
    return None if statistics is None else _indexed(file, layout, statistics, indexes)


def _indexed(file: BinaryIO, layout: Layout, statistics: Statistics, indexes: list[ChunkIndex]) -> Layout | None:
    """`layout` with the blocks and counts of a summary; None when it does not say which topics are where, or lies."""
    channels = layout.declared.channels
    counts = statistics.channel_message_counts
    in_chunks = len(indexes) == statistics.chunk_count and (indexes or not statistics.message_count)
    if not in_chunks or not all(index.message_index_offsets for index in indexes):
        return None
    indexes.sort(key=lambda index: index.chunk_start_offset)
    if any(one.chunk_start_offset + one.chunk_length > two.chunk_start_offset for one, two in pairwise(indexes)):
        return None
    unpacked = sum(index.uncompressed_size for index in indexes)
    if unpacked > _most_unpacked(file) or sum(counts.values()) * MESSAGE_START.size > unpacked:
        return None
    for index in indexes:
        topics = frozenset(channels[number].topic for number in index.message_index_offsets)
        layout.blocks.append(Block(index.chunk_start_offset, index.chunk_length, index.uncompressed_size, topics))
    for number, count in counts.items():
        layout.counts[channels[number].topic] += count
    return layout


def _most_unpacked(file: BinaryIO) -> int:
    """How many bytes the chunks of `file` may unpack to."""
    return MAX_UNPACKED + UNPACKED_RATIO * file.seek(0, 2)


def _says_unpacked(raw: bytes) -> int:
    """How many bytes a block says that it unpacks to; 0 when it does not say, or more than is ever unpacked."""
    if raw[0] != Opcode.CHUNK or len(raw) < RECORD.size + CHUNK_HEAD.size:
        return 0
    size: int = CHUNK_HEAD.unpack_from(raw, RECORD.size)[2]
    return size if size <= MAX_CHUNK else 0


def _unpacked(raw: bytes) -> bytes:
    """The records in a block, whose bytes are one chunk or bare messages."""
    if raw[0] != Opcode.CHUNK:
        return raw
    _, _, size, check_sum, name_length = CHUNK_HEAD.unpack_from(raw, RECORD.size)
    at = RECORD.size + CHUNK_HEAD.size + name_length
    packing = raw[at - name_length : at].decode()
    (length,) = LENGTH.unpack_from(raw, at)
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk that unpacks to {size} bytes; at most {MAX_CHUNK} are taken")
    data = _decompressed(packing, raw[at + LENGTH.size : at + LENGTH.size + length], size)
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes; it says {size}")
    if check_sum not in (0, zlib.crc32(data)):
        raise ValueError("a chunk whose check sum is not that of its bytes")
    return data


def _decompressed(packing: str, packed: bytes, size: int) -> bytes:
    """What is in a chunk, as long as it is no longer than the `size` that the chunk says."""
    if packing == "zstd":
        if zstandard.frame_content_size(packed) > size:
            raise ValueError("a chunk that unpacks to more than it says")
        return zstandard.decompress(packed, size)
    if packing == "lz4":
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
        return unpacked
    if packing:
        raise ValueError(f"a chunk packed by {packing!r}")
    return packed


def _name(text: str) -> str:
    """A name as it is shown; raises ValueError for one that is longer than any."""
    if len(text) > MAX_NAME:
        raise ValueError(f"a name of {len(text)} characters; at most {MAX_NAME} are taken")
    return printable(text)


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))
