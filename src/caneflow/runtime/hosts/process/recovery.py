"""What a process of one operator needs to continue after a kill, and when it is written."""

import logging
import math
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.stages.byte_budget import weight
from caneflow.runtime.stages.journal import Brought
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.snapshot_keeper import SnapshotKeeper
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

SNAPSHOT_PERIOD = 0.5  # s between two snapshots of an operator
LIVE_SNAPSHOT_PERIOD = 2.0  # s, live: each is work, and wear of the disk; to catch up on so little is soon done


class Recovery:
    """Keeps the snapshots of an operator, and goes on from the last one."""

    def __init__(
        self,
        plan: NodePlan,
        stage: Stage,
        outputs: Outputs,
        snapshots: Path,
        lock: AbstractContextManager[object],
    ) -> None:
        """`lock`: over the stage and what it has sent."""
        self._plan = plan
        self._stage = stage
        self._outputs = outputs
        self._lock = lock
        self.keeper = SnapshotKeeper(snapshots, stage.operator)
        self.confirmed: dict[str, int] = {}  # by input key what the last snapshot has handled
        # Bytes after which a snapshot confirms what was handled: writers keep no more than twice as many for this node.
        self._snapshot_bytes = min(wire.budget for wire in plan.inputs.values()) // 2
        self._since_snapshot = 0  # bytes of samples that came
        self._keeps = True  # the last snapshot could be kept
        self._period = SNAPSHOT_PERIOD if plan.replay else LIVE_SNAPSHOT_PERIOD
        self._next = time.monotonic() + self._period
        self.ended = False  # something was raised while a sample was handled: nothing is kept any more

    def note(self, payload: bytes) -> None:
        """Take note of a sample that came."""
        self._since_snapshot += weight(payload)

    def keep(self) -> None:
        """Now and then: what a new process in this one's place needs to go on."""
        with self._lock:
            full = self._since_snapshot >= self._snapshot_bytes
            due = time.monotonic() >= self._next or (full and self._keeps)
            if self.ended or not due or self._next == math.inf:
                return
            came = self._since_snapshot
            self._next = math.inf  # until this one is kept
            handled = {self._plan.inputs[port].key: seq for port, (seq, _) in self._stage.state().inputs.items()}
            fresh = handled != self.confirmed
            snapshot = self._taken() if fresh else None
        self._keeps = not fresh or self._is_kept(snapshot)  # live without the lock: samples do not wait for the disk
        if self._keeps:
            with self._lock:
                self._since_snapshot -= came
        if self._keeps or full:  # else the writers of a replay would wait for a snapshot without end
            self.confirmed = handled
        self._next = time.monotonic() + self._period

    def resume(self) -> bool:
        """Go on where a process before this one was killed; whether there was one, and its snapshot fits."""
        try:
            kept = self.keeper.resume()
            if kept is None:
                return False
            self._stage.resume(kept.stage, kept.operator)
        except SnapshotError as error:
            log.warning("starts without its snapshot, which cannot be used: %s", one_line(error))
            return False
        self.keeper.go_on_with(kept.operator)
        for port, samples in kept.history.items():
            for seq, payload in samples:
                self._outputs.history.keep(port, seq, payload)
        self.confirmed = {self._plan.inputs[port].key: seq for port, (seq, _) in kept.stage.inputs.items()}
        return True

    def confirmed_by(self, node: str) -> dict[str, int]:
        """By input key the last seq that will not be asked for again."""
        return self.confirmed

    def keep_brought(self, brought: Brought) -> None:
        """Nothing: there is no source here."""

    def brought_since(self) -> Iterable[Brought]:
        """Nothing, likewise."""
        return ()

    def note_failure(self) -> None:
        """Note that the process ends with an error."""
        self.keeper.note_failure()

    def _taken(self) -> bytes | None:
        snapshot = self.keeper.taken(self._stage.state(), self._outputs.history.kept(), self._stage.operator)
        if self.keeper.state is not None:
            self._stage.note_packed(self.keeper.state)
        return snapshot

    def _is_kept(self, snapshot: bytes | None) -> bool:
        """Keep a snapshot, or None for a state that cannot be kept; whether writers may forget what it has handled.

        They may when a process in this one's place would not ask for it. So while no snapshot can be written they keep
        what came since the last one, up to the bound of their histories: beyond it a replay goes on, and would end with
        status 1 if this process were killed. A replay without any snapshot begins again with its first sample; a live
        operator with what is new, since old samples would only make it late.
        """
        if snapshot is not None:
            return self.keeper.keep(snapshot)
        if not self._plan.replay:
            self.keeper.discard()
        return not self._plan.replay
