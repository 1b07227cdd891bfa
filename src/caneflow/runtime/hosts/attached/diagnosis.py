"""What is wrong with a running flow: from the way to it, link by link, to its nodes and wires; with what to try.

A denial by TLS or by access control looks to Zenoh like a link or a reader that is not there, so each step is taken
on its own: the name, the port, the certificates, the link, the answer.
"""

import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import psutil
import zenoh

import caneflow
from caneflow.messages import control_key
from caneflow.messages.control import EdgeStatus, FlowStatus, NodeStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import (
    ANSWER_TIMEOUT,
    ANY,
    endpoint_of,
    link_settings,
    timed_statuses,
)
from caneflow.runtime.hosts.attached.way_to import Finding, way_to
from caneflow.runtime.hosts.launcher.node_statistics import OLD, OTHER_CLOCK
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.runtime.hosts.links.session import UNIX, open_session
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.runtime.wording import listed, one_line

CLOCK_TOLERANCE = 0.005  # s between two machines; ages and latencies between them are off by it
STALE = 3.0  # s without word from a node that says its counters once a second
SETTLED = 5.0  # s from the start of a node, after which its wires are judged

PLACES: dict[str, tuple[str, tuple[str, ...]]] = {  # where a sample is lost: what happened, what to try
    "sender": ("could not be sent: time goes backwards, or the bytes are bad", ("see the writer's log lines",)),
    "wire": ("never came", ("is the link fast enough? was the writer restarted? see `caneflow status`, restarts",)),
    "decode": ("broke the contract, or the program refused them", ("see the reader's log lines: each cause once",)),
    "queue": ("fell out of a full queue, or were too old", ("the reader is too slow: `caneflow top`",)),
    "late": (
        "came after the graph had gone on",
        ("a larger max_lag_ms on this input; see its age in `caneflow status`",),
    ),
}


def diagnosed(flow: str | None = None, at: str | None = None, keys: Path = DEFAULT_KEYS) -> Iterator[Finding]:
    """What there is to say of the running flow `flow`, on this machine or at the endpoint `at`; of None of all here."""
    names = dict.fromkeys(found.flow for found in running_flows()) if flow is None and at is None else ()
    if len(names) > 1:
        for name in names:
            for finding in diagnosed(name, at, keys):
                yield replace(finding, node=f"{name}: {finding.node}")
        return
    try:
        endpoint = at or endpoint_of(flow)
    except DataflowError as error:
        try_this = () if running_flows() else TO_FIND_A_FLOW
        yield Finding(node=flow or "flow", state="bad", text=str(error), attempts=try_this)
        return
    for finding in way_to(endpoint, keys):
        yield finding
        if finding.state == "bad":
            return
    try:
        session = open_session(mode="client", connect=[endpoint], more=link_settings(endpoint, keys))
    except DataflowError as error:
        attempts = ("is it a Zenoh endpoint of caneflow? with keys it is tls/..., without tcp/...",)
        yield Finding(node=endpoint, state="bad", text=one_line(error), attempts=attempts)
        return
    with session:
        yield from _running(session, flow or ANY, endpoint)


TO_FIND_A_FLOW = (
    "start it: caneflow run FILE; with several machines on each of them: --machine NAME",
    "one of another user is seen by that user and by root only",
    "one on another machine: --at tcp/HOST:PORT, as `machines:` in its file says",
)


# --- the way there ----------------------------------------------------------------------------------------------


def _running(session: zenoh.Session, flow: str, endpoint: str) -> Iterator[Finding]:
    try:
        answers = timed_statuses(session, flow)
    except DataflowError as error:
        attempts = ("pip install the same version of caneflow on all machines",)
        yield Finding(node=endpoint, state="bad", text=one_line(error), attempts=attempts)
        return
    if not answers:
        yield _no_answer(flow, endpoint)
        return
    names = {answer.flow for answer, _ in answers}
    if len(names) > 1:
        text = f"several flows answer: {listed(sorted(names))}"
        yield Finding(node=endpoint, state="bad", text=text, attempts=("name one",))
        return
    for status, offset in answers:
        yield from _machine(status, offset)
        yield from _nodes(session, status)
    known = [status for status, _ in answers]
    yield from _edges(session, known)


