"""Whether the ports of a TI mmWave radar are there, and its configuration file can be used."""

from collections.abc import Iterator
from pathlib import Path

from caneflow.device_checks.ports import at_port
from caneflow.protocols import ti_mmwave
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

TOO_SLOW = 1.5  # m/s that a walk reaches


def examine(node: Node) -> Iterator[Finding]:
    """The configuration's Doppler limits, then each port; the samples tell whether the radar takes it."""
    settings = node.settings
    try:
        text = Path(settings.config).read_text(encoding="utf-8", errors="replace")
        chirps = ti_mmwave.chirps_of(ti_mmwave.lines_of(text))
    except (OSError, ProtocolError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        attempts = (f"a .cfg file of the vendor's demo, then --set {node.name}.config=...; see docs/hardware.md",)
        yield Finding(node=node.name, state="bad", text=f"{settings.config}: {reason}", attempts=attempts)
        return
    text = (
        f"{settings.config}: up to {chirps.doppler_limit:.2f} m/s in steps of {chirps.doppler_step:.3f}, "
        f"{1.0 / chirps.period:.1f} Hz"
    )
    if chirps.doppler_limit < TOO_SLOW:
        shorter = ("shorter chirps: a walk and the swing of the cane need 3 m/s, 138 us for 3 transmitters",)
        yield Finding(node=node.name, state="look", text=text, attempts=shorter)
    else:
        yield Finding(node=node.name, state="ok", text=text)
    for port in (settings.cli, settings.data):
        if port is not None:
            yield from at_port(node, Path(port), "serial")
