"""`caneflow status`: the nodes and edges of a running flow, what they count and where samples are lost."""

import json
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
import typer

from caneflow.messages.control import EdgeStatus, FlowStatus, NodeStatus
from caneflow.options import At, Keys
from caneflow.runtime.hosts.attached.attach import attached
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.runtime.wording import in_columns, span

PLACES = ("sender", "wire", "decode", "queue", "late")  # where a sample may be lost, on its way
DELAYS = ("edge", "Hz", "latency ms", "age ms", "silent s")  # median / 99th percentile
COUNTS = ("edge", "handled", "waiting", "lost")
STALE = 3.0  # s without word from a node that says its counters once a second


def command(
    flow: Annotated[
        str | None, typer.Argument(metavar="FLOW", help="Its name; by default the only one that runs here.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; times in s, memory in bytes.")
    ] = False,
    endpoint: Annotated[
        bool, typer.Option("--endpoint", help="Print only where other programs attach, for scripts.")
    ] = False,
) -> None:
    """Show the nodes and edges of a running flow: rates, delays, and how many samples were lost where.

    Rates are in Hz. Latency is from the writer's put to the reader's hand, age from the measurement to there (live
    flows only); median and 99th percentile of the last 1000 samples, in ms. Silent: s since the last sample.
    Lost at the sender: brought, but could not be sent. On the wire: never came. In decoding: broke the contract, or
    the program refused it. In the queue: pushed out of a full one, or too old. Late: the graph had gone on without it.

    Example: caneflow status cane --json
    """
    with attached(flow, at, keys) as here:
        status = here.status()
    if endpoint:
        print(status.endpoint)
    elif as_json:
        print(json.dumps(plain(status), indent=2))
    else:
        print("\n".join(lines(status)))


def plain(status: FlowStatus) -> dict[str, Any]:
    """What `status --json` prints."""
    about: dict[str, Any] = msgspec.to_builtins(status)
    about["nodes"] = {node.pop("node"): node for node in about["nodes"]}
    for edge in about["edges"]:
        edge["lost"] = {place: edge.pop(place) for place in PLACES}
    return about


def lines(status: FlowStatus) -> Iterator[str]:
    """The same for people."""
    kind = "replay" if status.replay else "live"
    yield f"{status.flow}: {kind}, on {status.host}, caneflow {status.version}, up {span(status.uptime)}"
    yield f"other programs attach at {status.endpoint}"
    yield ""
    head: tuple[str, ...] = ("node", "state", "pid", "up", "cpu", "memory", "restarts", "sent")
    rows = [head, *(_node(node) for node in status.nodes)]
    if any(node.machine for node in status.nodes):
        machines = ("machine", *(node.machine for node in status.nodes))
        rows = [(*row, machine) for row, machine in zip(rows, machines, strict=True)]
    yield from in_columns(rows, right=(2, 3, 4, 5, 6))
    yield ""
    yield from in_columns([DELAYS, *map(_delays, status.edges)], right=range(1, len(DELAYS)))
    yield ""
    yield from in_columns([COUNTS, *map(_counts, status.edges)], right=(1, 2))
    for node in status.nodes:
        if node.state != "ready" and node.said:
            yield f"{node.node} said: {node.said}"


def _node(node: NodeStatus) -> tuple[str, ...]:
    cpu = "-" if node.cpu is None else f"{100 * node.cpu:.0f} %"
    memory = "-" if node.memory is None else f"{node.memory / 1e6:.0f} MB"
    sent = ", ".join(f"{port} {_at_rate(node.rates[port])}" for port in node.sent)
    if node.process:  # the first node of a process shows what that costs
        cpu, memory = (f"in {node.process}", "") if node.cpu is None else (f"{node.process}: {cpu}", memory)
    state = node.state
    if node.counted is not None and node.counted > STALE:
        state += f", silent {span(node.counted)}"
    return node.node, state, str(node.pid or "-"), span(node.uptime), cpu, memory, str(node.restarts), sent or "-"


def _delays(edge: EdgeStatus) -> tuple[str, ...]:
    delays = edge.delays
    return (
        _wire(edge),
        "-" if edge.rate is None else f"{edge.rate:.1f}",
        _both(delays.latency_p50, delays.latency_p99),
        _both(delays.age_p50, delays.age_p99),
        "-" if delays.silent is None else f"{delays.silent:.2f}",
    )


def _counts(edge: EdgeStatus) -> tuple[str, ...]:
    lost = ", ".join(f"{number} {place}" for place in PLACES if (number := getattr(edge, place)))
    return _wire(edge), str(edge.handled), str(edge.waiting), lost or "0"


def _wire(edge: EdgeStatus) -> str:
    return f"{edge.writer} > {edge.reader}"


def _both(p50: float | None, p99: float | None) -> str:
    return "-" if p50 is None or p99 is None else f"{1e3 * p50:.3g} / {1e3 * p99:.3g}"


def _at_rate(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.1f} Hz"
