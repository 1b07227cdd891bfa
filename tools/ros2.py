"""`caneflow ros2`: a running flow as ROS 2 topics, over Zenoh and without ROS; and the same as a node of a graph.

settings of the node  router : str | None    where ROS's router is, e.g. tcp/127.0.0.1:7447
                      listen : str | None    or where to be one, on this machine
                      domain : int           ROS_DOMAIN_ID
                      distro : str           humble, jazzy, kilted, lyrical
                      world, namespace, tf   as the options of the command
in                    any number of streams, of any message; those that ROS has a message for become topics
"""

import contextlib
import logging
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from annotated_types import Ge, Le

from caneflow.bridges.frames import frames_of
from caneflow.bridges.rmw_zenoh import (
    LATCHED_QOS,
    MOST_DOMAINS,
    PUBLISHER,
    ROUTER,
    STREAM_QOS,
    Participant,
    attachment,
    gid_of,
)
from caneflow.bridges.ros_messages import (
    DIAGNOSTICS,
    DIAGNOSTICS_TYPE,
    TF_STATIC,
    TF_TYPE,
    Make,
    RosMessages,
    tf_stream,
)
from caneflow.bridges.ros_types import DEFAULT_DISTRO, DISTROS, RosTypes
from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, MessageError, Pose, Sample, decode, stream_of
from caneflow.messages.control import FlowStatus
from caneflow.messages.rig import Rig, read_rig
from caneflow.options import At, Keys
from caneflow.runtime import Context, Sink
from caneflow.runtime.hosts.attached.flow_events import Began, Came, Ended, Event, Told
from caneflow.runtime.hosts.attached.followed import followed, telling
from caneflow.runtime.hosts.links.neighbours import Neighbour
from caneflow.runtime.node import run
from caneflow.runtime.site import DEFAULT_KEYS

log = logging.getLogger(__name__)

NAMESPACE = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)*")  # of ROS
FRAME = re.compile(r"\w[\w/]*")


