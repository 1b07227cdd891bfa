"""Acconeer's A121 (module XM125, or a sensor board on XC120), by its exploration protocol: a serial port or TCP.

out  frame : RadarFrame   `sweeps` sweeps each, without a gap from frame to frame
"""

import logging
import math
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from caneflow.algorithms.clocks.clock_fit import ClockFit, ClockFitSettings
from caneflow.algorithms.quantities import Time
from caneflow.errors import not_installed
from caneflow.messages import RadarFrame
from caneflow.protocols import a121, a121_messages
from caneflow.protocols.a121_messages import Answer, Frame, Metadata
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.terminal_errors import TERMINAL_ERRORS
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

ANSWER_TIME = 1.0  # s; a setup calibrates the sensor, which takes some 0.2 s
SILENCE = 0.5  # s without a frame, and at least SILENT_FRAMES of them, after which the radar is started again
SILENT_FRAMES = 4
SAYING = 0.25  # s after which the driver says that nothing comes
RETRY = 0.25  # s between two attempts at a radar that is not there
BITS_PER_BYTE = 10  # on a UART
RECEIVED = 65_536  # bytes at once
LOSS_PERIOD = 30.0  # s between two lines about losses
NOTHING_NEW = 0  # ns


@dataclass(frozen=True, kw_only=True)
class A121Settings:
    """Where the radar is and how it measures; what it cannot do is found before it is opened."""

    __pydantic_config__ = {"extra": "forbid"}

    port: str = "/dev/ttyUSB0"  # serial port of an XM125
    baud: Annotated[int, Ge(9600), Le(3_000_000)] = a121_messages.FAST_BAUD  # bit/s, agreed on after the first words
    flow_control: bool = True  # RTS and CTS, as the vendor's boards wire them
    host: str | None = None  # of a server on TCP (XC120, Raspberry Pi), in the place of the serial port
    tcp_port: Annotated[int, Ge(1), Le(65535)] = a121_messages.TCP_PORT
    start: Annotated[float, Ge(0.0), Le(20.0)] = 0.3  # m, of the first point
    end: Annotated[float, Ge(0.0), Le(20.0)] = 1.3  # m: the last point is not beyond it
    step: Annotated[float, Ge(0.002), Le(2.0)] = 0.06  # m between points; the radar takes 2.5 mm times a divisor of 24
    profile: Annotated[int, Ge(1), Le(5)] = 3  # 1: short pulse, fine range; 5: long pulse, most power
    hwaas: Annotated[int, Ge(1), Le(511)] = 16  # samples averaged in a point
    prf: Literal["19_5_MHz", "15_6_MHz", "13_0_MHz"] = "15_6_MHz"
    sweep_rate: Annotated[float, Ge(10.0), Le(20_000.0)] = 2000.0  # Hz; unambiguous up to 1.239 mm times it
    sweeps: Annotated[int, Ge(2), Le(1000)] = 20  # of a frame
    range_offset: Annotated[float, Ge(-1.0), Le(1.0)] = 0.0  # m measured too far: by centimetres with the profile
    start_timeout_s: Time = 10.0  # s to the first frame; later the radar is waited for

    def __post_init__(self) -> None:
        if self.end < self.start:
            raise ValueError(f"end is {self.end:g} m; the last point lies beyond the first, at {self.start:g} m")
        if fault := a121.setup_fault(self.setup, None if self.host else self.baud):
            raise ValueError(fault)

    @property
    def setup(self) -> a121.SweepSetup:
        """The same in the radar's own units."""
        step = a121.fitting_step(self.step)
        first = round(self.start / a121.BASE_STEP)
        return a121.SweepSetup(
            start_point=first,
            points=max(math.floor((self.end / a121.BASE_STEP - first) / step + 1e-6), 0) + 1,
            step_length=step,
            profile=self.profile,
            averages=self.hwaas,
            repetition=self.prf,
            sweep_rate=self.sweep_rate,
            sweeps=self.sweeps,
        )

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.sweep_rate / self.sweeps

    @property
    def address(self) -> str:
        """Where the radar is, for people."""
        return f"{self.host}, TCP port {self.tcp_port}" if self.host else self.port


