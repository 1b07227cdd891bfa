"""The Bosch BNO055 on a UART or on I2C.

out  imu : Imu   gyro, acceleration, magnetic field, the chip's own attitude, 100 Hz
"""

import logging
import math
import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Milliseconds, Time
from caneflow.errors import not_installed
from caneflow.messages import Imu
from caneflow.protocols import bno055
from caneflow.protocols.bno055 import CalibrationProfile, Measurement, Mode
from caneflow.protocols.bno055_chip import Chip, Reading, Setup
from caneflow.protocols.bno055_link import UartLink
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.pacing import Pacing, Spacing, Verdict
from caneflow.protocols.register_link import Faults, I2cLink, Link
from caneflow.protocols.terminal_errors import TERMINAL_ERRORS
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

LOST: tuple[type[Exception], ...] = (
    OSError,
    *TERMINAL_ERRORS,
    ProtocolError,
)  # what a port or a chip that is gone raises
RETRY = 0.05  # s between two looks for a chip that is gone
START_PATIENCE = 1.5  # s that a chip may take to start, twice what the data sheet says
SILENCE = 0.3  # s without an answer, after which the port is opened again
IN_DOUBT_AFTER = 0.25  # s without a sample, after which the chip is asked for its state
ASK_AGAIN = 0.5  # s
REVIVAL_PERIOD = 5.0  # s between two attempts to get a chip going whose values stand still
REPORT_PERIOD = 60.0  # s


@dataclass(frozen=True, kw_only=True)
class Bno055Settings:
    """Where the chip is and how it is to work."""

    __pydantic_config__ = {"extra": "forbid"}

    port: str = "/dev/serial0"  # the serial port; on I2C the bus, e.g. /dev/i2c-1
    bus: Literal["uart", "i2c"] = "uart"
    address: Literal[0x28, 0x29] = 0x28  # on I2C; 0x29 with COM3 high
    baud: Literal[115200] = 115200  # bit/s, the only rate that the chip has
    mode: Literal["ndof", "imu"] = "ndof"  # the chip's fusion: with the magnetometer, or without
    rate: Annotated[float, Ge(0.01), Le(100)] = 100.0  # Hz; 100: every value of the chip's fusion, once
    external_crystal: bool = True
    axes: str = "+x+y+z"  # the chip's axes that are the body's x, y, z
    accel_and_mag: bool = True  # read these too; without them I2C with clock stretching keeps up with 100 Hz
    calibration_file: str | None = None  # given to the chip at the start, written at the end when it is calibrated
    answer_timeout_ms: Milliseconds = 30.0  # ms; an adapter on USB may hold an answer back for 16
    start_timeout_s: Time = 10.0  # s to the first sample; later the chip is waited for forever

    def __post_init__(self) -> None:
        try:
            bno055.axes(self.axes)
        except ProtocolError as error:
            raise ValueError(f"axes: {error}") from error
        if (self.bus == "i2c") != self.port.startswith("/dev/i2c-"):
            raise ValueError(f"port is {self.port!r}; with bus: {self.bus} it is {EXAMPLES[self.bus]}")


EXAMPLES = {"uart": "a serial port, e.g. /dev/serial0", "i2c": "an I2C bus, e.g. /dev/i2c-1"}


