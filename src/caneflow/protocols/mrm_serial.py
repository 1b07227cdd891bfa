"""MRM messages on a serial link: A5 A5, length, message, and over a UART a CRC-16/XMODEM of the message."""

import binascii
import struct
from collections.abc import Iterator

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import SCAN_INFO_BYTES

SYNC = b"\xa5\xa5"
SHORTEST_MESSAGE = 4  # type and id
LONGEST_MESSAGE = SCAN_INFO_BYTES
_LENGTH = struct.Struct(">H")
_CRC = struct.Struct(">H")
_HEAD_BYTES = len(SYNC) + _LENGTH.size


def framed(message: bytes, *, crc: bool) -> bytes:
    """`message` as it goes over a USB (`crc` False) or UART (`crc` True) link.

    Raises:
        ProtocolError: a length that no receiver accepts.
    """
    if not SHORTEST_MESSAGE <= len(message) <= LONGEST_MESSAGE:
        raise ProtocolError(
            f"a message of {len(message)} bytes cannot be framed; {SHORTEST_MESSAGE}..{LONGEST_MESSAGE} can"
        )
    tail = _CRC.pack(binascii.crc_hqx(message, 0)) if crc else b""
    return SYNC + _LENGTH.pack(len(message)) + message + tail


class SerialDeframer:
    """Finds messages in a byte stream that may start anywhere and lose bytes; holds less than one frame."""

    def __init__(self, *, crc: bool) -> None:
        self._crc_bytes = _CRC.size if crc else 0
        self._buffer = bytearray()
        self.skipped_bytes = 0  # that belonged to no frame
        self.bad_checksums = 0

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield the messages that `data` completes."""
        self._buffer += data
        messages: list[bytes] = []
        while (message := self._next()) is not None:
            messages.append(message)
        return iter(messages)

    def _next(self) -> bytes | None:
        while True:
            self._skip_to_sync()
            if len(self._buffer) < _HEAD_BYTES:
                return None
            (length,) = _LENGTH.unpack_from(self._buffer, len(SYNC))
            if not SHORTEST_MESSAGE <= length <= LONGEST_MESSAGE:
                self._skip(1)  # a sync word inside of something else
                continue
            end = _HEAD_BYTES + length + self._crc_bytes
            if len(self._buffer) < end:
                return None
            message = bytes(self._buffer[_HEAD_BYTES : _HEAD_BYTES + length])
            if self._crc_bytes and _CRC.unpack_from(self._buffer, end - 2)[0] != binascii.crc_hqx(message, 0):
                self.bad_checksums += 1
                self._skip(1)  # the length itself may be wrong: look for the next sync right behind this one
                continue
            del self._buffer[:end]
            return message

    def _skip_to_sync(self) -> None:
        at = self._buffer.find(SYNC)
        if at < 0:  # nothing but perhaps the first half of a sync word
            at = len(self._buffer) - self._buffer.endswith(SYNC[:1])
        self._skip(at)

    def _skip(self, count: int) -> None:
        self.skipped_bytes += count
        del self._buffer[:count]
