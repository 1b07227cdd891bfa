"""I2C transfers over a Unix socket: how an emulated chip is reached where there is no bus. No I/O here.

Request: address (1 byte), bytes written and bytes to read (2 each, little-endian), what is written. Answer: 0 or the
errno of a bus that did not acknowledge (1 byte), bytes read (2, little-endian), those bytes.
"""

import struct
from typing import Final, NamedTuple

REQUEST: Final = struct.Struct("<BHH")
ANSWER: Final = struct.Struct("<BH")


class Request(NamedTuple):
    """One transfer: write, then read after a repeated start."""

    address: int
    written: bytes
    length: int

    def packed(self) -> bytes:
        """As it goes over the socket."""
        return REQUEST.pack(self.address, len(self.written), self.length) + self.written


def answered(data: bytes) -> bytes:
    """An answer with what was read."""
    return ANSWER.pack(0, len(data)) + data


def refused(error_number: int) -> bytes:
    """An answer of a bus that did not acknowledge."""
    return ANSWER.pack(error_number & 0xFF, 0)
