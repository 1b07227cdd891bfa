"""The TDK InvenSense MPU-9250 on I2C, worn on the belt.

out  imu : Imu   gyro, acceleration, magnetic field, 100 Hz; no attitude, put operators.attitude behind it
"""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, TypeAlias

from annotated_types import Ge, Le

from caneflow.algorithms.quantities import MagneticField, Time
from caneflow.errors import not_installed
from caneflow.messages import Imu
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mounting import mounting
from caneflow.protocols.mpu9250 import MAGNETOMETER_ADDRESS
from caneflow.protocols.mpu9250_chip import NAME, Chip, Reading, Setup
from caneflow.protocols.pacing import Pacing, Spacing, Verdict
from caneflow.protocols.register_link import Faults, I2cLink
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

LOST = (OSError, ProtocolError)  # what a bus or a chip that is gone raises
FASTER = 1.02  # readings for each value: the chip's clock may be 1 % off
RETRY = 0.1  # s between two looks for a chip that is gone
SILENCE = 0.3  # s without an answer, after which the bus is opened again
MAG_PATIENCE = 0.5  # s without a word of the magnetometer, after which the chip is set up again
SATURATED_PATIENCE = 5.0  # s of readings at the end of a range, after which the chip is set up again
REVIVAL_PERIOD = 5.0  # s between two attempts to get a chip going whose values stand still
REPORT_PERIOD = 60.0  # s
WIDER = "gyro_range and accel_range may be wider (docs/hardware.md)"

Transfer: TypeAlias = Callable[[int, bytes, int], bytes]  # address, what to write, bytes to read after that


@dataclass(frozen=True, kw_only=True)
class Mpu9250Settings:
    """Where the chip is and how it is to measure."""

    __pydantic_config__ = {"extra": "forbid"}

    bus: Annotated[int, Ge(0), Le(255)] = 1  # /dev/i2c-N
    address: Annotated[int, Ge(0x68), Le(0x69)] = 0x68  # 0x69 with AD0 high
    rate: Annotated[float, Ge(4), Le(1000)] = 100.0  # Hz; the magnetometer has 100 at most
    gyro_range: Literal[250, 500, 1000, 2000] = 1000  # deg/s
    accel_range: Literal[2, 4, 8, 16] = 8  # g
    bandwidth: Literal[184, 92, 41, 20, 10, 5] = 41  # Hz, of the chip's low-pass filters
    magnetometer: bool = True
    mag_offset: tuple[MagneticField, MagneticField, MagneticField] = (
        0.0,
        0.0,
        0.0,
    )  # uT, body: what steel on the belt adds; is taken off
    axes: str = "+x+y+z"  # the chip's axes (gyro's and accelerometer's) that are the body's x, y, z
    start_timeout_s: Time = 10.0  # s to the first sample; later the chip is waited for forever

    def __post_init__(self) -> None:
        try:
            mounting(self.axes)
        except ProtocolError as error:
            raise ValueError(f"axes: {error}") from error
        if not all(map(math.isfinite, self.mag_offset)):
            raise ValueError(f"mag_offset is {self.mag_offset}; NaN and infinity are not a field")