class Bno055(Source):
    """Reads the chip's measurements and its fusion in one burst; outlives its port, its power and its resets.

    A stamp is when the chip had the request for the values. When that was just before they changed, they are read
    a second time and keep the stamp of the first, which is nearer to the change.
    """

    outputs = {"imu": Imu}
    Settings = Bno055Settings

    def __init__(self, settings: Bno055Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node
        self._block = bno055.WHOLE if settings.accel_and_mag else bno055.WITHOUT_ACCEL_AND_MAG
        self._file = None if settings.calibration_file is None else Path(settings.calibration_file)
        self._setup = Setup(
            mode=Mode[settings.mode.upper()],
            axes=bno055.axes(settings.axes),
            external_crystal=settings.external_crystal,
            profile=None if self._file is None else read_profile(self._file),
        )
        self._set_up_before = False
        self._last_stamp = 0  # ns, of the last sample
        self._quiet_until = 0  # ns
        self._levels = (0, 0, 0, 0)
        self._said = ""  # the last warning
        self._dropped = ""  # why the last reading was
        self._give_up = math.inf  # s, monotonic, unless there is a sample by then
        self._next_revival = 0.0  # s, monotonic
        self._pacing = Pacing(settings.rate, time.monotonic(), chip_rate=bno055.RATE)
        self._report = Report(self._pacing, 1.0 / settings.rate)

    def samples(self) -> Brought:
        """Yield what the chip measures; raises DataflowError when it gives no sample at the start."""
        self._give_up = time.monotonic() + self._settings.start_timeout_s
        try:
            while True:
                try:
                    with opened(self._settings) as link:
                        yield from self._stay(Chip(link, time.sleep))
                except LOST as error:
                    self._set_back(error)
                yield self._quiet()
                time.sleep(RETRY)
        finally:
            self._report.tell(time.monotonic())

    def _stay(self, chip: Chip) -> Brought:
        """Samples as long as the chip is there; raises one of LOST."""
        yield from self._found(chip)
        if not (self._set_up_before and chip.works_as(self._setup)):
            chip.set_up(self._setup)
            self._set_up_before, self._next_revival = True, time.monotonic() + REVIVAL_PERIOD
        try:
            yield from self._measured(chip)
        except LOST:
            raise
        except BaseException:  # the flow ends, wherever that was heard
            self._save_profile(chip)
            raise

    def _found(self, chip: Chip) -> Brought:
        """Wait for a chip that starts."""
        until = time.monotonic() + START_PATIENCE
        while True:
            try:
                chip.require()
            except ProtocolError:
                if time.monotonic() > until:
                    raise
            else:
                return
            yield self._quiet()
            time.sleep(RETRY / 2)

    def _measured(self, chip: Chip) -> Brought:
        pacing, report = self._pacing, self._report
        report.watch(chip.link)
        answered = sampled = asked = time.monotonic()
        pacing.restart(answered)
        early: int | None = None  # ns, stamp of a reading that came before the values changed
        while True:
            if (wait := pacing.due - time.monotonic()) > 0:
                time.sleep(wait)
            began = time.monotonic()
            try:
                reading = chip.read(self._block)
            except ProtocolError:
                now = time.monotonic()
                pacing.failed(now)
                if now - answered > SILENCE:
                    raise
                early = None
                yield self._quiet()
                continue
            now = answered = time.monotonic()
            report.reading(now - began)
            verdict = self._verdict(reading, now)
            if verdict is Verdict.REPEATED:
                early = reading.stamp
                continue
            stamp, early = early or reading.stamp, None
            if verdict is Verdict.NEW:
                sampled = now
                if self._is_later(stamp):
                    yield "imu", self._sample(stamp, reading.said)
            elif now - max(sampled, asked) > (IN_DOUBT_AFTER if asked <= sampled else ASK_AGAIN):
                asked = now
                self._ask(chip, verdict)
                yield self._quiet()
            report.tell_now_and_then(now)

    def _verdict(self, reading: Reading, now: float) -> Verdict | None:
        """What a reading is; None: it is dropped, and read again.

        Its orientation is none, as before the fusion has begun and after a reset, or the chip cannot measure that.
        """
        if not bno055.is_rotation(reading.said.orientation):
            self._report.refused += 1
            self._dropped = "the chip gives no orientation"
        elif wrong := bno055.impossible(reading.said, self._setup.axes):
            if wrong not in self._report.impossible:
                log.warning("a reading with %s, which the chip cannot measure: dropped, as are others like it", wrong)
            self._report.impossible[wrong] += 1
            self._dropped = f"the chip says what it cannot measure: {wrong}"
        else:
            verdict = self._pacing.took(reading.values, now)
            self._report.frozen += verdict is Verdict.FROZEN
            return verdict
        self._pacing.failed(now)
        return None

    def _sample(self, stamp: int, said: Measurement) -> Imu:
        self._last_stamp, self._levels = stamp, said.calibration
        self._report.spacing.take(stamp)
        if self._said:
            log.info("the chip is back")
            self._said = ""
        return Imu(
            stamp=stamp,
            gyro=said.gyro,
            accel=said.accel,
            mag=said.mag if self._setup.mode is Mode.NDOF else None,
            orientation=said.orientation,
            linear_accel=said.linear_accel,
            calibration=said.calibration,
        )

    def _is_later(self, stamp: int) -> bool:
        """Whether a sample may have this stamp: not while a clock that was set back has not caught up."""
        ahead = max(self._last_stamp, self._quiet_until) - stamp
        if ahead < 0:
            return True
        if not self._report.clock_back:
            log.warning("the clock was set back by %.3f s: no samples until it has caught up", ahead / 1e9)
        self._report.clock_back += 1
        return False

    def _quiet(self) -> Quiet:
        """Say that nothing has come until now, so that nobody waits for it."""
        self._quiet_until = max(time.time_ns(), self._last_stamp, self._quiet_until)
        return Quiet(self._quiet_until)

    def _ask(self, chip: Chip, verdict: Verdict | None) -> None:
        """Find out why there are no samples; raises ProtocolError when something can be done about it."""
        state = chip.state()
        if not chip.works_as(self._setup):
            raise ProtocolError(f"the chip was reset: {state}; is set up again")
        what = "the values stand still" if verdict is Verdict.FROZEN else self._dropped
        now = time.monotonic()
        if now > self._next_revival:
            chip.reset()
            raise ProtocolError(f"{what}: {state}; was reset")
        if self._is_given_up(now):
            raise ProtocolError(f"{what}: {state}")
        self._warn(f"{what}: {state}")

    def _is_given_up(self, now: float) -> bool:
        """Whether there has never been a sample, for too long."""
        return not self._last_stamp and now > self._give_up

    def _set_back(self, error: Exception) -> None:
        """Take note that there is no chip; raises DataflowError when it is given up."""
        where, reason = f"BNO055 on {self._settings.port}", reason_of(error)
        if self._is_given_up(time.monotonic()):
            raise DataflowError(
                f"{self._node}: {where}: no sample within {self._settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        self._warn(f"{where}: {reason}; tries again")

    def _warn(self, text: str) -> None:
        if text != self._said:
            log.warning("%s", text)
            self._said = text

    def _save_profile(self, chip: Chip) -> None:
        """Keep what the chip has learnt, when it says that it has learnt all."""
        sensors = self._levels[1:] if self._setup.mode is Mode.NDOF else self._levels[1:3]
        if self._file is None or min(sensors) < 3:
            return
        try:
            chip.link.settle()  # the flow may have ended in the middle of an answer
            write_profile(self._file, chip.profile())
        except LOST as error:
            log.warning("the calibration was not saved: %s", error)
        else:
            log.info("calibration saved to %s", self._file)


class Report:
    """What became of the readings, told once a minute and at the end."""

    def __init__(self, pacing: Pacing, period: float) -> None:
        self.spacing = Spacing(period)
        self.impossible: Counter[str] = Counter()  # readings by what in them cannot be, since the start
        self._impossible_told = 0
        self._pacing = pacing
        self._link: Link | None = None
        self._clear(time.monotonic())

    def _clear(self, now: float) -> None:
        self.refused = 0  # no orientation
        self.frozen = 0
        self.clock_back = 0
        self._faults = Faults()
        self._readings = 0
        self._seconds = 0.0
        self._slowest = 0.0  # s
        self._impossible_told = self.impossible.total()
        self._pacing.missed = self._pacing.repeated = 0
        self.spacing.clear()
        self._told = now

    def watch(self, link: Link) -> None:
        """Take note of whose faults are to be told from now on."""
        self._collect()
        self._link = link

    def reading(self, took: float) -> None:
        """Note a reading that took so many s."""
        self._readings += 1
        self._seconds += took
        self._slowest = max(self._slowest, took)

    def tell_now_and_then(self, now: float) -> None:
        """Tell, if it is time."""
        if now - self._told >= REPORT_PERIOD:
            self.tell(now)

    def tell(self, now: float) -> None:
        """Log one line and begin again."""
        self._collect()
        if self._readings:
            log.info("%s", self._line())
        self._clear(now)

    def _collect(self) -> None:
        if self._link is not None:
            self._faults = self._faults.plus(self._link.faults)
            self._link.faults = Faults()

    def _line(self) -> str:
        spacing = self.spacing
        troubles = {
            "missed": self._pacing.missed,
            "without orientation": self.refused,
            "dropped as impossible": self.impossible.total() - self._impossible_told,
            "frozen": self.frozen,
            "gaps": spacing.gaps,
            "before a clock that was set back": self.clock_back,
        }
        counted = "".join(f", {number} {name}" for name, number in troubles.items() if number)
        return (
            f"{spacing.count} samples every {1e3 * spacing.mean:.3f} ms, jitter {1e3 * spacing.jitter:.2f}, "
            f"longest {1e3 * spacing.longest:.1f}; reading {1e3 * self._seconds / self._readings:.1f} ms, "
            f"slowest {1e3 * self._slowest:.1f}; {self._pacing.repeated} read again{counted}; {self._faults}"
        )


def reason_of(error: Exception) -> str:
    """What an error says, without its number."""
    if isinstance(error, TERMINAL_ERRORS):
        return os.strerror(error.args[0])
    return getattr(error, "strerror", None) or str(error)


@contextmanager
def opened(settings: Bno055Settings) -> Iterator[Link]:
    """The way to the chip; raises OSError when it cannot be opened."""
    link = _i2c if settings.bus == "i2c" else _uart
    with link(settings) as way:
        yield way


@contextmanager
def _uart(settings: Bno055Settings) -> Iterator[Link]:
    try:
        import serial
    except ImportError as error:
        raise _missing("pyserial") from error
    timeout = settings.answer_timeout_ms / 1e3
    port = serial.Serial(settings.port, settings.baud, timeout=timeout, write_timeout=1.0, exclusive=True)
    try:
        with suppress(OSError, ValueError, *TERMINAL_ERRORS):  # adapters on USB have it, others need it not
            port.set_low_latency_mode(True)
        yield UartLink(port, time.sleep, time.time_ns)
    finally:
        with suppress(OSError, *TERMINAL_ERRORS):
            port.close()


@contextmanager
def _i2c(settings: Bno055Settings) -> Iterator[Link]:
    try:
        import smbus2
    except ImportError as error:
        raise _missing("smbus2") from error

    with smbus2.SMBus(settings.port) as bus:

        def transfer(data: bytes, length: int) -> bytes:
            # read_i2c_block_data ends at 32 bytes; this does not
            messages = [smbus2.i2c_msg.write(settings.address, data)]
            if length:
                messages.append(smbus2.i2c_msg.read(settings.address, length))
            bus.i2c_rdwr(*messages)
            return bytes(messages[-1]) if length else b""

        yield I2cLink(transfer, time.sleep, time.time_ns)


def _missing(package: str) -> DataflowError:
    return DataflowError(not_installed(package, "devices"))


def read_profile(path: Path) -> CalibrationProfile | None:
    """The profile in a file; None when there is no file yet. Raises DataflowError for one that holds none."""
    try:
        profile = msgspec.json.decode(path.read_bytes(), type=CalibrationProfile)
        profile.to_bytes()
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError, ProtocolError) as error:
        raise DataflowError(f"{path}: holds no calibration of a BNO055: {error}; remove it") from error
    return profile


def write_profile(path: Path, profile: CalibrationProfile) -> None:
    """Write the profile so that the file is whole at every instant, through a loss of power as well."""
    beside = path.with_name(f"{path.name}.new")
    with beside.open("wb") as file:
        file.write(msgspec.json.format(msgspec.json.encode(profile)) + b"\n")
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


if __name__ == "__main__":
    run(Bno055)
