"""Where things are in an MCAP file: by its summary, or by a walk over its records when there is none."""

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Metadata, MetadataIndex, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

MAGIC = MCAP0_MAGIC  # at the start and at the end of the file
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the payload
MESSAGE_START = struct.Struct("<BQHIQQ")  # a message's record up to its payload
FOOTER_LENGTH = RECORD.size + 20 + len(MAGIC)
CHECKED_FOOTER = RECORD.size + 16  # bytes of the footer that its check sum covers
MESSAGE = int(Opcode.MESSAGE)  # comparing with the enum's member takes as long as unpacking a message
MAX_BARE = 2**20  # bytes of messages outside any chunk that are taken as one block
# A chunk of ours has 256 kB and one message more, so 32 MiB at most; but 60 kB of a hostile file unpack to gigabytes.
MAX_CHUNK = 2**26  # bytes, unpacked
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
    topics: frozenset[str]  # which have messages in it


@dataclass
class Declarations:
    """Channels and schemas by their numbers in the file."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)

    def note(self, opcode: int, body: bytes) -> None:
        """Take in a record, if it declares something; raises ValueError when it declares it otherwise than before."""
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(body))
            if self.channels.setdefault(channel.id, channel) != channel:
                raise ValueError(f"channel {channel.id} is declared in two ways")
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(body))
            if self.schemas.setdefault(schema.id, schema) != schema:
                raise ValueError(f"schema {schema.id} is declared in two ways")


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

    def __init__(self, data: bytes, declared: Declarations) -> None:
        """Find the messages in `data`; what it declares on the way is added to `declared`."""
        self.data = data
        self.messages: defaultdict[str, list[Entry]] = defaultdict(list)
        of_channel: dict[int, list[Entry]] = {}
        at, end = 0, len(data)
        while at < end:
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


def layout_of(file: BinaryIO) -> Layout:
    """Where things are in `file`, by the summary at its end, or else by a walk. Needs the magic at its start."""
    try:
        by_summary = _summarised(file)
    except DAMAGE:
        by_summary = None
    return by_summary or walked(file)


def content_of(file: BinaryIO, block: Block, declared: Declarations) -> Content:
    """The messages of `block`. Raises one of DAMAGE when its bytes are not sound."""
    if block.length > MAX_CHUNK:
        raise ValueError(f"a chunk of {block.length} bytes; at most {MAX_CHUNK} are taken")
    content = Content(_unpacked(_read_at(file, block.offset, block.length)), declared)
    if missing := block.topics - content.messages.keys():
        raise ValueError(f"no message of {', '.join(missing)}")
    return content


def walked(file: BinaryIO) -> Layout:
    """Where things are in `file`, found record by record, up to its end or to where it was cut."""
    layout = Layout(complete=False, declared=_summarised_declarations(file))
    in_chunks = in_summary = False
    for opcode, offset, raw in _stretches(file):
        if opcode == Opcode.FOOTER:
            layout.complete = True
        elif in_summary:
            continue
        elif opcode == Opcode.DATA_END:
            in_summary = True
        elif opcode == Opcode.CHUNK or (opcode == MESSAGE and not in_chunks):
            in_chunks = opcode == Opcode.CHUNK
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
        content = Content(_unpacked(raw), layout.declared)
    except DAMAGE:
        layout.damaged.append(offset)
        return
    layout.blocks.append(Block(offset, len(raw), frozenset(content.messages)))
    layout.counts.update({topic: len(entries) for topic, entries in content.messages.items()})


def _note(layout: Layout, opcode: int, body: bytes) -> None:
    """Take in a record without messages."""
    if opcode == Opcode.METADATA:
        metadata = Metadata.read(_stream(body))
        layout.metadata[metadata.name] = metadata.metadata
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
        raw = head + file.read(length) if opcode in READ and length <= MAX_CHUNK else head
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
            _note(layout, Opcode.METADATA, _read_at(file, index.offset, index.length)[RECORD.size :])
        else:
            layout.declared.note(opcode, body)
    return None if statistics is None else _indexed(layout, statistics, indexes)


def _indexed(layout: Layout, statistics: Statistics, indexes: list[ChunkIndex]) -> Layout | None:
    """`layout` with the blocks and counts of a summary; None when it does not say which topics are where."""
    channels = layout.declared.channels
    in_chunks = len(indexes) == statistics.chunk_count and (indexes or not statistics.message_count)
    if not in_chunks or not all(index.message_index_offsets for index in indexes):
        return None
    for index in sorted(indexes, key=lambda index: index.chunk_start_offset):
        topics = frozenset(channels[number].topic for number in index.message_index_offsets)
        layout.blocks.append(Block(index.chunk_start_offset, index.chunk_length, topics))
    for number, count in statistics.channel_message_counts.items():
        layout.counts[channels[number].topic] += count
    return layout


def _unpacked(raw: bytes) -> bytes:
    """The records in a block, whose bytes are one chunk or bare messages."""
    if raw[0] != Opcode.CHUNK:
        return raw
    chunk = Chunk.read(_stream(raw[RECORD.size :]))
    if chunk.uncompressed_size > MAX_CHUNK:
        raise ValueError(f"a chunk that unpacks to {chunk.uncompressed_size} bytes; at most {MAX_CHUNK} are taken")
    data = _decompressed(chunk)
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {len(data)} bytes; it says {chunk.uncompressed_size}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk whose check sum is not that of its bytes")
    return data


def _decompressed(chunk: Chunk) -> bytes:
    """What is in a chunk, as long as it is no longer than the chunk says."""
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) > chunk.uncompressed_size:
            raise ValueError("a chunk that unpacks to more than it says")
        return zstandard.decompress(chunk.data, chunk.uncompressed_size)
    if chunk.compression == "lz4":
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size)
        return unpacked
    if chunk.compression:
        raise ValueError(f"a chunk packed by {chunk.compression!r}")
    return chunk.data


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))
