"""`caneflow list`: the flows that run on this machine, and the last ones that did."""

import json
from collections.abc import Iterable, Iterator
from typing import Annotated, Any

import msgspec
import typer

from caneflow.messages.control import FlowStatus
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.attached.attach import statuses
from caneflow.runtime.hosts.attached.run_logs import KeptLog, kept_logs
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, running_flows
from caneflow.runtime.hosts.links.session import open_session
from caneflow.runtime.wording import in_columns, span

LONGEST_NAME = 30  # letters of a flow that are shown


def command(
    ended: Annotated[
        bool, typer.Option("--ended", help="Those that have ended, whose logs are still there, the last first.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list; times in s, or UTC.")] = False,
) -> None:
    """Show the flows that run on this machine: live or replay, nodes that are ready, s since the start, pid.

    Those of this user; root sees all. A number in front of an ended run is what `caneflow logs --run` takes.

    Example: caneflow list --json
    """
    told, lines = _ended(kept_logs()) if ended else _running(running_flows())
    if as_json:
        print(json.dumps(told, indent=2))
    else:
        print("\n".join(lines))


def _running(flows: Iterable[RunningFlow]) -> tuple[list[dict[str, Any]], Iterator[str]]:
    found = [(flow, _status(flow)) for flow in flows]
    told = [
        {
            "flow": flow.flow,
            "pid": flow.pid,
            "endpoint": flow.endpoint,
            "owner": flow.owner,
            "answers": status is not None,
            **({} if status is None else _about(status)),
        }
        for flow, status in found
    ]
    return told, _running_lines(told)


def _about(status: FlowStatus) -> dict[str, Any]:
    ready = sum(node.state == "ready" for node in status.nodes)
    return {
        "replay": status.replay,
        "machine": status.machine,
        "uptime": status.uptime,
        "nodes": len(status.nodes),
        "ready": ready,
    }


def _running_lines(told: list[dict[str, Any]]) -> Iterator[str]:
    if not told:
        yield "no flow runs on this machine; `caneflow list --ended` shows the last that did"
        return
    rows: list[tuple[str, ...]] = [("flow", "kind", "ready", "up", "pid", "machine", "user")]
    for each in told:
        if each["answers"]:
            kind = "replay" if each["replay"] else "live"
            state = (kind, f"{each['ready']} of {each['nodes']}", span(each["uptime"]))
        else:
            state = ("no answer", "-", "-")
        rows.append((_short(each["flow"]), *state, str(each["pid"]), each.get("machine", ""), each["owner"]))
    yield from in_columns([row[: _used(rows)] for row in rows], right=(3, 4))


def _used(rows: list[tuple[str, ...]]) -> int:
    """How many columns to show: the last ones only where something stands in them."""
    return 7 if any(row[6] for row in rows[1:]) else 6 if any(row[5] for row in rows[1:]) else 5


def _status(flow: RunningFlow) -> FlowStatus | None:
    """What its launcher says; None: nothing, it is just beginning or ending, or hangs."""
    try:
        with open_session(mode="client", connect=[flow.endpoint]) as session:
            return next((each for each in statuses(session, flow.flow) if each.pid == flow.pid), None)
    except DataflowError:
        return None


def _ended(logs: list[KeptLog]) -> tuple[list[dict[str, Any]], Iterator[str]]:
    numbers: dict[str, int] = {}
    told = []
    for log in logs:
        numbers[log.run.flow] = numbers.get(log.run.flow, 0) + 1
        if not log.running:
            about = msgspec.to_builtins(log.run)
            told.append({"run": numbers[log.run.flow], **about, "log": str(log.folder)})
    return told, _ended_lines(told)


def _ended_lines(told: list[dict[str, Any]]) -> Iterator[str]:
    if not told:
        yield "no log of an ended flow is kept on this machine"
        return
    rows = [("flow", "run", "kind", "began", "ended", "status")]
    for each in told:
        kind = "replay" if each["replay"] else "live"
        end = "-" if each["ended"] is None else _second(each["ended"])
        status = "killed" if each["status"] is None else str(each["status"])
        rows.append((_short(each["flow"]), str(each["run"]), kind, _second(each["started"]), end, status))
    yield from in_columns(rows, right=(1,))


def _second(time: str) -> str:
    """A time of a log without what is below a second."""
    return f"{time[:10]} {time[11:19]}Z"


def _short(name: str) -> str:
    return name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 3]}..."
