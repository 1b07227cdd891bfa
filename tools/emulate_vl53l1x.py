"""`caneflow emulate vl53l1x`: a ranger of one zone that is not there, played from a recording over a Unix socket."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from caneflow.i2c_bus import EMULATED, serve
from caneflow.protocols.vl53l1x import ADDRESS, NAME
from caneflow.protocols.vl53l1x_emulator import Emulator, as_c_source, pretended_table
from caneflow.recording.ranges_over_time import echoes_of

STARTING = 5.0  # s that a driver may take until the chip measures


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    bus: Annotated[
        Path, typer.Option(metavar="PATH", help="The Unix socket to make, in the place of a bus.")
    ] = EMULATED,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which ranges, where the recording has several.")
    ] = None,
) -> None:
    """Be a VL53L1X that sees the nearest target of what was recorded, once, in real time. Ends with the recording.

    The recording begins when the chip begins to measure. PATH.c is written: a table of the right size for the driver,
    of no use to a chip.

    Example: caneflow emulate vl53l1x walk.mcap & caneflow run flow.yaml --set tof.bus=/tmp/caneflow-i2c
    --set tof.table=/tmp/caneflow-i2c.c
    """
    echoes = echoes_of(recording, stream)
    chip = Emulator(echoes)
    Path(f"{bus}.c").write_text(as_c_source(pretended_table()))
    greeting = f"{NAME} of {recording} on {bus}, address 0x{ADDRESS:02X}"
    try:
        serve(bus, greeting, chip.transfer, echoes.end + STARTING, partial(print, flush=True))
    finally:
        print(f"{chip.readings} readings", flush=True)
