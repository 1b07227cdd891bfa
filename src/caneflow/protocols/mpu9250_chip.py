"""An MPU-9250 at the end of an I2C bus: found, set up with its magnetometer, read. No I/O but the links'."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from caneflow.protocols import mpu9250
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mpu9250 import MagRegister, Measurement, Register, Scales
from caneflow.protocols.register_link import Link

NAME = "MPU-9250"
UNADJUSTED = (b"\0\0\0", b"\xff\xff\xff")  # what a memory says that could not be read


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the chip is to work."""

    rate: float = 100.0  # Hz; the nearest that the chip can have, 1000 / n
    gyro_range: int = 1000  # deg/s, one of GYRO_RANGES
    accel_range: int = 8  # g, one of ACCEL_RANGES
    bandwidth: int = 41  # Hz, one of FILTERS
    magnetometer: bool = True

    @property
    def divider(self) -> int:
        """What the internal rate is divided by."""
        return min(max(round(mpu9250.INTERNAL_RATE / self.rate), 1), 256)

    @property
    def chip_rate(self) -> float:
        """Hz that the chip then has."""
        return mpu9250.INTERNAL_RATE / self.divider

    @property
    def delay(self) -> float:
        """Seconds by which the filter delays."""
        return mpu9250.FILTERS[self.bandwidth][1]

    def registers(self) -> bytes:
        """From RATE_DIVIDER to ACCEL_CONFIG_2."""
        filtered, _ = mpu9250.FILTERS[self.bandwidth]
        gyro, accel = mpu9250.GYRO_RANGES[self.gyro_range] << 3, mpu9250.ACCEL_RANGES[self.accel_range] << 3
        return bytes([self.divider - 1, filtered, gyro, accel, filtered])


class Reading(NamedTuple):
    """One burst."""

    stamp: int  # ns, when the chip had the request
    values: bytes  # the same as before when nothing is new
    said: Measurement


class Chip:
    """Procedures; each raises ProtocolError when the chip does not do its part."""

    def __init__(self, link: Link, magnetometer: Link, pause: Callable[[float], None]) -> None:
        """`magnetometer`: the way to the second die, which is there only in between (PIN_BYPASS)."""
        self.link = link
        self.magnetometer = magnetometer
        self._pause = pause
        self._scales = Scales.of(250, 2, b"\x80\x80\x80")

    def require(self, *, magnetometer: bool) -> str:
        """The chip's name; raises ProtocolError unless it is one that can be read here."""
        (identity,) = self.link.read(Register.WHO_AM_I, 1).data
        wanted = mpu9250.WITH_MAGNETOMETER | ({} if magnetometer else mpu9250.WITHOUT_MAGNETOMETER)
        if identity in wanted:
            return wanted[identity]
        if identity in mpu9250.WITHOUT_MAGNETOMETER:
            name = mpu9250.WITHOUT_MAGNETOMETER[identity]
            raise ProtocolError(f"is an {name}, which has no magnetometer; with `magnetometer: false` it can be used")
        raise ProtocolError(f"WHO_AM_I is 0x{identity:02X}; an MPU-9250 says 0x71")

    def set_up(self, setup: Setup) -> None:
        """Make the chip work as wanted, from whatever state."""
        self.link.write_unanswered(Register.POWER, bytes([mpu9250.POWER_RESET]))
        self._pause(mpu9250.RESET)
        self.link.write(Register.POWER, bytes([mpu9250.POWER_BEST_CLOCK]))
        self._pause(mpu9250.GYRO_START)
        registers = setup.registers()
        self.link.write(Register.RATE_DIVIDER, registers)
        adjustment = self._set_up_magnetometer() if setup.magnetometer else b"\x80\x80\x80"
        self.link.write(Register.PIN_CONFIG, mpu9250.SET_UP)
        if setup.magnetometer:
            self._let_magnetometer_be_read()
        kept = self.link.read(Register.RATE_DIVIDER, len(registers)).data
        if kept != registers:
            raise ProtocolError(f"does not keep its settings: {kept.hex(' ')} in the place of {registers.hex(' ')}")
        self._scales = Scales.of(setup.gyro_range, setup.accel_range, adjustment)

    def read(self) -> Reading:
        """All values in one burst."""
        data, stamp = self.link.read(Register.PIN_CONFIG, mpu9250.BURST)
        return Reading(stamp, data[mpu9250.VALUES], mpu9250.measurement(data, self._scales))

    def _set_up_magnetometer(self) -> bytes:
        """Let it measure, over the host's own bus; its adjustment."""
        self.link.write(Register.USER_CONTROL, b"\0")
        self.link.write(Register.PIN_CONFIG, bytes([mpu9250.PIN_BYPASS]))
        self._pause(mpu9250.MAG_CHANGE)
        (identity,) = self.magnetometer.read(MagRegister.ID, 1).data
        if identity != mpu9250.MAGNETOMETER_ID:
            raise ProtocolError(f"its magnetometer's identity is 0x{identity:02X}; an AK8963 says 0x48")
        self.magnetometer.write(MagRegister.CONTROL_2, bytes([mpu9250.MAG_RESET]))
        self._pause(mpu9250.MAG_CHANGE)
        self._change_magnetometer(mpu9250.MAG_FUSE_ROM)
        adjustment = self.magnetometer.read(MagRegister.ADJUSTMENT, 3).data
        if adjustment in UNADJUSTED:
            raise ProtocolError(f"its magnetometer's adjustment reads {adjustment.hex(' ')}, which none has")
        self._change_magnetometer(mpu9250.MAG_POWER_DOWN)
        self._change_magnetometer(mpu9250.MAG_100_HZ_16_BITS)
        return adjustment

    def _change_magnetometer(self, mode: int) -> None:
        self.magnetometer.write(MagRegister.CONTROL_1, bytes([mode]))
        self._pause(mpu9250.MAG_CHANGE)

    def _let_magnetometer_be_read(self) -> None:
        """Make the first die read the second with each sample: status, field, and the status that lets it go on."""
        self.link.write(Register.MASTER_CONTROL, bytes([mpu9250.MASTER_400_KHZ]))
        length = MagRegister.STATUS_2 - MagRegister.STATUS_1 + 1
        self.link.write(
            Register.SLAVE_ADDRESS,
            bytes(
                [
                    mpu9250.SLAVE_READ | mpu9250.MAGNETOMETER_ADDRESS,
                    MagRegister.STATUS_1,
                    mpu9250.SLAVE_ENABLED | length,
                ]
            ),
        )
        self.link.write(Register.USER_CONTROL, bytes([mpu9250.USER_MASTER]))
