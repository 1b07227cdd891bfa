"""Recordings that nobody wrote in good faith: each makes a small file claim, repeat or hide a lot."""

import json
import struct
from collections.abc import Callable, Iterable, Mapping

import lz4.frame  # type: ignore[import-untyped]
import msgpack
import zstandard
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
SECOND = 10**9  # ns
ESCAPES = "\x1b]0;title\x07\x1b[2J\x7f\x9b2J\u202e\u2028\n"  # what a terminal obeys, or shows as a line of its own
LOST = {"node": "mine", "port": "imu", "reason": "lost"}
ABOUT = {"flow": "cane", "version": "1", "run": "x", "source": "live"}


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def pairs(values: Mapping[str, str]) -> bytes:
    return text(b"".join(text(key) + text(value) for key, value in values.items()))


def metadata(name: str, values: Mapping[str, str]) -> bytes:
    return record(Opcode.METADATA, text(name) + pairs(values))


def schema(number: int = 1, name: str = "caneflow.Imu/1", data: bytes = b"{}") -> bytes:
    return record(Opcode.SCHEMA, struct.pack("<H", number) + text(name) + text("jsonschema") + text(data))


def channel(number: int, topic: str, of_schema: int = 1) -> bytes:
    return record(Opcode.CHANNEL, struct.pack("<HH", number, of_schema) + text(topic) + text("msgpack") + pairs({}))


def message(number: int, stamp: int, seq: int = 0, payload: bytes | None = None) -> bytes:
    sample = msgpack.packb({"stamp": stamp, "seq": seq, "gyro": [0.0, 0.0, 0.0]}) if payload is None else payload
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, seq & 0xFFFFFFFF, stamp, stamp) + sample)


def chunk(data: bytes, packing: str = "zstd", says: int | None = None) -> bytes:
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[packing](data)
    head = struct.pack("<QQQI", 0, 1, len(data) if says is None else says, 0)
    return record(Opcode.CHUNK, head + text(packing) + struct.pack("<Q", len(packed)) + packed)


def chunk_index(offset: int, length: int, unpacked: int, channels: Iterable[int] = (1,)) -> bytes:
    offsets = b"".join(struct.pack("<HQ", number, 0) for number in channels)
    head = struct.pack("<QQQQ", 0, 1, offset, length) + text(offsets)
    return record(Opcode.CHUNK_INDEX, head + struct.pack("<Q", 0) + text("zstd") + struct.pack("<QQ", 0, unpacked))


def statistics(messages: int, chunks: int) -> bytes:
    counts = text(struct.pack("<HQ", 1, messages))
    return record(Opcode.STATISTICS, struct.pack("<QHIIIIQQ", messages, 1, 1, 0, 2, chunks, 0, 1) + counts)


def metadata_index(offset: int, length: int, name: str) -> bytes:
    return record(Opcode.METADATA_INDEX, struct.pack("<QQ", offset, length) + text(name))


def with_summary(body: bytes, summary: bytes, start: int | None = None) -> bytes:
    """A whole file; `start`: where its footer says that the summary starts."""
    data = MAGIC + body + record(Opcode.DATA_END, bytes(4))
    footer = struct.pack("<QQI", len(data) if start is None else start, 0, 0)
    return data + summary + record(Opcode.FOOTER, footer) + MAGIC


HEADER = record(Opcode.HEADER, text("") + text("x"))
FLOW, RIG = metadata("caneflow", ABOUT), metadata("rig", {"json": "{}"})
START = HEADER + FLOW + RIG + schema()
IMU = channel(1, "cane/imu/imu")
SAMPLES = b"".join(message(1, SECOND + k, k) for k in range(1000))


def indexed(indexes: Callable[[int, int], bytes], chunks: int, messages: int = 1000) -> bytes:
    """A file of one chunk with an index that lies; `indexes` is given the chunk's offset and length."""
    packed = chunk(SAMPLES)
    at = len(MAGIC)
    where = metadata_index(at + len(HEADER), len(FLOW), "caneflow")
    where += metadata_index(at + len(HEADER) + len(FLOW), len(RIG), "rig")
    lies = indexes(at + len(START + IMU), len(packed))
    return with_summary(START + IMU + packed, schema() + IMU + lies + statistics(messages, chunks) + where)


def numbered(count: int) -> bytes:
    return b"".join(channel(k, f"c/n{k}/p") for k in range(1, count + 1))


