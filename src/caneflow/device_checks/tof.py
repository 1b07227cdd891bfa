"""Whether a VL53L5CX or VL53L1X answers on its bus, and whether ST's file is there that it is given at the start."""

import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from caneflow.device_checks.ports import at_port, not_opened
from caneflow.i2c_bus import opened_bus
from caneflow.protocols import vl53l1x, vl53l5cx
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink, Link
from caneflow.protocols.vl53l5cx_chip import Chip as Vl53l5cxChip
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

ADDRESS = 0x29  # of both, when they have been switched on


class Kind(NamedTuple):
    """What differs between the chips."""

    name: str
    setting: str  # that names ST's file
    to_fetch: str
    read: Callable[[Mapping[str, bytes]], object]  # raises ProtocolError for a file that is not whole
    require: Callable[[Link], None]  # raises ProtocolError for another device
    pin: str  # that must be high


VL53L5CX = Kind(
    vl53l5cx.NAME,
    "firmware",
    "fetch ST's driver STSW-IMG023; vl53l5cx_buffers.h in it is the file (docs/hardware.md)",
    vl53l5cx.Firmware.of,
    lambda link: Vl53l5cxChip(link, time.sleep).require(),
    "LPn",
)
VL53L1X = Kind(
    vl53l1x.NAME,
    "table",
    "fetch ST's driver STSW-IMG009; VL53L1X_api.c in it is the file (docs/hardware.md)",
    vl53l1x.table_of,
    lambda link: vl53l1x.Chip(link, time.sleep).require(),
    "XSHUT",
)


def examine(kind: Kind, node: Node) -> Iterator[Finding]:
    """Whether ST's file is there, the bus can be opened, and the chip on it is the right one."""
    yield _file(kind, node)
    bus = node.settings.bus
    path = Path(bus) if isinstance(bus, str) else Path(f"/dev/i2c-{bus}")
    if isinstance(bus, str) and not path.is_socket():
        attempts = (f"caneflow emulate {kind.name.lower()} REC --bus {bus}",)
        yield Finding(node=node.name, state="bad", text=f"{bus}: no emulator has made this socket", attempts=attempts)
        return
    for finding in () if isinstance(bus, str) else at_port(node, path, "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    yield _chip(kind, node, path)


def _file(kind: Kind, node: Node) -> Finding:
    given = getattr(node.settings, kind.setting)
    if given is None:
        text = f"settings.{kind.setting} is missing"
        return Finding(node=node.name, state="bad", text=text, attempts=(kind.to_fetch,))
    try:
        kind.read(byte_arrays(Path(given).read_text(encoding="latin-1")))
    except (OSError, ProtocolError) as error:
        text = f"{kind.setting} {given}: {getattr(error, 'strerror', None) or error}"
        return Finding(node=node.name, state="bad", text=text, attempts=(kind.to_fetch,))
    return Finding(node=node.name, state="ok", text=f"{kind.setting} {given} is whole")


def _chip(kind: Kind, node: Node, path: Path) -> Finding:
    settings, said = node.settings, ""
    try:
        with opened_bus(settings.bus) as transfer:
            for address in dict.fromkeys((settings.address, ADDRESS)):
                link = I2cLink(partial(transfer, address), time.sleep, time.time_ns, device=kind.name, register_bytes=2)
                try:
                    kind.require(link)
                except ProtocolError as error:
                    said = said or str(error)
                else:
                    return Finding(node=node.name, state="ok", text=f"{kind.name} on {path}, address 0x{address:02X}")
    except OSError as error:
        return not_opened(node, path, error)
    attempts = (
        f"see who is on the bus: i2cdetect -y {settings.bus}",
        f"SDA to GPIO 2 (pin 3), SCL to GPIO 3 (pin 5), 3.3 V, ground; {kind.pin} high, or it does not answer",
        f"of two on one bus, hold {kind.pin} of the other low until this one has its address",
    )
    text = f"no {kind.name} on {path}, address 0x{settings.address:02X}: {said}"
    return Finding(node=node.name, state="bad", text=text, attempts=attempts)
