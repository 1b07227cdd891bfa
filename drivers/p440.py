"""The Time Domain PulsON 440 as a monostatic radar (MRM), on Ethernet or a serial link.

out  frame : RadarFrame   one scan each, up to 100 Hz
"""

import logging
import math
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeVar

from annotated_types import Ge, Le

from caneflow.algorithms.clocks.clock_fit import ClockFit
from caneflow.algorithms.quantities import Time
from caneflow.algorithms.radar.received_carrier import CarrierMeter
from caneflow.errors import not_installed
from caneflow.messages import RadarFrame, bounds
from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import RadarConfig, ScanInfo
from caneflow.protocols.mrm_scans import Scan, ScanAssembler, ScanKey
from caneflow.protocols.mrm_serial import SerialDeframer, framed
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

RECEIVE_BUFFER = 4 << 20  # bytes, as far as the system allows: 14 s of 480 samples at 100 Hz
LARGEST_DATAGRAM = 65_535
BAUD_RATE = 115_200  # of the UART; USB takes any

ANSWER_TIME = 0.25  # s that the radar has to answer
TRIES = 4  # of a request to a radar that is there: datagrams get lost
SAYING_PERIOD = 0.5  # s after which the driver says that nothing comes: only then can its process end it
NOTHING_NEW = 0  # ns, before every scan: one that is on its way may be stamped at any time
RETRY_PERIOD = 0.25  # s between two attempts at a radar that is not there
STOP_TRIES = 3
STILL_TIME = 0.06  # s without a scan after which a radar that was told to stop has stopped
MOST_ARRIVALS = 100  # scans under way
MOST_EARLY = 1000  # packets that may come while an answer is waited for

PATIENCE_MS = 25  # of the radar's clock, for what others have overtaken ...
PATIENCE_PERIODS = 4.0  # ... but as long that three scans may overtake one
BIN_PS = 2  # ps, the finest step of delay, rounded up: how far the radar may move the window's start
QUANTUM_PS = 5860  # ps, 96 bins of 61.035 ps, rounded up: how far the radar may move its end
LATEST_START = 500_000  # ps, to either side: a radar can be told to begin at 499 998 at most (MRM_SET_CONFIG_REQUEST)
RAW = 1  # scan type: neither filtered nor detected
LOSS_PERIOD = 30.0  # s between two lines about losses
FIRST_LOSS_LINE = 2.0  # s after the start, when it is known how often the radar scans
CLOCK_SET = 1_000_000  # ns by which the host's clock must differ from what it was to have been set
NOMINAL_CARRIER = 4.3e9  # Hz, the middle of what a P440 transmits, 3.1 to 4.8 GHz at -10 dB
TICKS_PER_SECOND = 1e3  # of the radar's clock

Picoseconds = Annotated[int, Ge(-499_998), Le(499_998)]
A = TypeVar("A", bound=mrm.Message)
ANTENNAS = {"a": 0, "b": 1, "a_to_b": 2, "b_to_a": 3}


