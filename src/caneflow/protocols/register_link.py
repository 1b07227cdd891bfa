"""Registers of a chip read and written, again when the chip had no time; and how that is done on I2C.

No I/O here: what carries the bytes, how to wait and what time it is are handed in.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from caneflow.protocols.errors import ProtocolError

T = TypeVar("T")

TRIES = 4
PAUSE = 0.002  # s before the next try


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


class FailedError(ProtocolError):
    """One try failed: what it counts as, and whether the same request may yet be answered."""

    def __init__(self, kind: str, text: str, *, worth_a_try: bool = True) -> None:
        super().__init__(text)
        self.kind = kind
        self.worth_a_try = worth_a_try


class Link(ABC):
    """The way to one chip."""

    def __init__(self, device: str, pause: Callable[[float], None], now_ns: Callable[[], int]) -> None:
        self.faults = Faults()
        self._device = device  # its name, for errors
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
            except FailedError as error:
                self.faults = self.faults._replace(**{error.kind: getattr(self.faults, error.kind) + 1})
                if number == TRIES or not error.worth_a_try:
                    raise ProtocolError(f"{self._device}: {what}: {error} ({number} tries)") from error
            self._pause(PAUSE)
        raise AssertionError("unreachable")


class I2cLink(Link):
    """A chip on an I2C bus; `transfer` writes bytes, then reads as many as it is told after a repeated start."""

    def __init__(
        self,
        transfer: Callable[[bytes, int], bytes],
        pause: Callable[[float], None],
        now_ns: Callable[[], int],
        *,
        device: str = "BNO055",
        register_bytes: int = 1,
    ) -> None:
        """`register_bytes`: how long the number of a register is, high byte first."""
        super().__init__(device, pause, now_ns)
        self._transfer = transfer
        self._register_bytes = register_bytes

    def write_unanswered(self, register: int, data: bytes) -> None:
        """Write what keeps the chip from answering."""
        self._write(register, data)

    def settle(self) -> None:
        """Do nothing: on this bus no answer is left over."""

    def _read(self, register: int, length: int) -> Received:
        began = self._now_ns()
        data = self._transferred(register.to_bytes(self._register_bytes, "big"), length)
        if len(data) != length:
            raise FailedError("short", f"the bus gave {len(data)} of {length} bytes")
        return Received(data, began)

    def _write(self, register: int, data: bytes) -> None:
        self._transferred(register.to_bytes(self._register_bytes, "big") + data, 0)

    def _transferred(self, data: bytes, length: int) -> bytes:
        try:
            return self._transfer(data, length)
        except OSError as error:  # the chip does not acknowledge while it starts
            raise FailedError("failed", error.strerror or str(error)) from error
