"""The processes of a flow: started in groups of their own, their lines merged, none left behind."""

import contextlib
import os
import queue
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from caneflow.runtime.hosts.launcher.fork_server import Ended, ForkServer, Started
from caneflow.runtime.hosts.process.source_threads import SOURCES_END

LINES_PATIENCE = 1.0  # s that the last lines of an ended node have to come: a child of it may hold the pipe open


class Line(NamedTuple):
    """A line that a node wrote."""

    node: str
    text: str


class Exited(NamedTuple):
    """A node's process has ended."""

    node: str
    pid: int
    status: int  # negative: the signal that ended it


class ForkServerLost(NamedTuple):
    """The process that starts nodes has been killed, and every node with it."""


@dataclass(eq=False)
class _Process:
    """A node's process, from the request for it to its end."""

    node: str
    reader: threading.Thread
    pid: int = 0  # 0: not there yet
    started: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)


class Processes:
    """Starts, watches and ends one process per node; a context manager that leaves none behind."""

    def __init__(self, events: "queue.SimpleQueue[object]", fork_server: ForkServer) -> None:
        self._events = events
        self._fork_server = fork_server
        self._running: dict[str, _Process] = {}
        self._asked: queue.SimpleQueue[_Process] = queue.SimpleQueue()  # to be started, in this order
        self._closing = False
        self._listener = threading.Thread(target=self._listen, daemon=True, name="fork server")

    def __enter__(self) -> "Processes":
        self._listener.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end(list(self._running), patience=1.0)
        self._closing = True
        self._fork_server.close()
        self._listener.join()

    def start(self, node: str, program: Sequence[str], plan: bytes, called: Path) -> int:
        """Start the node's process with its plan, `called` so where processes are listed.

        Its pid, or 0 when the fork server is lost. Raises OSError when this process has no descriptors left.
        """
        with _in_memory(plan) as descriptor:
            return self.start_program(node, [*program, str(called)], descriptor)

    def start_program(self, node: str, arguments: Sequence[str], plan: int | None = None) -> int:
        """Start what follows `python`, under the name `node`; `plan`: a descriptor of what its last argument names."""
        reading, writing = os.pipe()
        lines = os.fdopen(reading, encoding="utf-8", errors="replace")
        process = _Process(node, threading.Thread(target=self._read, args=(node, lines), daemon=True))
        process.reader.start()
        try:
            self._asked.put(process)
            self._fork_server.start(arguments, writing, plan)
            process.started.wait()
        except OSError:
            return 0  # the listener knows as well, and has said so
        finally:
            os.close(writing)
        self._running[node] = process
        return process.pid

    def forget(self, exited: Exited) -> None:
        """Take note that a process has ended."""
        process = self._running.get(exited.node)
        if process is not None and process.pid == exited.pid:
            del self._running[exited.node]

    def ask_to_end(self, node: str) -> None:
        """Ask a node's process to end, and go on."""
        if node in self._running:
            _signal(self._running[node], signal.SIGTERM)

    def ask_sources_to_end(self, node: str) -> bool:
        """Ask a group's process to end its sources; whether there is one."""
        process = self._running.get(node)
        if process is None or process.ended.is_set():
            return False
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, SOURCES_END)  # what it started itself is not asked
        return True

    def kill(self, node: str) -> None:
        """End a node's process at once."""
        if node in self._running:
            _signal(self._running[node], signal.SIGKILL)

    def end(self, *groups: Sequence[str], patience: float) -> list[str]:
        """Ask the nodes' processes to end, kill them after `patience` s; the names of those that were killed.

        One group after the other, so that the later ones still take what the earlier ones said last; one that takes
        long does not hold up the next beyond half of the time that is left.
        """
        deadline = time.monotonic() + patience
        ending = []
        for nodes in groups:
            asked = [self._running.pop(node) for node in nodes if node in self._running]
            for process in asked:
                _signal(process, signal.SIGTERM)
            turn = time.monotonic() + (deadline - time.monotonic()) / 2
            for process in asked:
                process.ended.wait(max(0.0, turn - time.monotonic()))
            ending += asked
        killed = []
        for process in ending:
            if not process.ended.wait(max(0.0, deadline - time.monotonic())):
                killed.append(process.node)
                _signal(process, signal.SIGKILL)
                process.ended.wait()
            process.reader.join(LINES_PATIENCE)
        return killed

    def _listen(self) -> None:
        """Follow what the fork server says until it ends."""
        there: dict[int, _Process] = {}
        while (word := self._fork_server.hear()) is not None:
            match word:
                case Started(pid):
                    process = there[pid] = self._asked.get()
                    process.pid = pid
                    process.started.set()
                case Ended(pid, status):
                    process = there.pop(pid)
                    process.ended.set()
                    threading.Thread(target=self._tell_end, args=(process, status), daemon=True).start()
        if not self._closing:
            self._events.put(ForkServerLost())
        while not self._asked.empty():
            self._asked.get().started.set()
        for process in there.values():
            process.ended.set()

    def _tell_end(self, process: _Process, status: int) -> None:
        process.reader.join(LINES_PATIENCE)
        self._events.put(Exited(process.node, process.pid, status))

    def _read(self, node: str, lines: IO[str]) -> None:
        with lines:
            for line in lines:
                self._events.put(Line(node, line.rstrip("\n")))


@contextlib.contextmanager
def _in_memory(data: bytes) -> Iterator[int]:
    """A descriptor of a file in memory that holds `data`: there is always room for it."""
    descriptor = os.memfd_create("plan")
    try:
        with open(descriptor, "wb", closefd=False) as file:
            file.write(data)
        yield descriptor
    finally:
        os.close(descriptor)


def _signal(process: _Process, number: int) -> None:
    """Send the process and what it started a signal, unless it has ended."""
    if not process.ended.is_set():
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
