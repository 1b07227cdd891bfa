"""`caneflow top`: what each node of a running flow costs."""

import json
import sys
import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from caneflow.messages.control import FlowStatus, NodeStatus
from caneflow.options import At, Keys
from caneflow.runtime.hosts.attached.attach import attached
from caneflow.runtime.site import DEFAULT_KEYS
from caneflow.runtime.wording import in_columns


def command(
    flow: Annotated[
        str | None, typer.Argument(metavar="FLOW", help="Its name; by default the only one that runs here.")
    ] = None,
    at: At = None,
    keys: Keys = DEFAULT_KEYS,
    every: Annotated[float, typer.Option(metavar="S", min=0.1, help="s between two looks.")] = 1.0,
    count: Annotated[
        int | None,
        typer.Option(min=1, help="Looks to take; by default one, and in a terminal until Ctrl-C."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per look, on a line of its own.")
    ] = False,
) -> None:
    """Show what each node of a running flow costs: processor in % of one core, resident memory in MB.

    The dearest is on top. In a terminal the table is renewed until Ctrl-C; elsewhere it is printed once.

    Example: caneflow top cane --every 2 --count 5
    """
    live = sys.stdout.isatty() and not as_json
    with attached(flow, at, keys) as here:
        looks = _looks(here.status, every, count if count or live else 1)
        if live:
            _show(looks)
            return
        for status in looks:
            print(json.dumps(plain(status)) if as_json else "\n".join(lines(status)), flush=True)


def plain(status: FlowStatus) -> dict[str, Any]:
    """What `top --json` prints: `cpu` in cores, `memory` in bytes, by node."""
    nodes = {
        node.node: {"pid": node.pid, "state": node.state, "cpu": node.cpu, "memory": node.memory}
        for node in _dearest_first(status)
    }
    return {"flow": status.flow, "cpu": _cpu(status), "memory": _memory(status), "nodes": nodes}


def lines(status: FlowStatus) -> Iterator[str]:
    """The same for people."""
    rows = [("node", "pid", "cpu", "memory", "state")]
    rows += [
        (node.node, str(node.pid or "-"), _percent(node.cpu), _megabytes(node.memory), node.state)
        for node in _dearest_first(status)
    ]
    rows.append(("together", "", _percent(_cpu(status)), _megabytes(_memory(status)), ""))
    yield from in_columns(rows, right=(1, 2, 3))


def _looks(look: Any, every: float, count: int | None) -> Iterator[FlowStatus]:
    taken = 0
    while count is None or taken < count:
        if taken:
            time.sleep(every)
        yield look()
        taken += 1


def _show(looks: Iterator[FlowStatus]) -> None:
    from rich.live import Live  # here, as it takes 0.1 s to import
    from rich.text import Text

    try:
        with Live(auto_refresh=False) as table:
            for status in looks:
                table.update(Text("\n".join(lines(status)), no_wrap=True, overflow="crop"), refresh=True)
    except KeyboardInterrupt:  # the way to end it
        return


def _dearest_first(status: FlowStatus) -> list[NodeStatus]:
    return sorted(status.nodes, key=lambda node: -(node.cpu or 0.0))


def _cpu(status: FlowStatus) -> float:
    return sum(node.cpu or 0.0 for node in status.nodes)


def _memory(status: FlowStatus) -> int:
    return sum(node.memory or 0 for node in status.nodes)


def _percent(cpu: float | None) -> str:
    return "-" if cpu is None else f"{100 * cpu:.1f} %"


def _megabytes(memory: int | None) -> str:
    return "-" if memory is None else f"{memory / 1e6:.0f} MB"
