"""How a tool gets at a running flow: finds it on this machine, joins it as a Zenoh client, asks and listens."""

import logging
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import zenoh

from caneflow.errors import CaneflowError
from caneflow.messages import control_key, sample_key
from caneflow.messages.control import EdgeStatus, FlowStatus, NodeStatus
from caneflow.printable import printable
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, refused_addresses, running_flows
from caneflow.runtime.hosts.links.session import open_session, sent_at
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.runtime.wording import did_you_mean, listed

if TYPE_CHECKING:
    from caneflow.runtime.hosts.links.certificates import Credentials

log = logging.getLogger(__name__)

ANSWER_TIMEOUT = 2.0  # s that a launcher has to answer; it takes some ms
ASK_AGAIN = 0.1  # s: what a launcher declares may come a moment after the link to it
WRITE_TIMEOUT = 30.0  # s that a sink has to answer: it may have to write much first
ANY = "*"


class Heard(NamedTuple):
    """A sample as it came to a tool."""

    key: str
    schema: str  # "" when the writer did not say
    payload: bytes
    sent_at: int  # ns: when the writer put it; 0: it did not say


class Attached:
    """A tool's place in a running flow."""

    def __init__(self, session: zenoh.Session, flow: str) -> None:
        self.session = session
        self.flow = flow  # its name

    def status(self) -> FlowStatus:
        """What the launchers of the flow, one on each machine, know of their nodes, as one.

        Raises DataflowError when none answers.
        """
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while not (answers := statuses(self.session, self.flow)) and time.monotonic() < deadline:
            time.sleep(ASK_AGAIN)  # where nobody is known to answer, Zenoh says so at once
        if not answers:
            raise DataflowError(f"{self.flow} does not answer; it may be ending: try again, or `caneflow doctor`")
        return merged(answers)

    def ask(self, node: str, question: bytes) -> list[bytes]:
        """What the sink `node` (`*`: each) answers to `question`; one that does not understand it says nothing."""
        replies = self.session.get(
            control_key(self.flow, "ask", node),
            payload=question,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=WRITE_TIMEOUT,
        )
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    @contextmanager
    def samples(
        self, streams: Sequence[tuple[str, str]], hear: "queue.SimpleQueue[Heard] | Callable[[Heard], None]"
    ) -> Iterator[None]:
        """Put every sample of `streams` (node, port; `*` is any) into `hear`, while the block lasts."""
        put = hear.put if isinstance(hear, queue.SimpleQueue) else hear

        def on_sample(sample: zenoh.Sample) -> None:
            schema = str(sample.encoding).rpartition(";")[2]
            put(Heard(printable(str(sample.key_expr)), printable(schema), sample.payload.to_bytes(), sent_at(sample)))

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        held = [self.session.declare_subscriber(sample_key(self.flow, *stream), handler) for stream in streams]
        try:
            yield
        finally:
            for subscriber in held:
                subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types


@contextmanager
def attached(flow: str | None = None, endpoint: str | None = None, keys: Path = DEFAULT_KEYS) -> Iterator[Attached]:
    """Join the running flow of the name `flow`, on this machine or at `endpoint`, as a Zenoh client.

    To an endpoint `tls/...` it goes as an observer, by its certificate in `keys`.

    Raises DataflowError when there is none, or when there are several to choose from.
    """
    where = endpoint or endpoint_of(flow)
    with open_session(mode="client", connect=[where], more=link_settings(where, keys)) as session:
        yield Attached(session, flow if flow is not None else _name_at(session, where))


def link_settings(endpoint: str, keys: Path) -> dict[str, Any]:
    """Zenoh's settings for a link to `endpoint`; raises DataflowError when it takes a certificate that is not there."""
    if not endpoint.startswith(("tls/", "quic/")):
        return {}
    own = observer_credentials(keys)
    if own is None:
        raise DataflowError(
            f"{endpoint}: takes a certificate, and {keys} holds none; `caneflow keys add NAME --observer` makes one, "
            "where ca.key is"
        )
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(own.authority),
            "enable_mtls": True,
            "connect_certificate": str(own.certificate),
            "connect_private_key": str(own.key),
            "verify_name_on_connect": False,
        }
    }


def statuses(session: zenoh.Session, flow: str) -> list[FlowStatus]:
    """Every launcher's answer; `flow` may be `*`."""
    return [status for status, _ in timed_statuses(session, flow)]


def observer_credentials(keys: Path) -> "Credentials | None":
    """An observer's key and certificate in the folder `keys`, else whatever machine's there is; None: none."""
    from caneflow.runtime.hosts.links import certificates  # here, as few need them

    authority = certificates.AUTHORITY
    names = [path.stem for path in sorted(keys.glob("*.key")) if path.stem != authority]
    if len(names) > 1:
        roles = {listed.name: listed.role for listed in certificates.certificates(keys)}
        names.sort(key=lambda name: roles.get(name) != "observer")
    return certificates.credentials(keys, names[0]) if names else None


