"""Where an operator's snapshots are kept between two processes: one file in the run's own folder, the newest only.

A snapshot is a luxury: one that cannot be written or read is said in one line, and the operator goes on without.
"""

import logging
import sys
from pathlib import Path
from typing import NamedTuple

import msgspec

import caneflow
from caneflow.runtime.program import Operator
from caneflow.runtime.stages.operator_stage import StageState
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.sent_samples import Kept
from caneflow.runtime.stages.snapshot import pack, unpack
from caneflow.runtime.stages.snapshot_file import SnapshotFile
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

LAYOUT = 3  # of the file: one of another layout is not read


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


class SnapshotKeeper(SnapshotFile):
    """Keeps the newest snapshot of one operator."""

    def __init__(self, path: Path, operator: Operator) -> None:
        """`operator`: as it was just built; its attributes are those that a snapshot must have."""
        super().__init__(path)
        self._operator = operator
        self._built = set(vars(operator))
        self._module = type(operator).__module__
        self._program = f"{self._name()}:{type(operator).__qualname__}"
        self._on_trial = False  # a snapshot was gone on from, and none was kept since
        self.state: bytes | None = None  # of the operator, when it was packed last
        self._possible = self._folder >= 0  # False: none can be taken, and that was said

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

    def resume(self) -> Resumed | None:
        """What the newest snapshot holds; None when there is none. Raises SnapshotError for one that does not fit."""
        data = self._read()
        return None if data is None else self.resumed(data)

    def resumed(self, data: bytes) -> Resumed:
        """What a snapshot holds; raises SnapshotError for one that does not fit."""
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

    def keep(self, snapshot: bytes) -> bool:
        """Write what was taken in place of the one before. False: not possible now."""
        kept = super().keep(snapshot)
        self._on_trial = self._on_trial and not kept
        return kept

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

    def _unpacked(self, state: bytes) -> Operator:
        operator = unpack(state, self._module)
        if type(operator) is not type(self._operator):
            raise SnapshotError(f"it holds a {type(operator).__name__}, not a {type(self._operator).__name__}")
        if missing := self._built - vars(operator).keys():
            raise SnapshotError(f"it lacks the attribute {min(missing)}")
        return operator

    def _name(self) -> str:
        """The program's module by its own name, also where it runs as a script."""
        spec = getattr(sys.modules[self._module], "__spec__", None)
        return spec.name if spec is not None else self._module
