"""Whether a sonar answers on its bus, or its serial line is there."""

from collections.abc import Iterator
from pathlib import Path

from caneflow.device_checks.ports import at_port
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

WIRING = (
    "an MB12xx: SDA to GPIO 2 (pin 3), SCL to GPIO 3 (pin 5), 3.3 to 5 V, ground; it measures only when it is asked to",
    "an MB10xx: its TX is an inverted RS-232 of 0 to 5 V; put an inverter and a level shifter in between",
)


def examine(node: Node) -> Iterator[Finding]:
    """Whether the bus or the line is there; whether the sensor speaks is seen by its samples."""
    settings = node.settings
    if settings.link == "serial":
        yield from at_port(node, Path(settings.port), "serial")
    elif isinstance(settings.bus, str):
        there = Path(settings.bus).is_socket()
        text = f"{settings.bus}: {'an emulator is there' if there else 'no emulator has made this socket'}"
        attempts = () if there else (f"caneflow emulate mb1202 REC --bus {settings.bus}", *WIRING)
        yield Finding(node=node.name, state="ok" if there else "bad", text=text, attempts=attempts)
    else:
        yield from at_port(node, Path(f"/dev/i2c-{settings.bus}"), "smbus2")