def _no_answer(flow: str, endpoint: str) -> Finding:
    named = "any flow" if flow == ANY else flow
    if endpoint.startswith("tls/"):
        text = f"linked, but nothing of {named} comes through: denied by access control, or another flow runs there"
        attempts: tuple[str, ...] = (
            "is the certificate an observer's? caneflow keys list",
            "what a denied one asks is dropped without a word: ask on the machine itself, without --at",
        )
    else:
        text = f"linked, but no launcher of {named} answers within {ANSWER_TIMEOUT:g} s"
        attempts = (
            "is it ending, or stopped (SIGSTOP)? try again",
            "is it of another version? caneflow --version there",
        )
    return Finding(node=endpoint, state="bad", text=text, attempts=attempts)


def _machine(status: FlowStatus, offset: tuple[float, float]) -> Iterator[Finding]:
    """Version and clock of one launcher's machine, as seen from here."""
    where = status.machine or status.host
    ahead, uncertainty = offset
    kind = "replay" if status.replay else "live"
    text = f"{status.flow}, {kind}, up {status.uptime:.0f} s, caneflow {status.version}, pid {status.pid}"
    yield Finding(node=where, state="ok", text=text)
    if status.version != caneflow.__version__:
        text = f"runs caneflow {status.version}, here is {caneflow.__version__}"
        yield Finding(node=where, state="look", text=text, attempts=("pip install the same version on both",))
    if status.host == platform.node():
        return
    text = f"its clock is {1e3 * abs(ahead):.1f} ms {'ahead' if ahead > 0 else 'behind'} (+-{1e3 * uncertainty:.1f} ms)"
    if abs(ahead) - uncertainty > CLOCK_TOLERANCE:
        attempts = ("timedatectl on both: is the clock synchronised? else sudo apt install chrony",)
        text += "; ages and latencies between the machines are off by it"
        yield Finding(node=where, state="look", text=text, attempts=attempts)
    else:
        yield Finding(node=where, state="ok", text=text)


def _nodes(session: zenoh.Session, status: FlowStatus) -> Iterator[Finding]:
    attempts: tuple[str, ...]
    # A reader counts whether anything comes or not; a source may wait.
    readers = {edge.reader.partition(".")[0] for edge in status.edges}
    for node in status.nodes:
        silent = node.uptime if node.counted is None else node.counted
        said = f"; it said: {node.said}" if node.said else ""
        if node.state != "ready":
            text = f"is {node.state}{said}"
            attempts = ("its log lines say why; run its program's test alone", "more time: ready_timeout_s in the file")
            yield Finding(node=node.node, state="bad", text=text, attempts=attempts)
        elif silent > STALE and (node.node in readers or any(node.rates.values())):
            text = f"has said nothing for {silent:.0f} s, pid {node.pid} is there{said}"
            attempts = (f"is it stopped, or in a long computation? py-spy dump --pid {node.pid}",)
            yield Finding(node=node.node, state="bad", text=text, attempts=attempts)
        elif node.restarts:
            text = f"was restarted {node.restarts} x{said}"
            yield Finding(node=node.node, state="look", text=text, attempts=("its log lines say why it ended",))
        if status.host == platform.node():
            yield from _links(node, status)


def _links(node: NodeStatus, status: FlowStatus) -> Iterator[Finding]:
    """Whether each link that the node should have is there: only the machine itself can tell."""
    try:
        listening, dialled = _endpoints_of(node.pid)
        dialled |= {endpoint for endpoint in node.connect if _takes_all(endpoint, status)}
    except psutil.Error:
        return  # someone else's process, or it has just ended
    listeners = {endpoint: other.node for other in status.nodes for endpoint in other.listen}
    for endpoint in node.listen:
        if endpoint not in listening:
            text = f"should listen on {_shown(endpoint)}, and does not: its readers get nothing"
            yield Finding(node=node.node, state="bad", text=text, attempts=("end the flow and start it again",))
    missing = [endpoint for endpoint in node.connect if endpoint not in dialled]
    for endpoint in missing:
        whom = listeners.get(endpoint, "its launcher")
        text = f"dials {whom} on {_shown(endpoint)}, without success"
        stands = (
            "is the run's folder there? sockets in a removed one cannot be dialled"
            if endpoint.startswith(f"{UNIX}/")
            else "a firewall on loopback? sudo iptables -L"
        )
        attempts = (f"is {whom} ready? it is dialled again every 0.2 s", stands)
        yield Finding(node=node.node, state="bad", text=text, attempts=attempts)
    up = [listeners.get(endpoint, "the launcher") for endpoint in node.connect if endpoint in dialled]
    if not missing:
        places = ", ".join(map(_shown, node.listen))
        text = f"{f'listens on {places}; ' if places else ''}linked to {listed(up)}"
        yield Finding(node=node.node, state="ok", text=text)


