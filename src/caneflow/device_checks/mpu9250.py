"""Whether both dies of an MPU-9250 answer, and whether it can be set up."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from caneflow.device_checks.ports import at_port, not_opened, opened_bus
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mpu9250 import MAGNETOMETER_ADDRESS
from caneflow.protocols.mpu9250_chip import NAME as MPU9250
from caneflow.protocols.mpu9250_chip import Chip as Mpu9250Chip
from caneflow.protocols.mpu9250_chip import Setup
from caneflow.protocols.register_link import I2cLink
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding


def examine(node: Node) -> Iterator[Finding]:
    """Whether both dies answer on the bus, and whether the chip can be set up."""
    settings = node.settings
    path = Path(f"/dev/i2c-{settings.bus}")
    for finding in at_port(node, path, "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    where = f"{path}, address 0x{settings.address:02X}"
    try:
        with opened_bus(str(path)) as transfer:
            inertial, magnetometer = partial(transfer, settings.address), partial(transfer, MAGNETOMETER_ADDRESS)
            chip = Mpu9250Chip(
                I2cLink(inertial, time.sleep, time.time_ns, device=MPU9250),
                I2cLink(magnetometer, time.sleep, time.time_ns, device=f"{MPU9250}, magnetometer"),
                time.sleep,
            )
            name = chip.require(magnetometer=settings.magnetometer)
            chip.set_up(Setup(magnetometer=settings.magnetometer))
    except OSError as error:
        yield not_opened(node, path, error)
    except ProtocolError as error:
        other = 0x69 if settings.address == 0x68 else 0x68
        attempts = (
            f"see who is on the bus: i2cdetect -y {settings.bus}; it may be address 0x{other:02X} (AD0 high: 0x69), "
            f"then --set {node.name}.address=0x{other:02X}",
            "SDA to GPIO 2 (pin 3), SCL to GPIO 3 (pin 5), 3.3 V, ground; nCS high, or the chip speaks SPI",
            f"a board sold as an MPU-9250 may hold an MPU-6500: --set {node.name}.magnetometer=false",
        )
        yield Finding(node=node.name, state="bad", text=f"no MPU-9250 on {where}: {error}", attempts=attempts)
    else:
        yield Finding(node=node.name, state="ok", text=f"{name} on {where}, set up; {chip.link.faults}")