def files() -> dict[str, bytes]:
    """By name what is wrong, the file: each below 4 MB."""
    large = metadata("rig", {"json": "{}", "x": "y" * 1_000_000})
    late = channel(2, "cane/@/late", 2) + b"".join(
        message(2, k, 0, msgpack.packb({**LOST, "first_seq": k, "last_seq": k + 9})) for k in range(5000)
    )
    rig = json.dumps({f"k{k}": [[]] for k in range(150_000)})
    zeros = chunk(bytes(2**26 - 1000))
    return {
        "65534 channels": MAGIC + START + numbered(65534),
        "65534 channels, packed": MAGIC + START + chunk(numbered(65534)),
        "1000 channels, message by message": MAGIC
        + START
        + b"".join(channel(k, f"c/n{k}/p") + message(k, SECOND) for k in range(1, 1001))
        + b"".join(message(1 + k % 1000, SECOND + 1 + k, 1 + k // 1000) for k in range(5_000)),
        "tiny chunks": MAGIC
        + START
        + numbered(1000)
        + b"".join(chunk(message(1 + k % 1000, SECOND + k)) for k in range(1000)),
        "empty chunks": MAGIC + START + chunk(b"") * 5000,
        "chunks of zeros": MAGIC + START + zeros * 3,
        "a chunk of the same message": MAGIC + START + IMU + chunk(message(1, SECOND, 0, b"") * 1_500_000),
        "small chunks of the same message": MAGIC + START + IMU + chunk(message(1, SECOND, 0, b"") * 2000) * 100,
        "a chunk of the same channel": MAGIC + START + IMU + chunk(IMU * 1_000_000),
        "large schemas": MAGIC + START + b"".join(chunk(schema(2 + k, "x", bytes(2**21))) for k in range(20)),
        "60000 schemas": MAGIC + START + b"".join(schema(2 + k) for k in range(60_000)),
        "30000 records of metadata": MAGIC + START + b"".join(metadata(f"m{k}", {}) for k in range(30_000)),
        "names of 40 kB": MAGIC + START + b"".join(channel(k, f"c/{'n' * 40_000}{k}/p") for k in range(1, 60)),
        "a rig of 2 MB": MAGIC + HEADER + FLOW + metadata("rig", {"json": rig}),
        "30000 wrong sensors": MAGIC
        + HEADER
        + FLOW
        + metadata("rig", {"json": json.dumps({"sensors": {f"{ESCAPES}{i}": 1 for i in range(9000)}})})
        + schema()
        + IMU
        + message(1, SECOND),
        "the same chunk 10000 times": indexed(lambda at, n: chunk_index(at, n, len(SAMPLES)) * 10_000, 10_000, 10**7),
        "a count of 2^63": indexed(lambda at, n: chunk_index(at, n, len(SAMPLES)), 1, 2**63),
        "a chunk of 2^62 bytes": indexed(lambda at, n: chunk_index(at, n, 2**62), 1),
        "a chunk before the file": indexed(lambda at, n: chunk_index(0, 8, 8) + chunk_index(at, 2**63, 9), 2),
        "a summary in itself": with_summary(START + IMU + chunk(SAMPLES), b"", start=10**4),
        "a summary at the start": with_summary(START + IMU + chunk(SAMPLES), b"", start=8),
        "metadata that is found 20000 times": with_summary(
            HEADER + FLOW + RIG + large,
            metadata_index(len(MAGIC + HEADER + FLOW + RIG), len(large), "rig") * 20_000 + statistics(0, 0),
        ),
        "streams far apart in time": MAGIC
        + START
        + chunk(numbered(1000))
        + b"".join(
            chunk(b"".join(message(k, SECOND * k + j, j, b"") for k in range(1, 1001))) for j in range(15)
        ),
        "streams far apart in the file": MAGIC
        + START
        + chunk(numbered(8))
        + b"".join(chunk(message(k, SECOND, 0, bytes(2**24))) for k in range(1, 9)),
        "5000 notes of what was lost": MAGIC + START + IMU + SAMPLES + schema(2, "caneflow.LeftOut/1") + late,
        "a chunk that says less": MAGIC + START + IMU + chunk(SAMPLES, says=100),
        "a chunk that says more": MAGIC + START + IMU + chunk(SAMPLES, "lz4", says=2**62),
    }  # fmt: skip


def with_names(hostile: str = ESCAPES) -> bytes:
    """A sound file with `hostile` in every name that there is."""
    about = {"flow": f"flow{hostile}", "version": "1", "run": f"run{hostile}", "source": f"source{hostile}"}
    return (
        MAGIC
        + HEADER
        + metadata("caneflow", about)
        + metadata("rig", {"json": json.dumps({f"rig{hostile}": 1, "sensors": {f"sensor{hostile}": 1}})})
        + schema(1, f"schema{hostile}")
        + schema(2, "caneflow.Pose/1")
        + channel(1, f"cane/node{hostile}/port{hostile}")
        + channel(2, f"cane/@/said{hostile}")
        + channel(3, "cane/fusion/pose", 2)
        + message(1, SECOND)
        + message(2, SECOND)
        + b"".join(message(3, SECOND + k, k, a_pose(SECOND + k, k, f"method{hostile}")) for k in range(3))
    )


def a_pose(stamp: int, seq: int, method: str) -> bytes:
    zero = [0.0, 0.0, 0.0]
    packed: bytes = msgpack.packb(
        {"stamp": stamp, "seq": seq, "position": zero, "velocity": zero, "orientation": [1.0, *zero], "method": method}
    )
    return packed
