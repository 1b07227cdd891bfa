"""How many files a flow needs open, looked at before it starts: Zenoh ends a process that cannot open one."""

import contextlib
import resource

from caneflow.runtime.errors import DataflowError

FOR_A_PROCESS = 48  # measured: a node has 30 open, a launcher of four nodes 41
FOR_A_NODE = 6  # in its launcher: its lines, its link, what is open while it starts
PLENTY = 4096


def raise_limit() -> None:
    """Let this process, and those it starts from now on, open as many files as the system allows, up to PLENTY."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = PLENTY if most == resource.RLIM_INFINITY else min(PLENTY, most)
    if now != resource.RLIM_INFINITY and now < wanted:
        with contextlib.suppress(OSError, ValueError):  # then what there is has to do
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))


def require_open_files(nodes: int) -> None:
    """Raise DataflowError unless the launcher of so many nodes may open what it needs."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = FOR_A_PROCESS + FOR_A_NODE * nodes
    if allowed != resource.RLIM_INFINITY and allowed < needed:
        raise DataflowError(
            f"{allowed} files may be open at a time, a flow of {nodes} nodes needs {needed}; "
            "allow more with `ulimit -n 1024`"
        )
