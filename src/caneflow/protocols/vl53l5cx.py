"""ST VL53L5CX: 8 x 8 zones of time of flight on I2C. Registers, commands to its firmware, readings. No I/O here.

Written after ST's description (DS13754, UM2884) and its driver's traffic. The firmware and the tables that go with it
are ST's and not here: they come with ST's driver STSW-IMG023, in `vl53l5cx_buffers.h`, which the user fetches
(docs/hardware.md).

The firmware keeps bytes in words of four, the last byte first; here everything is as it is on the bus.
"""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.errors import ProtocolError

NAME: Final = "VL53L5CX"
ADDRESS: Final = 0x29
IDENTITY: Final = b"\xf0\x02"  # device and revision
PAGE: Final = 0x7FFF  # register that chooses the page of all others
ROWS = COLUMNS = 8
ZONES: Final = ROWS * COLUMNS
FASTEST: Final = 15  # Hz with 8 x 8 zones
FIELD: Final = math.radians(45)  # rad over the rows and over the columns
REACH: Final = (0.02, 4.0)  # m

COMMAND_STATUS, COMMAND_START, COMMAND_END = 0x2C00, 0x2C04, 0x2FFF  # registers of page 2
DONE: Final = 3  # second byte of the status
FAILED: Final = 0x7F  # third byte of the status, from here on
OFFSETS_AT, CROSSTALK_AT, CONFIGURATION_AT, STORED_AT = 0x2E18, 0x2CF8, 0x2C34, 0x2FD8
STORED_SIZE, OFFSETS_SIZE, CROSSTALK_SIZE = 492, 488, 776  # bytes

ZONE_CONFIG, RATE, RANGING_MODE, SPAD_CONFIG = 0x5450, 0x5458, 0xAD30, 0xAD38  # blocks of the firmware
SINGLE_RANGE, OUTPUT_CONFIG, OUTPUT_ENABLES, OUTPUT_LIST = 0xD964, 0xD968, 0xD970, 0xD980
PIPE_CONTROL, GLARE_FILTER, STREAM = 0xDB80, 0xE108, 0x5440

FIRMWARE_PAGES: Final = ((0x09, 0x8000), (0x0A, 0x8000), (0x0B, 0x5000))  # page, bytes
FIRMWARE_SIZE: Final = sum(size for _, size in FIRMWARE_PAGES)


class Output:
    """Headers of a reading's blocks, for 64 zones and one target each: bytes an element (4 bits), elements, number."""

    START, META, COMMON = 0x0000000D, 0x54B400C0, 0x54C00040
    AMBIENT, SPADS, COUNT, SIGNAL = 0x54D00404, 0x55D00404, 0xDB840401, 0xDBC40404
    SIGMA, DISTANCE, REFLECTANCE, STATUS, MOTION = 0xDEC40402, 0xDF440402, 0xE0440401, 0xE0840401, 0xD85808C0


OUTPUTS: Final = (
    Output.START,
    Output.META,
    Output.COMMON,
    Output.AMBIENT,
    Output.SPADS,
    Output.COUNT,
    Output.SIGNAL,
    Output.SIGMA,
    Output.DISTANCE,
    Output.REFLECTANCE,
    Output.STATUS,
    Output.MOTION,
)
WANTED: Final = frozenset(OUTPUTS) - {Output.SPADS, Output.REFLECTANCE, Output.MOTION}
ENABLED: Final = (sum(1 << n for n, each in enumerate(OUTPUTS) if each in WANTED), 0, 0, 0xC0000000)
HEADER, FOOTER = 16, 8  # bytes around the blocks of a reading

TARGET, NO_TARGET, TOO_NEAR, NOT_TRUSTED, NOT_MEASURED = range(5)  # of Ranges.status
# What the chip says of a target (UM2884, table of target status), as Ranges.status. Only 5 is called certain there.
MEANING: Final[Mapping[int, int]] = {
    0: NOT_MEASURED,  # ranging data not updated
    1: NOT_TRUSTED,  # signal rate too low on the array
    2: NOT_TRUSTED,  # target phase
    3: NOT_TRUSTED,  # sigma too high
    4: NOT_TRUSTED,  # target consistency failed
    5: TARGET,
    6: NOT_TRUSTED,  # wrap around not checked
    7: NOT_TRUSTED,  # rate consistency failed
    8: NOT_TRUSTED,  # signal rate too low for this target
    9: NOT_TRUSTED,  # valid, with a large pulse: two targets in one
    10: NOT_TRUSTED,  # valid, with no target in the reading before
    11: NOT_TRUSTED,  # measurement consistency failed
    12: NOT_TRUSTED,  # blurred by another target
    13: NOT_TRUSTED,  # detected, but inconsistent
    255: NO_TARGET,
}
_MEANINGS: Final = np.array([MEANING.get(code, NOT_TRUSTED) for code in range(256)], np.uint8)


