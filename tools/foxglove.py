"""`caneflow foxglove`: a running flow, or a recording, in Foxglove and its like; and the same as a node of a graph.

settings of the node  port : int         on 127.0.0.1; 0 for any that is free
                      world, tf : str    as the options of the command
in                    any number of streams, of any message
"""

import contextlib
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from annotated_types import Ge, Le

from caneflow.bridges.foxglove_channels import FoxgloveChannels, sdk
from caneflow.bridges.frames import frames_of
from caneflow.bridges.ros_messages import RosMessages, tf_stream
from caneflow.bridges.ros_types import RosTypes
from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, MessageError, Sample, decode, stream_of
from caneflow.messages.control import FlowStatus
from caneflow.messages.rig import Rig, read_rig
from caneflow.options import At, Keys
from caneflow.recording import Recorded, Recording
from caneflow.recording.playback import Playback, PlaybackState
from caneflow.runtime import Context, Sink
from caneflow.runtime.hosts.attached.flow_events import Began, Came, Ended, Event, Told
from caneflow.runtime.node import run
from caneflow.runtime.site import DEFAULT_KEYS

log = logging.getLogger(__name__)

HOST = "127.0.0.1"  # the protocol has no key and no account
DEFAULT_PORT = 8765  # where Foxglove looks first
BACKLOG = 8192  # messages that a client may be behind; then it loses the oldest
Kinds = Mapping[str, type[Sample] | None]  # by stream, node/port


