"""Whether a BNO055 answers, by UART or I2C, and how fast."""

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from caneflow.device_checks.ports import at_port, not_opened, opened_bus
from caneflow.protocols import bno055
from caneflow.protocols.bno055_chip import Chip as Bno055Chip
from caneflow.protocols.bno055_chip import Identity
from caneflow.protocols.bno055_link import UartLink
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink, Link
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

PROBE_READS = 50
MOST_OVERRUNS = 0.1  # part of the readings
UART_ATTEMPTS = (
    "cross the wires: the chip's TX (its SDA pin) to RX of the host, its RX (SCL) to TX, ground to ground",
    "select its UART: PS1 high, PS0 low, then power it again",
    "no login shell on the port: sudo raspi-config, Interface Options, Serial Port",
    "on a Raspberry Pi 3 or later: dtoverlay=disable-bt in config.txt gives the pins the better UART",
)


def examine(node: Node) -> Iterator[Finding]:
    """Whether the port can be opened and a chip answers, and how fast."""
    settings = node.settings
    path = Path(settings.port)
    for finding in at_port(node, path, "serial" if settings.bus == "uart" else "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    try:
        with _link(settings) as link:
            yield from _chip(node, Bno055Chip(link, time.sleep))
    except OSError as error:
        yield not_opened(node, path, error)


def _chip(node: Node, chip: Bno055Chip) -> Iterator[Finding]:
    where, i2c = f"{node.settings.port}", node.settings.bus == "i2c"
    if i2c:
        where += f", address 0x{node.settings.address:02X}"
    try:
        chip.require()
        identity = chip.identity()
    except ProtocolError as error:
        attempts = _i2c_attempts(node.settings) if i2c else UART_ATTEMPTS
        yield Finding(node=node.name, state="bad", text=f"no BNO055 on {where}: {error}", attempts=attempts)
        return
    yield Finding(node=node.name, state="ok", text=f"BNO055 on {where}, software {identity.software}, {chip.state()}")
    if identity.self_test != bno055.SELF_TEST_PASSED:
        text = f"its self-test failed: {_failed_parts(identity)}"
        attempts = ("take its power off and on; the same again: the chip is broken",)
        yield Finding(node=node.name, state="look", text=text, attempts=attempts)
    yield _speed(node, chip)


def _failed_parts(identity: Identity) -> str:
    parts = ("accelerometer", "magnetometer", "gyro", "microcontroller")
    return ", ".join(part for bit, part in enumerate(parts) if not identity.self_test >> bit & 1)


def _speed(node: Node, chip: Bno055Chip) -> Finding:
    """How long one reading takes, against the rate that is asked for."""
    block = bno055.WHOLE if node.settings.accel_and_mag else bno055.WITHOUT_ACCEL_AND_MAG
    took = []
    for _ in range(PROBE_READS):
        began = time.monotonic()
        try:
            chip.read(block)
        except ProtocolError:
            continue
        took.append(time.monotonic() - began)
    if not took:
        text = f"answers, but gave none of {PROBE_READS} readings: {chip.link.faults}"
        return Finding(node=node.name, state="bad", text=text, attempts=("take the chip's power off and on",))
    median = statistics.median(took)
    text = f"{block.length} bytes take {1e3 * median:.1f} ms, up to {1e3 * max(took):.1f}; {chip.link.faults}"
    attempts: tuple[str, ...] = ()
    if median > 0.95 / node.settings.rate:
        attempts = _to_be_faster(node)
    elif sum(chip.link.faults) > MOST_OVERRUNS * PROBE_READS:
        attempts = ("shorter wires, one common ground, 3.3 V at the chip while it runs",)
    return Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)


def _i2c_attempts(settings: Any) -> tuple[str, ...]:
    other = 0x29 if settings.address == 0x28 else 0x28
    return (
        f"see who is on the bus: i2cdetect -y {settings.port.rpartition('-')[2]}; it may be address 0x{other:02X}",
        "a Raspberry Pi garbles what a chip says that stretches the clock, as this one does: "
        "dtoverlay=i2c-gpio in config.txt, then the bus that it makes; or use the UART",
        "PS1 and PS0 low, then power it again",
    )


def _to_be_faster(node: Node) -> tuple[str, ...]:
    if node.settings.bus == "i2c":
        return (
            f"--set {node.name}.accel_and_mag=false reads 34 bytes in the place of 46",
            "400 kHz on the bus: i2c_gpio_delay_us=1 with dtoverlay=i2c-gpio",
            "use the UART: 46 bytes take 4.7 ms there",
        )
    return ("an adapter on USB: echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB*/latency_timer",)


@contextmanager
def _link(settings: Any) -> Iterator[Link]:
    """The way to a BNO055; raises OSError when it cannot be opened."""
    if settings.bus == "uart":
        import serial

        timeout = settings.answer_timeout_ms / 1e3
        with serial.Serial(settings.port, settings.baud, timeout=timeout, exclusive=True) as port:
            yield UartLink(port, time.sleep, time.time_ns)
    else:
        with opened_bus(settings.port) as transfer:
            yield I2cLink(partial(transfer, settings.address), time.sleep, time.time_ns)