def _endpoints_of(pid: int) -> tuple[set[str], set[str]]:
    """Where a process listens, and which ports it has dialled; which Unix sockets it has, the kernel does not list."""
    if not pid:
        return set(), set()
    sockets = psutil.Process(pid).net_connections(kind="tcp")
    listening = {f"tcp/127.0.0.1:{each.laddr.port}" for each in sockets if each.status == psutil.CONN_LISTEN}
    dialled = {
        f"tcp/127.0.0.1:{each.raddr.port}" for each in sockets if each.status == psutil.CONN_ESTABLISHED and each.raddr
    }
    return listening | {f"{UNIX}/{path}" for path in _unix_paths(pid)}, dialled


def _takes_all(endpoint: str, status: FlowStatus) -> bool:
    """Whether as many links as there should be have been taken at a Unix socket."""
    if not endpoint.startswith(f"{UNIX}/"):
        return False
    listener = next((node.pid for node in status.nodes if endpoint in node.listen), status.pid)
    expected = sum(endpoint in node.connect for node in status.nodes if node.pid)
    # The socket that listens, and one for each link that it has taken.
    return _unix_paths(listener).count(endpoint.partition("/")[2]) > expected


def _unix_paths(pid: int) -> list[str]:
    """The paths of a process's Unix sockets, each as often as there is one."""
    paths = [str(each.laddr) for each in psutil.Process(pid).net_connections(kind="unix")] if pid else []
    return [path for path in paths if path]


def _edges(session: zenoh.Session, answers: Sequence[FlowStatus]) -> Iterator[Finding]:
    nodes = {node.node: node for status in answers for node in status.nodes}
    writers = {(node.node, port): sent for node in nodes.values() for port, sent in node.sent.items()}
    for status in answers:
        for edge in status.edges:
            yield from _edge(session, status, edge, nodes, writers)


def _edge(
    session: zenoh.Session,
    status: FlowStatus,
    edge: EdgeStatus,
    nodes: dict[str, NodeStatus],
    writers: dict[tuple[str, str], int],
) -> Iterator[Finding]:
    """What a wire lost, and why nothing comes."""
    where = f"{edge.writer} > {edge.reader}"
    for place, (what, attempts) in PLACES.items():
        if lost := getattr(edge, place):
            yield Finding(
                node=where, state="look", text=f"{lost} samples lost ({place}): they {what}", attempts=attempts
            )
    age = edge.delays.handled
    if age is not None and OLD < age < OTHER_CLOCK:
        text = f"samples are {age:.1f} s old when they are handled, and so is what follows from them"
        attempts = (
            "which node is busy? `caneflow top`; is the link fast enough?",
            "max_age_ms on this input drops and counts what is too old",
        )
        yield Finding(node=where, state="bad", text=text, attempts=attempts)
    writer, _, port = edge.writer.partition("/")
    reader = nodes[edge.reader.partition(".")[0]]
    sent = writers.get((writer, port), 0)
    if edge.received or reader.uptime < SETTLED:
        return
    if not sent:
        if writer in nodes and nodes[writer].state == "ready" and not status.replay:
            text, attempts = "nothing was sent yet", (f"a device? caneflow doctor --devices; else see {writer}'s log",)
            yield Finding(node=where, state="look", text=text, attempts=attempts)
        return
    key = control_key(status.flow, "edge", writer, reader.node)
    with_reader = "answers to its writer's name" if _is_matched(session, key) else "is heard by nobody here"
    text = f"{sent} samples were sent and none came; the reader {with_reader}"
    attempts = (
        f"do the links of {reader.node} and {writer} say bad above?",
        "on two machines: is their link up (doctor on both), and may the key pass (access control: the file's wires)?",
    )
    yield Finding(node=where, state="bad", text=text, attempts=attempts)


def _is_matched(session: zenoh.Session, key: str) -> bool:
    """Whether someone answers to `key`, as far as this session knows."""
    querier = session.declare_querier(key)
    time.sleep(0.05)  # what is matched is told a moment after the declaration
    matched: bool = querier.matching_status.matching  # type: ignore[attr-defined]  # the stub says bool
    querier.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks its types
    return matched


def _shown(endpoint: str) -> str:
    """An endpoint of this machine, in short."""
    return (
        f"socket {endpoint.rpartition('/')[2]}"
        if endpoint.startswith(f"{UNIX}/")
        else f"port {endpoint.rpartition(':')[2]}"
    )
