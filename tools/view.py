"""`caneflow view`: a running flow, or a recording, in the browser; and the same as a node of a graph.

settings of the node  port : int   on 127.0.0.1; 0 for any that is free
in                    any number of streams, of any message
"""

import contextlib
import logging
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from annotated_types import Ge, Le

from caneflow.errors import CaneflowError, not_installed
from caneflow.messages import Cue, MessageError, Sample, decode
from caneflow.messages.control import FlowStatus
from caneflow.messages.registry import SCHEMA
from caneflow.messages.rig import Rig, User, read_rig
from caneflow.options import At, Keys
from caneflow.runtime import Context, Sink
from caneflow.runtime.hosts.attached.flow_events import Began, Came, Ended, Told
from caneflow.runtime.node import run
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.viewing.live import LiveStreams
from caneflow.viewing.phone_page import PhonePageSettings, page_server, squares_of
from caneflow.viewing.recorded import RecordedStreams

if TYPE_CHECKING:
    from caneflow.viewing.server import Feed, PageServer

log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
LAST_WORDS = 0.15  # s that a page is given to hear of the end


def command(
    what: Annotated[
        str | None, typer.Argument(metavar="[FLOW|REC]", help="A running flow's name, or a recording.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    port: Annotated[int, typer.Option(min=0, max=65535, help="On 127.0.0.1; 0: any that is free.")] = 0,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the page in the browser of this machine.")] = False,
    phone: Annotated[
        bool, typer.Option("--phone", help="Serve the phone's page instead: cues as sound, vibration and words.")
    ] = False,
    listen: Annotated[
        str, typer.Option(metavar="ADDR", help="Of --phone: address of this machine; beyond loopback keys/page.crt.")
    ] = LOOPBACK,
) -> None:
    """Show a running flow in the browser: track, speed, range-Doppler map, IMU, nodes and edges; or a recording.

    Prints the page's address, with the key without which it shows nothing, and serves it until Ctrl-C. The page is
    for this machine only; from another, tunnel to it: ssh -L 8765:127.0.0.1:8765 HOST, with --port 8765. Lengths are
    in m, speeds in m/s, angles in degrees or rad, times in s. A view never holds up the flow.

    Example: caneflow view cane --open
    """
    with contextlib.suppress(KeyboardInterrupt):
        if phone:
            _serve_phone(what, at, keys, listen, port)
        elif what is not None and (Path(what).is_file() or Path(what).suffix == ".mcap"):
            _show_recording(Path(what), port, open_browser=open_browser)
        else:
            _show_flow(what, at, keys, port, open_browser=open_browser)


def _serve_phone(flow: str | None, at: str | None, keys: Path, listen: str, port: int) -> None:
    """Tell a phone the cues of a running flow, until it ends."""
    from caneflow.runtime.hosts.attached.followed import followed  # here, as it takes Zenoh: a recording does not

    with contextlib.closing(followed(flow, at, keys)) as events:
        began = next(events)
        assert isinstance(began, Began)
        guidance = (read_rig(began.status.rig).user or User()).guidance
        settings = PhonePageSettings(listen=listen, port=port, keys=str(keys))
        with page_server(settings, guidance, hears=True, senses=False) as server:
            print(*squares_of(server), f"{server.address}  (Ctrl-C ends it)", sep="\n", flush=True)
            for event in events:  # a flow that has ended is told as blind: no cue comes
                if isinstance(event, Came) and event.kind is Cue:
                    with contextlib.suppress(MessageError):
                        server.tell(decode(event.payload, Cue))


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
    from caneflow.runtime.hosts.attached.followed import followed  # here, as it takes Zenoh: a recording does not

    with contextlib.closing(followed(flow, at, keys)) as events:
        began = next(events)
        assert isinstance(began, Began)
        streams = _streams(began.status)
        with serving(streams, port) as server:
            _say(server, open_browser=open_browser)
            for event in events:
                match event:
                    case Began(status=status):
                        streams = _streams(status)
                        server.show(streams)
                    case Came():
                        _take(streams, event)
                    case Told(status, unheard):
                        streams.tell(status, unheard)
                    case Ended(name):
                        streams.end()
                        print(f"{name} has ended; this goes on when it is started again (Ctrl-C ends it)", flush=True)


def _streams(status: FlowStatus) -> LiveStreams:
    return LiveStreams(flow=status.flow, rig=read_rig(status.rig), live=False if status.replay else None)


def _take(streams: LiveStreams, came: Came) -> None:
    with contextlib.suppress(MessageError):  # the readers count and name what cannot be read
        message = decode(came.payload, came.kind or Sample)  # of a user's own type: its stamp and number
        schema = came.kind.schema if came.kind else came.schema
        streams.take(f"{came.node}/{came.port}", message, came.received, schema if SCHEMA.fullmatch(schema) else "")


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
        from caneflow.runtime.hosts.attached.followed import telling

        streams = self._streams = LiveStreams(flow=flow, rig=self._rig)
        self._server.show(self._streams)
        # Where no launcher answers, the page shows what comes here.
        self._open.enter_context(telling(flow, lambda status: streams.tell(status, 0)))


if __name__ == "__main__":
    run(View)
