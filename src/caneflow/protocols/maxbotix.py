"""MaxBotix range finders by sound: MB12xx on I2C, MB10xx on a serial line. No I/O here.

I2CXL-MaxSonar-EZ data sheet: write 0x51 to 0x70 to take a reading, which needs up to 100 ms, in which the chip does not
acknowledge; then two bytes, cm, high byte first. LV-MaxSonar-EZ (PD11832): 9600 baud, `R`, three digits of
inches, carriage return, 20 times a second; the HRLV models send four digits of mm.
"""

import re
import struct
from collections.abc import Callable
from typing import Final, Literal, TypeAlias

from caneflow.protocols.errors import ProtocolError

Transfer: TypeAlias = Callable[[bytes, int], bytes]  # what to write, bytes to read after that; OSError: no acknowledge
Unit: TypeAlias = Literal["inch", "cm", "mm"]

ADDRESS: Final = 0x70
TAKE_READING: Final = 0x51
READING_TIME: Final = 0.1  # s
TRIES: Final = 4
PAUSE: Final = 0.005  # s before the next try
NEAREST: Final = 0.2  # m; what is nearer is told of as this (MB12xx)
FARTHEST_CM: Final = 765  # what an MB12xx says when nothing answers
BAUD: Final = 9600
METRES: Final = {"inch": 0.0254, "cm": 0.01, "mm": 0.001}
LONGEST_WORD: Final = 6  # bytes: R, four digits, carriage return

_WORD = re.compile(rb"R(\d{3,4})\r")


def taken(transfer: Transfer, pause: Callable[[float], None]) -> float:
    """Take one reading of an MB12xx: the distance, m. Raises ProtocolError when the chip does not answer."""
    _tried(lambda: transfer(bytes((TAKE_READING,)), 0), pause)
    pause(READING_TIME)
    data = _tried(lambda: transfer(b"", 2), pause)
    if len(data) != 2:
        raise ProtocolError(f"the bus gave {len(data)} bytes of a reading; expected 2")
    centimetres: int = struct.unpack(">H", data)[0]
    if not 0 < centimetres <= FARTHEST_CM:
        raise ProtocolError(f"a reading of {centimetres} cm; expected 1 to {FARTHEST_CM}")
    return centimetres * METRES["cm"]


def _tried(attempt: Callable[[], bytes], pause: Callable[[float], None]) -> bytes:
    for number in range(1, TRIES + 1):
        try:
            return attempt()
        except OSError as error:
            if number == TRIES:
                raise ProtocolError(f"no acknowledge ({error.strerror or error}; {TRIES} tries)") from error
        pause(PAUSE)
    raise AssertionError("unreachable")


class SerialWords:
    """The distances in what a serial line brings, in whatever pieces; what is not a word is left out and counted."""

    def __init__(self, unit: Unit) -> None:
        self.garbled = 0  # bytes
        self._metres = METRES[unit]
        self._rest = b""

    def feed(self, data: bytes) -> list[float]:
        """Distances, m, that are complete with `data`."""
        self._rest += data
        found, end = [], 0
        for word in _WORD.finditer(self._rest):
            self.garbled += word.start() - end
            found.append(int(word[1]) * self._metres)
            end = word.end()
        self._rest = self._rest[end:]
        if len(self._rest) >= LONGEST_WORD:  # no word begins in what is older than one
            self.garbled += len(self._rest) - LONGEST_WORD + 1
            self._rest = self._rest[1 - LONGEST_WORD :]
        return found


def said(distance: float | None, unit: Unit, farthest: float) -> bytes:
    """A word of the serial line for a distance, m; None: nothing answers, which is said as the farthest."""
    number = round((farthest if distance is None else distance) / METRES[unit])
    digits = 4 if unit == "mm" else 3
    return f"R{min(number, 10**digits - 1):0{digits}d}\r".encode()
