"""An emulated P440: requests in, confirms and scans out; time is an argument, faults come from a seeded generator.

It plays what was recorded, so its window is the recording's whatever it is told, as a radar's is rounded to what it
can do; the answer to GET_CONFIG says so. The world goes on while the radar does not look: scans whose time passes
while it is stopped are never sent.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import RadarConfig, ScanInfo
from caneflow.protocols.mrm_scans import CLOCK_SPAN, LOG_HEAD_BYTES, milliseconds_after

RESOLUTION = 32  # bins per sample: the only one there is
MOST_OVERTAKING = 3  # packets that may overtake a reordered one
LONGEST_HELD = 0.02  # s that a reordered packet is held when nothing overtakes it
LONGEST_REORDERED_MS = 2000  # a clock that goes back further was started again; how long that took is not in the log
READY_ID = 0

Chance = Annotated[float, Ge(0), Le(1)]
Span: TypeAlias = tuple[float, float]  # s from the beginning of the recording, and s that it lasts


class Moment(NamedTuple):
    """What the radar sends at one instant: a scan in its packets, or a single packet of a log."""

    time: float  # s since the recording began
    packets: tuple[bytes, ...]  # SCAN_INFO messages


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong, and how often; spans of one kind do not overlap."""

    loss: Chance = 0.0  # of each datagram, in either direction
    reorder: Chance = 0.0  # of each scan packet: up to MOST_OVERTAKING others arrive before it
    duplicate: Chance = 0.0  # of each scan packet
    freezes: tuple[Span, ...] = ()  # it answers, but no scans come, unless it is started again
    unplugs: tuple[Span, ...] = ()  # no power; then it has booted, and does not scan


@dataclass(kw_only=True, slots=True)
class EmulatorCounts:
    """What went over the link, and what a fault kept from it."""

    requests: int = 0
    unknown: int = 0  # messages that a radar does not take
    scans: int = 0  # or single packets of a log
    packets: int = 0  # sent, copies included
    lost: int = 0
    reordered: int = 0
    duplicated: int = 0


@dataclass(slots=True)
class _Held:
    """A packet that others overtake."""

    packet: bytes
    overtaking: int  # packets that may still pass
    until: float  # s, host time


@dataclass(slots=True)
class _State:
    """What a radar forgets when its power fails."""

    config: RadarConfig
    booted_at: float = 0.0  # s of the recording
    scanning: bool = False
    frozen: bool = False
    mode: int = mrm.MODE_MRM
    sleep: int = mrm.SLEEP_ACTIVE
    held: list[_Held] = field(default_factory=list)


