"""A session on the Zenoh network of another system, with the keys, attachments and tokens that that system wants.

Apart from the flow's own session, always: the flow's links have access control, short leases and no strangers.
"""

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh
import zenoh.ext

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.session import open_session

LEASE = 10_000  # ms, Zenoh's own default: the other side is not ours, and may be slow
SETTLING = 1.0  # s that a new publisher sends everything: who hears it is told a moment later
POLL = 0.01  # s between two looks at who hears it
LOOPBACK = ("tcp/127.", "tcp/localhost:", "tcp/[::1]:", "udp/127.", "unixsock-stream/")


class Foreign(NamedTuple):
    """What came from the other system."""

    key: str
    payload: bytes
    attachment: bytes | None


class Outlet:
    """One key that is published, and whether anybody hears it."""

    def __init__(self, publisher: Any, *, watched: bool, patient: bool) -> None:
        """`watched`: it can tell who hears it. `patient`: in its first second it waits until someone does."""
        self._publisher = publisher
        self._watched = watched
        self._patient = patient
        self._settled_at = time.monotonic() + SETTLING
        # Zenoh tells of changes: to ask it costs a sample's whole handling, as it hands its receiving thread over.
        self._matching = False
        if watched:
            told = zenoh.handlers.Callback(self._take_status, indirect=False)
            self.listener = publisher.declare_matching_listener(told)
            self._matching = publisher.matching_status.matching

    @property
    def is_heard(self) -> bool:
        """Whether someone listens, as far as this session knows; in its first second: yes."""
        if not self._watched:
            return True
        while not self._matching:
            if time.monotonic() >= self._settled_at:
                return False
            if not self._patient:
                return True
            time.sleep(POLL)  # what is sent now would reach nobody, not even those that listen already
        return True

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Send one message."""
        self._publisher.put(payload, attachment=attachment)

    def _take_status(self, status: zenoh.MatchingStatus) -> None:
        self._matching = status.matching


class Neighbour:
    """A place in another system's network; a context manager, whose end takes its tokens and keys away."""

    def __init__(self, *, router: str | None = None, listen: str | None = None, waits: bool = False) -> None:
        """`router`: where theirs is; else this is one itself, at `listen`. `waits`: a put blocks and loses nothing.

        Raises DataflowError when there is no router, or when `listen` is not on this machine alone.
        """
        if listen is not None and not listen.startswith(LOOPBACK):
            raise DataflowError(f"{listen}: is open to other machines, without keys; expected e.g. tcp/127.0.0.1:7447")
        where = (
            {"mode": "router", "listen": [listen]} if listen is not None else {"mode": "client", "connect": [router]}
        )
        more = {"transport/link/tx/lease": LEASE, "timestamping/enabled": True}  # stamps: for what is kept
        self._session = open_session(**where, replay=waits, more=more)
        self._control = zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP
        self._waits = waits
        self._held: list[Any] = []  # tokens, publishers and subscribers
        self._lock = threading.Lock()
        self.identity = str(self._session.info.zid())

    def token(self, key: str) -> None:
        """Say that something is there, for as long as this session is."""
        self._hold(self._session.liveliness().declare_token(key))

    def outlet(self, key: str, *, kept: bool = False) -> Outlet:
        """Publish on `key`; `kept`: the last message is there for those that come later."""
        if kept:
            cache = zenoh.ext.CacheConfig(1)
            publisher: Any = zenoh.ext.declare_advanced_publisher(
                self._session, key, congestion_control=self._control, cache=cache, publisher_detection=True
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=self._control)
        self._hold(publisher)
        return Outlet(publisher, watched=not kept, patient=self._waits)

    def hear(self, key: str, take: Callable[[Foreign], None], *, kept: bool = False) -> None:
        """Hand what comes on `key` to `take`, on a thread of Zenoh's: it must not wait.

        `kept`: also the last message of publishers that keep it, which came before.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            attached = None if sample.attachment is None else sample.attachment.to_bytes()
            take(Foreign(str(sample.key_expr), sample.payload.to_bytes(), attached))

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        if kept:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            self._hold(zenoh.ext.declare_advanced_subscriber(self._session, key, handler, history=history))
        else:
            self._hold(self._session.declare_subscriber(key, handler))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave; everything that was declared here goes."""
        with self._lock:
            held, self._held = self._held, []
        for each in held:
            each.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]  # the stub lacks its types

    def _hold(self, declared: Any) -> None:
        with self._lock:
            self._held.append(declared)
