"""`caneflow view`: a running flow, or a recording, in the browser; and the same as a node of a graph.

settings of the node  port : int   on 127.0.0.1; 0 for any that is free
in                    any number of streams, of any message
"""

import contextlib
import logging
import queue
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from annotated_types import Ge, Le

from caneflow.errors import CaneflowError, not_installed
from caneflow.messages import SAMPLES, MessageError, Sample, decode, stream_of
from caneflow.messages.control import FlowStatus
from caneflow.messages.registry import SCHEMA
from caneflow.messages.rig import Rig, read_rig
from caneflow.options import At, Keys
from caneflow.runtime import Context, Sink
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import ANY, DEFAULT_KEYS, Attached, Heard, attached
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.node import run
from caneflow.viewing.live import LiveStreams
from caneflow.viewing.recorded import RecordedStreams

if TYPE_CHECKING:
    from caneflow.viewing.server import Feed, PageServer

log = logging.getLogger(__name__)

MOST_WAITING = 20_000  # samples that this process may be behind; what comes beyond is left out here, and counted
STATUS_PERIOD = 1.0  # s
SEARCH_PERIOD = 0.5  # s between two looks for a flow that is to come back
LAST_WORDS = 0.15  # s that a page is given to hear of the end


def command(
    what: Annotated[
        str | None, typer.Argument(metavar="[FLOW|REC]", help="A running flow's name, or a recording.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    port: Annotated[int, typer.Option(min=0, max=65535, help="On 127.0.0.1; 0: any that is free.")] = 0,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in the browser of this machine.")] = False,
) -> None:
    """Show a running flow in the browser: track, speed, range-Doppler map, IMU, nodes and edges; or a recording.

    Prints the page's address, with the key without which it shows nothing, and serves it until Ctrl-C. The page is
    for this machine only; from another, tunnel to it: ssh -L 8765:127.0.0.1:8765 HOST, with --port 8765. Lengths are
    in m, speeds in m/s, angles in degrees or rad, times in s. A view never holds up the flow.

    Example: caneflow view cane --open
    """
    with contextlib.suppress(KeyboardInterrupt):
        if what is not None and (Path(what).is_file() or Path(what).suffix == ".mcap"):
            _show_recording(Path(what), port, open_browser=open_browser)
        else:
            _show_flow(what, at, keys, port, open_browser=open_browser)


def _show_recording(path: Path, port: int, *, open_browser: bool) -> None:
    with RecordedStreams(path) as streams, serving(streams, port) as server:
        _say(server, open_browser=open_browser)
        streams.read()
        if streams.problem:
            raise CaneflowError(streams.problem)
        while True:
            time.sleep(1.0)


def _show_flow(flow: str | None, at: str | None, keys: Path, port: int, *, open_browser: bool) -> None:
    """Show a flow, and when it has ended and is started again, the new one."""
    with attached(flow, at, keys) as here:
        name, status = here.flow, here.status()
        streams = _streams(status)
        with serving(streams, port) as server:
            _say(server, open_browser=open_browser)
            _relay(here, status, streams, local=at is None)
            while True:
                print(f"{name} has ended; this goes on when it is started again (Ctrl-C ends it)", flush=True)
                with _again(name, at, keys) as (here, status):
                    streams = _streams(status)
                    server.show(streams)
                    _relay(here, status, streams, local=at is None)


@contextmanager
def _again(flow: str, at: str | None, keys: Path) -> Iterator[tuple[Attached, FlowStatus]]:
    """Join the flow as soon as there is one of that name again."""
    with contextlib.ExitStack() as stack:
        while True:
            with contextlib.suppress(DataflowError):
                here = stack.enter_context(attached(flow, at, keys))
                status = here.status()
                break
            stack.pop_all().close()
            time.sleep(SEARCH_PERIOD)
        yield here, status


def _streams(status: FlowStatus) -> LiveStreams:
    return LiveStreams(flow=status.flow, rig=read_rig(status.rig), live=False if status.replay else None)


