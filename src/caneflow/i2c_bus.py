"""I2C buses: Linux's, or the Unix socket of an emulator; and the emulator's end of that socket."""

import errno
import os
import select
import signal
import socket
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final, Protocol, TypeAlias

from caneflow.errors import CaneflowError, not_installed
from caneflow.protocols import i2c_socket

EMULATED: Final = Path(gettempdir()) / "caneflow-i2c"  # an emulator's socket, by default
ANSWER_TIME: Final = 2.0  # s, of an emulator
LONGEST_WAIT: Final = 0.2  # s

Transfer: TypeAlias = Callable[[int, bytes, int], bytes]  # address, what to write, bytes to read after that


class Chip(Protocol):
    """What sits on an emulated bus."""

    def __call__(self, address: int, written: bytes, length: int, time: float) -> bytes:
        """One transfer at `time`, s; raises OSError when it is not acknowledged."""


@contextmanager
def opened_bus(bus: int | str) -> Iterator[Transfer]:
    """Transfers on /dev/i2c-N, or on an emulator's socket; raises OSError when it cannot be opened."""
    if isinstance(bus, str):
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(ANSWER_TIME)
            client.connect(bus)
            yield lambda address, written, length: _over_socket(client, address, written, length)
        return
    try:
        import smbus2
    except ImportError as error:
        raise CaneflowError(not_installed("smbus2", "devices")) from error
    with smbus2.SMBus(bus) as opened:
        yield lambda address, written, length: _over_bus(smbus2, opened, address, written, length)


def _over_bus(smbus2: Any, bus: Any, address: int, written: bytes, length: int) -> bytes:
    messages = [smbus2.i2c_msg.write(address, written)] if written else []
    messages += [smbus2.i2c_msg.read(address, length)] if length else []
    bus.i2c_rdwr(*messages)
    return bytes(messages[-1]) if length else b""


def _over_socket(client: socket.socket, address: int, written: bytes, length: int) -> bytes:
    client.sendall(i2c_socket.Request(address, written, length).packed())
    error, count = i2c_socket.ANSWER.unpack(_received(client, i2c_socket.ANSWER.size))
    data = _received(client, count)
    if error:
        raise OSError(error, os.strerror(error))
    return data


def _received(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = client.recv(count - len(data))
        if not piece:
            raise OSError(errno.ENXIO, "the emulator has gone")
        data += piece
    return data


def serve_client(client: socket.socket, chip: Chip, now: Callable[[], float]) -> None:
    """Answer one client's transfers until it leaves."""
    with client, client.makefile("rb") as asked:
        while len(head := asked.read(i2c_socket.REQUEST.size)) == i2c_socket.REQUEST.size:
            address, count, length = i2c_socket.REQUEST.unpack(head)
            written = asked.read(count)
            try:
                answer = i2c_socket.answered(chip(address, written, length, now()))
            except OSError as error:
                answer = i2c_socket.refused(error.errno or errno.EIO)
            client.sendall(answer)


def serve(path: Path, greeting: str, chip: Chip, lasts: float, tell: Callable[[str], None]) -> None:
    """Be an emulated bus at `path` for `lasts` s from the first transfer on; ends like Ctrl-C at SIGTERM.

    `tell` is given `greeting` once clients can connect, and a line at the end.

    Raises CaneflowError when something else has that name.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if os.path.lexists(path):
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise CaneflowError(f"{path}: exists and is not an emulator's socket; choose another name with --bus")
        path.unlink()  # of an emulator that was killed
    begin: float | None = None

    def now() -> float:
        nonlocal begin
        begin = time.monotonic() if begin is None else begin
        if time.monotonic() - begin > lasts:
            raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))  # the chip has no power any more
        return time.monotonic() - begin

    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        tell(greeting)
        try:
            while begin is None or time.monotonic() - begin <= lasts:
                if select.select([server], [], [], LONGEST_WAIT)[0]:
                    serve_client(server.accept()[0], chip, now)
            tell("the recording is over")
        finally:
            path.unlink(missing_ok=True)
