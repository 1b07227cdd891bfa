"""Whether an A121's exploration server answers, and what it is."""

import json
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from caneflow.device_checks.ports import at_port
from caneflow.protocols import a121_messages
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

ANSWER_TIME = 1.0  # s
FIRMWARE = "an XM125 needs Acconeer's exploration server flashed: hold BOOT, the vendor's app flashes it"


def examine(node: Node) -> Iterator[Finding]:
    """What a server on TCP says of itself; of a serial port whether it can be opened: its samples tell the rest."""
    settings = node.settings
    if settings.host is None:
        yield from at_port(node, Path(settings.port), "serial")
        return
    try:
        system = _system_info(settings.host, settings.tcp_port)
    except (OSError, ProtocolError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        attempts = (
            f"ping {settings.host}: when that is silent too, see cable and power",
            "the server takes one client: end the flow, or the vendor's app, that has it",
            FIRMWARE,
        )
        text = f"no A121 at {settings.address}: {reason}"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    sensor = system.get("sensor")
    text = f"{system.get('hw')} at {settings.address}, software {system.get('rss_version')}, sensor {sensor}"
    if sensor == "a121":
        yield Finding(node=node.name, state="ok", text=text)
    else:
        other = ("the driver is for an A121; the A111 speaks another dialect",)
        yield Finding(node=node.name, state="bad", text=text, attempts=other)


def _system_info(host: str, port: int) -> dict[str, object]:
    """What a server says of itself; raises OSError or ProtocolError when it says nothing, or nonsense."""
    lines, until = a121_messages.Lines(), time.monotonic() + ANSWER_TIME
    with closing(socket.create_connection((host, port), timeout=ANSWER_TIME)) as link:
        link.sendall(a121_messages.line({"cmd": "get_system_info"}))
        while time.monotonic() < until and (data := link.recv(65_536)):
            for answer in lines.feed(data):
                if isinstance(found := answer.said.get("system_info"), dict):
                    return found
                if answer.said.get("status") == "error":
                    raise ProtocolError(f"it says {json.dumps(answer.said)[:80]}")
    raise TimeoutError(None, "it does not answer")