@dataclass(frozen=True, kw_only=True)
class P440Settings:
    """Where the radar is and how it scans; by default 480 bins, which fit into 10 ms at integration index 11."""

    __pydantic_config__ = {"extra": "forbid"}

    link: Literal["udp", "usb", "uart"] = "udp"  # Ethernet, or a serial port; the UART is too slow for 100 Hz
    host: str = "192.168.1.100"  # of a radar on Ethernet
    port: Annotated[int, Ge(1), Le(65535)] = mrm.UDP_PORT
    device: str = "/dev/ttyACM0"  # serial port of a radar on USB or UART
    scan_start_ps: Picoseconds = 10_000  # ps after the pulse, antenna path included
    scan_stop_ps: Picoseconds = 39_297  # ps; the radar rounds the window up to a multiple of 96 bins of 61.035 ps
    scan_period_us: Annotated[int, Ge(0), Le(60_000_000)] = 10_000  # us between scans; 0: back to back
    integration_index: Annotated[int, Ge(6), Le(15)] = 11  # 2^index pulses are summed in a bin
    code_channel: Annotated[int, Ge(0), Le(10)] = 6
    transmit_gain: Annotated[int, Ge(0), Le(63)] = 63  # 0..63; the regulator may ask for less
    antennas: Literal["a", "b", "a_to_b", "b_to_a"] = "a_to_b"  # transmits by the first, receives by the last
    antenna_delay_ps: Annotated[int, Ge(0), Le(100_000)] = 10_000  # ps of path in the antennas, both ways
    # Hz, effective centre of the received band; default: 4.3 GHz until it has been measured on echoes that move
    carrier: Annotated[float, Ge(bounds.CARRIER[0]), Le(bounds.CARRIER[1])] | None = None
    bandwidth: Annotated[float, Ge(bounds.BANDWIDTH[0]), Le(bounds.BANDWIDTH[1])] = 1.7e9  # Hz, at -10 dB
    silence_s: Time = 0.5  # s without a packet after which the radar is started again

    def __post_init__(self) -> None:
        if self.scan_stop_ps <= self.scan_start_ps:
            raise ValueError(
                f"scan_stop_ps is {self.scan_stop_ps}; the scan stops after it starts, at {self.scan_start_ps} ps"
            )
        if self.silence_s * 1e6 < 2 * self.scan_period_us:
            raise ValueError(
                f"silence_s is {self.silence_s}; a radar that scans every {self.scan_period_us} us is silent as long"
            )

    @property
    def address(self) -> str:
        """Where the radar is, for people."""
        return f"{self.host}, UDP port {self.port}" if self.link == "udp" else self.device

    @property
    def nominal_period(self) -> float | None:
        """Ticks of the radar's clock between scans; None: as fast as it can."""
        return self.scan_period_us * 1e-6 * TICKS_PER_SECOND or None

    def over(self, config: RadarConfig) -> RadarConfig:
        """`config` with what is set here; the rest, such as the node's number, stays the radar's own."""
        return replace(
            config,
            node_id=min(max(config.node_id, 1), 2**32 - 2),
            scan_start_ps=self.scan_start_ps,
            scan_stop_ps=self.scan_stop_ps,
            scan_resolution_bins=32,
            base_integration_index=self.integration_index,
            segment_sample_counts=(0, 0, 0, 0),
            segment_integrations=(0, 0, 0, 0),
            antenna_mode=ANTENNAS[self.antennas],
            transmit_gain=self.transmit_gain,
            code_channel=self.code_channel,
            persist=0,  # flash wears
        )


class Clock:
    """The host's clock: one that only goes on, for intervals, and its place in the Unix epoch, for stamps."""

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()

    def now(self) -> int:
        """Time (ns) that nobody sets."""
        return time.monotonic_ns()

    def epoch(self, instant: int) -> int:
        """`instant` (ns, of `now`) as ns of the Unix epoch."""
        offset = time.time_ns() - time.monotonic_ns()
        if abs(offset - self._offset) > CLOCK_SET:
            self._offset = offset
        return instant + self._offset

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class Link(ABC):
    """A way to the radar that carries whole messages; every method raises OSError when it is broken."""

    @abstractmethod
    def send(self, message: bytes) -> None:
        """Send a message."""

    @abstractmethod
    def receive(self, timeout: float) -> bytes | None:
        """The next message; None when none comes within `timeout` s."""

    @abstractmethod
    def close(self) -> None:
        """Give the way up."""


