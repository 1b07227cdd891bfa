"""The processes of a flow: started in groups of their own, their lines merged, none left behind."""

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

from caneflow.runtime.hosts import guard

# One thread for linear algebra in each process: the flow is parallel already, and sums must not depend on cores.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class Line(NamedTuple):
    """A line that a node wrote."""

    node: str
    text: str


class Exited(NamedTuple):
    """A node's process has ended."""

    node: str
    pid: int
    status: int  # as subprocess has it: negative for a signal


class Processes:
    """Starts, watches and ends one process per node; a context manager that leaves none behind."""

    def __init__(self, events: "queue.SimpleQueue[object]", folder: Path) -> None:
        """`folder` is the run's own: every node is started with a path in it, by which the guard finds them."""
        self._events = events
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._guard = subprocess.Popen(
            [sys.executable, "-I", "-S", guard.__file__, str(folder)],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        self.end(list(self._running), patience=1.0)
        self._guard.kill()  # everything has ended: there is nothing left to guard
        self._guard.communicate()

    def start(self, node: str, program: Sequence[str], plan: Path) -> int:
        """Start the node's process; its pid."""
        process = subprocess.Popen(
            [sys.executable, *program, str(plan)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
            env={**ONE_THREAD, **os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self._running[node] = process
        threading.Thread(target=self._watch, args=(node, process), daemon=True, name=f"watch {node}").start()
        return process.pid

    def forget(self, exited: Exited) -> None:
        """Take note that a process has ended; what it started itself ends with it."""
        process = self._running.get(exited.node)
        if process is not None and process.pid == exited.pid:
            del self._running[exited.node]
            _signal_group(exited.pid, signal.SIGKILL)

    def kill(self, node: str) -> None:
        """End a node's process at once."""
        if node in self._running:
            _signal_group(self._running[node].pid, signal.SIGKILL)

    def end(self, nodes: Sequence[str], patience: float) -> list[str]:
        """Ask the nodes' processes to end, kill them after `patience` s; the names of those that were killed."""
        ending = {node: self._running[node] for node in nodes if node in self._running}
        for process in ending.values():
            _signal_group(process.pid, signal.SIGTERM)
        deadline = time.monotonic() + patience
        killed = []
        for node, process in ending.items():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=max(0.0, deadline - time.monotonic()))
            if process.poll() is None:
                killed.append(node)
                _signal_group(process.pid, signal.SIGKILL)
                process.wait()
            self.forget(Exited(node, process.pid, process.returncode))
        return killed

    def _watch(self, node: str, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        reader = threading.Thread(target=self._read, args=(node, process.stdout), daemon=True)
        reader.start()
        status = process.wait()
        reader.join(timeout=1.0)  # a child of the node may hold the pipe open
        self._events.put(Exited(node, process.pid, status))

    def _read(self, node: str, lines: IO[str]) -> None:
        for line in lines:
            self._events.put(Line(node, line.rstrip("\n")))


def _signal_group(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, number)