def command(
    what: Annotated[
        str | None, typer.Argument(metavar="[FLOW|REC]", help="A running flow's name, or a recording.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="On 127.0.0.1; 0: any that is free.")] = DEFAULT_PORT,
    play: Annotated[
        bool, typer.Option("--play", help="Of a recording: begin at once, not when the viewer asks.")
    ] = False,
    world: Annotated[
        str | None, typer.Option(metavar="NAME", help="Frame of the poses; by default odom, for a room map.")
    ] = None,
    tf: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Poses that fill /tf, where several streams could.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
) -> None:
    """Serve a running flow, or a recording, to Foxglove, Lichtblick or PlotJuggler on this machine.

    Prints the address to open there, and serves it until Ctrl-C. From another machine, tunnel to it:
    ssh -L 8765:127.0.0.1:8765 HOST. A recording is played by the viewer's own controls. Only what a viewer shows is
    converted, and a flow is never held up.

    Example: caneflow foxglove cane
    """
    naming = Naming(world, tf)
    with contextlib.suppress(KeyboardInterrupt):
        if what is not None and (Path(what).is_file() or Path(what).suffix == ".mcap"):
            _serve_recording(Path(what), port, naming, play=play)
        else:
            _serve_flow(what, at, keys, port, naming)


@dataclass(frozen=True)
class Naming:
    """How frames are called, and which poses move them."""

    world: str | None
    tf: str | None


def _serve_flow(flow: str | None, at: str | None, keys: Path, port: int, naming: Naming) -> None:
    from caneflow.runtime.hosts.attached.followed import followed  # here, as it takes Zenoh: a recording does not

    with contextlib.closing(followed(flow, at, keys)) as events:
        for event in events:
            if isinstance(event, Began):
                port = _serve_run(event, events, port, naming)
                print(f"{event.flow} has ended; this goes on when it is started again (Ctrl-C ends it)", flush=True)


def _serve_run(began: Began, events: Iterator[Event], port: int, naming: Naming) -> int:
    """Serve what the flow says until it has ended; the port, on which the next run is served again."""
    kinds = {edge.writer: SAMPLES.get(edge.schema) for edge in began.status.edges}
    with FoxgloveServer(began.flow, read_rig(began.status.rig), kinds, port, naming) as server:
        server.tell_rig(time.time_ns())
        server.tell_status(began.status)
        print(f"{server.address}  {began.flow} (Ctrl-C ends it)", flush=True)
        for event in events:
            match event:
                case Came():
                    server.take(event)
                case Told():
                    server.tell_status(event.status)
                case Ended():
                    break
        return server.port


def _serve_recording(path: Path, port: int, naming: Naming, *, play: bool) -> None:
    with Recording(path) as source:
        if naming.tf is not None:
            source.stream(*naming.tf.split("/", 1))
        kinds = {f"{each.node}/{each.port}": SAMPLES.get(each.schema) for each in source.streams.values() if each.count}
        playback: Playback

        def take(sample: Recorded) -> None:
            server.take_recorded(sample)

        def tell(state: PlaybackState) -> None:
            server.tell_playback(state)

        playback = Playback(source, take, tell)
        with FoxgloveServer(path.name, source.validated_rig(), kinds, port, naming, playback) as server:
            server.tell_rig(playback.span[0])
            server.tell_settings({}, source.rig)
            print(f"{server.address}  {path} (Ctrl-C ends it)", flush=True)
            if play:
                playback.control(playing=True, speed=1.0)
            playback.run()


class FoxgloveServer:
    """A server of Foxglove's protocol for one flow or one recording; a context manager."""

    def __init__(
        self,
        name: str,
        rig: Rig,
        kinds: Kinds,
        port: int,
        naming: Naming,
        playback: Playback | None = None,
    ) -> None:
        """`kinds`: the streams whose channels are there from the start.

        Raises CaneflowError for a port that is taken, and where what it needs is not installed.
        """
        foxglove = sdk()
        from foxglove.websocket import Capability

        types = RosTypes()
        context = foxglove.Context()
        messages = RosMessages(types, frames_of(rig, naming.world), tf=tf_stream(kinds, naming.tf))
        self._channels = FoxgloveChannels(context, messages)
        for stream, kind in kinds.items():
            node, _, of = stream.partition("/")
            self._channels.declare(node, of, kind)
        self._listener = _Listener(self._channels, playback)
        capabilities = [Capability.Parameters, *([Capability.Time, Capability.PlaybackControl] if playback else [])]
        try:
            self._server = foxglove.start_server(
                name=name,
                host=HOST,
                port=port,
                capabilities=capabilities,
                server_listener=self._listener,
                context=context,
                playback_time_range=playback.span if playback else None,
                message_backlog_size=BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise CaneflowError(f"{HOST}:{port}: cannot be served on: {error}; use another --port") from error
        self.port: int = self._server.port
        self.address = f"ws://{HOST}:{self.port}"

    def take(self, came: Came) -> None:
        """Serve a sample of a flow, if a viewer shows what it becomes."""
        with contextlib.suppress(MessageError):  # the readers count and name what cannot be read
            if came.kind is None:
                self._channels.take_unknown(came.node, came.port, came.schema, came.payload)
            elif self._channels.is_heard(came.node, came.port, came.kind):
                self._channels.take(came.node, came.port, decode(came.payload, came.kind))

    def take_recorded(self, sample: Recorded) -> None:
        """Serve a sample of a recording, likewise."""
        if sample.kind is not None and self._channels.is_heard(sample.node, sample.port, sample.kind):
            self._channels.take(sample.node, sample.port, sample.decoded())

    def take_message(self, node: str, port: str, message: Sample) -> None:
        """Serve a sample that is decoded already."""
        self._channels.take(node, port, message)

    def tell_rig(self, stamp: int) -> None:
        """Serve what is bolted on, at `stamp` (ns), to viewers that come later as well."""
        self._channels.tell_rig(stamp)

    def tell_status(self, status: FlowStatus) -> None:
        """Serve how nodes and wires are, and the settings of the nodes."""
        self._channels.tell_status(status, time.time_ns())
        self.tell_settings({node.node: node.settings for node in status.nodes}, status.rig)

    def tell_settings(self, settings: Mapping[str, Any], rig: Mapping[str, Any]) -> None:
        """Let viewers read the settings by node, and the rig, as parameters."""
        self._listener.values = {**flat(settings), **flat({"rig": rig})}

    def tell_playback(self, state: PlaybackState) -> None:
        """Move the viewers' clock; say when the end is reached."""
        self._server.broadcast_time(state.at)
        if state.ended:
            self._server.broadcast_playback_state(_theirs(state, did_seek=False, request=""))

    def __enter__(self) -> "FoxgloveServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()


class _Listener:
    """What viewers ask for; called on threads of the library's."""

    def __init__(self, channels: FoxgloveChannels, playback: Playback | None) -> None:
        self._channels = channels
        self._playback = playback
        self.values: dict[str, Any] = {}  # parameters by name

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._channels.say_again(channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """The channels ask who is there."""

    def on_parameters_subscribe(self, names: list[str]) -> None:
        """They do not change while a flow runs."""

    def on_parameters_unsubscribe(self, names: list[str]) -> None:
        """Likewise."""

    def on_get_parameters(self, client: Any, names: list[str], request_id: str | None = None) -> list[Any]:
        from foxglove.websocket import Parameter

        values = self.values
        return [Parameter(name, value=values[name]) for name in names or values if name in values]

    def on_set_parameters(self, client: Any, parameters: list[Any], request_id: str | None = None) -> list[Any]:
        """Nothing is set: the answer has the values as they are."""
        return self.on_get_parameters(client, [each.name for each in parameters])

    def on_playback_control_request(self, request: Any) -> Any:
        from foxglove.websocket import PlaybackCommand

        if self._playback is None:
            return None
        playing = request.playback_command == PlaybackCommand.Play
        state = self._playback.control(playing=playing, speed=request.playback_speed, at=request.seek_time)
        return _theirs(state, did_seek=request.seek_time is not None, request=request.request_id)


def _theirs(state: PlaybackState, *, did_seek: bool, request: str) -> Any:
    from foxglove.websocket import PlaybackState as Theirs
    from foxglove.websocket import PlaybackStatus

    status = PlaybackStatus.Ended if state.ended else PlaybackStatus.Playing if state.playing else PlaybackStatus.Paused
    return Theirs(status, state.at, state.speed, did_seek, request)


def flat(values: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Maps within maps as names with dots; what is not known is left out, and so are empty lists."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        match value:
            case Mapping():
                found |= flat(value, f"{before}{name}.")
            case bool() | int() | float() | str():
                found[f"{before}{name}"] = value
            case list() | tuple() if value and all(isinstance(each, int | float) for each in value):
                found[f"{before}{name}"] = [float(each) for each in value]
            case None | [] | ():
                continue
            case _:
                found[f"{before}{name}"] = str(value)
    return found


@dataclass(frozen=True, kw_only=True)
class FoxgloveSettings:
    """Where it is served, and how things are called there."""

    __pydantic_config__ = {"extra": "forbid"}

    port: Annotated[int, Ge(0), Le(65535)] = DEFAULT_PORT  # on 127.0.0.1; 0: any that is free. The log says which
    world: str | None = None  # frame of the poses; None: odom, for a room map
    tf: str | None = None  # node/port of the poses that fill /tf, where several streams could


class Foxglove(Sink):
    """The server as a node: of the streams that the graph wires to it."""

    Settings = FoxgloveSettings

    def __init__(self, settings: FoxgloveSettings, context: Context) -> None:
        from caneflow.runtime.hosts.attached.followed import telling

        flow = next((key.partition("/")[0] for key in context.keys.values()), context.node)
        kinds = {key.partition("/")[2]: context.ports[port] for port, key in context.keys.items()}
        self._open = contextlib.ExitStack()
        naming = Naming(settings.world, settings.tf)
        self._server = self._open.enter_context(FoxgloveServer(flow, context.rig, kinds, settings.port, naming))
        self._server.tell_rig(time.time_ns())
        self._open.enter_context(telling(flow, self._server.tell_status))
        log.info("%s serves %s", self._server.address, flow)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Serve one sample."""
        self._server.take_message(*stream_of(key), message)

    def idle(self, time: int) -> None:
        """Nothing waits here."""

    def finish(self) -> None:
        """End the server."""
        self._open.close()


if __name__ == "__main__":
    run(Foxglove)
