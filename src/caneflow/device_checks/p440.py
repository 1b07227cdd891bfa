"""Whether a P440 answers, and how it is."""

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from caneflow.device_checks.ports import at_port, text_of
from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

ANSWER_TIME = 0.5  # s, of a radar
ASKED = 4  # times
FIREWALL = Path("/etc/ufw/ufw.conf")


def examine(node: Node) -> Iterator[Finding]:
    """Whether a radar answers on Ethernet, and how it is; on a serial link only the stream tells."""
    settings = node.settings
    if settings.link != "udp":
        yield from at_port(node, Path(settings.device), "serial")
        return
    where = f"{settings.host}, UDP port {settings.port}"
    try:
        said = _radar_status(settings.host, settings.port)
    except OSError as error:
        attempts = _network_attempts(node, error)
        text = f"no P440 at {where}: {error.strerror or error}"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    version = ".".join(map(str, said.application))
    text = f"P440 at {where}, number {said.serial_number}, software {version}, {said.temperature:g} degC"
    yield Finding(node=node.name, state="ok", text=text)
    if said.self_test:
        attempts = ("take its power off and on; the same again: the module is broken",)
        text = f"its self-test says 0x{said.self_test:02X}; good is 0"
        yield Finding(node=node.name, state="look", text=text, attempts=attempts)


def _radar_status(host: str, port: int) -> mrm.GetStatusConfirm:
    """What a radar says of itself; raises OSError when it says nothing."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        udp.connect((host, port))
        udp.settimeout(ANSWER_TIME)
        for number in range(ASKED):
            udp.send(mrm.build(mrm.GetStatusRequest(message_id=number)))
            until = time.monotonic() + ANSWER_TIME
            while time.monotonic() < until:  # one that scans sends its scans in between
                try:
                    message = mrm.parse(udp.recv(65_535))
                except (TimeoutError, ProtocolError):
                    continue
                if isinstance(message, mrm.GetStatusConfirm):
                    return message
    raise TimeoutError(None, f"no answer, asked {ASKED} times")


def _network_attempts(node: Node, error: OSError) -> tuple[str, ...]:
    host, port = node.settings.host, node.settings.port
    if isinstance(error, ConnectionRefusedError):
        return (f"{host} is there, but no radar: find the radar's address, then --set {node.name}.host=...",)
    if isinstance(error, socket.gaierror):
        return (f"{host} is not an address; the radar's own is 192.168.1.100 unless it was changed",)
    attempts = [
        f"ping {host}: when that is silent too, see cable and power (5 to 48 V, 3 W)",
        "the radar sends to one host only: end the flow, or the vendor's program, that has it",
    ]
    firewall = f"let its answers through the firewall: sudo ufw allow proto udp from {host} port {port}"
    attempts.insert(0 if "ENABLED=yes" in text_of(FIREWALL) else len(attempts), firewall)
    network, own = host.rpartition(".")[0], _own_address(host)
    if own is None or own.rpartition(".")[0] != network:
        via = "there is no way to it" if own is None else f"this host would ask from {own}"
        attempts.insert(0, f"{via}: give it an address beside it: sudo ip addr add {network}.10/24 dev eth0")
    return tuple(attempts)


def _own_address(host: str) -> str | None:
    """The address from which this host would ask another one; None: it has no way there."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        try:
            udp.connect((host, mrm.UDP_PORT))
        except OSError:
            return None
        address: str = udp.getsockname()[0]
        return address
