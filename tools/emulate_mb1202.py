"""`caneflow emulate mb1202`: a sonar on I2C that is not there, played from a recording over a Unix socket."""

import errno
import os
import select
import signal
import socket
import stat
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from typing import Annotated, Protocol

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import Ranges
from caneflow.protocols import i2c_socket
from caneflow.protocols.maxbotix import ADDRESS
from caneflow.protocols.maxbotix_emulator import Echoes, I2cSonar
from caneflow.recording import Recording

BUS = Path(gettempdir()) / "caneflow-i2c"
LONGEST_WAIT = 0.2  # s


class Chip(Protocol):
    """What sits on the bus."""

    def __call__(self, written: bytes, length: int, time: float) -> bytes:
        """One transfer; raises OSError when it is not acknowledged."""


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    bus: Annotated[Path, typer.Option(metavar="PATH", help="The Unix socket to make, in the place of a bus.")] = BUS,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which ranges, where the recording has several.")
    ] = None,
) -> None:
    """Be an MB1202 that hears the nearest target of what was recorded, once, in real time. Ends with the recording.

    The recording begins with the driver's first transfer.

    Example: caneflow emulate mb1202 walk.mcap & caneflow run flow.yaml --set sonar.bus=/tmp/caneflow-i2c
    """
    echoes = echoes_of(recording, stream)
    chip = I2cSonar(echoes)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends like Ctrl-C
    if os.path.lexists(bus):
        if not stat.S_ISSOCK(bus.lstat().st_mode):
            raise CaneflowError(f"{bus}: exists and is not an emulator's socket; choose another name with --bus")
        bus.unlink()  # of an emulator that was killed
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(bus))
        server.listen()
        print(f"MB1202 of {recording} on {bus}, address 0x{ADDRESS:02X}", flush=True)
        try:
            _serve(server, chip, echoes.end)
            print("the recording is over", flush=True)
        finally:
            bus.unlink(missing_ok=True)
            print(f"{chip.readings} readings", flush=True)


def echoes_of(recording: Path, stream: str | None) -> Echoes:
    """The nearest target over time of a stream of ranges, from the recording's first sample on."""
    with Recording(recording) as opened:
        there = {f"{found.node}/{found.port}": (found.node, found.port) for found in opened.streams_of(Ranges)}
        if stream is None and len(there) == 1:
            (stream,) = there
        if stream not in there:
            asked = f"no ranges {stream}" if stream else "choose one stream of ranges with --stream"
            raise CaneflowError(f"{recording}: {asked}; there are {', '.join(there) or 'none'}")
        span = opened.span()
        assert span is not None  # the stream has a sample
        times, distances = [], []
        for found in opened.samples([there[stream]]):
            reading = found.decoded()
            assert isinstance(reading, Ranges)
            times.append((found.stamp - span[0]) * 1e-9)
            distances.append(nearest_of(reading))
    return Echoes(times, distances)


def nearest_of(reading: Ranges) -> float | None:
    """The nearest target (m) of all zones, as sound hears it; None: there is none."""
    seen = reading.ranges[(reading.status == 0) & (reading.ranges > 0)]
    return float(seen.min()) if len(seen) else None


def serve_bus(client: socket.socket, transfer: Chip, now: Callable[[], float]) -> None:
    """Answer one client's transfers until it leaves."""
    with client, client.makefile("rb") as asked:
        while len(head := asked.read(i2c_socket.REQUEST.size)) == i2c_socket.REQUEST.size:
            address, count, length = i2c_socket.REQUEST.unpack(head)
            written = asked.read(count)
            try:
                if address != ADDRESS:
                    raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
                answer = i2c_socket.answered(transfer(written, length, now()))
            except OSError as error:
                answer = i2c_socket.refused(error.errno or errno.EIO)
            client.sendall(answer)


def _serve(server: socket.socket, chip: I2cSonar, end: float) -> None:
    """One client after the other, until the recording is over."""
    begin: float | None = None

    def now() -> float:
        nonlocal begin
        begin = time.monotonic() if begin is None else begin
        if time.monotonic() - begin > end:
            raise OSError(errno.ENXIO, os.strerror(errno.ENXIO))  # the chip has no power any more
        return time.monotonic() - begin

    while begin is None or time.monotonic() - begin <= end:
        if select.select([server], [], [], LONGEST_WAIT)[0]:
            serve_bus(server.accept()[0], chip.transfer, now)
