"""The fusion on a microcontroller at a serial port: samples go down, poses come back; it stands where fusion stands.

in   imu   : Imu          orientation, linear acceleration, 100 Hz
in   speed : GroundSpeed  one per radar frame, 100 Hz
out  pose  : Pose         one per IMU sample

It is an operator that has a device: for each IMU sample it waits for the microcontroller's pose, so a replay through it
is exact at any speed and two runs give the same bytes. Samples are numbered and sent again when the line has eaten
them; docs/mcu.md has the dialogue. Stamps are the host's and come back as they went, so poses need no other clock.
"""

import errno
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol

import msgspec
from annotated_types import Ge, Le

from caneflow.algorithms.cane.luenberger import LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import observer_constants
from caneflow.algorithms.clocks.clock_fit import ClockFit, ClockFitSettings
from caneflow.algorithms.quantities import Milliseconds, Time
from caneflow.errors import not_installed
from caneflow.messages import GroundSpeed, Imu, MessageError, Pose, Sample, decode, encode
from caneflow.protocols import uart_frames
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.terminal_errors import TERMINAL_ERRORS
from caneflow.protocols.uart_frames import NUMBERS, Deframer, Frame, Kind, PoseAnswer, Status, framed
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

READ_TIME = 0.01  # s that a read of the port lasts when nothing comes
WRITE_TIME = 2.0  # s after which a port that takes nothing is broken
RESET_PERIOD = 0.25  # s between two attempts to begin
MOST_UNANSWERED = 4  # samples that may be under way: together less than its queue of 512 bytes
TELL_PERIOD = 30.0  # s between two lines about a disturbed line
CLOCK_SPAN = 1 << 32  # ticks, then 0 again


@dataclass(frozen=True, kw_only=True)
class UartGatewaySettings:
    """Where the microcontroller is, and what its observer was built with: checked against it at the start."""

    __pydantic_config__ = {"extra": "forbid"}

    method: Literal["luenberger_fixed"] = "luenberger_fixed"  # as in fusion, so that one can stand for the other
    luenberger: LuenbergerSettings = field(default_factory=LuenbergerSettings)
    port: str = "/dev/ttyACM0"  # or a URL of pyserial, e.g. socket://host:port
    baud: Annotated[int, Ge(1200), Le(12_000_000)] = 921_600
    answer_timeout_ms: Milliseconds = 100.0  # ms after which a sample is sent again
    give_up_s: Time = 2.0  # s without an answer after which there is no microcontroller
    start_timeout_s: Time = 10.0  # s, likewise at the start

    def __post_init__(self) -> None:
        observer_constants(self.luenberger, (0.0, 1.0, 0.0))  # raises for what fixed point does not have


class Line(Protocol):
    """A serial line."""

    def send(self, data: bytes) -> None:
        """Send all of `data`; raises OSError when the line is broken."""

    def receive(self) -> bytes:
        """What has come, waiting READ_TIME for it; raises OSError when the line is broken."""

    def close(self) -> None:
        """Close the line."""