@dataclass(frozen=True)
class Firmware:
    """What ST hands out with its driver."""

    program: bytes
    configuration: bytes
    crosstalk: bytes
    ask_stored: bytes  # the command that reads the offsets measured in the factory

    @classmethod
    def of(cls, arrays: Mapping[str, bytes]) -> "Firmware":
        """From the arrays of `vl53l5cx_buffers.h`; raises ProtocolError when one is missing or has another size."""
        wanted = {
            "FIRMWARE": FIRMWARE_SIZE,
            "DEFAULT_CONFIGURATION": 972,
            "DEFAULT_XTALK": CROSSTALK_SIZE,
            "GET_NVM_CMD": 40,
        }
        found = []
        for name, size in wanted.items():
            data = arrays.get(f"VL53L5CX_{name}", b"")
            if len(data) != size:
                has = f"holds {len(data)} bytes" if data else "is not there"
                raise ProtocolError(f"VL53L5CX_{name} {has}; expected {size} bytes, as in ST's vl53l5cx_buffers.h")
            found.append(data)
        return cls(*found)


@dataclass(frozen=True, eq=False)
class Reading:
    """One reading, zones row by row, top row first, each from left to right as the sensor looks out."""

    stream: int  # counts readings, 0..254
    temperature: int  # degC, of the chip
    distance: NDArray[np.float32]  # m perpendicular to the chip, (64,)
    status: NDArray[np.uint8]  # as in Ranges
    sigma: NDArray[np.float32]  # m
    signal: NDArray[np.float32]  # kcps per SPAD
    ambient: NDArray[np.float32]  # kcps per SPAD


def swapped(data: bytes) -> bytes:
    """Bytes of a multiple of four, with the order in each word reversed."""
    if len(data) % 4:
        raise ProtocolError(f"{len(data)} bytes are no whole words of 4")
    return np.frombuffer(data, ">u4").astype("<u4").tobytes()


def block_bytes(output: int) -> int:
    """Bytes of a block behind its header."""
    kind, size = output & 0xF, output >> 4 & 0xFFF
    return kind * size if 1 <= kind < 13 else size


def reading_size(enabled: frozenset[int] = WANTED) -> int:
    """Bytes of one reading."""
    return HEADER + FOOTER + sum(4 + block_bytes(output) for output in OUTPUTS if output in enabled)


def write_command(index: int, data: bytes) -> tuple[int, bytes]:
    """Register and bytes that write `data` (as the firmware's C structures hold it) to the block `index`."""
    size = len(data)
    head = struct.pack(">HBB", index, size >> 4 & 0xFF, (size & 0xF) << 4)
    tail = b"\0\0\0\x0f\x05\x01" + struct.pack(">H", size + 8)
    return COMMAND_END - (size + 12) + 1, head + swapped(data) + tail


def read_command(index: int, size: int) -> tuple[int, bytes]:
    """Register and bytes that ask for `size` bytes of the block `index`; the answer is at COMMAND_START."""
    head = struct.pack(">HBB", index, size >> 4 & 0xFF, (size & 0xF) << 4)
    return COMMAND_END - 11, head + b"\0\0\0\x0f\0\x02\0\x08"


def answered(data: bytes, size: int) -> bytes:
    """The `size` bytes of a block in what was read from COMMAND_START."""
    return swapped(data)[4 : 4 + size]


def offsets(stored: bytes, *, whole: bool) -> bytes:
    """What to write at OFFSETS_AT, of the factory's `stored` offsets, for 8 x 8 zones (`whole`) or 4 x 4."""
    data = bytearray(stored[:OFFSETS_SIZE])
    if not whole:
        data[0x10:0x18] = bytes((0x0F, 0x04, 0x04, 0x00, 0x08, 0x10, 0x10, 0x07))
        words = bytearray(swapped(bytes(data)))
        words[0x3C : 0x3C + 256] = _quartered(words[0x3C : 0x3C + 256], "<u4")
        words[0x140 : 0x140 + 128] = _quartered(words[0x140 : 0x140 + 128], "<i2")
        data = bytearray(swapped(bytes(words)))
    return bytes(data[8:]) + b"\0\0\0\x0f\x03\x01\x01\xe4"


def crosstalk(table: bytes, *, whole: bool) -> bytes:
    """What to write at CROSSTALK_AT, for 8 x 8 zones (`whole`) or 4 x 4."""
    if whole:
        return table
    data = bytearray(table)
    data[0x08:0x10] = bytes((0x0F, 0x04, 0x04, 0x17, 0x08, 0x10, 0x10, 0x07))
    data[0x20:0x28] = bytes((0x00, 0x78, 0x00, 0x08, 0x00, 0x00, 0x00, 0x08))
    words = bytearray(swapped(bytes(data)))
    words[0x34 : 0x34 + 256] = _quartered(words[0x34 : 0x34 + 256], "<u4")
    data = bytearray(swapped(bytes(words)))
    data[0x134:0x138] = bytes((0xA0, 0xFC, 0x01, 0x00))
    data[0x78:0x7C] = bytes(4)
    return bytes(data)


