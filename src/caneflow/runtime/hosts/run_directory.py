"""Where a running flow keeps its plans and says how tools attach to it: one private folder per run."""

import os
import shutil
import tempfile
from pathlib import Path

import msgspec
import psutil


class RunningFlow(msgspec.Struct, frozen=True):
    """How to find a flow that runs on this machine."""

    flow: str
    pid: int  # of its launcher
    endpoint: str  # where tools attach, as Zenoh clients


class RunDirectory:
    """The folder of one run, there while it runs."""

    def __init__(self, flow: str, endpoint: str) -> None:
        self._running = RunningFlow(flow, os.getpid(), endpoint)
        self.path = _root() / f"{flow}-{os.getpid()}"

    def __enter__(self) -> "RunDirectory":
        _sweep()
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        (self.path / "flow.json").write_bytes(msgspec.json.encode(self._running))
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.path, ignore_errors=True)


def running_flows() -> list[RunningFlow]:
    """The flows that run on this machine under this user."""
    found = [msgspec.json.decode(path.read_bytes(), type=RunningFlow) for path in _root().glob("*/flow.json")]
    return sorted((flow for flow in found if psutil.pid_exists(flow.pid)), key=lambda flow: flow.flow)


def _root() -> Path:
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(base) / f"caneflow-{os.getuid()}"


def _sweep() -> None:
    """Remove what launchers left that were killed."""
    for path in _root().glob("*-*"):
        pid = path.name.rpartition("-")[2]
        if pid.isdigit() and not psutil.pid_exists(int(pid)):
            shutil.rmtree(path, ignore_errors=True)
