"""ST VL53L1X: one zone of time of flight on I2C. Registers and readings. No I/O here.

Written after ST's description (DS12385, UM2510) and its driver's traffic. The table that the chip is set up with is
ST's and not here: it comes with ST's driver STSW-IMG009, in `VL53L1X_api.c`, which the user fetches (docs/hardware.md).
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import Link

NAME: Final = "VL53L1X"
ADDRESS: Final = 0x29
IDENTITY: Final = b"\xea\xcc"  # model and type
REACH: Final = (0.04, 4.0)  # m
BUDGETS: Final[Mapping[int, tuple[int, int]]] = {  # ms of one measurement, long distance: two timeouts of the chip
    20: (0x001E, 0x0022),
    33: (0x0060, 0x006E),
    50: (0x00AD, 0x00C6),
    100: (0x01CC, 0x01EA),
}
LONG: Final = (  # register, value: distances up to 4 m
    (0x4B, b"\x0a"), (0x60, b"\x0f"), (0x63, b"\x0d"), (0x69, b"\xb8"), (0x78, b"\x0f\x0d"), (0x7A, b"\x0e\x0e"),
)  # fmt: skip
TABLE_AT, TABLE_SIZE = 0x2D, 91
MOVE, PREVIOUS_TEMPERATURE, STARTING = 0x01, 0x0B, 0x08  # registers
POLARITY, READY, TIMEOUT_A, TIMEOUT_B, PERIOD, CLEAR, START = 0x30, 0x31, 0x5E, 0x61, 0x6C, 0x86, 0x87
RESULT, RESULT_SIZE = 0x89, 17
OSCILLATOR, BOOTED, MODEL = 0xDE, 0xE5, 0x10F
POLLS: Final = 200
POLL: Final = 0.005  # s

TARGET, NO_TARGET, TOO_NEAR, NOT_TRUSTED, NOT_MEASURED = range(5)  # of Ranges.status
# What the chip's own state of a measurement means (UM2510): 9 is valid, 4 is no signal, the rest is doubtful.
MEANING: Final[Mapping[int, int]] = {9: TARGET, 4: NO_TARGET}
_RESULT = struct.Struct(">BxxBxxxHxxxxHH")


@dataclass(frozen=True)
class Reading:
    """One measurement."""

    distance: float  # m
    status: int  # as in Ranges
    signal: float  # kcps
    ambient: float  # kcps


def table_of(arrays: Mapping[str, bytes]) -> bytes:
    """The table of `VL53L1X_api.c`; raises ProtocolError when it is missing or has another size."""
    names = ("VL51L1X_DEFAULT_CONFIGURATION", "VL53L1X_DEFAULT_CONFIGURATION")  # the first is ST's own spelling
    for name in names:
        if len(found := arrays.get(name, b"")) == TABLE_SIZE:
            return found
        if found:
            raise ProtocolError(f"{name} holds {len(found)} bytes; expected {TABLE_SIZE}")
    raise ProtocolError(f"{names[0]} is not there; expected {TABLE_SIZE} bytes, as in ST's VL53L1X_api.c")


def parsed(data: bytes) -> Reading:
    """A reading of the RESULT_SIZE bytes at RESULT."""
    state, _, ambient, distance, signal = _RESULT.unpack(data)
    status = MEANING.get(state & 0x1F, NOT_TRUSTED)
    return Reading(distance * 1e-3, status, 8.0 * signal, 8.0 * ambient)


def built(reading: Reading) -> bytes:
    """As the chip says it. For the emulator."""
    state = {TARGET: 9, NO_TARGET: 4}.get(reading.status, 7)
    distance = min(max(round(1e3 * reading.distance), 0), 0xFFFF)
    return _RESULT.pack(state, 40, round(reading.ambient / 8), distance, round(reading.signal / 8))


class Chip:
    """One chip."""

    def __init__(self, link: Link, pause: Callable[[float], None]) -> None:
        self.link = link
        self._pause = pause

    def require(self) -> None:
        """Raise ProtocolError unless this is a VL53L1X that has started."""
        self._wait("its start", lambda: bool(self.link.read(BOOTED, 1).data[0] & 1))
        if (said := self.link.read(MODEL, 2).data) != IDENTITY:
            raise ProtocolError(f"not a {NAME}: it says {said.hex()}; expected {IDENTITY.hex()}")

    def move(self, address: int) -> None:
        """Give it another address on the bus, at which it answers from now on."""
        self.link.write(MOVE, bytes((address,)))

    def set_up(self, table: bytes, budget: int, period: int) -> None:
        """Long distances, `budget` ms a measurement, one every `period` ms; measures once to warm up, then goes on."""
        self.link.write(START, b"\0")
        self.link.write(TABLE_AT, table)
        self.link.write(START, b"\x40")
        self._wait("its first reading", self.is_ready)
        self.link.write(CLEAR, b"\x01")
        self.link.write(START, b"\0")
        self.link.write(STARTING, b"\x09")
        self.link.write(PREVIOUS_TEMPERATURE, b"\0")
        for register, value in LONG:
            self.link.write(register, value)
        first, second = BUDGETS[budget]
        self.link.write(TIMEOUT_A, first.to_bytes(2, "big"))
        self.link.write(TIMEOUT_B, second.to_bytes(2, "big"))
        ticks = int.from_bytes(self.link.read(OSCILLATOR, 2).data, "big") & 0x3FF  # of its slow clock in a ms
        self.link.write(PERIOD, int(ticks * period * 1.075).to_bytes(4, "big"))
        self.link.write(START, b"\x40")

    def is_ready(self) -> bool:
        """Whether there is a reading that was not read."""
        polarity = 0 if self.link.read(POLARITY, 1).data[0] & 0x10 else 1
        return self.link.read(READY, 1).data[0] & 1 == polarity

    def read(self) -> Reading:
        """The reading that is there; lets the chip make the next."""
        reading = parsed(self.link.read(RESULT, RESULT_SIZE).data)
        self.link.write(CLEAR, b"\x01")
        return reading

    def _wait(self, what: str, has_come: Callable[[], bool]) -> None:
        for _ in range(POLLS):
            if has_come():
                return
            self._pause(POLL)
        raise ProtocolError(f"waited {POLLS * POLL:g} s for {what} in vain")
