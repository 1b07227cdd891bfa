"""A DRV2605 without the chip: its registers on an I2C bus, and what the motor was made to do.

Pure: what is written, and the time (s), in; what is read out. A bus that does not acknowledge raises OSError.
"""

import errno
import os
from dataclasses import dataclass, field

from caneflow.protocols.drv2605 import ADDRESS, OPEN_LOOP, PLAYING, RESET, STANDBY, STRONGEST, UNSIGNED, Register

POWER_ON = {Register.STATUS: 7 << 5, Register.MODE: STANDBY, Register.FEEDBACK: 0x36, Register.CONTROL_3: 0xA0}
SIZE = 0x23

Span = tuple[float, float]  # s from the first transfer, and s that it lasts


@dataclass
class Drv2605Emulator:
    """One chip on a bus of its own."""

    gone: tuple[Span, ...] = ()  # it does not answer, and has forgotten everything after that
    device: int = 7  # of the status: DRV2605L
    driven: list[tuple[float, float]] = field(default_factory=list)  # (s, 0..1), each time it changes
    _registers: bytearray = field(default_factory=lambda: _power_on(7))
    _lost: bool = False

    def __post_init__(self) -> None:
        self._registers = _power_on(self.device)

    def __call__(self, address: int, written: bytes, length: int, time: float) -> bytes:
        """One transfer at `time`, s."""
        if address != ADDRESS or any(begin <= time < begin + lasts for begin, lasts in self.gone):
            self._lost = self._lost or address == ADDRESS
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        if self._lost:
            self._registers, self._lost = _power_on(self.device), False
        at = written[0] if written else 0
        for offset, value in enumerate(written[1:]):
            self._write(at + offset, value)
        self._note(time)
        return bytes(self._registers[(at + offset) % SIZE] for offset in range(length))

    @property
    def strength(self) -> float:
        """How strong the motor runs now, 0..1."""
        mode = self._registers[Register.MODE]
        if mode & STANDBY or mode & 0x07 != PLAYING:
            return 0.0
        if not self._registers[Register.CONTROL_3] & UNSIGNED:
            raise AssertionError("the strength is taken as signed: half of it would run backwards")
        return self._registers[Register.PLAYBACK] / STRONGEST

    def _write(self, register: int, value: int) -> None:
        if register == Register.MODE and value & RESET:
            self._registers = _power_on(self.device)
        elif register != Register.STATUS:  # which is read only
            self._registers[register % SIZE] = value

    def _note(self, time: float) -> None:
        if not self.driven or self.driven[-1][1] != self.strength:
            self.driven.append((time, self.strength))


def _power_on(device: int) -> bytearray:
    registers = bytearray(SIZE)
    for register, value in POWER_ON.items():
        registers[register] = value
    registers[Register.STATUS] = device << 5
    assert registers[Register.CONTROL_3] & OPEN_LOOP
    return registers
