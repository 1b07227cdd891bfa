"""Zenoh sessions with explicit links: no discovery, one dialling side per edge, nothing beyond what is written.

The defaults of Zenoh lose data silently: peers do not relay for peers, a lost link is dialled again after up to
4 s, a frozen peer is noticed after 10 s, and a put that blocks gives up after 5 s and closes the link.
"""

import ctypes
import json
import os
import random
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import get_ident
from typing import Any, Literal

import zenoh

from caneflow.runtime.errors import DataflowError

LIVE_LEASE = 1_000  # ms until a frozen peer is given up
REPLAY_LEASE = 60_000  # ms: a replay waits for a reader that stalls, it does not lose it
WAIT_BEFORE_CLOSE = 600_000_000  # us that a replay's blocking put waits before the link is closed
# A burst of 100 small express samples with Zenoh's default queue of 2 batches and 1 ms: 12 % dropped on loopback.
# With these: none, and no put took longer than 3 ms.
BATCHES = 16  # that may wait to be sent; Zenoh's greatest
FULL = ("data", "data_low")  # the priorities of samples: to readers, and to tools
WAIT_BEFORE_DROP = 20_000  # us that a live put waits before the sample is dropped
PRIORITIES = (
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
)
THREADS = {  # read once by Zenoh, when the first session of a process opens
    # One thread that waits for all links and takes what comes, instead of one that waits and two that take: none wakes
    # another for a sample. What is sent has its own.
    "ZENOH_RUNTIME": "(rx: (worker_threads: 1), net: (handover: rx))",
    "RUST_MIN_STACK": str(8 * 2**20),  # bytes: operators run on that thread, and Python is used to 8 MiB, not to 2
}
# What Zenoh prints unless RUST_LOG says. Where access control has refused a declaration, Zenoh prints an error for its
# end ("Unknown token id=2"), on the standard output; that one is expected.
LOGGED = "error,zenoh::api::session=off,zenoh::net::routing::hat=off,zenoh::net::routing::dispatcher=off"
RETRY = {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 2}
SENT_AT_BYTES = 8  # of a sample's attachment: ns, little-endian
UNIX = "unixsock-stream"  # Zenoh's word for Unix sockets
LONGEST_PATH = 99  # bytes of a Unix socket's; Linux takes 107
MOST_SOCKETS = 9_999  # of one run
PORTS = range(20_000, 32_000)  # below Linux's ephemeral ports, so that no outgoing connection takes one


def open_session(
    *,
    mode: str = "peer",
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    replay: bool = False,
    identity: str = "",
    more: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """A session on exactly these endpoints; raises DataflowError when it cannot be opened.

    `identity`: its id in hexadecimal; "": a random one. `more`: further settings of Zenoh, by path.
    """
    for variable, value in THREADS.items():
        os.environ.setdefault(variable, value)
    zenoh.init_log_from_env_or(LOGGED)
    # Live, a router that waits for a dead link longer than the lease would hold up the nodes that dial it.
    patience = WAIT_BEFORE_CLOSE if replay else LIVE_LEASE * 1_000
    settings = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "open/return_conditions/connect_scouted": False,
        "transport/link/tx/lease": REPLAY_LEASE if replay else LIVE_LEASE,
        "transport/link/tx/queue/size": {priority: BATCHES if priority in FULL else 2 for priority in PRIORITIES},
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": patience,
        **({"id": identity} if identity else {}),
        **(more or {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join((*listen, *connect))
        cause = str(error).partition(" at /")[0].strip()  # Zenoh adds the place in its own source
        if cause.startswith("Unable to connect"):
            refused = ", or one side refuses the other's certificate" if where.startswith(("tls/", "quic/")) else ""
            cause = f"nobody answers there{refused}; `caneflow doctor --at {where}` finds the cause"
        raise DataflowError(f"no Zenoh session on {where}: {cause}") from error


def protocol(endpoint: str) -> str:
    """Of an endpoint: tcp, tls, unixsock-stream; "" of none."""
    return endpoint.partition("/")[0]


class KnownThreads:
    """Those of Zenoh's threads that hold on to what Python keeps for a thread.

    A thread that Python did not start is given a new state for every callback and loses it after: as much work as
    decoding a sample, and three times that with cold caches.
    """

    def __init__(self) -> None:
        self._known: set[int] = set()

    def know_this_one(self) -> None:
        """Let the thread that calls keep its state as long as it lives."""
        me = get_ident()
        if me not in self._known:
            self._known.add(me)
            ctypes.pythonapi.PyGILState_Ensure()  # without the release that would end it


def sending_now() -> bytes:
    """What a writer attaches to a sample, to say when it was sent."""
    return time.time_ns().to_bytes(SENT_AT_BYTES, "little")


def sent_at(sample: zenoh.Sample) -> int:
    """When the writer put the sample (ns), as it says in the attachment; 0: it does not say."""
    if sample.attachment is None:
        return 0
    raw = sample.attachment.to_bytes()
    return int.from_bytes(raw, "little") if len(raw) == SENT_AT_BYTES else 0


class Ports:
    """Loopback ports for the processes of one run, free now and reserved among the flows of this machine."""

    def __init__(self) -> None:
        self._reservations: list[socket.socket] = []

    def __enter__(self) -> "Ports":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def endpoint(self) -> str:
        """A loopback endpoint that nobody listens on."""
        for port in random.sample(PORTS, k=200):  # spreads flows over the ports; nothing secret
            if self._reserve(port):
                return f"tcp/127.0.0.1:{port}"
        raise DataflowError(f"no free port on 127.0.0.1 within {PORTS.start}..{PORTS.stop - 1}")

    def release(self) -> None:
        """Give the reservations back."""
        for reservation in self._reservations:
            reservation.close()
        self._reservations.clear()

    def _reserve(self, port: int) -> bool:
        # An abstract Unix socket is a lock that the kernel drops when this process dies, however it dies.
        reservation = socket.socket(socket.AF_UNIX)
        try:
            reservation.bind(f"\0caneflow-port-{port}")
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(("127.0.0.1", port))
        except OSError:
            reservation.close()
            return False
        self._reservations.append(reservation)
        return True


class Sockets:
    """Unix sockets for the processes of one run, in its private folder: nobody else on this machine can dial them."""

    def __init__(self, folder: Path) -> None:
        """Raises DataflowError when the sockets of `folder` cannot have names that Zenoh takes."""
        self._folder = folder
        self._number = 0
        longest = len(os.fsencode(folder / str(MOST_SOCKETS)))
        if longest > LONGEST_PATH:
            raise DataflowError(
                f"{folder}: too long for Unix sockets in it ({longest} bytes with a number, at most {LONGEST_PATH}); "
                "set XDG_RUNTIME_DIR to a shorter folder of your own, or write `links: tcp` in the file"
            )
        if any(letter in "?#" or not letter.isprintable() for letter in str(folder)):
            raise DataflowError(
                f"{str(folder)!a}: a folder of Unix sockets may have no ?, # or control character in its name; "
                "set XDG_RUNTIME_DIR to another folder of your own, or write `links: tcp` in the file"
            )

    def __enter__(self) -> "Sockets":
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is reserved: they go with their folder."""

    def endpoint(self) -> str:
        """The endpoint of a socket that nobody listens on."""
        path = self._folder / str(self._number)
        self._number += 1
        return f"{UNIX}/{path}"


def local_links(links: Literal["unix", "tcp"], folder: Path) -> Ports | Sockets:
    """Endpoints for the links between the processes of one run, whose folder is `folder`."""
    return Sockets(folder) if links == "unix" else Ports()
