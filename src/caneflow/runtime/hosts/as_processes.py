"""Runs a deployment as processes. Takes Linux and Zenoh, so it is imported by who does that, before the first fork."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import caneflow.runtime.hosts.process.process
import caneflow.runtime.hosts.process.sources  # noqa: F401 - what is imported before the fork server, each node has
from caneflow.runtime.dataflow.graph import Restart
from caneflow.runtime.deployment import Deployment
from caneflow.runtime.hosts.launcher.background import in_background
from caneflow.runtime.hosts.launcher.console import Console
from caneflow.runtime.hosts.launcher.fork_server import ForkServer
from caneflow.runtime.hosts.launcher.launcher import Launcher
from caneflow.runtime.hosts.launcher.open_files import raise_limit, require_open_files
from caneflow.runtime.outcome import Outcome


class AsProcesses:
    """A host that forks; a context manager that leaves no process behind. To be entered before there is any thread."""

    def __init__(self, *, detach: bool = False) -> None:
        """`detach`: go on in the background; what called it is let go when every node is ready."""
        raise_limit()
        self._detach = detach
        self._background = in_background() if detach else None

    def __enter__(self) -> "AsProcesses":
        self._fork_server = ForkServer(silent=self._detach)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._fork_server.close()

    def run(self, deployment: Deployment, restarts: Mapping[str, Restart], keys: Path, *, view: bool) -> Outcome:
        """Run to the end, or until a signal ends it; `keys`: the folder with this machine's certificate.

        Raises DataflowError when this process may not open as many files as that takes.
        """
        require_open_files(sum(map(deployment.runs_here, deployment.plans)))
        with Console(deployment.flow, self._background) as console:
            return Launcher(deployment, dict(restarts), console, self._fork_server, keys, view=view).run()
