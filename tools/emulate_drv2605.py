"""`caneflow emulate drv2605`: a vibration motor on I2C that is not there; says when it would have run."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from caneflow.i2c_bus import EMULATED, serve
from caneflow.protocols import drv2605
from caneflow.protocols.drv2605_emulator import Drv2605Emulator


def command(
    bus: Annotated[
        Path, typer.Option(metavar="PATH", help="The Unix socket to make, in the place of a bus.")
    ] = EMULATED,
    duration: Annotated[float, typer.Option(metavar="S", min=0.1, help="s, from the first transfer on.")] = 60.0,
) -> None:
    """Be a DRV2605L with a motor, for `drivers.haptic`; print each change of its strength, with the time.

    Example: caneflow emulate drv2605 & caneflow run flow.yaml --set haptic.bus=/tmp/caneflow-i2c
    """
    chip = Drv2605Emulator()
    told = 0

    def transfer(address: int, written: bytes, length: int, time: float) -> bytes:
        nonlocal told
        answer = chip(address, written, length, time)
        for at, strength in chip.driven[told:]:
            print(f"{at:.2f} s: {strength:.0%}", flush=True)
        told = len(chip.driven)
        return answer

    greeting = f"{drv2605.NAME} on {bus}, address 0x{drv2605.ADDRESS:02X}"
    serve(bus, greeting, transfer, duration, partial(print, flush=True))
