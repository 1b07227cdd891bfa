"""`caneflow emulate vl53l5cx`: an 8 x 8 ranger on I2C that is not there, played from a recording over a Unix socket."""

from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.i2c_bus import EMULATED, serve
from caneflow.outputs import require_free
from caneflow.protocols import vl53l5cx
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.vl53l5cx import Firmware
from caneflow.protocols.vl53l5cx_emulator import Emulator, Scene, as_c_source, pretended_firmware
from caneflow.recording.ranges_over_time import readings_of


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording.", show_default=False)],
    bus: Annotated[
        Path, typer.Option(metavar="PATH", help="The Unix socket to make, in the place of a bus.")
    ] = EMULATED,
    stream: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Which ranges, where the recording has several.")
    ] = None,
    firmware: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="ST's vl53l5cx_buffers.h, which it wants to be given; else PATH.h is written, of no use to a chip.",
        ),
    ] = None,
) -> None:
    """Be a VL53L5CX that sees what was recorded, once, in real time. Ends with the recording.

    The recording begins with the driver's first transfer, and again when the chip begins to measure.

    Example: caneflow emulate vl53l5cx walk.mcap --stream tof_up/ranges & caneflow run flow.yaml
    --set tof_up.bus=/tmp/caneflow-i2c --set tof_up.firmware=/tmp/caneflow-i2c.h
    """
    scene = scene_of(recording, stream)
    wanted = firmware_of(firmware, Path(f"{bus}.h"))
    chip = Emulator(scene, wanted)
    greeting = f"{vl53l5cx.NAME} of {recording} on {bus}, address 0x{vl53l5cx.ADDRESS:02X}"
    try:
        serve(bus, greeting, chip.transfer, scene.end + STARTING, partial(print, flush=True))
    finally:
        print(f"{chip.readings} readings", flush=True)


STARTING = 5.0  # s that a driver may take until the chip measures


def firmware_of(given: Path | None, pretended: Path) -> Firmware:
    """The firmware that the chip takes: ST's, or one that is written to `pretended` for the driver to read."""
    if given is None:
        made = pretended_firmware()
        source = as_c_source(made)
        if not (pretended.is_file() and pretended.read_text(errors="replace") == source):  # of an emulator before
            require_free(pretended)
            pretended.write_text(source)
        return made
    try:
        return Firmware.of(byte_arrays(given.read_text(encoding="latin-1")))
    except OSError as error:
        raise CaneflowError(f"{given}: {error.strerror}") from error
    except ProtocolError as error:
        raise CaneflowError(f"{given}: {error}") from error


def scene_of(recording: Path, stream: str | None) -> Scene:
    """What a stream of 64 zones saw over time, from its first reading on."""
    seen = readings_of(recording, stream)[1]
    zones = {len(each.ranges) for each in seen}
    if zones != {vl53l5cx.ZONES}:
        raise CaneflowError(f"{recording}: readings of {sorted(zones)} zones; a {vl53l5cx.NAME} has {vl53l5cx.ZONES}")
    has_sigma = all(each.sigma is not None for each in seen)
    return Scene(
        times=[(each.stamp - seen[0].stamp) * 1e-9 for each in seen],
        ranges=np.array([each.ranges for each in seen]),
        status=np.array([each.status for each in seen]),
        sigma=np.array([each.sigma for each in seen]) if has_sigma else None,
    )