class RadarEmulator:
    """One radar with one client, to whom all answers and scans go. Times `now` are s of any clock that goes on."""

    def __init__(
        self,
        moments: Iterator[Moment],
        *,
        config: RadarConfig,
        random: np.random.Generator,
        faults: Faults | None = None,
        begin: float | None = None,
        confirms_stop: bool = True,
        mode: int = mrm.MODE_MRM,
        sleep: int = mrm.SLEEP_ACTIVE,
    ) -> None:
        """`config`: what the recording was made with. `begin`: when the recording begins; None: with the first start.

        confirms_stop: False for a radar that keeps silent when told to stop.  mode, sleep: what it wakes up in.
        """
        self.counts = EmulatorCounts()
        self._moments = moments
        self._next: Moment | None = next(moments, None)
        self._factory = config
        self._state = _State(config, mode=mode, sleep=sleep)
        self._random = random
        self._faults = faults or Faults()
        self._begin = begin
        self._confirms_stop = confirms_stop
        self._freezes = deque(sorted(self._faults.freezes))  # that are not over
        self._unplugs = deque(sorted(self._faults.unplugs))
        self._freezing: float | None = None  # s, the beginning of the freeze that was last suffered

    @property
    def scanning(self) -> bool:
        """Whether it sends scans."""
        return self._state.scanning and not self._state.frozen

    @property
    def over(self) -> bool:
        """Whether the recording has been played to its end."""
        return self._next is None and not self._state.held

    def receive(self, message: bytes, now: float) -> list[bytes]:
        """The answers to a datagram that came at `now`."""
        if self._is_unplugged(now):
            return []
        self.counts.requests += 1
        if self._hits(self._faults.loss):
            self.counts.lost += 1
            return []
        try:
            request = mrm.parse(message)
        except ProtocolError:
            self.counts.unknown += 1
            return []
        answer = self._answer(request, now)
        return self._through_the_link([mrm.build(answer)]) if answer else []

    def send_due(self, now: float) -> list[bytes]:
        """What it sends unasked until `now`, in the order of sending."""
        out = self._suffered(now)
        while self.scanning and self._next is not None and self._next.time <= self._time(now):
            self.counts.scans += 1
            out += self._scan_packets(self._next.packets, now)
            self._next = next(self._moments, None)
        self._pass_unseen(now)
        return out + self._overdue(now)

    def next_due(self, now: float) -> float | None:
        """When `send_due` has something to do next; None: not before it is asked something."""
        due = [held.until for held in self._state.held]
        if self._begin is not None:
            if self._next is not None:
                due.append(self._begin + self._next.time)
            due += [self._begin + at + lasts for at, lasts in self._unplugs]
        return min(due, default=None)

    def _time(self, now: float) -> float:
        """Seconds since the recording began; before it has begun, -inf."""
        return -math.inf if self._begin is None else now - self._begin

    def _is_unplugged(self, now: float) -> bool:
        return any(at <= self._time(now) < at + lasts for at, lasts in self._unplugs)

    def _suffered(self, now: float) -> list[bytes]:
        """Take the faults whose time has come; what is sent on account of them."""
        time = self._time(now)
        self._freeze(time)
        if self._is_unplugged(now):
            self._state = _State(self._factory)
        if self._unplugs and time >= sum(self._unplugs[0]):
            self._unplugs.popleft()
            self._state = _State(self._factory, booted_at=time)
            return self._through_the_link([mrm.build(mrm.ReadyInfo(message_id=READY_ID))])
        return []

    def _freeze(self, time: float) -> None:
        while self._freezes and time >= self._freezes[0][0]:
            at, lasts = self._freezes[0]
            if time < at + lasts:
                self._state.frozen = self._state.frozen or self._freezing != at
                self._freezing = at
                return
            self._freezes.popleft()
            self._state.frozen = False

    def _pass_unseen(self, now: float) -> None:
        """Let the world go on up to `now`: what the radar does not see is not sent later."""
        while self._next is not None and self._next.time < self._time(now) and not self.scanning:
            self._next = next(self._moments, None)

    # --- requests -----------------------------------------------------------------------------------------------

    def _answer(self, request: mrm.Message, now: float) -> mrm.Message | None:
        number = request.message_id
        match request:
            case mrm.GetStatusRequest():
                return mrm.GetStatusConfirm(message_id=number, serial_number=0xE440, package="caneflow emulator")
            case mrm.SetSleepModeRequest(mode=mode):
                self._state.sleep = mode
                return mrm.SetSleepModeConfirm(message_id=number)
            case mrm.SetOperationModeRequest(mode=mode):
                self._state.mode = mode
                return mrm.SetOperationModeConfirm(message_id=number, mode=mode)
            case mrm.SetConfigRequest(config=config):
                return mrm.SetConfigConfirm(message_id=number, status=self._set(config))
            case mrm.GetConfigRequest():
                clock = math.floor(1e3 * max(self._time(now) - self._state.booted_at, 0.0)) % CLOCK_SPAN
                return mrm.GetConfigConfirm(
                    message_id=number, config=self._state.config, timestamp_ms=clock, status=self._readiness()
                )
            case mrm.ControlRequest(scan_count=count):
                return self._control(number, count, now)
            case _:  # what only a radar says
                self.counts.unknown += 1
                return None

    def _readiness(self) -> int:
        if self._state.sleep != mrm.SLEEP_ACTIVE:
            return mrm.STATUS_ASLEEP
        return mrm.STATUS_OK if self._state.mode == mrm.MODE_MRM else mrm.STATUS_WRONG_MODE

    def _set(self, config: RadarConfig) -> int:
        if status := self._readiness():
            return status
        good = (
            1 <= config.node_id <= 2**32 - 2
            and -499_998 <= config.scan_start_ps < config.scan_stop_ps <= 499_998
            and config.scan_resolution_bins == RESOLUTION
            and 6 <= config.base_integration_index <= 15
            and config.transmit_gain <= 63
            and config.code_channel <= 10
        )
        if not good:
            return mrm.STATUS_UNSUPPORTED
        was = self._factory
        self._state.config = replace(config, scan_start_ps=was.scan_start_ps, scan_stop_ps=was.scan_stop_ps)
        return mrm.STATUS_OK

    def _control(self, number: int, count: int, now: float) -> mrm.Message | None:
        status = self._readiness()
        if status == mrm.STATUS_OK and count:
            self._begin = now if self._begin is None else self._begin
            self._pass_unseen(now)
            self._state.scanning, self._state.frozen = True, False
        elif not count:
            self._state.scanning = False
            self._state.held.clear()
            if not self._confirms_stop:
                return None
        return mrm.ControlConfirm(message_id=number, status=status)

    # --- the link -----------------------------------------------------------------------------------------------

    def _scan_packets(self, packets: tuple[bytes, ...], now: float) -> list[bytes]:
        out: list[bytes] = []
        for packet in packets:
            current = self._clocked(packet)
            if self._hits(self._faults.reorder):
                self.counts.reordered += 1
                overtaking = int(self._random.integers(1, MOST_OVERTAKING + 1))
                self._state.held.append(_Held(current, overtaking, now + LONGEST_HELD))
                continue
            copies = 1 + self._hits(self._faults.duplicate)
            self.counts.duplicated += copies - 1
            out += self._through_the_link([current] * copies)
            out += self._overtaken()
        return out

    def _overtaken(self) -> list[bytes]:
        """Held packets after one more packet has passed them."""
        for held in self._state.held:
            held.overtaking -= 1
        return self._let_go([held for held in self._state.held if held.overtaking <= 0])

    def _overdue(self, now: float) -> list[bytes]:
        return self._let_go([held for held in self._state.held if held.until <= now])

    def _let_go(self, going: list[_Held]) -> list[bytes]:
        self._state.held = [held for held in self._state.held if held not in going]
        return self._through_the_link([held.packet for held in going])

    def _through_the_link(self, packets: list[bytes]) -> list[bytes]:
        through = [packet for packet in packets if not self._hits(self._faults.loss)]
        self.counts.lost += len(packets) - len(through)
        self.counts.packets += len(through)
        return through

    def _hits(self, chance: float) -> bool:
        return chance > 0 and self._random.random() < chance

    def _clocked(self, packet: bytes) -> bytes:
        """`packet` with the time since the last boot; as it was recorded until there is one."""
        if not self._state.booted_at:
            return packet
        recorded = int.from_bytes(packet[8:12])
        return packet[:8] + ((recorded - round(1e3 * self._state.booted_at)) % CLOCK_SPAN).to_bytes(4) + packet[12:]


def moments_of_log(data: bytes) -> tuple[RadarConfig, Iterator[Moment]]:
    """How the radar of a log was set, and the log's packets, byte for byte, at the times which they carry.

    Raises:
        ProtocolError: no configuration block, or something else than SCAN_INFO where one should begin, here or
            while the packets are drawn.
    """
    return RadarConfig.from_bytes(data), _logged(data)


def _logged(data: bytes) -> Iterator[Moment]:
    elapsed_ms, last = 0, None
    for offset in range(LOG_HEAD_BYTES, len(data) - mrm.SCAN_INFO_BYTES + 1, mrm.SCAN_INFO_BYTES):
        payload = data[offset : offset + mrm.SCAN_INFO_BYTES]
        packet = mrm.parse(payload)
        if not isinstance(packet, ScanInfo):
            raise ProtocolError(f"log, byte {offset}: a {type(packet).__name__}, where a log has ScanInfo only")
        step_ms = 0 if last is None else milliseconds_after(packet.timestamp_ms, last)
        elapsed_ms += max(step_ms, 0)
        if last is None or step_ms > 0 or step_ms < -LONGEST_REORDERED_MS:
            last = packet.timestamp_ms
        yield Moment(elapsed_ms / 1e3, (payload,))