def _quartered(data: bytes | bytearray, kind: str) -> bytes:
    """8 x 8 values as the means of 2 x 2 of them in front, and zeros."""
    grid = np.frombuffer(bytes(data), kind).astype(np.int64).reshape(4, 2, 4, 2)
    means = np.trunc(grid.sum(axis=(1, 3)) / 4).astype(np.int64).reshape(-1)
    return np.concatenate([means, np.zeros(48, np.int64)]).astype(kind).tobytes()


def tilt_factors() -> NDArray[np.float64]:
    """Distance along a zone's ray for one perpendicular to the chip, (64,): 1 / (cos e cos a)."""
    angle = FIELD * (0.5 - (np.arange(ROWS) + 0.5) / ROWS)
    factors: NDArray[np.float64] = 1.0 / np.outer(np.cos(angle), np.cos(angle)).reshape(-1)
    return factors


def parsed(data: bytes, enabled: frozenset[int] = WANTED) -> Reading:
    """The reading in `data`, as it came over the bus; raises ProtocolError for one that is torn."""
    if len(data) != reading_size(enabled):
        raise ProtocolError(f"a reading of {len(data)} bytes; expected {reading_size(enabled)}")
    words = swapped(data)
    if words[8:10] != words[-4:-2]:
        raise ProtocolError("a reading whose end belongs to another one")
    blocks = _blocks(words)
    missing = {Output.META, Output.COUNT, Output.DISTANCE, Output.STATUS} - set(blocks)
    if missing:
        raise ProtocolError(f"a reading without block 0x{min(missing):08X}")
    codes = np.frombuffer(blocks[Output.STATUS], "u1").copy()
    codes[np.frombuffer(blocks[Output.COUNT], "u1") == 0] = 255
    distance = np.maximum(np.frombuffer(blocks[Output.DISTANCE], "<i2"), 0) / 4000.0
    status = _MEANINGS[codes]
    status[(status == TARGET) & (distance <= 0.0)] = NOT_TRUSTED
    return Reading(
        stream=data[0],
        temperature=struct.unpack("b", blocks[Output.META][8:9])[0],
        distance=_seen(distance),
        status=_seen(status).astype(np.uint8),
        sigma=_seen(np.frombuffer(blocks[Output.SIGMA], "<u2") / 128_000.0),
        signal=_seen(np.frombuffer(blocks[Output.SIGNAL], "<u4") / 2048.0),
        ambient=_seen(np.frombuffer(blocks[Output.AMBIENT], "<u4") / 2048.0),
    )


def built(reading: Reading, codes: NDArray[np.uint8], enabled: frozenset[int] = WANTED) -> bytes:
    """A reading as the chip sends it; `codes` (64,) is what it says of each target, 255 for none. For the emulator."""
    contents = {
        Output.META: bytes(8) + struct.pack("b", reading.temperature) + bytes(3),
        Output.AMBIENT: np.rint(_seen(reading.ambient) * 2048.0).astype("<u4").tobytes(),
        Output.COUNT: (_seen(codes) != 255).astype("u1").tobytes(),
        Output.SIGNAL: np.rint(_seen(reading.signal) * 2048.0).astype("<u4").tobytes(),
        Output.SIGMA: np.rint(_seen(reading.sigma) * 128_000.0).clip(0, 65535).astype("<u2").tobytes(),
        Output.DISTANCE: np.rint(_seen(reading.distance) * 4000.0).clip(0, 32767).astype("<i2").tobytes(),
        Output.STATUS: np.where(_seen(codes) == 255, 0, _seen(codes)).astype("u1").tobytes(),
    }
    number = bytes((reading.stream, reading.stream ^ 0xFF))
    words = struct.pack("<I", reading.stream << 24 | 0x0510) + bytes(4) + number + bytes(6)
    for output in OUTPUTS:
        if output in enabled:
            words += struct.pack("<I", output) + contents.get(output, b"").ljust(block_bytes(output), b"\0")
    words += bytes(4) + number + bytes(2)
    return bytes((reading.stream, 0x05, 0x05, 0x10)) + swapped(words)[4:]


def _blocks(words: bytes) -> dict[int, bytes]:
    """Contents by header, of a reading in words."""
    found, at = {}, HEADER
    while at < len(words) - FOOTER:
        output = struct.unpack_from("<I", words, at)[0]
        found[output] = words[at + 4 : at + 4 + block_bytes(output)]
        at += 4 + block_bytes(output)
    return found


def _seen(zones: NDArray[np.generic]) -> NDArray[np.float32]:
    """Zones of the chip as they look out, or the other way round: its lens swaps left and right in each row.

    The chip counts rows from below and its lens turns the picture, so its first row is the top one (DS13754, 5.1.3).
    """
    return np.ascontiguousarray(zones.reshape(ROWS, COLUMNS)[:, ::-1].reshape(-1), np.float32)