class Link(ABC):
    """Bytes to and from the radar; every method raises OSError when it is broken."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send all of `data`."""

    @abstractmethod
    def receive(self, timeout: float) -> bytes:
        """What has come; b"" when nothing does within `timeout` s."""

    @abstractmethod
    def close(self) -> None:
        """Give the way up."""


class TcpLink(Link):
    """A server on the network."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=ANSWER_TIME)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        """Send all."""
        self._socket.settimeout(ANSWER_TIME)
        self._socket.sendall(data)

    def receive(self, timeout: float) -> bytes:
        """What has come."""
        self._socket.settimeout(max(timeout, 1e-3))
        try:
            data = self._socket.recv(RECEIVED)
        except TimeoutError:
            return b""
        if not data:
            raise OSError("the server has hung up")
        return data

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


class SerialLink(Link):
    """A module on a UART."""

    def __init__(self, device: str, *, flow_control: bool) -> None:
        try:
            import serial
        except ImportError as error:
            raise DataflowError(not_installed("pyserial", "a121")) from error
        self._port = serial.Serial(
            device, a121_messages.FIRST_BAUD, exclusive=True, write_timeout=ANSWER_TIME, rtscts=flow_control
        )
        with suppress(OSError, *TERMINAL_ERRORS):
            self._port.send_break()  # whatever it was doing at whatever rate: the module listens at the first one again

    def set_baud(self, baud: int) -> None:
        """Go on at another rate."""
        self._port.baudrate = baud

    def send(self, data: bytes) -> None:
        """Send all."""
        self._port.write(data)

    def receive(self, timeout: float) -> bytes:
        """What has come."""
        self._port.timeout = max(timeout, 0.0)
        return bytes(self._port.read(max(self._port.in_waiting, 1)))

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class Silent(Exception):
    """The radar does not answer, or no longer measures; says why."""


FAILURES: tuple[type[Exception], ...] = (Silent, OSError, ProtocolError, *TERMINAL_ERRORS)


class Server:
    """An exploration server at the other end of a link."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._lines = a121_messages.Lines()
        self._come: deque[Answer] = deque()

    def ask(self, request: dict[str, Any], *, timeout: float = ANSWER_TIME) -> dict[str, Any]:
        """The answer to `request`; raises Silent without one, ProtocolError when it is refused."""
        self._link.send(a121_messages.line(request))
        until = time.monotonic() + timeout
        while (answer := self.next(until - time.monotonic())) is not None:
            if "result_info" in answer.said:  # a frame that was under way
                continue
            if answer.said.get("status") == "error":
                raise ProtocolError(f"refuses {request.get('cmd')}: {str(answer.said.get('message'))[:200]}")
            return answer.said
        raise Silent(f"no answer to {request.get('cmd')} within {timeout:g} s")

    def next(self, timeout: float) -> Answer | None:
        """What the server says next; None when nothing whole comes within `timeout` s."""
        until = time.monotonic() + timeout
        while not self._come:
            left = until - time.monotonic()
            if left <= 0:
                return None
            self._come += self._lines.feed(self._link.receive(left))
        return self._come.popleft()

    def forget(self) -> None:
        """Drop what has come, and half of what is coming."""
        self._come.clear()
        self._lines = a121_messages.Lines()


