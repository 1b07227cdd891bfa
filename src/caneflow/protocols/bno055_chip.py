"""A BNO055 at the end of a link: found, set up, read, and asked what it has learnt. No I/O but the link's."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from caneflow.protocols import bno055
from caneflow.protocols.bno055 import (
    ERROR_NAMES,
    MODE_BITS,
    PROFILE_BYTES,
    STATUS_ERROR,
    STATUS_NAMES,
    Axes,
    Block,
    CalibrationProfile,
    Measurement,
    Mode,
    Register,
)
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import Link, Received

# Of the tables' times, which are typical ones.
MARGIN = 0.003  # s
CLOCK_STATUS_AFTER = 0.01  # s from the choice of the crystal until the status may be believed (a user's finding)
CLOCK_PATIENCE = 1.0  # s that the change may take
CLOCK_BUSY = 0x01
POLL = 0.01  # s


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the chip is to work."""

    mode: Mode = Mode.NDOF
    axes: Axes = field(default_factory=Axes)
    external_crystal: bool = True
    profile: CalibrationProfile | None = None  # None: the chip begins again


class Identity(NamedTuple):
    """What the chip says that it is."""

    chip: int  # 0xA0
    accel: int  # 0xFB
    mag: int  # 0x32
    gyro: int  # 0x0F
    software: str  # e.g. "3.11"
    bootloader: int
    self_test: int  # 4 bits: MCU, gyro, magnetometer, accelerometer; 0x0F is passed


class State(NamedTuple):
    """What the chip does."""

    status: int
    error: int
    mode: int

    def __str__(self) -> str:
        status = STATUS_NAMES.get(self.status, f"status {self.status}")
        because = f" ({ERROR_NAMES.get(self.error, self.error)})" if self.status == STATUS_ERROR else ""
        known = self.mode in set(Mode)
        return f"{status}{because}, mode {Mode(self.mode).name if known else f'0x{self.mode:02X}'}"


class Reading(NamedTuple):
    """One burst."""

    stamp: int  # ns
    values: bytes  # the registers but temperature and calibration: the same as before when nothing is new
    said: Measurement


class Chip:
    """Procedures; each raises ProtocolError when the chip does not do its part."""

    def __init__(self, link: Link, pause: Callable[[float], None]) -> None:
        self.link = link
        self._pause = pause

    def require(self) -> None:
        """Raise ProtocolError unless a BNO055 answers; while it starts, for START_UP or RESET s, it does not.

        Another program may have left it on page 1, where it has no id.
        """
        self._choose_page()
        (chip,) = self._read(Register.CHIP_ID, 1)
        if chip != bno055.CHIP_ID:
            raise ProtocolError(f"chip id 0x{chip:02X}; a BNO055 has 0x{bno055.CHIP_ID:02X}")

    def identity(self) -> Identity:
        """What the chip says that it is."""
        chip, accel, mag, gyro, low, high, bootloader = self._read(Register.CHIP_ID, 7)
        (self_test,) = self._read(Register.SELF_TEST, 1)
        return Identity(chip, accel, mag, gyro, f"{high:x}.{low:02x}", bootloader, self_test & 0x0F)

    def state(self) -> State:
        """What the chip does, and why not if it does not."""
        status, error, _, _, mode = self._read(Register.STATUS, 5)
        return State(status, error, mode & MODE_BITS)

    def read(self, block: Block) -> Reading:
        """The measurements of `block` in one burst."""
        data, stamp = self.link.read(block.first, block.length)
        return Reading(stamp, data[: bno055.VALUES_END], bno055.measurement(block, data))

    def set_up(self, setup: Setup) -> None:
        """Make the chip work as wanted, from whatever state; its fusion begins again."""
        self._choose_page()
        if setup.profile is not None and not self._is_fresh():
            self.reset()  # a fusion that has run does not take a profile (Bosch's moderator)
        self.change_mode(Mode.CONFIG)
        self.link.write(Register.POWER, bytes([bno055.POWER_NORMAL]))
        self._choose_clock(external=setup.external_crystal)
        self.link.write(Register.UNITS, bytes([bno055.UNITS_SI]))
        self.link.write(Register.AXIS_MAP, bytes([setup.axes.map, setup.axes.sign]))
        if setup.profile is not None:
            self.link.write(Register.PROFILE, setup.profile.to_bytes())
        self.change_mode(setup.mode)
        if not self.works_as(setup):
            raise ProtocolError(f"BNO055: does not keep its settings: {self.state()}")

    def works_as(self, setup: Setup) -> bool:
        """Whether the chip is set up so already: not so after a reset or a loss of power."""
        axes = self._read(Register.AXIS_MAP, 2)
        (units,) = self._read(Register.UNITS, 1)
        return (
            self._mode() == setup.mode and axes == bytes([setup.axes.map, setup.axes.sign]) and units == bno055.UNITS_SI
        )

    def change_mode(self, mode: Mode) -> None:
        """Switch, and wait until it is done; between two modes that measure the way is through CONFIG."""
        self.link.write(Register.MODE, bytes([mode]))
        self._pause((bno055.TO_CONFIG if mode == Mode.CONFIG else bno055.FROM_CONFIG) + MARGIN)

    def reset(self) -> None:
        """Reset, and wait until the chip has started."""
        self.change_mode(Mode.CONFIG)  # the trigger is not among the few registers that can be written elsewhere
        self.link.write_unanswered(Register.TRIGGER, bytes([bno055.TRIGGER_RESET]))
        self._pause(bno055.RESET)
        self._wait_until(self._answers, bno055.RESET, "does not come back from its reset")

    def profile(self) -> CalibrationProfile:
        """What the chip has learnt. It is left in CONFIG mode: only there it tells."""
        self.change_mode(Mode.CONFIG)
        return CalibrationProfile.from_bytes(self._read(Register.PROFILE, PROFILE_BYTES))

    def _choose_page(self) -> None:
        self.link.write(Register.PAGE_ID, b"\0")

    def _choose_clock(self, *, external: bool) -> None:
        wanted = bno055.TRIGGER_EXTERNAL_CRYSTAL if external else 0
        self._wait_until(self._clock_is_free, CLOCK_PATIENCE, "its clock stays in change")
        self.link.write(Register.TRIGGER, bytes([wanted]))
        self._pause(CLOCK_STATUS_AFTER)
        self._wait_until(self._clock_is_free, CLOCK_PATIENCE, "its clock stays in change; has it the crystal?")

    def _is_fresh(self) -> bool:
        """Whether the fusion has not run since the chip started: then it has learnt nothing."""
        return self._mode() == Mode.CONFIG and not any(self._read(Register.PROFILE, PROFILE_BYTES))

    def _answers(self) -> bool:
        return self._read(Register.CHIP_ID, 1)[0] == bno055.CHIP_ID

    def _clock_is_free(self) -> bool:
        return not self._read(Register.CLOCK_STATUS, 1)[0] & CLOCK_BUSY

    def _mode(self) -> int:
        return self._read(Register.MODE, 1)[0] & MODE_BITS

    def _wait_until(self, condition: Callable[[], bool], patience: float, otherwise: str) -> None:
        """Ask again and again; an answer that fails, as while the clock changes, is none."""
        for _ in range(round(patience / POLL)):
            try:
                if condition():
                    return
            except ProtocolError:
                pass
            self._pause(POLL)
        raise ProtocolError(f"BNO055: {otherwise}")

    def _read(self, register: int, length: int) -> bytes:
        received: Received = self.link.read(register, length)
        return received.data