def command(
    flow: Annotated[str | None, typer.Argument(metavar="[FLOW]", help="A running flow's name.")] = None,
    router: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help=f"The router of ROS; by default {ROUTER}.")
    ] = None,
    listen: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Be that router, here; where no rmw_zenohd runs.")
    ] = None,
    domain: Annotated[int, typer.Option(min=0, max=MOST_DOMAINS, help="ROS_DOMAIN_ID.")] = 0,
    distro: Annotated[
        str, typer.Option(help=f"Release of ROS 2, whose types are spoken: {', '.join(DISTROS)}.")
    ] = DEFAULT_DISTRO,
    world: Annotated[
        str | None, typer.Option(metavar="NAME", help="Frame of the poses; by default odom, for a room map.")
    ] = None,
    namespace: Annotated[str, typer.Option(metavar="/NS", help="Goes before every topic but /diagnostics.")] = "",
    tf: Annotated[
        str | None, typer.Option(metavar="NODE/PORT", help="Poses that fill /tf, where several streams could.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
) -> None:
    """Show a running flow to ROS 2 as topics, without ROS: its nodes need RMW_IMPLEMENTATION=rmw_zenoh_cpp.

    Only what a ROS node listens to is converted, and the flow is never held up. It goes on until Ctrl-C; when the flow
    ends, it waits for the next one of that name.

    Example: caneflow ros2 cane --router tcp/127.0.0.1:7447
    """
    try:
        settings = Ros2Settings(
            router=router, listen=listen, domain=domain, distro=distro, world=world, namespace=namespace, tf=tf
        )
    except ValueError as error:
        raise CaneflowError(str(error)) from error
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(followed(flow, at, keys)) as events:
        for event in events:
            if isinstance(event, Began):
                _show(event, events, settings)
                print(f"{event.flow} has ended; this goes on when it is started again (Ctrl-C ends it)", flush=True)


def _show(began: Began, events: Iterator[Event], settings: "Ros2Settings") -> None:
    """Publish what the flow says, until it has ended."""
    kinds = {edge.writer: SAMPLES.get(edge.schema) for edge in began.status.edges}
    with Ros2Bridge(settings, began.flow, read_rig(began.status.rig), kinds, waits=began.status.replay) as bridge:
        print(f"{began.flow} is in ROS 2 by {bridge.where}, domain {settings.domain} (Ctrl-C ends it)", flush=True)
        if bridge.left_out:
            print(f"left out {', '.join(bridge.left_out)}: ROS has no message for it", flush=True)
        for event in events:
            match event:
                case Came():
                    bridge.take(event.node, event.port, event.kind, lambda came=event: decode(came.payload, came.kind))  # type: ignore[misc]
                case Told():
                    bridge.tell_status(event.status)
                case Ended():
                    return


@dataclass(frozen=True, kw_only=True)
class Ros2Settings:
    """Where ROS is, and how things are called there."""

    __pydantic_config__ = {"extra": "forbid"}

    router: str | None = None  # an endpoint of Zenoh; without it and listen: where rmw_zenohd listens on this machine
    listen: str | None = None  # be the router, at this endpoint of this machine
    domain: Annotated[int, Ge(0), Le(MOST_DOMAINS)] = 0  # ROS_DOMAIN_ID
    distro: str = DEFAULT_DISTRO  # whose types are spoken
    world: str | None = None  # frame of the poses; None: odom, for a room map
    namespace: str = ""  # goes before every topic but /diagnostics
    tf: str | None = None  # node/port of the poses that fill /tf, where several streams could

    def __post_init__(self) -> None:
        if self.distro not in DISTROS:
            raise ValueError(f"distro is {self.distro!r}; expected one of {', '.join(DISTROS)}")
        if self.router is not None and self.listen is not None:
            raise ValueError("router and listen: expected one of them; with listen this is the router")
        if not NAMESPACE.fullmatch(self.namespace):
            raise ValueError(f"namespace is {self.namespace!r}; expected e.g. /cane")
        if self.world is not None and not FRAME.fullmatch(self.world):
            raise ValueError(f"world is {self.world!r}; expected a frame's name, e.g. odom")


class _Topic:
    """One topic that is published."""

    def __init__(self, neighbour: Neighbour, node: Participant, number: int, topic: str, kind: str, types: RosTypes):
        digest, kept = types.hash(kind), topic.endswith(TF_STATIC)
        token = node.entity_token(number, PUBLISHER, topic, kind, digest, LATCHED_QOS if kept else STREAM_QOS)
        self._outlet = neighbour.outlet(node.key(topic, kind, digest), kept=kept)
        neighbour.token(token)
        self._gid = gid_of(token)
        self._encoded = types.encoder(kind)
        self._sent = 0

    @property
    def is_heard(self) -> bool:
        return self._outlet.is_heard

    def send(self, message: Any) -> None:
        self._sent += 1
        payload = self._encoded(message)
        self._outlet.put(payload, attachment(self._sent, time.time_ns(), self._gid))


class Ros2Bridge:
    """The streams of one flow as topics; a context manager, whose end takes the topics away."""

    def __init__(
        self,
        settings: Ros2Settings,
        flow: str,
        rig: Rig,
        kinds: Mapping[str, type[Sample] | None],
        *,
        waits: bool,
    ) -> None:
        """`kinds`: by stream (node/port) its message, so that its topics are there before the first sample.

        `waits`: nothing is lost, whatever that takes: for a replay. Raises DataflowError where no router answers.
        """
        self._types = RosTypes(settings.distro)
        tf = tf_stream(kinds, settings.tf)
        frames = frames_of(rig, settings.world)
        self._messages = RosMessages(self._types, frames, namespace=settings.namespace, tf=tf)
        router = settings.router or (None if settings.listen else ROUTER)
        self.where = settings.listen or router
        self._neighbour = Neighbour(router=router, listen=settings.listen, waits=waits)
        self._node = Participant(settings.domain, self._neighbour.identity, settings.namespace, f"caneflow_{flow}")
        self._count = 0  # of publishers
        self._streams: dict[str, list[tuple[_Topic, Make]]] = {}
        try:
            self._neighbour.token(self._node.token())
            self._topic(self._messages.static_topic, TF_TYPE).send(self._messages.static(time.time_ns()))
            self._diagnostics = self._topic(DIAGNOSTICS, DIAGNOSTICS_TYPE)
            for stream, kind in kinds.items():
                node, _, port = stream.partition("/")
                self._declare(node, port, kind)
        except BaseException:
            self._neighbour.close()
            raise
        if tf == "":
            poses = [stream for stream, kind in kinds.items() if kind is Pose]
            log.warning("nothing fills /tf: several streams hold poses (%s); choose one with tf", ", ".join(poses))

    @property
    def left_out(self) -> list[str]:
        """The streams so far that ROS has no message for."""
        return [stream for stream, topics in self._streams.items() if not topics]

    def take(self, node: str, port: str, kind: type[Sample] | None, decoded: Callable[[], Sample]) -> None:
        """Publish what a sample becomes, on the topics that have a listener; only then is it decoded."""
        topics = self._streams.get(f"{node}/{port}")
        if topics is None:
            topics = self._declare(node, port, kind)
        message: Sample | None = None
        for topic, make in topics:
            if topic.is_heard:
                try:
                    message = message or decoded()
                except MessageError:  # the readers count and name what cannot be read
                    return
                if (made := make(message)) is not None:
                    topic.send(made)

    def tell_status(self, status: FlowStatus) -> None:
        """Publish how nodes and wires are."""
        if self._diagnostics.is_heard:
            self._diagnostics.send(self._messages.diagnostics(status, time.time_ns()))

    def close(self) -> None:
        """Leave ROS's network."""
        self._neighbour.close()

    def __enter__(self) -> "Ros2Bridge":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self, node: str, port: str, kind: type[Sample] | None) -> list[tuple[_Topic, Make]]:
        pictures = self._messages.pictures(node, port, kind)
        topics = [(self._topic(each.topic, each.kind), each.make) for each in pictures]
        self._streams[f"{node}/{port}"] = topics
        return topics

    def _topic(self, topic: str, kind: str) -> _Topic:
        self._count += 1
        return _Topic(self._neighbour, self._node, self._count, topic, kind, self._types)


class Ros2(Sink):
    """The topics as a node: of the streams that the graph wires to it."""

    Settings = Ros2Settings

    def __init__(self, settings: Ros2Settings, context: Context) -> None:
        streams = {port: key.partition("/")[2] for port, key in context.keys.items()}
        flow = next((key.partition("/")[0] for key in context.keys.values()), context.node)
        kinds = {stream: context.ports[port] for port, stream in streams.items()}
        self._open = contextlib.ExitStack()
        self._bridge = self._open.enter_context(Ros2Bridge(settings, flow, context.rig, kinds, waits=context.replay))
        self._open.enter_context(telling(flow, self._bridge.tell_status))
        log.info("%s is in ROS 2 by %s, domain %d", flow, self._bridge.where, settings.domain)
        if self._bridge.left_out:
            log.info("left out %s: ROS has no message for it", ", ".join(self._bridge.left_out))

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Publish what one sample becomes."""
        node, port = stream_of(key)
        self._bridge.take(node, port, type(message), lambda: message)

    def idle(self, time: int) -> None:
        """Nothing waits here."""

    def finish(self) -> None:
        """Take the topics away."""
        self._open.close()


if __name__ == "__main__":
    run(Ros2)