class Microcontroller:
    """The observer at the other end of a line: takes each sample once, in order, whatever the line does.

    Samples carry numbers. One that was lost is noticed by the next: the microcontroller says which number it expects,
    and all from there on are sent again. An answer that was lost is asked for by sending its sample again: a number
    that was handled is answered as before and not handled again.
    """

    def __init__(self, line: Line, settings: UartGatewaySettings, clock: Callable[[], float] = time.monotonic) -> None:
        self._line = line
        self._settings = settings
        self._now = clock
        self._deframer = Deframer()
        self._session = 0
        self._number = 0  # of the next sample
        self._unanswered: deque[tuple[int, bytes]] = deque()  # number, frame
        self.repeated = 0  # frames that were sent again
        self.refused = 0  # speeds that were of no use
        self.status: Status | None = None  # the last that was heard

    @property
    def bad_frames(self) -> int:
        """Stretches of bytes from the microcontroller that were not frames."""
        return self._deframer.bad

    def begin(self, session: int) -> Status:
        """Let the observer begin again; raises DataflowError when nothing answers within `start_timeout_s`."""
        self._session, self._number = session, 0
        self._unanswered.clear()
        now = self._now()
        end, ask_at = now + self._settings.start_timeout_s, now
        while (now := self._now()) < end:
            if now >= ask_at:
                self._line.send(uart_frames.reset(session))
                ask_at = now + RESET_PERIOD
            for frame in self._deframer.feed(self._line.receive()):
                if frame.kind == Kind.STATUS:
                    self.status = _status(frame)
                    if self.status.session == session:
                        return self.status
        silent = f"no microcontroller has answered for {self._settings.start_timeout_s:g} s"
        raise DataflowError(silent) from TimeoutError(silent)  # it may be there when the node is started again

    def tell(self, payload: bytes) -> None:
        """Send a ground speed (msgpack)."""
        self._send(Kind.GROUND_SPEED, payload)
        if len(self._unanswered) >= MOST_UNANSWERED:
            self.ask()

    def estimate(self, payload: bytes) -> PoseAnswer:
        """The pose for an IMU sample (msgpack).

        Raises:
            Refused: the observer has no use for the sample.
            DataflowError: the microcontroller does not answer, or has lost its state.
        """
        number = self._send(Kind.IMU, payload)
        for frame in self._heard(self._unanswered[-1][1]):
            if frame.number != number or frame.kind not in (Kind.POSE, Kind.REFUSED):
                continue
            self._unanswered.clear()
            if frame.kind == Kind.REFUSED:
                raise Refused(f"imu: refused by the microcontroller: {uart_frames.refusal(frame.body)}")
            return uart_frames.pose_answer(frame.body)
        raise AssertionError("the frames have no end")

    def ask(self) -> Status:
        """How the microcontroller is, all samples taken; raises DataflowError as `estimate` does."""
        question = framed(Kind.ASK, 0)
        self._line.send(question)
        for frame in self._heard(question):
            if frame.kind == Kind.STATUS and frame.number == self._number:
                assert self.status is not None
                self._unanswered.clear()
                return self.status
        raise AssertionError("the frames have no end")

    def _send(self, kind: Kind, payload: bytes) -> int:
        number, self._number = self._number, (self._number + 1) % NUMBERS
        frame = framed(kind, number, payload)
        self._unanswered.append((number, frame))
        self._line.send(frame)
        return number

    def _heard(self, question: bytes) -> Iterator[Frame]:
        """The frames that come; sends again what was lost, and `question` when none comes for too long."""
        patience = self._settings.answer_timeout_ms / 1e3
        began = self._now()
        ask_at, repair_at = began + patience, began
        while True:
            for frame in self._deframer.feed(self._line.receive()):
                if frame.kind == Kind.STATUS:
                    self._check(_status(frame))
                    if self._now() >= repair_at and self._repair(frame.number, question):
                        repair_at = self._now() + patience
                elif frame.kind == Kind.REFUSED:
                    self.refused += frame.number in [number for number, sent in self._unanswered if sent != question]
                yield frame
            now = self._now()
            if now - began > self._settings.give_up_s:
                raise DataflowError(f"the microcontroller has not answered for {self._settings.give_up_s:g} s")
            if now >= ask_at:
                self._line.send(question)
                self.repeated += 1
                ask_at = now + patience

    def _repair(self, expected: int, question: bytes) -> bool:
        """Send again what the microcontroller lacks from number `expected` on; whether there was something."""
        lacking = [number for number, _ in self._unanswered]
        if expected not in lacking:
            return False
        frames = [frame for _, frame in self._unanswered][lacking.index(expected) :]
        if question not in frames:
            frames.append(question)
        for frame in frames:
            self._line.send(frame)
        self.repeated += len(frames)
        return True

    def _check(self, status: Status) -> None:
        self.status = status
        if status.session != self._session:
            raise DataflowError("the microcontroller was restarted: its state is lost")


class UartGateway(Operator):
    """One microcontroller that estimates; what it costs and what the line did is logged at the end."""

    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose}
    Settings = UartGatewaySettings

    def __init__(self, settings: UartGatewaySettings, context: Context) -> None:
        self._where = f"{context.node}: {settings.port}"
        self._constants = observer_constants(settings.luenberger, context.rig.boresight)
        try:
            self._line = SerialLine(settings)
        except OSError as error:
            raise DataflowError(f"{self._where}: {_reason(error)}") from error
        self._microcontroller = Microcontroller(self._line, settings)
        self._report = self._begun()
        self._tell_at = time.monotonic() + TELL_PERIOD

    def handle(self, port: str, message: Sample) -> Emitted:
        """The microcontroller's pose at an IMU sample's stamp; a speed only informs it."""
        try:
            if isinstance(message, Imu):
                return (("pose", self._pose(message)),)
            if isinstance(message, GroundSpeed):
                self._microcontroller.tell(encode(_needed_speed(message)))
        except (DataflowError, ProtocolError) as error:
            raise DataflowError(f"{self._where}: {error}") from error
        except OSError as error:
            raise DataflowError(f"{self._where}: {_reason(error)}") from error
        return ()

    def finish(self) -> Emitted:
        """Say what the line did; nothing is left to emit."""
        try:
            status = self._microcontroller.ask()
        except (DataflowError, ProtocolError, OSError) as error:
            log.warning("%s: %s", self._where, error)
        else:
            log.info("%s: %s", self._where, self._report.line(self._microcontroller, status))
        self._line.close()
        return ()

    def _begun(self) -> "Report":
        try:
            status = self._microcontroller.begin(time.time_ns() % (CLOCK_SPAN - 1) + 1)
        except (DataflowError, ProtocolError, OSError) as error:
            self._line.close()
            raise DataflowError(f"{self._where}: {error}") from error
        if status.digest != self._constants.digest:
            self._line.close()
            raise DataflowError(
                f"{self._where}: the firmware was built with other settings or another boresight "
                f"({status.digest:08x}, here {self._constants.digest:08x}); build it with "
                "`caneflow mcu config FILE -o observer_config.h`"
            )
        log.info("%s: observer %08x, version %d", self._where, status.digest, status.version)
        return Report(status)

    def _pose(self, imu: Imu) -> Pose:
        answer = self._microcontroller.estimate(encode(_needed_imu(imu)))
        self._report.answered(answer, time.time_ns())
        if time.monotonic() > self._tell_at:
            self._tell_at = time.monotonic() + TELL_PERIOD
            if trouble := self._report.news(self._microcontroller):
                log.warning("%s: %s", self._where, trouble)
        try:
            pose = decode(answer.payload, Pose)
        except MessageError as error:
            raise ProtocolError(f"a pose that is none: {error}") from error
        if pose.stamp != imu.stamp:
            raise ProtocolError(f"a pose with stamp {pose.stamp} ns for the imu sample at {imu.stamp} ns")
        return pose


