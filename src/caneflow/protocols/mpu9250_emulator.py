"""An MPU-9250 without the chip: both dies on an I2C bus, that reset and err, and measure a given motion.

Pure: what is written, and the time (s), in; what is read out. A bus that does not acknowledge raises OSError, as
the host's does. What is not in the data sheets is said where it is assumed.
"""

import errno
import os
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from numpy.random import Generator

from caneflow.protocols import mpu9250
from caneflow.protocols.mpu9250 import MagRegister, Measurement, Register, Scales, Vector

BYTE_TIME = 9 / 400e3  # s on the bus
ADJUSTMENT = bytes([0xB0, 0xB2, 0xA6])  # of one AK8963
MAG_RATE = 100.0  # Hz
MAG_SIZE = 0x13
DEFAULTS = {Register.POWER: 0x01, Register.WHO_AM_I: 0x71}
NOT_ACKNOWLEDGED = errno.EREMOTEIO

Span = tuple[float, float]  # s from the beginning of the motion, and s that it lasts


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What the chip measures, in the axes of gyro and accelerometer; all n long, times (s) increasing."""

    times: Sequence[float]
    gyro: Sequence[Vector]  # rad/s
    accel: Sequence[Vector]  # m/s^2
    mag: Sequence[Vector]  # uT

    def index(self, time: float) -> int:
        """Which values are there at `time`, s; the first ones before."""
        return max(bisect_right(self.times, time) - 1, 0)


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong. Times are s from the beginning of the motion."""

    refusals: float = 0.0  # part of all transfers that are not acknowledged
    short: float = 0.0  # part of all reads that end before their last bytes
    freezes: tuple[Span, ...] = ()  # the values stand still, unless there is a reset
    unplugs: tuple[Span, ...] = ()  # nobody on the bus; then the chip has been powered on
    resets: tuple[float, ...] = ()  # the chip starts again by itself
    overflows: tuple[Span, ...] = ()  # a magnet is too near


@dataclass
class Tally:
    """What was done."""

    transfers: int = 0
    refused: int = 0
    short: int = 0
    bursts: int = 0
    seen: set[int] = field(default_factory=set)  # which of the motion's values were read


