"""The way to a flow, link by link: the name, the port, the certificates; with what to try.

A denial by TLS looks to Zenoh like a link that is not there, so each step is taken on its own.
"""

import socket
import ssl
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import observer_credentials
from caneflow.runtime.hosts.links.session import UNIX
from caneflow.runtime.site import DEFAULT_KEYS

DIAL_TIMEOUT = 2.0  # s that a port may take to accept
REFUSAL_TIME = 0.5  # s that a TLS server takes to refuse a certificate: it says so after the handshake


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was looked at."""

    node: str  # or edge, machine, endpoint: where
    state: Literal["ok", "look", "bad"]
    text: str
    attempts: tuple[str, ...] = ()  # what to try next, the likeliest first


def way_to(endpoint: str, keys: Path = DEFAULT_KEYS) -> Iterator[Finding]:
    """Whether someone listens at `endpoint`, and takes this side's certificate; a finding that is bad is the last."""
    protocol, _, address = endpoint.partition("/")
    if protocol == UNIX:
        yield _way_to_socket(endpoint, address)
        return
    host, _, port = address.rpartition(":")
    if not (protocol and host and port.isdigit()):
        text = f"{endpoint}: not an endpoint"
        yield Finding(node=endpoint, state="bad", text=text, attempts=("give e.g. --at tcp/gateway.local:7447",))
        return
    try:
        link = socket.create_connection((host.strip("[]"), int(port)), timeout=DIAL_TIMEOUT)
    except OSError as error:
        yield _no_way(endpoint, host, port, error)
        return
    with link:
        yield Finding(node=endpoint, state="ok", text="someone listens")
        if protocol == "tls":
            yield _handshake(endpoint, host, link, keys)


def _way_to_socket(endpoint: str, path: str) -> Finding:
    """Whether someone listens at a Unix socket of this machine."""
    attempts: tuple[str, ...] = ("end the flow and start it again", "it is in the run's folder: was that removed?")
    try:
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(DIAL_TIMEOUT)
            link.connect(path)
    except PermissionError:
        text, attempts = "belongs to another user", ("a flow is reached by its own user, and by root",)
    except ConnectionRefusedError:
        text, attempts = "nobody listens: the flow was killed", ("start it again",)
    except OSError as error:
        text = f"no answer: {error.strerror or error}"
    except ValueError as error:
        text = f"not a path: {error}"
    else:
        return Finding(node=endpoint, state="ok", text="someone listens")
    return Finding(node=endpoint, state="bad", text=text, attempts=attempts)


def _no_way(endpoint: str, host: str, port: str, error: OSError) -> Finding:
    attempts: tuple[str, ...]
    if isinstance(error, socket.gaierror):
        text, attempts = f"no machine is called {host}", (f"ping {host}; else give its address in numbers",)
    elif isinstance(error, ConnectionRefusedError):
        text = f"{host} is there, but nobody listens on port {port}"
        attempts = (f"on {host}: caneflow status; does the flow run?", "is it the port that `machines:` says?")
    else:
        text = f"no answer: {error.strerror or error}"
        attempts = (
            f"ping {host}",
            f"let it through the firewall of {host}: sudo ufw allow proto tcp to any port {port}",
        )
    return Finding(node=endpoint, state="bad", text=text, attempts=attempts)


def _handshake(endpoint: str, host: str, link: socket.socket, keys: Path) -> Finding:
    """Who of the two sides refuses the other's certificate, if one does."""
    attempts: tuple[str, ...]
    try:
        own = observer_credentials(keys)
    except DataflowError as error:
        return Finding(node=endpoint, state="bad", text=str(error))
    if own is None:
        text = f"takes a certificate, and {keys} holds none"
        attempts = (f"caneflow keys add NAME --observer, where ca.key is; then copy its three files to {keys}",)
        return Finding(node=endpoint, state="bad", text=text, attempts=attempts)
    context = ssl.create_default_context(cafile=str(own.authority))
    context.check_hostname = False  # addresses change; the common name says who it is
    context.load_cert_chain(own.certificate, own.key)
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            secured.settimeout(REFUSAL_TIME)
            with suppress(TimeoutError):  # silence: it waits for us, so it took the certificate
                secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        text = f"denied by TLS, on this side: {error.verify_message}"
        attempts = (f"{own.authority} is of another authority: copy the ca.crt of the flow", "see `caneflow keys list`")
        return Finding(node=endpoint, state="bad", text=text, attempts=attempts)
    except ssl.SSLError as error:
        text = f"denied by TLS, on the other side: {_reason(error)}"
        attempts = (
            f"make {own.certificate.name} with the flow's own ca.key",
            "until when does it hold? caneflow keys list",
        )
        return Finding(node=endpoint, state="bad", text=text, attempts=attempts)
    except OSError as error:
        text = f"listens, but does not speak TLS: {error.strerror or error}"
        return Finding(node=endpoint, state="bad", text=text, attempts=(f"--at tcp/{endpoint.partition('/')[2]}",))
    return Finding(node=endpoint, state="ok", text=f"TLS, and it takes {own.certificate.name}")


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).lower().replace("_", " ")


# --- what answers -----------------------------------------------------------------------------------------------
