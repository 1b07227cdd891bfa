"""A TI mmWave radar with a demo firmware that sends points: IWR6843, AWR1843 (two ports), IWRL6432 (one).

out  points : RadarPoints   one frame each, as often as the configuration says (10 to 30 Hz)
"""

import logging
import time
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from caneflow.algorithms.clocks.clock_fit import ClockFit, ClockFitSettings
from caneflow.algorithms.quantities import Time
from caneflow.errors import not_installed
from caneflow.messages import RadarPoints
from caneflow.protocols import ti_mmwave
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.terminal_errors import TERMINAL_ERRORS
from caneflow.protocols.ti_mmwave import Chirps, Packet, Packets
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

ANSWER_TIME = 2.0  # s for one line; sensorStart takes longest
SILENCE = 1.0  # s without a frame, and at least SILENT_FRAMES of them, after which the radar is set up again
SILENT_FRAMES = 5
SAYING = 0.25  # s after which the driver says that nothing comes
RETRY = 0.25  # s
BITS_PER_BYTE = 10
FRAME_SPAN = 1 << 32
LOSS_PERIOD = 30.0  # s between two lines about losses
NOTHING_NEW = 0  # ns
FAILURES: tuple[type[Exception], ...] = (OSError, *TERMINAL_ERRORS)

Baud = Annotated[int, Ge(9600), Le(10_000_000)]


@dataclass(frozen=True, kw_only=True)
class TiMmwaveSettings:
    """Where the radar is, and the file that says how it measures."""

    __pydantic_config__ = {"extra": "forbid"}

    cli: str = "/dev/ttyUSB0"  # port that takes the configuration
    data: str | None = "/dev/ttyUSB1"  # port that sends points; none: the same
    cli_baud: Baud = ti_mmwave.CLI_BAUD
    data_baud: Baud = ti_mmwave.DATA_BAUD  # of `data`; of one port the configuration's line baudRate says it
    config: str = "mmwave.cfg"  # the vendor's file; its clutterRemoval must be off
    start_timeout_s: Time = 10.0  # s to the first frame; later the radar is waited for


class Refusal(DataflowError):
    """The radar does not take a line of its configuration."""