class UdpLink(Link):
    """One message per datagram; those of other senders are not heard."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (socket.gethostbyname(host), port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)

    def send(self, message: bytes) -> None:
        """Send a datagram."""
        self._socket.sendto(message, self._address)

    def receive(self, timeout: float) -> bytes | None:
        """The radar's next datagram."""
        deadline = time.monotonic() + timeout
        while True:
            # At least a moment: with none the socket would not wait for what is there either.
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                message, sender = self._socket.recvfrom(LARGEST_DATAGRAM)
            except TimeoutError:
                return None
            if sender == self._address:
                return message

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialLink(Link):
    """A5 A5 framing on a serial port, with checksums over a UART."""

    def __init__(self, device: str, *, crc: bool) -> None:
        try:
            import serial
        except ImportError as error:
            raise DataflowError(not_installed("pyserial", "devices")) from error
        self._port = serial.Serial(device, BAUD_RATE, exclusive=True)
        self._crc = crc
        self._deframer = SerialDeframer(crc=crc)
        self._messages: deque[bytes] = deque()

    def send(self, message: bytes) -> None:
        """Send a frame."""
        self._port.write(framed(message, crc=self._crc))

    def receive(self, timeout: float) -> bytes | None:
        """The next frame's message."""
        deadline = time.monotonic() + timeout
        while not self._messages:
            self._port.timeout = max(deadline - time.monotonic(), 0.0)
            data = self._port.read(max(self._port.in_waiting, 1))
            if not data:
                return None
            self._messages += self._deframer.feed(data)
        return self._messages.popleft()

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class Silent(Exception):
    """The radar does not answer, or no longer scans; says why."""


