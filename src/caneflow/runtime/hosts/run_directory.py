"""Where a running flow keeps its plans and says how tools attach to it: one private folder per run."""

import os
import shutil
import tempfile
from contextlib import suppress
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
    """The flows that run on this machine and that this user may see: the own ones; root sees all."""
    found: dict[int, RunningFlow] = {}
    for path in (path for root in _roots() for path in root.glob("*/flow.json")):
        with suppress(OSError, msgspec.DecodeError):  # it may be ending, or be somebody else's
            flow = msgspec.json.decode(path.read_bytes(), type=RunningFlow)
            if psutil.pid_exists(flow.pid):
                found[flow.pid] = flow
    return sorted(found.values(), key=lambda flow: (flow.flow, flow.pid))


def _root() -> Path:
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(base) / f"caneflow-{os.getuid()}"


def _roots() -> list[Path]:
    """Where flows may have been started: by this session, by one with another environment, by another user."""
    roots = {_root(): None}
    for base in (Path(tempfile.gettempdir()), Path("/tmp"), *Path("/run/user").glob("*")):  # noqa: S108 - looked at only
        with suppress(OSError):  # that of another user
            roots.update(dict.fromkeys(base.glob("caneflow-*")))
    return list(roots)


def state_folder(flow: str, machine: str, run: str) -> Path:
    """Where snapshots outlive a launcher of this machine, for as long as the leader's run goes on."""
    # systemd names a folder that outlives a reboot (StateDirectory=).
    base = os.environ.get("STATE_DIRECTORY")
    parent = (Path(base.partition(":")[0]) if base else _root()) / f"state-{flow}-{machine}"
    path = parent / run
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    for other in parent.iterdir():
        if other != path:
            shutil.rmtree(other, ignore_errors=True)
    return path


def remove_state_folder(path: Path) -> None:
    """Remove the snapshots of a run that ended in order."""
    shutil.rmtree(path.parent, ignore_errors=True)


def _sweep() -> None:
    """Remove what launchers left that were killed."""
    for path in _root().glob("*-*"):
        pid = path.name.rpartition("-")[2]
        if pid.isdigit() and not psutil.pid_exists(int(pid)):
            shutil.rmtree(path, ignore_errors=True)
