"""Transactions with a BNO055 on its UART; on I2C it is any chip with registers, see register_link.

No I/O here: what carries the bytes, how to wait and what time it is are handed in. The chip answers
`EE 07`, bus overrun, now and then, when its fusion kept it from the bytes; Bosch's advice is to send again.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import FailedError, Link, Received

BAUD = 115200  # bit/s, the chip's only rate
BYTE_TIME = 10 / BAUD  # s on the wire, 8N1
LONGEST = 128  # bytes of one read or write
START, WRITE, READ = 0xAA, 0x00, 0x01
ACKNOWLEDGE, DATA = 0xEE, 0xBB


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


class UartLink(Link):
    """A chip on a serial port (PS1 high, PS0 low)."""

    def __init__(self, port: BytePort, pause: Callable[[float], None], now_ns: Callable[[], int]) -> None:
        super().__init__("BNO055", pause, now_ns)
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
            raise FailedError("short", f"the answer ended after {len(data)} of {length} bytes")
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
            raise FailedError("silent", "no answer")
        return head

    def _garbled(self, text: str, kind: str = "garbled") -> FailedError:
        self.settle()
        return FailedError(kind, text)


def _refusal(status: int) -> FailedError:
    if status == Status.BUS_OVERRUN:
        return FailedError("overruns", "EE 07, bus overrun")
    known = status in set(Status)
    name = Status(status).name.lower().replace("_", " ") if known else "unknown"
    passing = not known or status in (Status.READ_FAILED, Status.WRITE_FAILED, Status.WRONG_START_BYTE)
    return FailedError("refused", f"EE {status:02X}, {name}", worth_a_try=passing or status == Status.RECEIVE_TIMEOUT)