def _relay(here: Attached, status: FlowStatus, streams: LiveStreams, *, local: bool) -> None:
    """Hand on what the flow says, until it has ended."""
    inbox: queue.Queue[tuple[Heard, int]] = queue.Queue(MOST_WAITING)
    unheard = 0

    def hear(heard: Heard) -> None:  # on Zenoh's thread: nothing but a put that does not wait
        nonlocal unheard
        try:
            inbox.put_nowait((heard, time.time_ns()))
        except queue.Full:
            unheard += 1

    kinds = {edge.writer: edge.schema for edge in status.edges}
    with here.samples([(ANY, ANY)], hear), _Inquiry(here, streams, lambda: unheard, local=local) as inquiry:
        while not inquiry.ended:
            with contextlib.suppress(queue.Empty):
                heard, received = inbox.get(timeout=0.2)
                _take(streams, heard, received, kinds)
    streams.end()


def _take(streams: LiveStreams, heard: Heard, received: int, kinds: dict[str, str]) -> None:
    with contextlib.suppress(ValueError, MessageError):  # the readers count and name what cannot be read
        name = "/".join(stream_of(heard.key))
        schema = heard.schema if SCHEMA.fullmatch(heard.schema) else kinds.get(name, "")
        message = decode(heard.payload, SAMPLES.get(schema, Sample))  # of a user's own type: its stamp and number
        streams.take(name, message, received, schema)


class _Inquiry:
    """Asks the launchers once a second how the flow is, on a thread of its own; a context manager."""

    def __init__(self, here: Attached, streams: LiveStreams, unheard: Callable[[], int], *, local: bool) -> None:
        self._here = here
        self._streams = streams
        self._unheard = unheard
        self._local = local
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="inquiry", daemon=True)
        self.ended = False

    def __enter__(self) -> "_Inquiry":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _ask(self) -> None:
        while not (self._stopped.wait(STATUS_PERIOD) or self.ended):
            try:
                self._streams.tell(self._here.status(), self._unheard())
            except DataflowError:
                self.ended = not self._local or self._here.flow not in {found.flow for found in running_flows()}


@contextmanager
def serving(feed: "Feed", port: int) -> Iterator["PageServer"]:
    """The page's server; raises CaneflowError when what it needs is not installed."""
    try:
        from caneflow.viewing.server import PageServer
    except ModuleNotFoundError as error:
        raise CaneflowError(not_installed(str(error.name), "view")) from error
    with PageServer(feed, port=port) as server:
        yield server


def _say(server: "PageServer", *, open_browser: bool) -> None:
    print(f"{server.address}  (Ctrl-C ends it)", flush=True)
    if open_browser:
        webbrowser.open(server.address)


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Where the page is."""

    port: Annotated[int, Ge(0), Le(65535)] = 0  # on 127.0.0.1; 0: any that is free. The log says the address


class View(Sink):
    """The page as a node: shows the streams that the graph wires to it."""

    Settings = ViewSettings

    def __init__(self, settings: ViewSettings, context: Context) -> None:
        self._rig: Rig = context.rig
        self._streams: LiveStreams | None = None
        self._open = contextlib.ExitStack()
        self._server = self._open.enter_context(serving(LiveStreams(flow="", rig=self._rig), settings.port))
        log.info("the page is at %s", self._server.address)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Show one sample."""
        flow, _, name = key.partition("/")
        if self._streams is None:
            self._begin(flow)
        assert self._streams is not None
        self._streams.take(name, message, time)

    def idle(self, time: int) -> None:
        """The page's clock is its own."""

    def finish(self) -> None:
        """Tell the page that the flow has ended."""
        if self._streams is not None:
            self._streams.end()
        time.sleep(LAST_WORDS)
        self._open.close()

    def _begin(self, flow: str) -> None:
        """The first sample tells the flow's name: with it the launcher can be asked for nodes and edges."""
        self._streams = LiveStreams(flow=flow, rig=self._rig)
        self._server.show(self._streams)
        with contextlib.suppress(DataflowError):  # no launcher on this machine: the page shows what comes here
            here = self._open.enter_context(attached(flow))
            self._open.enter_context(_Inquiry(here, self._streams, lambda: 0, local=True))


if __name__ == "__main__":
    run(View)
