"""`caneflow stop`: end a running flow in order."""

from typing import Annotated

import typer

from caneflow.runtime.hosts.attached.asking import stopped
from caneflow.runtime.hosts.attached.attach import launchers_of
from caneflow.runtime.wording import listed

INCOMPLETE_STATUS = 1
ENDED_WELL = (0, 130)  # a replay that had just come to its end, or a flow that was ended


def command(
    flow: Annotated[
        str | None,
        typer.Argument(metavar="FLOW", help="Its name, or its pid; by default the only one that runs here."),
    ] = None,
    patience: Annotated[
        float, typer.Option("--timeout", metavar="S", min=1, max=3600, help="s to wait for its end.")
    ] = 30.0,
) -> None:
    """End a flow that runs on this machine as Ctrl-C would: sources first, recorders last. Waits until it has ended.

    Says what was lost, if anything was. Of a flow on several machines the leader's end is the end of all.
    Exit status 0: it has ended in order. 1: something was lost. 2: no such flow, or it has not ended in time.

    Example: caneflow stop cane
    """
    launchers = launchers_of(flow)
    runs = stopped(launchers, patience)
    lost = [line for run in runs if run is not None for line in run.lost]
    bad = any(run is not None and run.status not in ENDED_WELL for run in runs)
    name, pids = launchers[0].flow, listed(str(each.pid) for each in launchers)
    print(f"{name} (pid {pids}) has ended; {'lost or refused:' if lost else 'nothing was lost'}")
    for line in lost:
        print(f"  {line}")
    if bad:
        print(f"  it had failed; see `caneflow logs {name}`")
    raise typer.Exit(INCOMPLETE_STATUS if lost or bad else 0)