class Mpu9250(Source):
    """Reads the chip's nine axes in one burst; outlives its bus, its power and its resets.

    A stamp is when the chip had the request for the values, less the delay of its filter.
    """

    outputs = {"imu": Imu}
    Settings = Mpu9250Settings

    def __init__(self, settings: Mpu9250Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node
        self._mounting = mounting(settings.axes)
        self._setup = Setup(
            rate=settings.rate,
            gyro_range=settings.gyro_range,
            accel_range=settings.accel_range,
            bandwidth=settings.bandwidth,
            magnetometer=settings.magnetometer,
        )
        self._delay_ns = round(self._setup.delay * 1e9)
        self._last_stamp = 0  # ns, of the last sample
        self._quiet_until = 0  # ns
        self._said = ""  # the last warning
        self._saturated: Counter[str] = Counter()  # readings that were dropped, by what was at its end, since the start
        self._saturated_told = 0
        self._faults = Faults()
        self._pacing = self._new_pacing()
        self._spacing = Spacing(1.0 / settings.rate)
        self._next_report = time.monotonic() + REPORT_PERIOD
        self._next_revival = 0.0  # s, monotonic

    def samples(self) -> Brought:
        """Yield what the chip measures; raises DataflowError when it gives no sample at the start."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        try:
            while True:
                try:
                    with opened(self._settings) as chip:
                        yield from self._stay(chip)
                except LOST as error:
                    self._set_back(error, give_up)
                yield self._quiet()
                time.sleep(RETRY)
        finally:
            self._report()

    def _stay(self, chip: Chip) -> Brought:
        """Samples as long as the chip is there; raises one of LOST."""
        try:
            chip.require(magnetometer=self._settings.magnetometer)
            chip.set_up(self._setup)
            self._next_revival = time.monotonic() + REVIVAL_PERIOD
            yield from self._measured(chip)
        finally:
            self._faults = self._faults.plus(chip.link.faults).plus(chip.magnetometer.faults)

    def _measured(self, chip: Chip) -> Brought:
        pacing = self._pacing
        answered = told = usable = time.monotonic()
        pacing.restart(answered)
        early: int | None = None  # ns, stamp of a reading that came before the values changed
        while True:
            if (wait := pacing.due - time.monotonic()) > 0:
                time.sleep(wait)
            try:
                reading = chip.read()
            except ProtocolError:
                now = time.monotonic()
                pacing.failed(now)
                if now - answered > SILENCE:
                    raise
                early = None
                yield self._quiet()
                continue
            answered = time.monotonic()
            told = self._checked(reading, told, answered)
            if reading.said.saturated:
                self._note_saturated(reading.said.saturated)
                if answered - usable > SATURATED_PATIENCE:
                    raise ProtocolError(f"nothing but {reading.said.saturated} at the end of its range")
                pacing.failed(answered)
                early = None
                yield self._quiet()
                continue
            usable = answered
            verdict = pacing.took(reading.values, answered)
            if verdict is Verdict.REPEATED:
                early = reading.stamp
                continue
            stamp, early = (early or reading.stamp) - self._delay_ns, None
            if verdict is Verdict.FROZEN:
                self._require_change(answered)
                yield self._quiet()
            elif stamp > max(self._last_stamp, self._quiet_until):
                yield "imu", self._sample(stamp, reading)
            if answered > self._next_report:
                self._report()

    def _checked(self, reading: Reading, told: float, now: float) -> float:
        """When the magnetometer last said something, s; raises ProtocolError for a chip that is to be set up again."""
        if reading.said.was_reset:
            raise ProtocolError("the chip was reset")
        if reading.said.magnetometer_works or not self._settings.magnetometer:
            return now
        if now - told > MAG_PATIENCE:
            raise ProtocolError("the magnetometer says nothing")
        return told

    def _note_saturated(self, what: str) -> None:
        """Count a reading that is dropped: what is at the end of its range was more than it says."""
        if not self._saturated[what]:
            log.warning("%s at the end of its range: the reading is dropped, as are others like it; %s", what, WIDER)
        self._saturated[what] += 1

    def _require_change(self, now: float) -> None:
        """Raise ProtocolError now and then while the values stand still, which sets the chip up again."""
        if now > self._next_revival:
            raise ProtocolError("the values stand still")

    def _sample(self, stamp: int, reading: Reading) -> Imu:
        self._last_stamp = stamp
        self._spacing.take(stamp)
        if self._said:
            log.info("the chip is back")
            self._said = ""
        turned = self._mounting.turned
        mag = None
        if reading.said.mag is not None and self._settings.magnetometer:
            x, y, z = turned(reading.said.mag)
            dx, dy, dz = self._settings.mag_offset
            mag = (x - dx, y - dy, z - dz)
        return Imu(stamp=stamp, gyro=turned(reading.said.gyro), accel=turned(reading.said.accel), mag=mag)

    def _quiet(self) -> Quiet:
        """Say that nothing has come until now, so that nobody waits for it."""
        self._quiet_until = max(time.time_ns() - self._delay_ns, self._last_stamp, self._quiet_until)
        return Quiet(self._quiet_until)

    def _set_back(self, error: Exception, give_up: float) -> None:
        """Take note that there is no chip; raises DataflowError when there never was one."""
        where = f"MPU-9250 on /dev/i2c-{self._settings.bus}, address 0x{self._settings.address:02X}"
        reason = getattr(error, "strerror", None) or str(error)
        if not self._last_stamp and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: {where}: no sample within {self._settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        text = f"{where}: {reason}; tries again"
        if text != self._said:
            log.warning("%s", text)
            self._said = text

    def _new_pacing(self) -> Pacing:
        return Pacing(self._settings.rate, time.monotonic(), chip_rate=self._setup.chip_rate, faster=FASTER)

    def _report(self) -> None:
        """Log how it went since the last time."""
        spacing, pacing = self._spacing, self._pacing
        if spacing.count:
            log.info(
                "%d samples every %.3f ms, jitter %.2f, longest %.1f; "
                "%d read again, %d missed, %d gaps, %d dropped as saturated; %s",
                *(spacing.count, 1e3 * spacing.mean, 1e3 * spacing.jitter, 1e3 * spacing.longest),
                *(pacing.repeated, pacing.missed, spacing.gaps),
                *(self._saturated.total() - self._saturated_told, self._faults),
            )
        self._saturated_told = self._saturated.total()
        spacing.clear()
        pacing.repeated = pacing.missed = 0
        self._faults = Faults()
        self._next_report = time.monotonic() + REPORT_PERIOD


@contextmanager
def opened(settings: Mpu9250Settings) -> Iterator[Chip]:
    """The chip on its bus; raises OSError when the bus cannot be opened."""
    with opened_bus(settings.bus) as transfer:
        yield chip_on(transfer, settings.address)


def chip_on(transfer: Transfer, address: int) -> Chip:
    """Both dies of a chip on a bus."""
    inertial, magnetometer = partial(transfer, address), partial(transfer, MAGNETOMETER_ADDRESS)
    return Chip(
        I2cLink(inertial, time.sleep, time.time_ns, device=NAME),
        I2cLink(magnetometer, time.sleep, time.time_ns, device=f"{NAME}, magnetometer"),
        time.sleep,
    )


@contextmanager
def opened_bus(number: int) -> Iterator[Transfer]:
    """Transfers on /dev/i2c-N; raises OSError when there is no such bus."""
    try:
        import smbus2
    except ImportError as error:
        raise DataflowError(not_installed("smbus2", "devices")) from error

    with smbus2.SMBus(number) as bus:

        def transfer(address: int, data: bytes, length: int) -> bytes:
            messages = [smbus2.i2c_msg.write(address, data)]
            if length:
                messages.append(smbus2.i2c_msg.read(address, length))
            bus.i2c_rdwr(*messages)
            return bytes(messages[-1]) if length else b""

        yield transfer


if __name__ == "__main__":
    run(Mpu9250)
