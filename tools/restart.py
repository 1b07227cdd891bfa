"""`caneflow restart`: end a node of a running flow and start it again."""

import time
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.runtime.hosts.attached.asking import restarted
from caneflow.runtime.hosts.attached.attach import launchers_of


def command(
    words: Annotated[
        list[str],
        typer.Argument(metavar="[FLOW] NODE", help="The flow may be left out when only one runs here."),
    ],
) -> None:
    """End a node of a running flow in order and start it again, e.g. to reopen a device; the others go on.

    Waits until it is ready. It continues where it was, as after a failure, but its restart policy does not count it.
    Only the user who runs the flow, and root, may; on the machine on which the node runs. Exit status 0: it is ready
    again. 2: there is no such flow or node, or it does not start.

    Example: caneflow restart cane imu
    """
    if len(words) > 2:
        raise CaneflowError(f"{' '.join(words)!r}: give a flow and one of its nodes, e.g. cane imu")
    launchers = launchers_of(words[0] if len(words) == 2 else None)
    begun = time.monotonic()
    answer = restarted(launchers, words[-1])
    took = time.monotonic() - begun
    print(f"{launchers[0].flow}: {words[-1]} is ready again after {took:.1f} s (pid {answer.pid})")