class Emulator:
    """One chip, powered on at `now`, whose motion begins then."""

    def __init__(
        self,
        motion: Motion,
        faults: Faults,
        rng: Generator,
        *,
        now: float,
        address: int = 0x68,
        identity: int = 0x71,
        clock: float = 1.0,
    ) -> None:
        """`clock`: how fast its own is; the data sheet allows 1 % of error."""
        self.begin = now
        self.tally = Tally()
        self._motion = motion
        self._faults = faults
        self._rng = rng
        self._address = address
        self._identity = identity
        self._clock = clock
        self._resets = deque(sorted(faults.resets))
        self._unplugs = deque(sorted(faults.unplugs))
        self._start(now)

    def transfer(self, address: int, written: bytes, length: int, now: float) -> bytes:
        """A write and, after a repeated start, a read of `length` bytes; raises OSError when nobody acknowledges."""
        self._live(now)
        self.tally.transfers += 1
        if self._is_unplugged(now) or self._rng.random() < self._faults.refusals:
            raise self._refusal()
        if address == self._address:
            answer = self._inertial(written, length, now)
        elif address == mpu9250.MAGNETOMETER_ADDRESS and self._bypassed():
            answer = self._magnetometer(written, length)
        else:
            raise self._refusal()
        if length and self._rng.random() < self._faults.short:
            self.tally.short += 1
            return answer[: -max(length // 3, 1)]
        return answer

    # --- the chip's life ----------------------------------------------------------------------------------------

    def _start(self, now: float) -> None:
        self._registers = bytearray(0x80)
        for register, value in DEFAULTS.items():
            self._registers[register] = value
        self._registers[Register.WHO_AM_I] = self._identity
        self._mag = bytearray(MAG_SIZE)
        self._mag[MagRegister.ID] = mpu9250.MAGNETOMETER_ID
        self._deaf_until = now + mpu9250.RESET
        self._started_at = now

    def _live(self, now: float) -> None:
        """Let the resets and returns of power happen whose time has come."""
        while self._resets and now >= self.begin + self._resets[0]:
            self._start(self.begin + self._resets.popleft())
            self._deaf_until = self._started_at
        while self._unplugs and now >= self.begin + sum(self._unplugs[0]):
            self._start(self.begin + sum(self._unplugs.popleft()))

    def _is_unplugged(self, now: float) -> bool:
        return bool(self._unplugs) and now >= self.begin + self._unplugs[0][0]

    def _refusal(self) -> OSError:
        self.tally.refused += 1
        return OSError(NOT_ACKNOWLEDGED, os.strerror(NOT_ACKNOWLEDGED))

    # --- registers ----------------------------------------------------------------------------------------------

    def _inertial(self, written: bytes, length: int, now: float) -> bytes:
        if now < self._deaf_until:
            raise self._refusal()
        register, values = written[0], written[1:]
        for address, value in enumerate(values, start=register):
            if address == Register.POWER and value & mpu9250.POWER_RESET:
                self._start(now)
                return b""
            if address < Register.ACCEL or Register.EXTERNAL + 24 <= address < Register.WHO_AM_I:
                self._registers[address] = value
        if length and register <= Register.EXTERNAL + 7 and register + length > Register.ACCEL:
            self._measure(now)
        return bytes(self._registers[register : register + length]).ljust(length, b"\0")

    def _measure(self, now: float) -> None:
        """Bring the registers of the values up to date, in the ranges that are set."""
        registers = self._registers
        said = self._said(now)
        scales = Scales.of(
            250 << (registers[Register.GYRO_CONFIG] >> 3 & 3),
            2 << (registers[Register.ACCEL_CONFIG] >> 3 & 3),
            ADJUSTMENT,
        )
        burst = mpu9250.burst(said, scales)
        registers[Register.ACCEL : Register.PIN_CONFIG + mpu9250.BURST] = burst[Register.ACCEL - Register.PIN_CONFIG :]

    def _said(self, now: float) -> Measurement:
        time = now - self.begin
        frozen = self._within(self._faults.freezes, time)
        if frozen is not None and self.begin + frozen >= self._started_at:
            time = frozen
        rate = mpu9250.INTERNAL_RATE / (1 + self._registers[Register.RATE_DIVIDER]) * self._clock
        index = self._motion.index(int(time * rate) / rate)  # it samples by its own clock
        self.tally.bursts += 1
        self.tally.seen.add(index)
        overflows = self._within(self._faults.overflows, now - self.begin) is not None
        return Measurement(
            gyro=self._motion.gyro[index],
            accel=self._motion.accel[index],
            temperature=25.0,
            mag=None if overflows else self._motion.mag[self._motion.index(int(time * MAG_RATE) / MAG_RATE)],
            was_reset=False,
            magnetometer_works=self._reads_magnetometer(),
        )

    def _reads_magnetometer(self) -> bool:
        """Whether the first die reads the second, and finds it measuring."""
        registers = self._registers
        asked = bytes(registers[Register.SLAVE_ADDRESS : Register.SLAVE_CONTROL + 1])
        return (
            bool(registers[Register.USER_CONTROL] & mpu9250.USER_MASTER)
            and not self._bypassed()
            and asked == bytes([0x80 | mpu9250.MAGNETOMETER_ADDRESS, MagRegister.STATUS_1, 0x88])
            and self._mag[MagRegister.CONTROL_1] == mpu9250.MAG_100_HZ_16_BITS
        )

    def _bypassed(self) -> bool:
        registers = self._registers
        master = registers[Register.USER_CONTROL] & mpu9250.USER_MASTER
        return bool(registers[Register.PIN_CONFIG] & mpu9250.PIN_BYPASS) and not master

    def _magnetometer(self, written: bytes, length: int) -> bytes:
        register, values = written[0], written[1:]
        for address, value in enumerate(values, start=register):
            if address == MagRegister.CONTROL_2 and value & mpu9250.MAG_RESET:
                self._mag[MagRegister.CONTROL_1] = mpu9250.MAG_POWER_DOWN
            elif address == MagRegister.CONTROL_1:
                self._mag[address] = value
        shown = bytearray(self._mag)
        if self._mag[MagRegister.CONTROL_1] == mpu9250.MAG_FUSE_ROM:
            shown[MagRegister.ADJUSTMENT :] = ADJUSTMENT
        return bytes(shown[register : register + length]).ljust(length, b"\0")

    def _within(self, spans: Sequence[Span], time: float) -> float | None:
        """The beginning of the span in which `time` lies, s of the motion; None: it lies in none."""
        return next((start for start, lasts in spans if start <= time < start + lasts), None)


class Bench:
    """A bus with an emulated chip on it, on a clock that goes on only when someone waits or talks."""

    def __init__(self, emulator: Emulator, *, time: float = 0.0) -> None:
        self.emulator = emulator
        self.time = time  # s

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        self.time += max(seconds, 0.0)

    def now_ns(self) -> int:
        """The time, ns."""
        return round(self.time * 1e9)

    def transfer(self, address: int, written: bytes, length: int) -> bytes:
        """A transfer, which takes its time on the bus."""
        answer = self.emulator.transfer(address, written, length, self.time)
        self.time += (1 + len(written) + (1 + length if length else 0)) * BYTE_TIME
        return answer