def timed_statuses(session: zenoh.Session, flow: str) -> list[tuple[FlowStatus, tuple[float, float]]]:
    """The same, each with how far (s) the clock of its machine is ahead of the one here, and how sure that is.

    The answer was given somewhere between question and arrival: half of that time is the uncertainty.
    """
    asked = time.time_ns()
    replies = session.get(
        control_key(flow, "status"),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=ANSWER_TIMEOUT,
    )
    answers = []
    for reply in replies:
        arrived = time.time_ns()
        if reply.ok is None:
            continue
        try:
            # Not by the codec of samples, which needs numpy: a status has to be there at once.
            said = _visible(msgspec.msgpack.decode(reply.ok.payload.to_bytes()))
            status = msgspec.convert(said, FlowStatus)
        except msgspec.DecodeError as error:
            raise DataflowError(
                f"a launcher answers in another way ({error}); is it of another version of caneflow?"
            ) from error
        ahead = (status.clock - (asked + arrived) / 2) / 1e9
        answers.append((status, (ahead, (arrived - asked) / 2e9)))
    return answers


def _visible(said: Any) -> Any:
    """What a peer said, with every text in it as a terminal can show it."""
    match said:
        case str():
            return printable(said)
        case dict():
            return {_visible(key): _visible(value) for key, value in said.items()}
        case list():
            return [_visible(each) for each in said]
    return said


def merged(answers: Sequence[FlowStatus]) -> FlowStatus:
    """One status of several launchers': that of the first, with the nodes and edges of all."""
    nodes: list[NodeStatus] = [node for answer in answers for node in answer.nodes]
    edges: list[EdgeStatus] = [edge for answer in answers for edge in answer.edges]
    first = answers[0]
    return FlowStatus(
        flow=first.flow,
        version=first.version,
        host=first.host,
        pid=first.pid,
        uptime=max(answer.uptime for answer in answers),
        replay=any(answer.replay for answer in answers),
        clock=first.clock,
        machine=first.machine,
        nodes=nodes,
        edges=edges,
        rig=next((answer.rig for answer in answers if answer.rig), {}),
        endpoint=first.endpoint,
    )


def endpoint_of(flow: str | None) -> str:
    """Where tools attach to the flow on this machine; raises DataflowError when there is none, or several."""
    found = launchers_of(flow)[0]
    if found.owner:
        log.warning("%s (pid %d)%s", found.flow, found.pid, _of_whom(found))
    return found.endpoint


def launchers_of(flow: str | None) -> list[RunningFlow]:
    """The launcher of the flow on this machine, or those of its parts; raises DataflowError as `endpoint_of` does.

    `flow`: its name, or the pid of a launcher; None: the only one.
    """
    running = running_flows()
    if flow is not None and flow.isdigit() and (chosen := [found for found in running if str(found.pid) == flow]):
        return chosen
    fitting = [found for found in running if flow in (None, found.flow)]
    # Root also sees those of other users, which must not stand in the place of its own.
    fitting = [found for found in fitting if not found.owner] or fitting
    if len(fitting) == 1:
        return fitting
    if not running:
        refused = "".join(f"; {said}" for said in refused_addresses())
        named = "" if flow is None else f" {flow!r}, nor any other,"
        raise DataflowError(
            f"no flow{named} runs on this machine; start one with `caneflow run FILE`, or name another's: --at{refused}"
        )
    names = sorted({found.flow for found in (fitting or running)})
    if not fitting:
        hint = did_you_mean(str(flow), names) or f" there is {listed(names)}"
        refused = "".join(f"; {said}" for said in refused_addresses())
        raise DataflowError(f"no flow {flow!r} runs on this machine;{hint}{refused}")
    if flow is None and len(names) > 1:
        raise DataflowError(f"several flows run on this machine; name one of {listed(names)}")
    if _are_one(fitting):
        return fitting
    each = listed(f"--at {found.endpoint} (pid {found.pid}{_of_whom(found)})" for found in fitting)
    raise DataflowError(f"{len(fitting)} flows {fitting[0].flow!r} run on this machine; choose by {each}")


def _of_whom(found: RunningFlow) -> str:
    return f", of user {found.owner}" if found.owner else ""


def _are_one(launchers: Sequence[RunningFlow]) -> bool:
    """Whether several launchers here run the parts of one flow, as they do where its machines are tried out on one."""
    try:
        with open_session(mode="client", connect=[launchers[0].endpoint]) as session:
            return {each.pid for each in launchers} <= {status.pid for status in statuses(session, launchers[0].flow)}
    except DataflowError:  # it has just ended
        return False


def _name_at(session: zenoh.Session, where: str) -> str:
    names = sorted({answer.flow for answer in statuses(session, ANY)})
    if len(names) != 1:
        raise DataflowError(f"{len(names) or 'no'} flows answer at {where}; name the flow: {listed(names)}")
    return names[0]


def parted(words: Sequence[str]) -> tuple[str | None, list[tuple[str, str]]]:
    """Flow and streams as they are named on a command line: `cane`, `fusion/pose`, `cane/fusion/pose`.

    Raises CaneflowError for a word that is none of them, and for two flows.
    """
    flows: dict[str, None] = {}
    streams = []
    for word in words:
        parts = word.split("/")
        if len(parts) > 3 or not all(parts):
            raise CaneflowError(
                f"{word!r} no such flow or stream; expected a flow (cane) or one of its streams (fusion/pose)"
            )
        if len(parts) != 2:
            flows[parts[0]] = None
        if len(parts) > 1:
            streams.append((parts[-2], parts[-1]))
    if len(flows) > 1:
        raise CaneflowError(f"{listed(flows)}: one flow at a time")
    return next(iter(flows), None), streams