class Framing:
    """Makes messages of frames: stamped on the host's clock by the count of the radar's own."""

    def __init__(self, settings: A121Settings) -> None:
        self._settings, self._setup = settings, settings.setup
        self._fit = ClockFit()
        self._axis = a121.RangeAxis(0.0, 1.0)
        rate = 0.0 if settings.host else settings.baud / BITS_PER_BYTE
        size = self._setup.sweeps * self._setup.points * a121.BYTES_PER_POINT
        self._transfer = round(1e9 * size / rate) if rate else 0  # ns; what a network takes is not known
        self._missed_before = 0
        self.frames = 0
        self.saturated = 0
        self.mended = 0  # samples

    @property
    def missed(self) -> int:
        """Frames that the radar's clock says are lacking."""
        return self._missed_before + self._fit.missed

    def begin(self, metadata: Metadata, ticks_per_second: float) -> None:
        """The radar starts to measure."""
        self._missed_before = self.missed
        self._axis = a121.range_axis(self._setup.start_point, self._setup.step_length, metadata.base_step)
        tick = ClockFitSettings(tick=1e9 / ticks_per_second, wraps_at=a121.FASTEST_WRAP)
        self._fit = ClockFit(tick, period=ticks_per_second / self._settings.rate)

    def message(self, frame: Frame, arrival: int) -> RadarFrame | None:
        """The frame that came at `arrival` (ns, host); None when its receiver was saturated."""
        self.frames += 1
        stamp = self._fit.update(frame.tick, arrival - self._transfer)
        if frame.saturated:
            self.saturated += 1
            return None
        scans, mended = a121.repaired(a121.scans_of(frame.samples[..., 0], frame.samples[..., 1]))
        self.mended += mended
        return RadarFrame(
            stamp=stamp,
            scans=scans,
            scan_period=1.0 / self._settings.sweep_rate,
            range_start=self._axis.start - self._settings.range_offset,
            range_step=self._axis.step,
            carrier=a121.CARRIER,
            bandwidth=a121.bandwidth_of(self._settings.profile),
        )


