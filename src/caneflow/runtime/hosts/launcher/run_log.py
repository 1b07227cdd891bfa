"""What the nodes and the launcher of a run say, in files for this user alone: bounded, and kept for the last runs.

`logs/<flow>-<time>-<pid>/`, beside the runs' own folders: `run.json` says of which run, `lines.jsonl` holds what was
said last, `earlier.jsonl` what was said before that.
"""

import os
import traceback
from contextlib import suppress
from datetime import UTC, datetime

import msgspec

from caneflow.errors import CaneflowError
from caneflow.printable import printable
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.launcher.private_folder import PrivateFolder

LOGS = "logs"
ABOUT, LINES, EARLIER = "run.json", "lines.jsonl", "earlier.jsonl"
MOST_BYTES = 500_000  # of one of the two files
MOST_RUNS = 20  # that are kept: 20 MB in all
LONGEST_LINE = 4_000  # characters
SHOWN_OF_FLOW = 40  # letters of the flow's name in the folder's
LEVELS = ("debug", "info", "warning", "error", "critical")  # the least first
NAMED = {level.upper(): level for level in LEVELS}  # as Python's logging begins a line


class LoggedLine(msgspec.Struct, frozen=True):
    """One line of a log."""

    time: str  # UTC, ISO 8601: when the launcher took it
    level: str
    node: str
    text: str


class LoggedRun(msgspec.Struct, frozen=True):
    """Which run a log is of, and how that ended."""

    flow: str
    pid: int  # of its launcher
    replay: bool
    started: str  # UTC, ISO 8601
    ended: str | None = None  # None: it still runs, or was killed
    status: int | None = None  # that its launcher ended with
    lost: tuple[str, ...] = ()  # a line for each kind of loss


class RunLog:
    """The log of one run; a context manager. Where it cannot be written, the run goes on without it."""

    def __init__(self, root: PrivateFolder, flow: str, *, replay: bool) -> None:
        """`root`: the folder that holds this user's runs."""
        self._root = root
        self._about = LoggedRun(flow, os.getpid(), replay, now())
        self._folder: PrivateFolder | None = None
        self._file = -1
        self._bytes = 0

    def __enter__(self) -> "RunLog":
        stamp = f"{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}"
        with suppress(DataflowError, OSError):
            logs = self._root.child(LOGS)
            _keep_the_last(logs, MOST_RUNS - 1)
            self._folder = logs.child(f"{self._about.flow[:SHOWN_OF_FLOW]}-{stamp}-{os.getpid()}")
            self._folder.write(ABOUT, msgspec.json.encode(self._about))
            self._file = self._opened()
        return self

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if isinstance(error, Exception):  # that ends the launcher: of a detached one nobody sees it otherwise
            expected = isinstance(error, CaneflowError)
            for line in [str(error)] if expected else "".join(traceback.format_exception(error)).splitlines():
                self.take("caneflow", line, "error")
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        if self._folder is not None:
            self._folder.close()

    def take(self, node: str, text: str, level: str = "") -> None:
        """Keep a line of `node`; its level is what the line begins with, unless `level` says."""
        if self._file < 0:
            return
        word, _, rest = text.partition(" ")
        if (named := NAMED.get(word)) is not None:
            level, text = level or named, rest
        shown = printable(text.expandtabs())
        if len(shown) > LONGEST_LINE:
            shown = f"{shown[:LONGEST_LINE]}..."
        line = msgspec.json.encode(LoggedLine(now(), level or "info", node, shown)) + b"\n"
        with suppress(OSError):  # a full disk: what is said then is lost
            if self._bytes + len(line) > MOST_BYTES:
                self._rotate()
            self._bytes += os.write(self._file, line)

    def end(self, status: int, lost: tuple[str, ...]) -> None:
        """Note how the run ended."""
        if self._folder is not None:
            about = msgspec.structs.replace(self._about, ended=now(), status=status, lost=lost)
            with suppress(DataflowError):
                self._folder.write(ABOUT, msgspec.json.encode(about))

    def _rotate(self) -> None:
        assert self._folder is not None
        within = self._folder.descriptor
        os.replace(LINES, EARLIER, src_dir_fd=within, dst_dir_fd=within)
        before, self._file, self._bytes = self._file, self._opened(), 0
        os.close(before)

    def _opened(self) -> int:
        assert self._folder is not None
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
        return os.open(LINES, flags, 0o600, dir_fd=self._folder.descriptor)


def now() -> str:
    """The time as logs write it: to the millisecond, in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def started_at(name: str) -> str:
    """The part of a folder's name that says when its run began: the names sort by it."""
    return name.rsplit("-", 2)[-2] if name.count("-") >= 2 else ""


def _keep_the_last(logs: PrivateFolder, number: int) -> None:
    """Remove the oldest logs but `number`; those of runs that go on stay, as they are locked."""
    for name in sorted(logs.names(), key=started_at)[: -number or None]:
        logs.remove_unused(name)
