"""Where an operator's snapshots are kept between two processes: one file in the run's own folder, the newest only.

A snapshot is a luxury: one that cannot be written or read is said in one line, and the operator goes on without.
"""

import logging
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec

import caneflow
from caneflow.runtime.program import Operator
from caneflow.runtime.stages.operator_stage import StageState
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.sent_samples import Kept
from caneflow.runtime.stages.snapshot import pack, unpack
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

LAYOUT = 3  # of the file: one of another layout is not read
OTHERS_WRITE = 0o022


class Snapshot(msgspec.Struct, frozen=True):
    """Everything that a new process needs to go on as if nothing had happened."""

    version: str  # of caneflow: another one may mean something else by the same names
    program: str
    stage: StageState
    history: dict[str, list[Kept]]  # by output port what its readers have not made sure of
    operator: bytes
    layout: int = 0


class Resumed(NamedTuple):
    """What a snapshot brought back."""

    operator: Operator
    stage: StageState
    history: dict[str, list[Kept]]


class SnapshotKeeper:
    """Keeps the newest snapshot of one operator."""

    def __init__(self, path: Path, operator: Operator) -> None:
        """`operator`: as it was just built; its attributes are those that a snapshot must have."""
        self._file = path.name
        self._operator = operator
        self._built = set(vars(operator))
        self._module = type(operator).__module__
        self._program = f"{self._name()}:{type(operator).__qualname__}"
        self._on_trial = False  # a snapshot was gone on from, and none was kept since
        self._failed = False  # to write one, and that was said
        self.state: bytes | None = None  # of the operator, when it was packed last
        self._possible = True  # False: none can be taken, and that was said
        # Held open: a folder that is removed and made again by another user gets nothing of ours, and gives nothing.
        self._folder = self._opened(path.parent)

    def taken(self, stage: StageState, history: dict[str, list[Kept]], operator: Operator) -> bytes | None:
        """The operator's state and where its streams stand; None, said once, when the state cannot be kept."""
        self._operator = operator  # another one after a sample that the one before could not handle
        self.state = None
        if not self._possible:
            return None
        try:
            if gone := self._built - vars(self._operator).keys():
                raise SnapshotError(f"state.{min(gone)} was deleted; a snapshot without it would look damaged")
            state = pack(self._operator, self._module)
        except SnapshotError as error:
            self._possible = False
            log.warning("cannot be brought back exactly after a kill: %s", one_line(error))
            return None
        self.state = state
        return msgspec.msgpack.encode(
            Snapshot(caneflow.__version__, self._program, stage, history, state, layout=LAYOUT)
        )

    def keep(self, snapshot: bytes) -> bool:
        """Write what was taken in place of the one before; the file is whole at any moment. False: not possible now.

        A folder that was removed is not made again: what stands under its name later may be another user's.
        """
        fresh = f"{self._file}.new"
        try:
            self._write(fresh, snapshot)
            os.replace(fresh, self._file, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        except OSError as error:
            self._remove(fresh)  # a full disk has no room for half a snapshot
            if not self._failed:
                log.warning(
                    "cannot write a snapshot: %s; goes on without (tried again, not said again)", error.strerror
                )
            self._failed = True
            return False
        self._on_trial = False
        return True

    def resume(self) -> Resumed | None:
        """What the newest snapshot holds; None when there is none. Raises SnapshotError for one that does not fit."""
        data = self._read()
        if data is None:
            return None
        try:
            snapshot = msgspec.msgpack.decode(data, type=Snapshot)
        except Exception as error:  # it may hold anything
            raise SnapshotError(f"it is damaged: {error}") from error
        made_by = (snapshot.layout, snapshot.version, snapshot.program)
        if made_by != (LAYOUT, caneflow.__version__, self._program):
            raise SnapshotError(f"it is of layout {made_by[0]}, of {made_by[2]} of caneflow {made_by[1]}")
        if snapshot.history.keys() != snapshot.stage.outputs.keys():
            raise SnapshotError("its samples are not those of its outputs")
        return Resumed(self._unpacked(snapshot.operator), snapshot.stage, snapshot.history)

    def go_on_with(self, operator: Operator) -> None:
        """Note that a snapshot's operator is used from now on."""
        self._operator = operator
        self._on_trial = True
        log.info("goes on from its snapshot")

    def note_failure(self) -> None:
        """Note that the node ends with an error: the snapshot that led there must not do so again and again."""
        if self._on_trial:
            self.discard()
            log.warning("failed after it had gone on from its snapshot; that one is not used again")

    def discard(self) -> None:
        """Remove the newest snapshot, if there is one."""
        self._remove(self._file)

    def _unpacked(self, state: bytes) -> Operator:
        operator = unpack(state, self._module)
        if type(operator) is not type(self._operator):
            raise SnapshotError(f"it holds a {type(operator).__name__}, not a {type(self._operator).__name__}")
        if missing := self._built - vars(operator).keys():
            raise SnapshotError(f"it lacks the attribute {min(missing)}")
        return operator

    def _opened(self, folder: Path) -> int:
        """A descriptor of the folder, if nobody else can write to it; -1, said once, when that is not so."""
        descriptor = -1
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            about = os.fstat(descriptor)
            if about.st_uid == os.geteuid() and not about.st_mode & OTHERS_WRITE:
                return descriptor
            os.close(descriptor)
            found = "others can write to it; expected a folder of this user's alone"
        except OSError as error:
            found = str(error.strerror)
        self._possible = False
        log.warning("keeps no snapshots: %s: %s", folder, found)
        return -1

    def _read(self) -> bytes | None:
        if self._folder < 0:
            return None
        try:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            with os.fdopen(os.open(self._file, flags, dir_fd=self._folder), "rb") as file:
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SnapshotError(f"it cannot be read: {error.strerror}") from error

    def _write(self, name: str, data: bytes) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
        with os.fdopen(os.open(name, flags, 0o600, dir_fd=self._folder), "wb") as file:
            file.write(data)

    def _remove(self, name: str) -> None:
        if self._folder >= 0:
            with suppress(OSError):  # it is not there
                os.unlink(name, dir_fd=self._folder)

    def _name(self) -> str:
        """The program's module by its own name, also where it runs as a script."""
        spec = getattr(sys.modules[self._module], "__spec__", None)
        return spec.name if spec is not None else self._module
