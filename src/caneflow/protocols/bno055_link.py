"""Transactions with a BNO055: registers read and written over a UART or I2C, again when the chip had no time.

No I/O here: what carries the bytes, how to wait and what time it is are handed in. On the UART the chip answers
`EE 07`, bus overrun, now and then, when its fusion kept it from the bytes; Bosch's advice is to send again.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, Protocol, TypeVar

from caneflow.protocols.errors import ProtocolError

T = TypeVar("T")

BAUD = 115200  # bit/s, the chip's only rate
BYTE_TIME = 10 / BAUD  # s on the wire, 8N1
LONGEST = 128  # bytes of one read or write
START, WRITE, READ = 0xAA, 0x00, 0x01
ACKNOWLEDGE, DATA = 0xEE, 0xBB

TRIES = 4
PAUSE = 0.002  # s before the next try


class Status(IntEnum):
    """What the chip says in the place of data (DS 4.7)."""

    WRITTEN = 0x01
    READ_FAILED = 0x02
    WRITE_FAILED = 0x03
    INVALID_ADDRESS = 0x04
    WRITE_DISABLED = 0x05
    WRONG_START_BYTE = 0x06
    BUS_OVERRUN = 0x07
    TOO_LONG = 0x08
    TOO_SHORT = 0x09
    RECEIVE_TIMEOUT = 0x0A


def read_request(register: int, length: int) -> bytes:
    """What asks for `length` registers from `register` on; raises ProtocolError for what no request can hold."""
    if not (0 <= register <= 0xFF and 1 <= length <= LONGEST):
        raise ProtocolError(f"{length} bytes at 0x{register:02X}; a read is of 1..{LONGEST} at 0x00..0xFF")
    return bytes((START, READ, register, length))


def write_request(register: int, data: bytes) -> bytes:
    """What writes `data` to the registers from `register` on; raises ProtocolError as `read_request` does."""
    if not (0 <= register <= 0xFF and 1 <= len(data) <= LONGEST):
        raise ProtocolError(f"{len(data)} bytes to 0x{register:02X}; a write is of 1..{LONGEST} at 0x00..0xFF")
    return bytes((START, WRITE, register, len(data))) + data


class Faults(NamedTuple):
    """How many tries failed, by what the chip did."""

    overruns: int = 0  # EE 07
    refused: int = 0  # another EE
    short: int = 0  # an answer that ended too early
    silent: int = 0  # no answer
    garbled: int = 0  # bytes that begin no answer, or that of another request
    failed: int = 0  # the port itself reported an error (I2C: no acknowledge)

    def plus(self, other: "Faults") -> "Faults":
        """Both counted together."""
        return Faults(*(mine + its for mine, its in zip(self, other, strict=True)))

    def __str__(self) -> str:
        return ", ".join(f"{n} {name}" for name, n in self._asdict().items() if n) or "no faults"


class Received(NamedTuple):
    """What a read gave."""

    data: bytes
    stamp: int  # ns, on the clock that was handed in: when the chip had the request, and took its values


class BytePort(Protocol):
    """A serial port as pyserial has it, with a timeout on reading."""

    def read(self, size: int = 1, /) -> bytes:
        """Up to `size` bytes; fewer when the timeout has passed."""
        ...

    def write(self, data: bytes, /) -> int | None:
        """Hand over all of `data`."""
        ...

    def reset_input_buffer(self) -> None:
        """Forget what has come and was not read."""
        ...


class _FailedError(ProtocolError):
    """One try failed: what it counts as, and whether the same request may yet be answered."""

    def __init__(self, kind: str, text: str, *, worth_a_try: bool = True) -> None:
        super().__init__(text)
        self.kind = kind
        self.worth_a_try = worth_a_try


class Link(ABC):
    """The way to one chip."""

    def __init__(self, pause: Callable[[float], None], now_ns: Callable[[], int]) -> None:
        self.faults = Faults()
        self._pause = pause
        self._now_ns = now_ns

    def read(self, register: int, length: int) -> Received:
        """`length` registers from `register` on; raises ProtocolError when no try succeeded."""
        return self._tried(f"read of {length} bytes at 0x{register:02X}", lambda: self._read(register, length))

    def write(self, register: int, data: bytes) -> None:
        """Write `data` from `register` on; raises ProtocolError when no try succeeded."""
        self._tried(f"write of {len(data)} bytes to 0x{register:02X}", lambda: self._write(register, data))

    @abstractmethod
    def write_unanswered(self, register: int, data: bytes) -> None:
        """Write what keeps the chip from answering: a reset."""

    @abstractmethod
    def settle(self) -> None:
        """Wait for the rest of an answer that was interrupted, and forget it."""

    @abstractmethod
    def _read(self, register: int, length: int) -> Received: ...

    @abstractmethod
    def _write(self, register: int, data: bytes) -> None: ...

    def _tried(self, what: str, attempt: Callable[[], T]) -> T:
        for number in range(1, TRIES + 1):
            try:
                return attempt()
            except _FailedError as error:
                self.faults = self.faults._replace(**{error.kind: getattr(self.faults, error.kind) + 1})
                if number == TRIES or not error.worth_a_try:
                    raise ProtocolError(f"BNO055: {what}: {error} ({number} tries)") from error
            self._pause(PAUSE)
        raise AssertionError("unreachable")


class UartLink(Link):
    """A chip on a serial port (PS1 high, PS0 low)."""

    def __init__(self, port: BytePort, pause: Callable[[float], None], now_ns: Callable[[], int]) -> None:
        super().__init__(pause, now_ns)
        self._port = port

    def write_unanswered(self, register: int, data: bytes) -> None:
        """Write what keeps the chip from answering."""
        self._port.write(write_request(register, data))

    def settle(self) -> None:
        """Wait for the rest of an answer that was interrupted, and forget it."""
        self._pause((LONGEST + 2) * BYTE_TIME)
        self._port.reset_input_buffer()

    def _read(self, register: int, length: int) -> Received:
        request = read_request(register, length)
        self._send(request)
        written = self._now_ns()
        first, second = self._head()
        answered = self._now_ns()
        if first == ACKNOWLEDGE:
            raise _refusal(second)
        if first != DATA:
            raise self._garbled(f"an answer begins with {first:02X}")
        if second != length:
            raise self._garbled(f"an answer of {second} bytes to a request for {length}", "short")
        data = self._port.read(length)
        if len(data) < length:
            raise _FailedError("short", f"the answer ended after {len(data)} of {length} bytes")
        # A port that sends late answers late: then the answer's beginning is nearer.
        return Received(data, min(written + round(len(request) * BYTE_TIME * 1e9), answered))

    def _write(self, register: int, data: bytes) -> None:
        self._send(write_request(register, data))
        first, second = self._head()
        if first != ACKNOWLEDGE:
            raise self._garbled(f"an acknowledgement begins with {first:02X}")
        if second != Status.WRITTEN:
            raise _refusal(second)

    def _send(self, request: bytes) -> None:
        self._port.reset_input_buffer()  # or an answer that came too late would pass for this request's
        self._port.write(request)

    def _head(self) -> bytes:
        head = self._port.read(2)
        if len(head) < 2:
            raise _FailedError("silent", "no answer")
        return head

    def _garbled(self, text: str, kind: str = "garbled") -> _FailedError:
        self.settle()
        return _FailedError(kind, text)


def _refusal(status: int) -> _FailedError:
    if status == Status.BUS_OVERRUN:
        return _FailedError("overruns", "EE 07, bus overrun")
    known = status in set(Status)
    name = Status(status).name.lower().replace("_", " ") if known else "unknown"
    passing = not known or status in (Status.READ_FAILED, Status.WRITE_FAILED, Status.WRONG_START_BYTE)
    return _FailedError("refused", f"EE {status:02X}, {name}", worth_a_try=passing or status == Status.RECEIVE_TIMEOUT)


class I2cLink(Link):
    """A chip on an I2C bus; `transfer` writes bytes, then reads as many as it is told after a repeated start."""

    def __init__(
        self,
        transfer: Callable[[bytes, int], bytes],
        pause: Callable[[float], None],
        now_ns: Callable[[], int],
    ) -> None:
        super().__init__(pause, now_ns)
        self._transfer = transfer

    def write_unanswered(self, register: int, data: bytes) -> None:
        """Write what keeps the chip from answering."""
        self._write(register, data)

    def settle(self) -> None:
        """Do nothing: on this bus no answer is left over."""

    def _read(self, register: int, length: int) -> Received:
        began = self._now_ns()
        data = self._transferred(bytes((register,)), length)
        if len(data) != length:
            raise _FailedError("short", f"the bus gave {len(data)} of {length} bytes")
        return Received(data, began)

    def _write(self, register: int, data: bytes) -> None:
        self._transferred(bytes((register,)) + data, 0)

    def _transferred(self, data: bytes, length: int) -> bytes:
        try:
            return self._transfer(data, length)
        except OSError as error:  # the chip does not acknowledge while it starts
            raise _FailedError("failed", error.strerror or str(error)) from error
