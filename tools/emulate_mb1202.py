"""`caneflow emulate mb1202`: a sonar on I2C that is not there, played from a recording over a Unix socket."""

import errno
import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from caneflow.i2c_bus import EMULATED, serve
from caneflow.protocols.maxbotix import ADDRESS
from caneflow.protocols.maxbotix_emulator import I2cSonar
from caneflow.recording.ranges_over_time import echoes_of


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