class Radar:
    """A radar at the other end of a link: it is asked, and what it says unasked is kept meanwhile."""

    def __init__(self, link: Link, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._number = 0  # of the last request
        self._early: deque[tuple[ScanInfo, int]] = deque(maxlen=MOST_EARLY)  # with their arrival
        self.unknown = 0  # messages that were none, or of no known type

    def ask(self, request: mrm.Message, answer: type[A], *, tries: int = TRIES) -> A:
        """The radar's answer to `request`, whose number is set here; raises Silent when there is none."""
        for _ in range(tries):
            self._send(request)
            deadline = self._clock.now() + round(ANSWER_TIME * 1e9)
            while (left := deadline - self._clock.now()) > 0:
                message = self._hear(left / 1e9)
                if isinstance(message, answer) and message.message_id == self._number:
                    return message
                if isinstance(message, ScanInfo):
                    self._early.append((message, self._clock.now()))
        raise Silent(f"no answer within {tries * ANSWER_TIME:g} s")

    def start(self, period_us: int) -> int:
        """Let it scan forever; its status. That it scans is an answer as well, when the other one gets lost."""
        self._early.clear()
        request = mrm.ControlRequest(message_id=0, scan_count=mrm.SCAN_COUNT_FOREVER, scan_interval_us=period_us)
        for _ in range(TRIES):
            with suppress(Silent):
                return self.ask(request, mrm.ControlConfirm, tries=1).status
            if self._early:
                return mrm.STATUS_OK
        raise Silent("does not start")

    def stop(self) -> bool:
        """Stop it, and drop what was still under way; whether no more scans come. A stop need not be confirmed."""
        for _ in range(STOP_TRIES):
            self._send(mrm.ControlRequest(message_id=0, scan_count=mrm.SCAN_COUNT_STOP))
            if self._falls_still():
                return True
        return False

    def next_packet(self, timeout: float) -> tuple[ScanInfo, int] | None:
        """The next packet of a scan and its arrival (ns of the steady clock); None when none comes in time.

        Raises Silent when the radar has booted.
        """
        if self._early:
            return self._early.popleft()
        message = self._hear(timeout)
        if isinstance(message, mrm.ReadyInfo):
            raise Silent("has been started again")
        return (message, self._clock.now()) if isinstance(message, ScanInfo) else None

    def _falls_still(self) -> bool:
        """Whether no scan comes for a moment after the confirm or, without one, for as long as an answer may take."""
        now = self._clock.now()
        patience, until, limit = ANSWER_TIME, now + round(ANSWER_TIME * 1e9), now + round(2 * ANSWER_TIME * 1e9)
        while now < min(until, limit):
            message = self._hear((until - now) / 1e9)
            now = self._clock.now()
            if isinstance(message, mrm.ControlConfirm) and message.message_id == self._number:
                patience = STILL_TIME
            elif not isinstance(message, ScanInfo):
                continue
            until = now + round(patience * 1e9)
        return now < limit

    def _send(self, request: mrm.Message) -> None:
        self._number = self._number % 0xFFFF + 1
        self._link.send(mrm.build(replace(request, message_id=self._number)))

    def _hear(self, timeout: float) -> mrm.Message | None:
        message = self._link.receive(timeout)
        if message is None:
            return None
        try:
            return mrm.parse(message)
        except ProtocolError:
            self.unknown += 1
            return None


class Framing:
    """Makes frames of scans: stamped on the host's clock, with the period that the radar truly keeps."""

    def __init__(self, settings: P440Settings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self._fit = ClockFit(period=settings.nominal_period)
        self._carrier = settings.carrier or NOMINAL_CARRIER
        self._meter = None if settings.carrier else CarrierMeter()
        self._held: list[tuple[int, Scan]] = []  # with stamps, as long as the period is not known
        self.scans = 0  # that came whole
        self.unfit = 0  # of them: no raw scan, nothing in it, or from where no radar scans

    @property
    def lost(self) -> int:
        """Scans that the radar made and that did not come whole."""
        return self._fit.missed

    @property
    def period(self) -> float | None:
        """Seconds between scans; None until it is known."""
        return None if self._fit.period is None else self._fit.period / TICKS_PER_SECOND

    def restart(self) -> None:
        """Forget the radar's clock: it was started again."""
        self._held.clear()
        self._fit.restart()

    def frames(self, scan: Scan, arrival: int) -> Iterator[RadarFrame]:
        """Yield what `scan`, complete at `arrival` (ns of the host's steady clock), allows to tell."""
        self.scans += 1
        there = abs(scan.scan_start_ps) <= LATEST_START
        if scan.scan_type != RAW or not len(scan.samples) or not scan.scan_step_bins or not there:
            self.unfit += 1
            return
        stamp = self._clock.epoch(self._fit.update(scan.timestamp_ms, arrival))
        self._held.append((stamp, scan))
        period = self.period
        if period is None:
            return
        held, self._held = self._held, []
        for stamp, one in held:
            self._measure(stamp, one)
            yield self._frame(stamp, one, period)

    def _measure(self, stamp: int, scan: Scan) -> None:
        """Take the carrier from the scans until it is settled; a setting overrides."""
        found = self._meter.update(1e-9 * stamp, scan.samples, scan.range_step) if self._meter else None
        if found is None:
            return
        self._carrier = found.carrier
        giga = [value / 1e9 for value in (found.carrier, found.error, found.spread)]
        if found.by_centroid:
            log.info("carrier %.3f +- %.3f GHz, the centroid of what moves; its phase has not settled yet", *giga[:2])
            return
        self._meter = None
        log.info("carrier %.3f +- %.3f GHz, measured on %d echoes (sd %.3f)", *giga[:2], found.echoes, giga[2])

    def _frame(self, stamp: int, scan: Scan, period: float) -> RadarFrame:
        return RadarFrame(
            stamp=stamp,
            scans=scan.samples[None, :],
            scan_period=period,
            range_start=scan.range_start(self._settings.antenna_delay_ps),
            range_step=scan.range_step,
            carrier=self._carrier,
            bandwidth=self._settings.bandwidth,
        )


class P440(Source):
    """Asks the radar for scans without end, puts their packets together, and stops it on every way out."""

    outputs = {"frame": RadarFrame}
    Settings = P440Settings

    def __init__(self, settings: P440Settings, context: Context) -> None:
        self._settings = settings
        self._node = context.node
        self._clock = self.make_clock()
        self._framing = Framing(settings, self._clock)
        self._told = ""  # why there are no frames; "": there are
        self._described = ""  # the radar, as it was described last
        self._assembler = ScanAssembler()  # of this session
        self._arrivals: dict[ScanKey, int] = {}  # ns, of scans that are not whole yet, or held back
        self._incomplete_before = 0  # scans of which a part came, in the sessions before
        self._lost_told = 0
        self._next_loss_line = 0  # ns

    def make_clock(self) -> Clock:
        """The host's clock."""
        return Clock()

    def open_link(self) -> Link:
        """The way to the radar; raises OSError when there is none."""
        if self._settings.link == "udp":
            return UdpLink(self._settings.host, self._settings.port)
        return SerialLink(self._settings.device, crc=self._settings.link == "uart")

    def samples(self) -> Brought:
        """Yield a frame for each scan; a radar that is not there, or falls silent, is asked until it answers."""
        try:
            while True:
                try:
                    with closing(self.open_link()) as link:
                        yield from self._session(Radar(link, self._clock))
                except Silent as reason:
                    self._say_silent(str(reason))
                except OSError as error:
                    self._say_silent(error.strerror or str(error))
                    self._clock.sleep(RETRY_PERIOD)
                # Frames of the next session are stamped after its start.
                yield Quiet(self._clock.epoch(self._clock.now()))
        finally:
            self._say_losses(at_once=True)

    def _session(self, radar: Radar) -> Brought:
        """Set the radar up and yield its frames until it falls silent; leaves it stopped, whatever happens."""
        status = radar.ask(mrm.GetStatusRequest(message_id=0), mrm.GetStatusConfirm, tries=1)
        try:
            if not radar.stop():
                raise Silent("does not stop what it was doing")
            config = self._configure(radar)
            self._describe(status, config)
            self._require(radar.start(self._settings.scan_period_us), "to scan")
            yield from self._frames(radar)
        finally:
            _leave_stopped(radar)

    def _configure(self, radar: Radar) -> RadarConfig:
        """Set the radar, wake it first if need be; what it made of the settings."""
        for _ in range(3):
            status = self._try_settings(radar)
            if status == mrm.STATUS_ASLEEP:
                radar.ask(mrm.SetSleepModeRequest(message_id=0, mode=mrm.SLEEP_ACTIVE), mrm.SetSleepModeConfirm)
            elif status == mrm.STATUS_WRONG_MODE:
                radar.ask(mrm.SetOperationModeRequest(message_id=0, mode=mrm.MODE_MRM), mrm.SetOperationModeConfirm)
            else:
                break
        self._require(status, "its settings")
        return radar.ask(mrm.GetConfigRequest(message_id=0), mrm.GetConfigConfirm).config

    def _try_settings(self, radar: Radar) -> int:
        there = radar.ask(mrm.GetConfigRequest(message_id=0), mrm.GetConfigConfirm)
        wanted = self._settings.over(there.config)
        return radar.ask(mrm.SetConfigRequest(message_id=0, config=wanted), mrm.SetConfigConfirm).status

    def _frames(self, radar: Radar) -> Brought:
        settings = self._settings
        patience = max(PATIENCE_MS, math.ceil(PATIENCE_PERIODS * settings.scan_period_us / 1e3))
        self._incomplete_before += self._assembler.counts.incomplete_scans
        self._arrivals.clear()
        period_ms = settings.nominal_period or math.inf
        self._assembler = assembler = ScanAssembler(patience_ms=patience, period_ms=period_ms)
        self._framing.restart()
        heard = self._clock.now()
        self._next_loss_line = max(self._next_loss_line, heard + round(FIRST_LOSS_LINE * 1e9))
        try:
            while True:
                left = settings.silence_s - (self._clock.now() - heard) / 1e9
                found = radar.next_packet(min(left, SAYING_PERIOD))
                if found is not None:
                    packet, heard = found
                    self._note_arrival(packet, heard)
                    for scan in assembler.feed(packet):
                        yield from self._told_frames(scan)
                elif (self._clock.now() - heard) / 1e9 >= settings.silence_s:
                    raise Silent(f"has sent no scan for {settings.silence_s:g} s")
                else:
                    yield Quiet(NOTHING_NEW)
        except (Silent, OSError):
            for scan in assembler.finish():
                yield from self._told_frames(scan)
            raise

    def _note_arrival(self, packet: ScanInfo, now: int) -> None:
        """Keep when a scan's last packet came: it may be held back for the sake of an older scan."""
        self._arrivals[packet.timestamp_ms, packet.message_id] = now
        if len(self._arrivals) > MOST_ARRIVALS:  # of scans that never became whole
            del self._arrivals[next(iter(self._arrivals))]

    def _told_frames(self, scan: Scan) -> Brought:
        arrival = self._arrivals.pop((scan.timestamp_ms, scan.message_id), None) or self._clock.now()
        before = self._framing.period
        for frame in self._framing.frames(scan, arrival):
            yield "frame", frame
            self._told = ""
        if self._framing.period != before:
            self._say_period()
        if self._framing.lost > self._lost_told:
            self._say_losses()

    def _require(self, status: int, what: str) -> None:
        if status != mrm.STATUS_OK:
            raise DataflowError(
                f"{self._node}: the radar at {self._settings.address} refuses {what}: {mrm.status_name(status)}"
            )

    # --- what is said to people ---------------------------------------------------------------------------------

    def _describe(self, status: mrm.GetStatusConfirm, taken: RadarConfig) -> None:
        """Say which radar it is and how it is set by its own word, when that is new or it was away."""
        wanted = self._settings.over(taken)
        text = (
            f"P440 {status.serial_number:x} ({status.package or 'old firmware'}): scans {taken.scan_start_ps} to "
            f"{taken.scan_stop_ps} ps, integration index {taken.base_integration_index}, code channel "
            f"{taken.code_channel}, gain {taken.transmit_gain}, antenna mode {taken.antenna_mode}"
        )
        if text == self._described and not self._told:
            return
        self._described = text
        log.info("%s: %s, %g degC", self._node, text, status.temperature)
        if status.self_test:
            log.warning("%s: the radar's self test failed: 0x%02x", self._node, status.self_test)
        wrong = [
            f"{name} {getattr(taken, name)} instead of {getattr(wanted, name)}"
            for name in ("base_integration_index", "antenna_mode", "transmit_gain", "code_channel")
            if getattr(taken, name) != getattr(wanted, name)
        ]
        if abs(taken.scan_start_ps - wanted.scan_start_ps) > BIN_PS or not (
            -BIN_PS <= taken.scan_stop_ps - wanted.scan_stop_ps <= QUANTUM_PS + BIN_PS
        ):
            wrong.append(
                f"a window of {taken.scan_start_ps} to {taken.scan_stop_ps} ps "
                f"instead of {wanted.scan_start_ps} to {wanted.scan_stop_ps} ps"
            )
        if wrong:
            log.warning("%s: the radar took %s", self._node, ", ".join(wrong))

    def _say_silent(self, reason: str) -> None:
        if reason != self._told:
            log.warning("%s: radar at %s: %s; asking on", self._node, self._settings.address, reason)
        self._told = reason

    def _say_period(self) -> None:
        period, wanted = self._framing.period, self._settings.nominal_period
        if period is None:
            return
        if wanted is None:
            log.info("%s: scans every %.3f ms", self._node, 1e3 * period)
        else:
            asked = 1e3 * wanted / TICKS_PER_SECOND
            log.warning("%s: scans every %.3f ms, asked for every %g ms", self._node, 1e3 * period, asked)

    def _say_losses(self, *, at_once: bool = False) -> None:
        """Say how many scans were lost, now and then; at the end in any case."""
        now, framing = self._clock.now(), self._framing
        if not at_once and now < self._next_loss_line:
            return
        self._next_loss_line = now + round(LOSS_PERIOD * 1e9)
        self._lost_told = framing.lost
        made = framing.scans + framing.lost
        incomplete = self._incomplete_before + self._assembler.counts.incomplete_scans
        if framing.lost or framing.unfit:
            log.warning(
                "%s: %d of %d scans lost, %d of these came in part; %d of no use",
                *(self._node, framing.lost, made, incomplete, framing.unfit),
            )


def _leave_stopped(radar: Radar) -> None:
    """Stop the radar, if it can be reached; also when the flow is ended while this is under way."""
    tried = False
    try:
        with suppress(OSError):
            radar.stop()
        tried = True
    finally:
        if not tried:
            with suppress(OSError):
                radar.stop()


if __name__ == "__main__":
    run(P440)
