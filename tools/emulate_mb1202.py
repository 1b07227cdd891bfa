"""`caneflow emulate mb1202`: a sonar on I2C that is not there, played from a recording over a Unix socket."""

import errno
import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.i2c_bus import EMULATED, serve
from caneflow.messages import Ranges
from caneflow.protocols.maxbotix import ADDRESS
from caneflow.protocols.maxbotix_emulator import Echoes, I2cSonar
from caneflow.recording import Recording


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    bus: Annotated[
        Path, typer.Option(metavar="PATH", help="The Unix socket to make, in the place of a bus.")
    ] = EMULATED,
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

    def transfer(address: int, written: bytes, length: int, time: float) -> bytes:
        if address != ADDRESS:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        return chip.transfer(written, length, time)

    try:
        serve(
            bus,
            f"MB1202 of {recording} on {bus}, address 0x{ADDRESS:02X}",
            transfer,
            echoes.end,
            partial(print, flush=True),
        )
    finally:
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
