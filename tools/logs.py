"""`caneflow logs`: what the nodes and the launcher of a flow have said, while it runs and afterwards."""

import json
import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Annotated

import msgspec
import typer

from caneflow.errors import CaneflowError
from caneflow.runtime.hosts.attached.run_logs import KeptLog, kept_logs
from caneflow.runtime.hosts.launcher.run_log import LEVELS, LoggedLine
from caneflow.runtime.wording import did_you_mean, listed

AGO = re.compile(r"(\d+(?:\.\d+)?)(s|min|h|d)")
SECONDS = {"s": 1, "min": 60, "h": 3600, "d": 86_400}


def command(
    flow: Annotated[
        str | None, typer.Argument(metavar="FLOW", help="Its name; by default the flow that was started last.")
    ] = None,
    node: Annotated[
        str | None, typer.Option(metavar="NODE", help="Only what this node said; `caneflow` is the launcher.")
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(metavar="10min|TIME", help="Only of the last 90s, 10min, 2h, 1d, or since e.g. 2026-11-30T14:05."),
    ] = None,
    level: Annotated[
        str | None, typer.Option(metavar="LEVEL", help=f"Only from this level on: {', '.join(LEVELS)}.")
    ] = None,
    grep: Annotated[
        str | None, typer.Option(metavar="PATTERN", help="Only lines that this regular expression is found in.")
    ] = None,
    run: Annotated[
        int, typer.Option(metavar="N", min=1, help="Of the Nth last run; 1: the one that runs, or ran last.")
    ] = 1,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Print what comes too, until the flow has ended or Ctrl-C.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object a line: time, level, node, text.")
    ] = False,
) -> None:
    """Print what the nodes and the launcher of a flow have said, with time, level and node.

    Kept for the last 20 runs of this user, the last 0.5 to 1 MB of each; `caneflow list --ended` shows them. Times
    are in UTC. A flow that was killed has its log too. Exit status 0 also when no line fits.

    Example: caneflow logs cane --node imu --since 10min --level warning

    Example: caneflow logs cane --follow --json
    """
    chosen = _chosen(flow, run)
    lines = _fitting(chosen.lines(follow=follow), node, _since(since), _levels(level), _pattern(grep))
    try:
        for line in lines:
            print(json.dumps(msgspec.to_builtins(line)) if as_json else _shown(line), flush=follow)
    except KeyboardInterrupt:
        if not follow:  # else it is the way to end it
            raise


def _chosen(flow: str | None, number: int) -> KeptLog:
    """The log of the `number`-th last run of `flow`."""
    logs = kept_logs(flow)
    if not logs:
        names = sorted({log.run.flow for log in kept_logs()})
        if flow is None or not names:
            raise CaneflowError("no log is kept on this machine; `caneflow run FILE` makes one")
        raise CaneflowError(f"no log of a flow {flow!r};{did_you_mean(flow, names)} there are those of {listed(names)}")
    if number > len(logs):
        raise CaneflowError(f"--run {number}: {len(logs)} runs{f' of {flow}' if flow else ''} are kept")
    return logs[number - 1]


def _fitting(
    lines: Iterable[LoggedLine], node: str | None, since: str, levels: frozenset[str], pattern: re.Pattern[str]
) -> Iterator[LoggedLine]:
    for line in lines:
        if node in (None, line.node) and line.time >= since and line.level in levels and pattern.search(line.text):
            yield line


def _levels(least: str | None) -> frozenset[str]:
    if least is None:
        return frozenset(LEVELS)
    if least.lower() not in LEVELS:
        raise CaneflowError(f"--level {least}: is none;{did_you_mean(least, LEVELS)} there are {listed(LEVELS)}")
    return frozenset(LEVELS[LEVELS.index(least.lower()) :])


def _pattern(text: str | None) -> re.Pattern[str]:
    try:
        return re.compile(text or "")
    except re.error as error:
        raise CaneflowError(f"--grep {text!r}: not a regular expression: {error}") from error


def _since(text: str | None) -> str:
    """The time, as logs write it, from which on lines are shown."""
    if text is None:
        return ""
    if ago := AGO.fullmatch(text):
        at = datetime.now(UTC) - timedelta(seconds=min(float(ago[1]) * SECONDS[ago[2]], 1e9))
    else:
        try:
            at = datetime.fromisoformat(text)
        except ValueError:
            raise CaneflowError(
                f"--since {text}: not a time; expected e.g. 90s, 10min, 2h, 1d or 2026-11-30T14:05 (UTC)"
            ) from None
        at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _shown(line: LoggedLine) -> str:
    return f"{line.time[11:]} {line.level:8} {line.node:12} {line.text}"
