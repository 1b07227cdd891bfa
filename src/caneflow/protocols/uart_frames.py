"""Frames on a serial line to a microcontroller, and what they say: 00, COBS(kind, number, body, CRC), 00.

COBS (Cheshire & Baker, "Consistent overhead byte stuffing", SIGCOMM 1997) leaves no zero inside of a frame, so a zero
always ends one: whatever was disturbed, the next frame is found. The checksum is CRC-16/XMODEM of all before it, most
significant byte first, as every number here. The same in C is mcu/frames.c; docs/mcu.md has the dialogue.
"""

import binascii
import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

from caneflow.protocols.errors import ProtocolError

VERSION = 1  # of the dialogue
NUMBERS = 1 << 16  # of samples, then 0 again
LONGEST_BODY = 512  # bytes, as much as the firmware takes
_HEAD = struct.Struct(">BH")
_CRC = struct.Struct(">H")
_SHORTEST = _HEAD.size + _CRC.size
LONGEST_CONTENT = _SHORTEST + LONGEST_BODY
LONGEST_CODED = LONGEST_CONTENT + LONGEST_CONTENT // 254 + 1
_BLOCK = 254  # bytes without a zero that one code byte stands for


class Kind(IntEnum):
    """What a frame is."""

    RESET = ord("R")  # from the host: a session begins; answered by a status
    ASK = ord("Q")  # from the host: answered by a status
    IMU = ord("I")  # from the host: answered by a pose or a refusal
    GROUND_SPEED = ord("G")  # from the host: not answered
    STATUS = ord("S")
    POSE = ord("P")
    REFUSED = ord("X")


class Frame(NamedTuple):
    """A frame whose checksum was right."""

    kind: int  # a later version may have kinds that are not in Kind
    number: int  # of the sample that it is or answers; status: of the sample that is expected
    body: bytes


class Status(NamedTuple):
    """How the microcontroller is; all counters wrap at 2**32."""

    version: int
    session: int  # 0: it was given none since its start
    digest: int  # of the constants that its observer was built with
    ticks_per_second: int
    clock: int  # ticks
    busy: int  # ticks that it did not sleep
    bad_frames: int
    lost_bytes: int


class PoseAnswer(NamedTuple):
    """A pose with what the microcontroller says of it."""

    saturated: bool
    gap: bool
    ticks: int  # that it took
    clock: int  # ticks, when it was ready
    payload: bytes  # Pose/1 in msgpack


_STATUS = struct.Struct(">B7I")
_POSE = struct.Struct(">B2I")
_SESSION = struct.Struct(">I")
_SATURATED, _GAP = 1, 2

REFUSALS = {
    1: "it is not a message of its kind",
    2: "it has no orientation",
    3: "its orientation is not a rotation",
    4: "it has neither linear_accel nor accel",
    5: "its stamp is not after the one before",
}


def framed(kind: int, number: int, body: bytes = b"") -> bytes:
    """A frame as it goes over the line.

    Raises:
        ProtocolError: more than LONGEST_BODY bytes.
    """
    if len(body) > LONGEST_BODY:
        raise ProtocolError(f"a body of {len(body)} bytes; a frame takes {LONGEST_BODY}")
    content = _HEAD.pack(kind, number) + body
    return b"\0" + encoded(content + _CRC.pack(binascii.crc_hqx(content, 0))) + b"\0"


def reset(session: int) -> bytes:
    """The frame that begins a session."""
    return framed(Kind.RESET, 0, _SESSION.pack(session))


def status(body: bytes) -> Status:
    """What a status says; raises ProtocolError for one of another version."""
    if len(body) != _STATUS.size or body[0] != VERSION:
        found = f"version {body[0]}" if body else "nothing"
        raise ProtocolError(f"a status of {len(body)} bytes that says {found}; version {VERSION} has {_STATUS.size}")
    return Status(*_STATUS.unpack(body))


def pose_answer(body: bytes) -> PoseAnswer:
    """What a pose's frame says; raises ProtocolError for one that is too short."""
    if len(body) < _POSE.size:
        raise ProtocolError(f"a pose of {len(body)} bytes; before its message it has {_POSE.size}")
    flags, ticks, clock = _POSE.unpack_from(body)
    return PoseAnswer(bool(flags & _SATURATED), bool(flags & _GAP), ticks, clock, body[_POSE.size :])


def refusal(body: bytes) -> str:
    """Why a sample was refused."""
    return REFUSALS.get(body[0] if body else 0, f"reason {body.hex()}")


def encoded(content: bytes) -> bytes:
    """`content` by COBS: as many bytes, one more and one for each 254, none of them zero."""
    coded = bytearray()
    for piece in content.split(b"\0"):
        whole, rest = divmod(len(piece), _BLOCK)
        for i in range(whole):
            coded += b"\xff" + piece[i * _BLOCK : (i + 1) * _BLOCK]
        coded.append(rest + 1)
        coded += piece[whole * _BLOCK :]
    # A full block stands for no zero: nothing has to follow the last one.
    last = content.rpartition(b"\0")[2]
    if last and len(last) % _BLOCK == 0:
        del coded[-1]
    return bytes(coded)


def decoded(coded: bytes) -> bytes:
    """What `encoded` had; raises ProtocolError when its codes lead past the end or there is a zero."""
    content = bytearray()
    at = 0
    while at < len(coded):
        code = coded[at]
        block = coded[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            raise ProtocolError(f"{len(coded)} bytes are not COBS: code {code} at {at}")
        content += block
        at += code
        if code <= _BLOCK and at < len(coded):
            content.append(0)
    return bytes(content)


class Deframer:
    """Finds frames in a stream of bytes that may start anywhere and be damaged; holds less than one frame.

    bad: stretches between two zeros that were not frames.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._coded = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Yield the frames that `data` completes."""
        *ended, rest = data.split(b"\0")
        frames = []
        for piece in ended:
            self._add(piece)
            if self._coded:
                frame = None if self._too_long else _frame(bytes(self._coded))
                self.bad += frame is None
                if frame is not None:
                    frames.append(frame)
            self._coded.clear()
            self._too_long = False
        self._add(rest)
        return iter(frames)

    def _add(self, piece: bytes) -> None:
        room = LONGEST_CODED - len(self._coded)
        self._too_long |= len(piece) > room
        self._coded += piece[:room]


def _frame(coded: bytes) -> Frame | None:
    try:
        content = decoded(coded)
    except ProtocolError:
        return None
    if len(content) < _SHORTEST or binascii.crc_hqx(content, 0) != 0:  # with its own checksum behind, it is 0
        return None
    kind, number = _HEAD.unpack_from(content)
    return Frame(kind, number, content[_HEAD.size : -_CRC.size])