class TiMmwave(Source):
    """Sends the configuration line by line, brings the points, and stops the sensor on every way out."""

    outputs = {"points": RadarPoints}
    Settings = TiMmwaveSettings

    def __init__(self, settings: TiMmwaveSettings, context: Context) -> None:
        self._settings, self._node = settings, context.node
        self._lines, self._chirps = _configuration(context.node, Path(settings.config))
        self._missed_before = 0
        self._fit = self._new_fit()
        self._packets = Packets()
        self._last_stamp = 0  # ns
        self._said = ""  # why there are no points; "": there are
        self._frames = 0
        self._losses_told = (0, 0)
        self._next_loss_line = 0.0  # s

    def samples(self) -> Brought:
        """Yield points; a radar that falls silent is set up again, one that never answered is an error."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        try:
            while True:
                try:
                    yield from self._session()
                except FAILURES as error:
                    self._set_back(error, give_up)
                yield Quiet(max(time.time_ns(), self._last_stamp))
                time.sleep(RETRY)
        finally:
            self._say_losses(at_once=True)

    def _session(self) -> Brought:
        settings = self._settings
        with ExitStack() as ports:
            cli = ports.enter_context(closing(_opened(settings.cli, settings.cli_baud)))
            data = cli
            if settings.data is not None:
                data = ports.enter_context(closing(_opened(settings.data, settings.data_baud)))
            try:
                last = self._configure(cli, one_port=settings.data is None)
                self._missed_before += self._fit.missed
                self._fit, self._packets = self._new_fit(), Packets()
                yield from self._streamed(data, last if data is cli else b"")
            finally:
                with suppress(*FAILURES):
                    cli.write(b"sensorStop\n")

    def _configure(self, cli: Any, *, one_port: bool) -> bytes:
        """Send the configuration; what came with the last answer. Raises Refusal with the line that is not taken."""
        said = b""
        with suppress(TimeoutError):
            self._answered(cli, "sensorStop")  # it may be running, and may not know the word before it is set up
        for line in self._lines:
            said = self._answered(cli, line)
            if ti_mmwave.ENDS[0] not in said:
                text = " ".join(said.decode("ascii", "replace").split())[-120:]
                raise Refusal(f"{self._node}: {self._settings.config}: the radar refuses {line!r}: {text}")
            if one_port and line.startswith("baudRate "):
                cli.baudrate = int(line.split()[1])
        return said

    def _answered(self, cli: Any, line: str) -> bytes:
        """What the radar says to `line`; raises TimeoutError (an OSError) when it does not end in time."""
        cli.reset_input_buffer()
        cli.write(line.encode("ascii", "replace") + b"\n")
        said, until = b"", time.monotonic() + ANSWER_TIME
        while (left := until - time.monotonic()) > 0:
            said += _read(cli, left)
            if any(end in said for end in ti_mmwave.ENDS):
                return said
            if line == "sensorStart" and ti_mmwave.MAGIC in said:  # one port: points instead of an answer
                return said + ti_mmwave.ENDS[0]
        raise TimeoutError(None, f"no answer to {line!r} within {ANSWER_TIME:g} s")

    def _streamed(self, data: Any, received: bytes) -> Brought:
        """Yield the points in what was `received` before, and in all that comes."""
        silence = max(SILENCE, SILENT_FRAMES * self._chirps.period)
        heard = time.monotonic()
        while True:
            now = time.time_ns()
            packets = list(self._packets.feed(received))
            if packets:
                heard = time.monotonic()
            elif time.monotonic() - heard > silence:
                raise TimeoutError(None, f"no frame for {silence:g} s")
            elif not received:
                yield Quiet(NOTHING_NEW)
            for packet in packets:
                message = self._message(packet, now)
                if message.stamp > self._last_stamp:
                    self._last_stamp, self._said = message.stamp, ""
                    yield "points", message
            self._say_losses()
            received = _read(data, SAYING)

    def _message(self, packet: Packet, arrival: int) -> RadarPoints:
        """The points of a packet that came at `arrival` (ns): by its number under the earliest arrivals."""
        self._frames += 1
        transfer = round(1e9 * packet.size * BITS_PER_BYTE / self._settings.data_baud)
        return points_of(packet, self._fit.update(packet.frame, arrival - transfer), self._chirps)

    def _new_fit(self) -> ClockFit:
        return ClockFit(ClockFitSettings(tick=1e9 * self._chirps.period, wraps_at=FRAME_SPAN), period=1.0)

    # --- what is said to people ---------------------------------------------------------------------------------

    def _set_back(self, error: Exception, give_up: float) -> None:
        """Take note that there is no radar; raises DataflowError when there never was one."""
        settings = self._settings
        where = settings.cli if settings.data is None else f"{settings.cli} and {settings.data}"
        reason = getattr(error, "strerror", None) or str(error)
        if not self._last_stamp and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: TI mmWave radar on {where}: no frame within {settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        if reason != self._said:
            log.warning("%s: TI mmWave radar on %s: %s; tries again", self._node, where, reason)
            self._said = reason

    def _say_losses(self, *, at_once: bool = False) -> None:
        now, losses = time.monotonic(), (self._missed_before + self._fit.missed, self._packets.refused)
        if losses == self._losses_told or (not at_once and now < self._next_loss_line):
            return
        self._next_loss_line, self._losses_told = now + LOSS_PERIOD, losses
        log.warning("%s: %d frames came, %d are missing, %d packets damaged", self._node, self._frames, *losses)


def points_of(packet: Packet, stamp: int, chirps: Chirps) -> RadarPoints:
    """A packet as a message."""
    doppler = packet.doppler * np.float32(chirps.doppler_step) if packet.in_bins else packet.doppler
    return RadarPoints(
        stamp=stamp,
        position=packet.position,
        doppler=doppler,
        snr=packet.snr,
        noise=packet.noise,
        frame_time=chirps.frame_time,
        doppler_step=chirps.doppler_step,
        doppler_limit=chirps.doppler_limit,
    )


def _configuration(node: str, path: Path) -> tuple[list[str], Chirps]:
    try:
        lines = ti_mmwave.lines_of(path.read_text(encoding="utf-8", errors="replace"))
        return lines, ti_mmwave.chirps_of(lines)
    except OSError as error:
        raise DataflowError(f"{node}: config {path}: {error.strerror or error}") from error
    except ProtocolError as error:
        raise DataflowError(f"{node}: config {path}: {error}") from error


def _opened(port: str, baud: int) -> Any:
    try:
        import serial
    except ImportError as error:
        raise DataflowError(not_installed("pyserial", "devices")) from error
    return serial.Serial(port, baud, exclusive=True, write_timeout=ANSWER_TIME)


def _read(port: Any, timeout: float) -> bytes:
    port.timeout = max(timeout, 0.0)
    return bytes(port.read(max(port.in_waiting, 1)))


if __name__ == "__main__":
    run(TiMmwave)