class A121(Source):
    """Sets the radar up, brings its frames, sets it up again when it asks for that, and stops it on every way out."""

    outputs = {"frame": RadarFrame}
    Settings = A121Settings

    def __init__(self, settings: A121Settings, context: Context) -> None:
        self._settings, self._node = settings, context.node
        self._framing = Framing(settings)
        self._last_stamp = 0  # ns
        self._said = ""  # why there are no frames; "": there are
        self._described = ""
        self._next_loss_line = 0.0  # s
        self._losses_told = (0, 0)

    def samples(self) -> Brought:
        """Yield frames; a radar that falls silent is asked until it answers, one that never answered is an error."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        try:
            while True:
                try:
                    with closing(self._opened()) as link:
                        yield from self._session(link)
                except FAILURES as error:
                    self._set_back(error, give_up)
                yield Quiet(max(time.time_ns(), self._last_stamp))
                time.sleep(RETRY)
        finally:
            self._say_losses(at_once=True)

    def _opened(self) -> Link:
        settings = self._settings
        return (
            TcpLink(settings.host, settings.tcp_port)
            if settings.host
            else SerialLink(settings.port, flow_control=settings.flow_control)
        )

    def _session(self, link: Link) -> Brought:
        server = Server(link)
        try:
            system = self._greeted(link, server)
            self._agree_on_baud(link, server)
            while True:
                began = time.monotonic()
                metadata = a121_messages.metadata_of(server.ask(a121_messages.setup_request(self._settings.setup)))
                self._require(metadata)
                self._describe(system, metadata)
                server.ask({"cmd": "start_streaming"})
                self._framing.begin(metadata, float(system.get("ticks_per_second") or 1_000_000))
                log.debug("%s: set up in %.2f s", self._node, time.monotonic() - began)
                yield from self._frames(server)
                began = time.monotonic()
                self._stop(server)
                log.info("%s: the radar asks to be calibrated; stopped in %.2f s", self._node, time.monotonic() - began)
                yield Quiet(max(time.time_ns(), self._last_stamp))
        finally:
            self._leave(link, server)

    def _greeted(self, link: Link, server: Server) -> dict[str, Any]:
        """What the server says of itself. One that was left streaming, or at another rate, is brought to listen."""
        rates = (a121_messages.FIRST_BAUD, self._settings.baud) if isinstance(link, SerialLink) else (None,)
        reason: Exception = Silent("no answer")
        for rate in rates:
            if isinstance(link, SerialLink) and rate is not None:
                link.set_baud(rate)
            for _ in range(2):
                try:
                    self._stop(server)
                    said = server.ask({"cmd": "get_system_info"}, timeout=0.5 * ANSWER_TIME)
                    return dict(said.get("system_info") or {})
                except (Silent, ProtocolError) as error:
                    server.forget()
                    reason = error
        raise reason

    def _agree_on_baud(self, link: Link, server: Server) -> None:
        if not isinstance(link, SerialLink):
            return
        server.ask({"cmd": "set_uart_baudrate", "baudrate": self._settings.baud})
        link.set_baud(self._settings.baud)

    def _stop(self, server: Server) -> None:
        """Stop what it may be doing; it may refuse, as it was doing nothing."""
        with suppress(ProtocolError):
            server.ask({"cmd": "stop_streaming"}, timeout=0.5 * ANSWER_TIME)

    def _leave(self, link: Link, server: Server) -> None:
        """Leave it stopped, at the rate that everybody begins with."""
        with suppress(*FAILURES):
            self._stop(server)
            if isinstance(link, SerialLink):
                server.ask({"cmd": "set_uart_baudrate", "baudrate": a121_messages.FIRST_BAUD})

    def _require(self, metadata: Metadata) -> None:
        setup = self._settings.setup
        if metadata.frame_points != setup.points * setup.sweeps:
            raise ProtocolError(f"sends frames of {metadata.frame_points} samples, not {setup.points} x {setup.sweeps}")
        if metadata.fastest_sweeps and metadata.fastest_sweeps < setup.sweep_rate:
            raise ProtocolError(
                f"sweeps {metadata.fastest_sweeps:.0f} times a second at most, asked for {setup.sweep_rate:g} Hz: "
                "fewer points, or a lower hwaas"
            )

    def _frames(self, server: Server) -> Brought:
        """Yield frames until the radar asks to be calibrated; raises Silent when none comes any more."""
        silence = max(SILENCE, SILENT_FRAMES / self._settings.rate)
        heard = time.monotonic()
        while True:
            answer = server.next(SAYING)
            now = time.monotonic()
            if answer is None:
                if now - heard > silence:
                    raise Silent(f"no frame for {silence:g} s")
                yield Quiet(NOTHING_NEW)
                continue
            if "result_info" not in answer.said:
                raise ProtocolError(f"said {str(answer.said)[:80]} in the place of a frame")
            heard = now
            frame = a121_messages.frame_of(answer, self._settings.setup)
            message = self._framing.message(frame, time.time_ns())
            if message is not None and message.stamp > self._last_stamp:
                self._last_stamp, self._said = message.stamp, ""
                yield "frame", message
            self._say_losses()
            if frame.uncalibrated:
                return

    # --- what is said to people ---------------------------------------------------------------------------------

    def _describe(self, system: dict[str, Any], metadata: Metadata) -> None:
        setup = self._settings.setup
        axis = a121.range_axis(setup.start_point, setup.step_length, metadata.base_step)
        text = (
            f"{system.get('hw', 'A121')} ({system.get('rss_version', 'unknown software')}): {setup.points} points "
            f"from {axis.start:.3f} m every {1e3 * axis.step:.1f} mm, "
            f"profile {setup.profile}, {setup.sweep_rate:g} sweeps/s of {metadata.fastest_sweeps:.0f} at most"
        )
        if text != self._described or self._said:
            log.info("%s: %s", self._node, text)
        self._described = text

    def _set_back(self, error: Exception, give_up: float) -> None:
        """Take note that there is no radar; raises DataflowError when there never was one."""
        reason = getattr(error, "strerror", None) or str(error)
        if not self._last_stamp and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: A121 at {self._settings.address}: no frame within "
                f"{self._settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        if reason != self._said:
            log.warning("%s: A121 at %s: %s; tries again", self._node, self._settings.address, reason)
            self._said = reason

    def _say_losses(self, *, at_once: bool = False) -> None:
        framing, now = self._framing, time.monotonic()
        losses = (framing.missed, framing.saturated)
        if losses == self._losses_told or (not at_once and now < self._next_loss_line):
            return
        self._next_loss_line, self._losses_told = now + LOSS_PERIOD, losses
        log.warning(
            "%s: %d frames came, %d are missing, %d saturated and left out; %d disturbed samples replaced",
            *(self._node, framing.frames, framing.missed, framing.saturated, framing.mended),
        )


if __name__ == "__main__":
    run(A121)
