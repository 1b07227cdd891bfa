"""The logs of the last runs of this machine, as their launchers keep them: found, read, followed."""

import os
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import msgspec
import psutil

from caneflow.printable import printable
from caneflow.runtime.hosts.launcher.private_folder import folder_of_user
from caneflow.runtime.hosts.launcher.run_directory import RunningFlow, run_roots
from caneflow.runtime.hosts.launcher.run_log import ABOUT, EARLIER, LINES, LOGS, LoggedLine, LoggedRun, started_at

FOLLOW_PERIOD = 0.3  # s between two looks at a log that grows
LONGEST_ABOUT = 65_536  # bytes of run.json


@dataclass(frozen=True, kw_only=True)
class KeptLog:
    """The log of one run."""

    folder: Path
    run: LoggedRun

    @property
    def running(self) -> bool:
        """Whether the run goes on: it has not noted its end, and the folder that its launcher holds is in use."""
        with suppress(OSError, msgspec.MsgspecError):
            about = _about(self.folder)
            return about.ended is None and psutil.pid_exists(about.pid)
        return False

    def lines(self, *, follow: bool = False) -> Iterator[LoggedLine]:
        """What is kept of it, the earliest first; `follow`: and what comes, until the run has ended."""
        with suppress(OSError), _opened(self.folder, EARLIER) as file:
            yield from map(_line, file)
        file = _opened(self.folder, LINES)
        while True:
            running = follow and self.running  # looked at before the last lines are read
            begun = b""
            for raw in file:
                begun += raw
                if begun.endswith(b"\n"):
                    yield _line(begun)
                    begun = b""
            file.seek(-len(begun), os.SEEK_CUR)  # the rest of it is being written
            newer = self._newer(file)
            if newer is None and not running:
                file.close()
                return
            if newer is not None:
                file.close()
                file = newer
            else:
                time.sleep(FOLLOW_PERIOD)

    def _newer(self, file: BinaryIO) -> BinaryIO | None:
        """The file of the last lines, if `file` is so no more."""
        with suppress(OSError):
            newer = _opened(self.folder, LINES)
            if not os.path.samestat(os.fstat(newer.fileno()), os.fstat(file.fileno())):
                return newer
            newer.close()
        return None


def kept_logs(flow: str | None = None) -> list[KeptLog]:
    """The logs of the runs of `flow` (None: of all) that this user may believe, the newest run first."""
    found = []
    for root in run_roots():
        with suppress(OSError), folder_of_user(root / LOGS, os.getuid()) as (logs, _):
            for name in os.listdir(logs):  # noqa: PTH208 - not by its path
                with suppress(OSError, msgspec.MsgspecError):
                    about = _about(root / LOGS / name)
                    if flow in (None, about.flow):
                        found.append(KeptLog(folder=root / LOGS / name, run=about))
    return sorted(found, key=lambda log: started_at(log.folder.name), reverse=True)


def run_of(launcher: RunningFlow) -> LoggedRun | None:
    """What the log of a run says of it; None: there is none."""
    mine = [log for log in kept_logs(launcher.flow) if log.run.pid == launcher.pid]
    return mine[0].run if mine else None


def _about(folder: Path) -> LoggedRun:
    with _opened(folder, ABOUT) as file:
        about = msgspec.json.decode(file.read(LONGEST_ABOUT), type=LoggedRun)
    return msgspec.structs.replace(about, lost=tuple(map(printable, about.lost)), flow=printable(about.flow))


def _opened(folder: Path, name: str) -> BinaryIO:
    """A file of a log; raises OSError unless it is a file of the folder's owner, who is this user or, for root, any."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK  # a pipe of that name would hold up its reader
    with folder_of_user(folder, os.getuid()) as (within, of_folder):
        file = os.fdopen(os.open(name, flags, dir_fd=within), "rb")
    about = os.fstat(file.fileno())
    if not stat.S_ISREG(about.st_mode) or about.st_uid != of_folder.st_uid:
        file.close()
        raise PermissionError(f"{folder / name}: not a log of one user")
    return file


def _line(raw: bytes) -> LoggedLine:
    try:
        line = msgspec.json.decode(raw, type=LoggedLine)
    except (msgspec.MsgspecError, UnicodeDecodeError):  # cut off on a full disk
        begins = printable(raw[:60].decode("latin1"))
        return LoggedLine("", "warning", "caneflow", f"a line that cannot be read: {begins}")
    return LoggedLine(*(printable(getattr(line, each)) for each in LoggedLine.__struct_fields__))
