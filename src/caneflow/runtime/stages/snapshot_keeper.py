"""Where an operator's snapshots are kept between two processes: one file in the run's own folder, the newest only."""

import logging
import sys
from pathlib import Path

import msgspec

import caneflow
from caneflow.runtime.program import Operator
from caneflow.runtime.stages.history import Kept
from caneflow.runtime.stages.snapshot import SnapshotError, pack, unpack
from caneflow.runtime.stages.stage import StageState

log = logging.getLogger(__name__)


class Snapshot(msgspec.Struct, frozen=True):
    """Everything that a new process needs to go on as if nothing had happened."""

    version: str  # of caneflow: another one may mean something else by the same names
    program: str
    stage: StageState
    history: dict[str, list[Kept]]  # by output port what its readers have not made sure of
    operator: bytes


class SnapshotKeeper:
    """Keeps the newest snapshot of one operator."""

    def __init__(self, path: Path, operator: Operator) -> None:
        self._path = path
        self._operator = operator
        self._module = type(operator).__module__
        self._program = f"{self._name()}:{type(operator).__qualname__}"
        self._possible = True

    def taken(self, stage: StageState, history: dict[str, list[Kept]]) -> bytes | None:
        """The operator's state and where its streams stand; None, said once, when the state cannot be kept."""
        if not self._possible:
            return None
        try:
            state = pack(vars(self._operator), self._module)
        except SnapshotError as error:
            self._possible = False
            log.warning("cannot be brought back exactly after a kill: %s", error)
            return None
        return msgspec.msgpack.encode(Snapshot(caneflow.__version__, self._program, stage, history, state))

    def keep(self, snapshot: bytes) -> None:
        """Write what was taken in place of the one before; the file is whole at any moment."""
        fresh = self._path.with_suffix(".new")
        fresh.write_bytes(snapshot)
        fresh.replace(self._path)

    def resume(self) -> Snapshot | None:
        """The newest snapshot, the operator brought to its state; None when there is none that fits."""
        if not self._path.exists():
            return None
        try:
            snapshot = msgspec.msgpack.decode(self._path.read_bytes(), type=Snapshot)
            if (snapshot.version, snapshot.program) != (caneflow.__version__, self._program):
                raise SnapshotError(f"it is of {snapshot.program} of caneflow {snapshot.version}")
            state = unpack(snapshot.operator, self._module)
        except (OSError, msgspec.MsgspecError, SnapshotError) as error:
            log.warning("starts anew, its snapshot cannot be used: %s", error)
            return None
        vars(self._operator).clear()
        vars(self._operator).update(state)
        log.info("goes on from its snapshot")
        return snapshot

    def _name(self) -> str:
        """The program's module by its own name, also where it runs as a script."""
        spec = getattr(sys.modules[self._module], "__spec__", None)
        return spec.name if spec is not None else self._module
