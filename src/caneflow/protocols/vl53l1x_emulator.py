"""A VL53L1X that is not there: its registers, and the readings of given distances over time.

Pure: what is written, and the time (s), in; what is read out. A bus that does not acknowledge raises OSError.
"""

import errno
import math
import os

from caneflow.protocols import vl53l1x
from caneflow.protocols.maxbotix_emulator import Echoes
from caneflow.protocols.vl53l1x import Reading

OSCILLATIONS = 0x0100  # of the slow clock in a ms


class Emulator:
    """One chip, powered on, that measures as `echoes` says; None is no target."""

    def __init__(self, echoes: Echoes) -> None:
        self.readings = 0  # that were read
        self.address = vl53l1x.ADDRESS
        self._echoes = echoes
        self._registers = bytearray(0x200)
        self._registers[vl53l1x.BOOTED] = 1
        self._registers[vl53l1x.MODEL : vl53l1x.MODEL + 2] = vl53l1x.IDENTITY
        self._registers[vl53l1x.OSCILLATOR : vl53l1x.OSCILLATOR + 2] = OSCILLATIONS.to_bytes(2, "big")
        self._begun: float | None = None  # s, when it began to measure
        self._cleared = 0  # readings, up to the last one that was taken

    def transfer(self, address: int, written: bytes, length: int, time: float) -> bytes:
        """Write register and data, then read `length` bytes; raises OSError when nobody acknowledges."""
        if address != self.address or len(written) < 2:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        register = int.from_bytes(written[:2], "big")
        for at, value in enumerate(written[2:], register):
            self._registers[at & 0x1FF] = value
            self._control(at, value, time)
        if length:
            self._measure(time)
            self.readings += length == vl53l1x.RESULT_SIZE
        return bytes(self._registers[register : register + length]).ljust(length, b"\0")

    def _control(self, register: int, value: int, time: float) -> None:
        if register == vl53l1x.MOVE:
            self.address = value
        elif register == vl53l1x.START:
            began = value == 0x40 and self._registers[vl53l1x.TABLE_AT : vl53l1x.CLEAR] != bytes(
                vl53l1x.CLEAR - vl53l1x.TABLE_AT
            )
            self._begun, self._cleared = (time, 0) if began else (None, 0)
        elif register == vl53l1x.CLEAR and value & 1:
            self._cleared = self._count(time)

    def _count(self, time: float) -> int:
        """Readings since it began."""
        if self._begun is None:
            return 0
        ticks = int.from_bytes(self._registers[vl53l1x.PERIOD : vl53l1x.PERIOD + 4], "big")
        return math.floor((time - self._begun) / max(ticks / (OSCILLATIONS * 1075.0), 0.001))

    def _measure(self, time: float) -> None:
        """Bring flag and result up to date."""
        is_new = self._count(time) > self._cleared
        active = 0 if self._registers[vl53l1x.POLARITY] & 0x10 else 1
        self._registers[vl53l1x.READY] = active if is_new else 1 - active
        distance = self._echoes.at(time - (self._begun or 0.0))
        status = vl53l1x.NO_TARGET if distance is None else vl53l1x.TARGET
        result = vl53l1x.built(Reading(distance or 0.0, status, signal=160.0, ambient=16.0))
        self._registers[vl53l1x.RESULT : vl53l1x.RESULT + len(result)] = result


def pretended_table() -> bytes:
    """What has the size of ST's table, for tests and for an emulator without ST's file: of no use to a chip."""
    table = bytearray(range(1, vl53l1x.TABLE_SIZE + 1))
    at = {vl53l1x.POLARITY: 0x01, vl53l1x.CLEAR: 0, vl53l1x.START: 0}
    at |= {vl53l1x.PERIOD + n: value for n, value in enumerate((0, 0, 0x0F, 0x89))}
    for register, value in at.items():
        table[register - vl53l1x.TABLE_AT] = value
    return bytes(table)


def as_c_source(table: bytes) -> str:
    """A source as ST hands it out, of any table."""
    return f"const uint8_t VL51L1X_DEFAULT_CONFIGURATION[] = {{ {', '.join(f'0x{each:02X}' for each in table)} }};\n"
