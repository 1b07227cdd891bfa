"""Who may hold up a launcher: in a replay the flow's own nodes and machines, a tool never.

A launcher passes samples on to tools, and between machines. Where one of those links is full, Zenoh holds up the thread
that receives for all of them, if the sample's writer said BLOCK, as in a replay. So what goes to a tool is dropped
instead. Zenoh tells links apart by their protocol and by the id of the session at the other end: the sessions of a
flow's own nodes and launchers have ids that are known beforehand, and every other one is a tool.
"""

import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

import zenoh

from caneflow.messages import control_key

ID_BYTES = 16  # of a Zenoh session's id
# Zenoh refuses a second session of one id while it takes the first for alive, which after a cut is the lease: so one
# that is started again takes another id of its own.
NODE_STARTS = 16  # ids that a node takes in turn
LAUNCHER_STARTS = 256  # ids of a machine's launcher, of which it takes a random one
LAST_SAMPLES = 1.0  # s that tools have to take what is still on its way when a launcher ends
STANDARD_STREAMS = 2  # the last of their file descriptors: a service's may be sockets, and are none of Zenoh's


def node_id(run: str, node: str, start: int) -> str:
    """The id of a node's session, started for the `start`-th time in this run of its launcher."""
    return _session_id("node", run, node, start % NODE_STARTS)


def node_ids(run: str, node: str) -> list[str]:
    """All ids that a node's session may have."""
    return [node_id(run, node, start) for start in range(NODE_STARTS)]


def launcher_ids(flow: str, machine: str) -> list[str]:
    """All ids that the session of a machine's launcher may have."""
    return [_session_id("launcher", flow, machine, start) for start in range(LAUNCHER_STARTS)]


def tool_links(
    flow: str, protocols: Iterable[str], own: Sequence[str], *, replay: bool, router: str = ""
) -> dict[str, Any]:
    """Zenoh's settings for a launcher whose links of `protocols` are tools', but for the sessions `own` of its flow.

    `router`: the protocol of a link to a router in the middle, whose session has an id that nobody knows beforehand.
    It must lose nothing, so that no link of this protocol is taken for a tool's.

    Samples go to tools behind everything else, so that a question is answered however much waits. Nothing waits for
    room: a tool that takes less than it is sent would slow down the launcher to its own pace.
    """
    samples, words = f"{flow}/**", control_key(flow, "**")
    to_tools = {"link_protocols": sorted(set(protocols) - {router})}
    to_own = {"zids": list(own)}
    to_router = {"link_protocols": [router] if router else []}
    own_samples = ("block" if replay else "drop", "data")
    # The later rule counts: it makes links of the flow's own what they were. Batches hold more than one sample, and so
    # a burst, where the samples are not express.
    rules = [
        ("to tools", to_tools, [samples, words], ("drop", "data_low")),
        ("own samples", to_own, [samples], own_samples),
        ("own words", to_own, [words], ("block", "data")),
        ("samples to a router", to_router, [samples], own_samples),
    ]
    return {
        "qos/network": [
            {
                "id": name,
                **links,
                "flows": ["egress"],
                "messages": ["put", "delete"],
                "key_exprs": keys,
                "overwrite": {"congestion_control": congestion, "priority": priority, "express": False},
            }
            for name, links, keys, (congestion, priority) in rules
            if all(links.values())  # Zenoh refuses an empty list
        ],
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }


def closing_at_once(session: zenoh.Session) -> object:
    """Close links without a wait, for as long as what is returned is kept.

    Zenoh has the kernel wait for 10 s, at the end of a TCP link, until the other end has read everything (SO_LINGER).
    Where that one is frozen, the thread that receives for all links waits.
    """
    handler = zenoh.handlers.Callback(_end_lingering, indirect=False)
    return session.info.declare_link_events_listener(handler, history=True)


@contextmanager
def closed_in_time(session: zenoh.Session, listens: Iterable[str]) -> Iterator[zenoh.Session]:
    """A launcher's session for a block, then closed; a tool that does not take the last samples is cut off.

    Zenoh alone waits 10 s for one that is frozen and not yet given up, and then fails. `listens`: its own endpoints.
    """
    try:
        yield session
    finally:
        closing = threading.Thread(target=_close, args=(session,))
        closing.start()
        closing.join(LAST_SAMPLES)
        if closing.is_alive():
            _cut_links({endpoint.partition("/")[2] for endpoint in listens})
            closing.join()


def _close(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError):  # it could not say goodbye to someone
        session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types


def _cut_links(own_paths: Iterable[str]) -> None:
    """End every TCP link of this process, and those over the Unix sockets `own_paths`."""
    paths = set(own_paths)

    def cut(link: socket.socket) -> None:
        if link.family != socket.AF_UNIX or link.getsockname() in paths:
            link.shutdown(socket.SHUT_RDWR)

    _with_each_link(cut)


def _end_lingering(_: zenoh.LinkEvent) -> None:
    """Switch the wait off on every TCP socket of this process."""

    def end(link: socket.socket) -> None:
        if link.family != socket.AF_UNIX:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))

    _with_each_link(end)


def _with_each_link(act: Callable[[socket.socket], None]) -> None:
    """Let `act` have each connected stream socket of this process, but for the standard streams."""
    for number in sorted(int(path.name) for path in Path("/proc/self/fd").iterdir()):
        if number <= STANDARD_STREAMS:
            continue
        with suppress(OSError):  # it is not a socket, or closed meanwhile
            link = socket.socket(fileno=number)
            try:
                if link.type == socket.SOCK_STREAM and not link.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                    act(link)
            finally:
                link.detach()


def _session_id(*names: object) -> str:
    digest = blake2b(repr(names).encode(), digest_size=ID_BYTES).hexdigest()
    return "c" + digest[1:]  # Zenoh refuses leading zeros
