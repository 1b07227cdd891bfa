"""The TI DRV2605 and DRV2605L, which drive a small vibration motor: registers, and what is written when.

Data sheet SLOS854 (DRV2605) and SLOS854D (DRV2605L), from memory: no chip was at hand. The motor is driven in real-time
playback: a byte is its strength, until the next.
"""

from enum import IntEnum
from typing import Final, Literal

from caneflow.protocols.errors import ProtocolError

NAME: Final = "DRV2605"
ADDRESS: Final = 0x5A
Motor = Literal["erm", "lra"]


class Register(IntEnum):
    """Those that are used."""

    STATUS = 0x00  # device in bits 7..5, 1: too hot, 0: too much current
    MODE = 0x01  # bit 7: reset, bit 6: standby, bits 2..0: mode
    PLAYBACK = 0x02  # real-time playback: the strength
    LIBRARY = 0x03
    FEEDBACK = 0x1A  # bit 7: LRA
    CONTROL_3 = 0x1D  # bit 5: ERM in open loop, bit 3: the strength has no sign


DEVICES: Final = {3: "DRV2605", 7: "DRV2605L", 4: "DRV2604", 6: "DRV2604L"}  # of STATUS
RESET: Final = 0x80
STANDBY: Final = 0x40
PLAYING: Final = 0x05  # mode: real-time playback
TOO_HOT: Final = 0x02
TOO_MUCH_CURRENT: Final = 0x01
LRA: Final = 0x80
UNSIGNED: Final = 0x08
OPEN_LOOP: Final = 0x20
RESET_TIME: Final = 0.002  # s, chosen: a few times what the chip takes to start
STRONGEST: Final = 0xFF


def require_device(status: int) -> str:
    """The name of the chip that gives this status; raises ProtocolError for another."""
    device = DEVICES.get(status >> 5)
    if device is None:
        raise ProtocolError(
            f"status 0x{status:02x} is not that of a {NAME}; expected a device of {', '.join(DEVICES.values())}"
        )
    return device


def set_up(motor: Motor, feedback: int, control: int) -> list[tuple[int, int]]:
    """What is written after a reset, register by register; `feedback` and `control` are what the chip has there."""
    lra = motor == "lra"
    return [
        (Register.PLAYBACK, 0),
        (Register.FEEDBACK, feedback | LRA if lra else feedback & ~LRA & 0xFF),
        (Register.CONTROL_3, (control | UNSIGNED) & ~OPEN_LOOP & 0xFF if lra else control | UNSIGNED | OPEN_LOOP),
        (Register.MODE, PLAYING),
    ]


def strength_byte(strength: float) -> int:
    """0..1 as the byte of real-time playback without sign."""
    return round(min(max(strength, 0.0), 1.0) * STRONGEST)


def trouble(status: int) -> str | None:
    """What the chip complains of; None: nothing."""
    if status & TOO_HOT:
        return "it is too hot and has switched its output off"
    if status & TOO_MUCH_CURRENT:
        return "too much current flows: is the motor shorted?"
    return None
