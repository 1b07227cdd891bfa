"""A BNO055 without the chip: speaks its UART protocol, starts, resets and errs like it, and measures a given motion.

Pure: bytes and the time (s) in, bytes out when their time on the wire has come. What is not in the data sheet is
said where it is assumed. The motion is what the chip said when it was recorded, so the axis map, the units and the
profile are registers that can be written and read, and change nothing.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from numpy.random import Generator

from caneflow.protocols import bno055
from caneflow.protocols.bno055 import MODE_BITS, PROFILE_BYTES, Mode, Register
from caneflow.protocols.bno055_link import (
    ACKNOWLEDGE,
    BYTE_TIME,
    DATA,
    LONGEST,
    READ,
    START,
    WRITE,
    Status,
)

FIFO = 8  # bytes that a serial port gathers before it wakes its reader
CLOCK_CHANGE = 0.1  # s to the external crystal: assumed
FUSION_START = 0.05  # s from the end of the mode change to the first values, zeros until then: assumed
REQUEST_PATIENCE = 0.03  # s within which a request must be complete: assumed
LAST_REGISTER = 0x7F

# Chip, accelerometer, magnetometer, gyro; software 3.11, bootloader 0x15 (DS 4.2.1)
IDENTITY = bytes([bno055.CHIP_ID, 0xFB, 0x32, 0x0F, 0x11, 0x03, 0x15])
LEARNT = bno055.CalibrationProfile(
    accel_offset=(-6, 3, 17), mag_offset=(-2, 395, 112), gyro_offset=(0, 1, 0), accel_radius=1000, mag_radius=832
)
WRITABLE_ALWAYS = {Register.PAGE_ID, Register.MODE}
WRITABLE_IN_CONFIG = {Register.UNITS, Register.POWER, Register.TRIGGER, Register.AXIS_MAP, Register.AXIS_SIGN}
PROFILE_REGISTERS = range(Register.PROFILE, Register.PROFILE + PROFILE_BYTES)

# Byte in the WHOLE block, and bytes, of what a glitch may hit: all axes of accelerometer, gyro, quaternion and linear
# acceleration, x and y of the magnetometer (the end of its z register is within its range), and the temperature.
GLITCHED = (*((at, 2) for at in (0, 2, 4, 6, 8, 12, 14, 16, 24, 26, 28, 30, 32, 34, 36)), (44, 1))
NO_VALUES = bytes(bno055.WHOLE.length)

Span = tuple[float, float]  # s from the beginning of the motion, and s that it lasts


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What the chip measures: from `times[i]` s on the WHOLE block `blocks[i]`; both n long, times increasing."""

    times: Sequence[float]
    blocks: Sequence[bytes]

    @property
    def end(self) -> float:
        """When the last values have been there as long as others, s."""
        return self.times[-1] + 1.0 / bno055.RATE

    def index(self, time: float) -> int:
        """Which values are there at `time`, s; -1: none yet."""
        return bisect_right(self.times, time) - 1


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong. Times are s from the beginning of the motion."""

    overruns: float = 0.0  # part of all requests that are answered by EE 07
    loss: float = 0.0  # part of all requests that are never answered
    short: float = 0.0  # part of all answers that end before their last bytes
    freezes: tuple[Span, ...] = ()  # the values stand still, unless there is a reset
    silences: tuple[Span, ...] = ()  # no answer
    resets: tuple[float, ...] = ()  # the chip starts again by itself
    glitches: float = 0.0  # part of all readings in which a value is at the end of its register, or all are the same
    page: int = 0  # of the registers, that another program left chosen


@dataclass
class Tally:
    """What was done."""

    requests: int = 0
    overruns: int = 0
    lost: int = 0
    short: int = 0
    bursts: int = 0  # readings of the measurements
    glitches: int = 0  # of them
    seen: set[int] = field(default_factory=set)  # which of the motion's values were read


class Emulator:
    """One chip, powered on at `now`."""

    def __init__(
        self,
        motion: Motion,
        faults: Faults,
        rng: Generator,
        *,
        now: float,
        begin: float | None = None,
    ) -> None:
        """The motion begins at `begin`, s on the same clock as `now`; None: as soon as the fusion runs."""
        self.begin = begin
        self.tally = Tally()
        self._motion = motion
        self._faults = faults
        self._rng = rng
        self._resets = deque(sorted(faults.resets))
        self._request_until = now  # when a request that has begun must be complete
        self._start(now, bno055.START_UP)
        self._page = self._pages[0][Register.PAGE_ID] = self._pages[1][Register.PAGE_ID] = faults.page

    def power_on(self, now: float) -> None:
        """Begin again after a loss of power; the motion goes on."""
        self._start(now, bno055.START_UP)

    def ended(self, now: float) -> bool:
        """Whether the motion is over."""
        return self.begin is not None and now - self.begin >= self._motion.end

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that came at `now`."""
        self._live(now)
        if self._request and now > self._request_until:
            self._request.clear()
            self._say(bytes([ACKNOWLEDGE, Status.RECEIVE_TIMEOUT]), now)
        if not self._request:
            self._request_until = now + REQUEST_PATIENCE
        self._request += data
        while (request := self._next_request(now)) is not None:
            self._take(request, now + len(request) * BYTE_TIME)

    def send(self, now: float) -> bytes:
        """Everything that has come through the wire by `now`."""
        self._live(now)
        sent = bytearray()
        while self._answers and self._answers[0][0] <= now:
            sent += self._answers.popleft()[1]
        return bytes(sent)

    def next_time(self) -> float | None:
        """When there is more to send, s; None: not before more is received."""
        return self._answers[0][0] if self._answers else None

    # --- the chip's life ----------------------------------------------------------------------------------------

    def _start(self, now: float, takes: float) -> None:
        self._pages = [bytearray(LAST_REGISTER + 1), bytearray(LAST_REGISTER + 1)]
        registers = self._pages[0]
        registers[: len(IDENTITY)] = IDENTITY
        registers[Register.SELF_TEST] = bno055.SELF_TEST_PASSED
        registers[Register.UNITS] = bno055.UNITS_SI
        registers[Register.MODE] = 0x10
        registers[Register.AXIS_MAP] = bno055.Axes().map
        self._page = 0
        self._deaf_until = now + takes  # hears nothing
        self._busy_until = now + takes  # hears, and has no time
        self._clock_free_at = now
        self._fusion_at: float | None = None
        self._has_fused = False
        self._started_at = now
        self._request = bytearray()
        self._answers: deque[tuple[float, bytes]] = deque()
        self._wire_free_at = now

    def _live(self, now: float) -> None:
        """Let the resets happen whose time has come."""
        while self.begin is not None and self._resets and now >= self.begin + self._resets[0]:
            self._start(self.begin + self._resets.popleft(), bno055.RESET)

    def _fusion_runs(self, now: float) -> bool:
        return self._fusion_at is not None and now >= self._fusion_at

    def _mode(self) -> int:
        return self._pages[0][Register.MODE] & MODE_BITS

    # --- requests -----------------------------------------------------------------------------------------------

    def _next_request(self, now: float) -> bytes | None:
        """The next whole request; what begins none is answered at once."""
        while self._request and self._request[0] != START:
            del self._request[0]
            self._say(bytes([ACKNOWLEDGE, Status.WRONG_START_BYTE]), now)
        if len(self._request) < 4:
            return None
        _, kind, _, length = self._request[:4]
        size = 4 + (length if kind == WRITE and length <= LONGEST else 0)
        if len(self._request) < size:
            return None
        request = bytes(self._request[:size])
        del self._request[:size]
        return request

    def _take(self, request: bytes, now: float) -> None:
        if now < self._deaf_until or self._within(self._faults.silences, now) is not None:
            return
        self.tally.requests += 1
        if self._faults.loss and self._rng.random() < self._faults.loss:
            self.tally.lost += 1
            return
        if now < self._busy_until or self._rng.random() < self._faults.overruns:
            self.tally.overruns += 1
            self._say(bytes([ACKNOWLEDGE, Status.BUS_OVERRUN]), now)
            return
        _, kind, register, length = request[:4]
        fault = _fault(kind, register, length)
        if fault is not None:
            self._say(bytes([ACKNOWLEDGE, fault]), now)
        elif kind == READ:
            self._answer(self._read(register, length, now), now)
        else:
            status = self._write(register, request[4:], now)
            if status is not None:
                self._say(bytes([ACKNOWLEDGE, status]), now)

    def _answer(self, data: bytes, now: float) -> None:
        answer = bytes([DATA, len(data)]) + data
        if self._rng.random() < self._faults.short:
            self.tally.short += 1
            answer = answer[: -max(len(data) // 3, 1)]
        self._say(answer, now)

    def _say(self, answer: bytes, now: float) -> None:
        """Put an answer on the wire: its head when the reader's FIFO is full, the rest at its end."""
        begin = max(now, self._wire_free_at)
        self._wire_free_at = begin + len(answer) * BYTE_TIME
        for part, end in ((answer[:FIFO], min(len(answer), FIFO)), (answer[FIFO:], len(answer))):
            if part:
                self._answers.append((begin + end * BYTE_TIME, part))

    # --- registers ----------------------------------------------------------------------------------------------

    def _read(self, register: int, length: int, now: float) -> bytes:
        if self._page == 0:
            self._refresh(register, length, now)
        return bytes(self._pages[self._page][register : register + length])

    def _refresh(self, register: int, length: int, now: float) -> None:
        """Bring the registers up to date that change by themselves."""
        page = self._pages[0]
        runs = self._fusion_runs(now)
        page[Register.CLOCK_STATUS] = now < self._clock_free_at
        page[Register.STATUS] = 5 if runs else 0
        if register <= Register.CALIBRATION and register + length > Register.ACCEL:
            page[Register.ACCEL : Register.SELF_TEST] = self._values(now) if runs else NO_VALUES

    def _values(self, now: float) -> bytes:
        """The measurements of a fusion that runs."""
        if self.begin is None:
            self.begin = self._fusion_at
        assert self.begin is not None
        frozen = self._within(self._faults.freezes, now)
        if frozen is not None and self.begin + frozen < self._started_at:
            frozen = None
        index = self._motion.index(now - self.begin if frozen is None else frozen)
        if index < 0:
            return NO_VALUES
        self.tally.bursts += 1
        self.tally.seen.add(index)
        values = self._motion.blocks[index]
        if self._mode() == Mode.IMU:
            mag = 6  # bytes from the beginning
            values = values[:mag] + bytes(6) + values[mag + 6 :]  # the magnetometer sleeps
        return self._glitched(values) if self._faults.glitches else values

    def _glitched(self, values: bytes) -> bytes:
        """The values, now and then with one of them, or all, as a bus makes them that loses bits."""
        if self._rng.random() >= self._faults.glitches:
            return values
        self.tally.glitches += 1
        at = int(self._rng.integers(len(GLITCHED) + 2))
        if at >= len(GLITCHED):
            return bytes([0x00, 0xFF][at - len(GLITCHED) :][:1]) * len(values)
        offset, size = GLITCHED[at]
        end = b"\x00\x80" if self._rng.random() < 0.5 else b"\xff\x7f"  # little endian
        return values[:offset] + end[-size:] + values[offset + size :]

    def _write(self, register: int, data: bytes, now: float) -> int | None:
        """Take what is written; what to say of it."""
        for address in range(register, register + len(data)):
            if not self._may_write(address):
                return Status.WRITE_DISABLED
        for address, value in enumerate(data, start=register):
            if address == Register.PAGE_ID:
                self._page = value & 1
                self._pages[0][address] = self._pages[1][address] = self._page
            elif self._page == 0 and address == Register.MODE:
                self._change_mode(value & MODE_BITS, now)
            elif self._page == 0 and address == Register.TRIGGER and value & bno055.TRIGGER_RESET:
                self._start(now, bno055.RESET)
                return None
            elif not (address in PROFILE_REGISTERS and self._has_fused):  # Bosch advises against it: assumed
                self._pages[self._page][address] = value
                if self._page == 0 and address == Register.TRIGGER:
                    self._clock_free_at = now + CLOCK_CHANGE
        return Status.WRITTEN

    def _may_write(self, address: int) -> bool:
        if self._page == 1:
            return address == Register.PAGE_ID
        if address in WRITABLE_ALWAYS:
            return True
        return self._mode() == Mode.CONFIG and (address in WRITABLE_IN_CONFIG or address in PROFILE_REGISTERS)

    def _change_mode(self, mode: int, now: float) -> None:
        page = self._pages[0]
        before = self._mode()
        page[Register.MODE] = 0x10 | mode
        if mode == before:
            return
        if mode == Mode.CONFIG:
            self._busy_until = now + bno055.TO_CONFIG
            learnt = slice(Register.PROFILE, Register.PROFILE + PROFILE_BYTES)
            if self._fusion_runs(now) and not any(page[learnt]):
                page[learnt] = LEARNT.to_bytes()
            self._fusion_at = None
        else:
            self._busy_until = now + bno055.FROM_CONFIG
            self._fusion_at = self._busy_until + FUSION_START
            self._has_fused = True

    def _within(self, spans: Sequence[Span], now: float) -> float | None:
        """The beginning of the span in which `now` lies, s of the motion; None: it lies in none."""
        if self.begin is None:
            return None
        time = now - self.begin
        return next((start for start, lasts in spans if start <= time < start + lasts), None)


class Bench:
    """A serial port with an emulated chip behind it, on a clock that goes on only when someone waits.

    A BytePort: 60 s at 100 Hz pass as fast as they are computed, and the same way every time.
    """

    def __init__(self, emulator: Emulator, *, time: float = 0.0, timeout: float = 0.03) -> None:
        self.emulator = emulator
        self.time = time  # s
        self.timeout = timeout  # s, of `read`
        self._come = bytearray()

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        self.time += max(seconds, 0.0)

    def now_ns(self) -> int:
        """The time, ns."""
        return round(self.time * 1e9)

    def write(self, data: bytes, /) -> None:
        """Hand over all of `data`."""
        self.emulator.receive(data, self.time)

    def read(self, size: int = 1, /) -> bytes:
        """Up to `size` bytes; fewer when the timeout has passed."""
        end = self.time + self.timeout
        while True:
            self._come += self.emulator.send(self.time)
            due = self.emulator.next_time()
            if len(self._come) >= size:
                break
            if due is None or due > end:
                self.time = end
                break
            self.time = max(self.time, due)
        data = bytes(self._come[:size])
        del self._come[:size]
        return data

    def reset_input_buffer(self) -> None:
        """Forget what has come and was not read."""
        self.emulator.send(self.time)
        self._come.clear()


def _fault(kind: int, register: int, length: int) -> int | None:
    """What is wrong with a request as such."""
    if kind not in (READ, WRITE):
        return Status.READ_FAILED
    if length == 0:
        return Status.TOO_SHORT
    if length > LONGEST:
        return Status.TOO_LONG
    if register + length - 1 > LAST_REGISTER:
        return Status.INVALID_ADDRESS
    return None
