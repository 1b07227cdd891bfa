"""Follows a running flow from outside: its samples, its state, its end, and its next run under the same name."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

from caneflow.messages import SAMPLES, stream_of
from caneflow.messages.control import FlowStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import ANY, Attached, Heard, attached
from caneflow.runtime.hosts.attached.flow_events import Began, Came, Ended, Event, Told
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.site import DEFAULT_KEYS

MOST_WAITING = 20_000  # samples that this process may be behind; what comes beyond is left out here, and counted
STATUS_PERIOD = 1.0  # s between two questions to the launchers
LOOK_PERIOD = 0.2  # s between two looks at what was said, while no sample comes
SEARCH_PERIOD = 0.5  # s between two looks for a flow that is to come back


def followed(flow: str | None, at: str | None = None, keys: Path = DEFAULT_KEYS) -> Generator[Event, None, None]:
    """What happens in the flow `flow` on this machine, or at `at`; it goes on until the iterator is closed.

    The flow is never held up: what cannot be taken in time is left out, and counted. After `Ended` the next event is
    `Began`, when the flow is started again. Raises DataflowError when there is no such flow to begin with.
    """
    with contextlib.ExitStack() as stack:
        here = stack.enter_context(attached(flow, at, keys))
        name = here.flow
        while True:
            status = here.status()
            yield Began(name, status)
            yield from _until_its_end(here, status, local=at is None)
            yield Ended(name)
            stack.close()
            here = _found_again(stack, name, at, keys)


def _found_again(stack: contextlib.ExitStack, flow: str, at: str | None, keys: Path) -> Attached:
    while True:
        with contextlib.suppress(DataflowError):
            here = stack.enter_context(attached(flow, at, keys))
            here.status()
            return here
        stack.close()
        time.sleep(SEARCH_PERIOD)


def _until_its_end(here: Attached, status: FlowStatus, *, local: bool) -> Iterator[Event]:
    inbox: queue.Queue[tuple[Heard, int]] = queue.Queue(MOST_WAITING)
    unheard = 0

    def hear(heard: Heard) -> None:  # on Zenoh's thread: nothing but a put that does not wait
        nonlocal unheard
        try:
            inbox.put_nowait((heard, time.time_ns()))
        except queue.Full:
            unheard += 1

    kinds = {edge.writer: edge.schema for edge in status.edges}
    # Without a limit, so that the inquiry never waits for a reader that has gone: it says one thing a second.
    said: queue.SimpleQueue[Told | None] = queue.SimpleQueue()
    inquiry = _Inquiry(here, lambda status: said.put(Told(status, unheard)), lambda: said.put(None), local=local)
    with here.samples([(ANY, ANY)], hear), inquiry:
        while True:
            with contextlib.suppress(queue.Empty):
                yield from _came(*inbox.get(timeout=LOOK_PERIOD), kinds)
            while not said.empty():
                told = said.get()
                if told is None:
                    return
                yield told


def _came(heard: Heard, received: int, kinds: dict[str, str]) -> Iterator[Came]:
    with contextlib.suppress(ValueError):  # no sample's key
        node, port = stream_of(heard.key)
        kind = SAMPLES.get(heard.schema) or SAMPLES.get(kinds.get(f"{node}/{port}", ""))
        yield Came(node, port, kind, heard.schema, heard.payload, received)


class _Inquiry:
    """Asks the launchers once a second how the flow is, on a thread of its own; a context manager."""

    def __init__(
        self, here: Attached, tell: Callable[[FlowStatus], None], end: Callable[[], None], *, local: bool
    ) -> None:
        self._here = here
        self._tell = tell
        self._end = end
        self._local = local
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="inquiry", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _ask(self) -> None:
        while not self._stopped.wait(STATUS_PERIOD):
            try:
                self._tell(self._here.status())
            except DataflowError:
                if not self._local or self._here.flow not in {found.flow for found in running_flows()}:
                    self._end()
                    return


@contextlib.contextmanager
def telling(flow: str, tell: Callable[[FlowStatus], None]) -> Iterator[None]:
    """Call `tell` once a second with the state of a flow of this machine, on a thread of its own, for a node of it.

    While no launcher answers, as in a run of one process, nothing is told.
    """
    stopped = threading.Event()

    def ask() -> None:
        while not stopped.wait(STATUS_PERIOD):
            with contextlib.suppress(DataflowError), attached(flow) as here:
                while not stopped.wait(STATUS_PERIOD):
                    tell(here.status())

    thread = threading.Thread(target=ask, name="inquiry", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()
