"""Whether a VL53L5CX answers on its bus, and whether ST's firmware is there to be given to it."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from caneflow.device_checks.ports import at_port, not_opened
from caneflow.i2c_bus import opened_bus
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink
from caneflow.protocols.vl53l5cx import ADDRESS, NAME, Firmware
from caneflow.protocols.vl53l5cx_chip import Chip
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

TO_FETCH = "fetch ST's driver STSW-IMG023; vl53l5cx_buffers.h in it is the file (docs/hardware.md)"
WIRING = (
    "SDA to GPIO 2 (pin 3), SCL to GPIO 3 (pin 5), 3.3 V, ground; LPn high, or the chip is deaf",
    "of two on one bus, hold LPn of the other low until this one has its address",
)


def examine(node: Node) -> Iterator[Finding]:
    """Whether the firmware is there, the bus can be opened, and the chip on it is the right one."""
    yield _firmware(node)
    bus = node.settings.bus
    path = Path(bus) if isinstance(bus, str) else Path(f"/dev/i2c-{bus}")
    if isinstance(bus, str) and not path.is_socket():
        attempts = (f"caneflow emulate vl53l5cx REC --bus {bus}",)
        yield Finding(node=node.name, state="bad", text=f"{bus}: no emulator has made this socket", attempts=attempts)
        return
    for finding in () if isinstance(bus, str) else at_port(node, path, "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    yield _chip(node, path)


def _firmware(node: Node) -> Finding:
    if node.settings.firmware is None:
        return Finding(node=node.name, state="bad", text="settings.firmware is missing", attempts=(TO_FETCH,))
    path = Path(node.settings.firmware)
    try:
        Firmware.of(byte_arrays(path.read_text(encoding="latin-1")))
    except (OSError, ProtocolError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return Finding(node=node.name, state="bad", text=f"firmware {path}: {reason}", attempts=(TO_FETCH,))
    return Finding(node=node.name, state="ok", text=f"firmware {path} is whole")


def _chip(node: Node, path: Path) -> Finding:
    settings, said = node.settings, ""
    try:
        with opened_bus(settings.bus) as transfer:
            for address in dict.fromkeys((settings.address, ADDRESS)):  # one that was just switched on is at ADDRESS
                link = I2cLink(partial(transfer, address), time.sleep, time.time_ns, device=NAME, register_bytes=2)
                try:
                    Chip(link, time.sleep).require()
                except ProtocolError as error:
                    said = said or str(error)
                else:
                    return Finding(node=node.name, state="ok", text=f"{NAME} on {path}, address 0x{address:02X}")
    except OSError as error:
        return not_opened(node, path, error)
    where = f"{path}, address 0x{settings.address:02X}"
    attempts = (f"see who is on the bus: i2cdetect -y {settings.bus}", *WIRING)
    return Finding(node=node.name, state="bad", text=f"no {NAME} on {where}: {said}", attempts=attempts)
