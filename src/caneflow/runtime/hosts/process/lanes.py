"""In a replay, all that comes for one input port, in order, on a thread of its own, which may block."""

import threading
import time
from collections.abc import Callable

from caneflow.runtime.hosts.process.events import Event, Stopped
from caneflow.runtime.hosts.process.inbox import Inbox

HEARING_OUT = 1.0  # s, at most and for all lanes, for what has come when a node is to end


class Lane:
    """The thread of one input port.

    Zenoh's receiving thread never waits for it: two nodes that wait for each other's would wait forever. And a mark or
    an answer never overtakes the samples that its writer sent before it: they would seem missing.
    """

    def __init__(self, name: str, inbox: Inbox[Event], bring: Callable[[Event], None]) -> None:
        self._inbox = inbox
        self.put = inbox.put
        self._bring = bring
        self._thread = threading.Thread(target=self._bring_all, name=name, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Bring what has come, and no more."""
        self._inbox.put(Stopped())

    def wait_for_end(self, until: float) -> None:
        """Wait for that, up to `until` (s, monotonic)."""
        self._thread.join(max(0.0, until - time.monotonic()))

    @property
    def held(self) -> int:
        """What waits, in bytes."""
        return self._inbox.held

    def _bring_all(self) -> None:
        while type(event := self._inbox.get()) is not Stopped:
            self._bring(event)