class Report:
    """What became of the samples, and how long the microcontroller took, on its clock and on the host's."""

    def __init__(self, start: Status) -> None:
        self._start = start
        self._clock = ClockFit(ClockFitSettings(tick=1e9 / start.ticks_per_second, wraps_at=CLOCK_SPAN))
        self._poses = self._saturated = self._gaps = 0
        self._ticks = 0  # of all poses together
        self._way_back = 0  # ns, the slowest
        self._told = (0, 0, 0)

    def answered(self, answer: PoseAnswer, arrival: int) -> None:
        """Take note of a pose that came at `arrival` (ns)."""
        self._poses += 1
        self._saturated += answer.saturated
        self._gaps += answer.gap
        self._ticks += answer.ticks
        # The microcontroller's clock on the host's: what an answer took beyond the fastest one of late.
        self._way_back = max(self._way_back, arrival - self._clock.update(answer.clock, arrival))

    def news(self, microcontroller: Microcontroller) -> str:
        """What went wrong since this was last asked; empty when nothing has."""
        now = microcontroller.bad_frames, microcontroller.repeated, self._saturated
        news = tuple(new - told for new, told in zip(now, self._told, strict=True))
        self._told = now
        if not any(news):
            return ""
        return f"{news[0]} damaged frames came, {news[1]} were sent again; {news[2]} poses saturated"

    def line(self, microcontroller: Microcontroller, end: Status) -> str:
        """The whole run in a line."""
        mean = 1e6 * self._ticks / max(self._poses, 1) / end.ticks_per_second
        bad_there = (end.bad_frames - self._start.bad_frames) % CLOCK_SPAN
        lost_there = (end.lost_bytes - self._start.lost_bytes) % CLOCK_SPAN
        return (
            f"{self._poses} poses, {mean:.0f} us each, answers up to {self._way_back / 1e6:.1f} ms behind the fastest; "
            f"damaged frames {bad_there} there, {microcontroller.bad_frames} here; {lost_there} bytes overrun; "
            f"{microcontroller.repeated} frames sent again, {microcontroller.refused} speeds refused; "
            f"{self._saturated} poses saturated, {self._gaps} gaps"
        )


class SerialLine:
    """A serial port, or what pyserial takes for one."""

    def __init__(self, settings: UartGatewaySettings) -> None:
        """Raises OSError when it cannot be opened."""
        try:
            import serial
        except ImportError as error:
            raise DataflowError(not_installed("pyserial", "devices")) from error
        try:
            self._port = serial.serial_for_url(
                settings.port, settings.baud, timeout=READ_TIME, write_timeout=WRITE_TIME, exclusive=True
            )
        except ValueError as error:  # a URL that is none, a baud rate that the port does not have
            raise OSError(errno.EINVAL, str(error)) from error

    def send(self, data: bytes) -> None:
        """Send all of `data`; raises OSError when the line is broken."""
        try:
            self._port.write(data)
        except TERMINAL_ERRORS as error:
            raise OSError(*error.args) from error

    def receive(self) -> bytes:
        """What has come, waiting READ_TIME for it; raises OSError when the line is broken."""
        try:
            first: bytes = self._port.read(1)
            return first + self._port.read(self._port.in_waiting) if first else first
        except TERMINAL_ERRORS as error:
            raise OSError(*error.args) from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def _status(frame: Frame) -> Status:
    return uart_frames.status(frame.body)


def _reason(error: OSError) -> str:
    """What an error says, without its number; pyserial puts both into one text."""
    return os.strerror(error.errno) if error.errno else str(error)


def _needed_imu(imu: Imu) -> Imu:
    """The sample without what the observer has no use for: the line is slow."""
    accel = imu.accel if imu.linear_accel is None else None
    return msgspec.structs.replace(imu, mag=None, calibration=None, accel=accel)


def _needed_speed(ground: GroundSpeed) -> GroundSpeed:
    """The sample without what the observer has no use for."""
    return msgspec.structs.replace(ground, velocity=None, velocity_cov=None, velocity_delay=None)


if __name__ == "__main__":
    run(UartGateway)
