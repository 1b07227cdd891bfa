"""What a group needs to continue after a kill: one snapshot of all its nodes, and what its sources brought since."""

import logging
import math
import time
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeAlias

from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.recovery import SNAPSHOT_PERIOD, Recovery
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.stages.byte_budget import weight
from caneflow.runtime.stages.decisions import Decided, Decision
from caneflow.runtime.stages.group import Group
from caneflow.runtime.stages.group_snapshot import GroupState
from caneflow.runtime.stages.journal import Brought, Journal, Record
from caneflow.runtime.stages.merge import BEGIN, END
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.snapshot_file import SnapshotFile
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

LIVE_GROUP_PERIOD = 4.0  # s between two snapshots, live: all operators are packed at once, and caught up within 0.1 s


class GroupRecovery:
    """Keeps the snapshots of a group and, live, the journal of its sources; goes on from them."""

    def __init__(
        self,
        plan: ProcessPlan,
        group: Group,
        outputs: Mapping[str, Outputs],
        snapshots: Path,
        lock: AbstractContextManager[object],
    ) -> None:
        """`lock`: over the group and what it has sent."""
        self._plan = plan
        self._group = group
        self._lock = lock
        self._state = GroupState(group, {name: each.history for name, each in outputs.items()}, snapshots)
        self._file = SnapshotFile(snapshots)
        self._stages = {name: each for name, each in group.readers.items() if isinstance(each, Stage)}
        self._journal = None if plan.replay else Journal(snapshots.with_suffix(".journal"))
        if self._journal is not None:
            for stage in self._stages.values():
                for arrivals in stage.inputs.values():
                    arrivals.keep = self._journal.append
        self._since: list[Record] = []  # of the journal, since the snapshot that was gone on from
        self._confirmed: dict[str, dict[str, int]] = {}  # by node and input key what the last snapshot has handled
        budgets = [wire.budget for wire in plan.arriving.values()]
        self._snapshot_bytes = min(budgets) // 2 if budgets else math.inf
        self._since_snapshot = 0  # bytes of samples that came from other processes
        self._keeps = True  # the last snapshot could be kept
        self._on_trial = False  # a snapshot was gone on from, and none was kept since
        self._period = SNAPSHOT_PERIOD if plan.replay else LIVE_GROUP_PERIOD
        self._next = time.monotonic() + self._period
        self._last: object = None  # where the streams stood at the last snapshot
        self.ended = False

    def note(self, payload: bytes) -> None:
        """Take note of a sample that came from another process."""
        self._since_snapshot += weight(payload)

    def keep_brought(self, brought: Brought) -> None:
        """Keep what a source has brought, before it is handled."""
        if self._journal is not None:
            self._journal.append(brought)

    def keep(self) -> None:
        """Now and then: what a new process in this one's place needs to go on."""
        with self._lock:
            full = self._since_snapshot >= self._snapshot_bytes
            due = time.monotonic() >= self._next or (full and self._keeps)
            if self.ended or not due or self._next == math.inf:
                return
            came, handled = self._since_snapshot, self._handled()
            stand = self._stand()
            fresh = stand != self._last
            self._next = math.inf  # until this one is kept
            if fresh:
                self._group.idle(time.time_ns())  # what sinks have taken up to here is not brought again
            number = self._journal.begin() if fresh and self._journal is not None else 0
            snapshot = self._state.taken(number) if fresh else None
            if fresh:
                self._keep_went_on()
        self._keeps = not fresh or self._is_kept(snapshot)  # without the lock: samples do not wait for the disk
        if self._keeps:
            self._last = stand
            if fresh and self._journal is not None:
                self._journal.forget(number)
            with self._lock:
                self._since_snapshot -= came
        if self._keeps or full:
            self._confirmed = handled
        self._next = time.monotonic() + self._period

    def resume(self) -> bool:
        """Go on where a process before this one was killed; whether there was one, and its snapshot fits."""
        try:
            data = self._file.read()
            if data is None:
                return False
            self._state.resume(data, self._decide_again, live=not self._plan.replay)
        except SnapshotError as error:
            log.warning("starts without its snapshot, which cannot be used: %s", one_line(error))
            self._forget()
            return False
        self._on_trial = True
        self._confirmed = self._handled()
        return True

    def brought_since(self) -> Iterable[Brought]:
        """What the sources of the process before this one brought after its snapshot.

        Until all of it has come again, nothing is decided by the clock.
        """
        since, self._since = self._since, []
        yield from (each for each in since if isinstance(each, Brought))
        newest = max(
            (last for feed in self._group.feeds.values() for _, last in feed.state().outputs.values()), default=BEGIN
        )
        for stage in self._stages.values():
            stage.caught_up_at = min(stage.caught_up_at, newest)

    def _decide_again(self, number: int) -> None:
        """Decide as the process before this one has since the journal's file `number`: what followed was published."""
        if self._journal is None:
            return
        self._since = list(self._journal.since(number))
        decisions: dict[tuple[str, str], list[Decision]] = {}
        for each in self._since:
            if not isinstance(each, Brought):
                decisions.setdefault((each.node, each.port), []).append(each)
        for name, stage in self._stages.items():
            stage.caught_up_at = END
            for port in stage.inputs:
                if (name, port) in decisions:
                    stage.decide_again(port, Decided(decisions[name, port]))

    def _keep_went_on(self) -> None:
        """Keep how far inputs have passed beyond their samples: a snapshot does not have it."""
        for went_on in (each for stage in self._stages.values() for each in stage.went_on()):
            if self._journal is not None:
                self._journal.append(went_on)

    def confirmed_by(self, node: str) -> dict[str, int]:
        """By input key the last seq that a node will not ask for again."""
        return self._confirmed.get(node, {})

    def note_failure(self) -> None:
        """Note that the process ends with an error: what led there must not do so again and again."""
        if self._on_trial:
            self._forget()
            log.warning("failed after it had gone on from its snapshot; that one is not used again")

    def _handled(self) -> dict[str, dict[str, int]]:
        return {
            name: {each.plan.key: each.handled_seq for each in reader.inputs.values()}
            for name, reader in self._group.readers.items()
        }

    def _stand(self) -> object:
        sent = {name: feed.state() for name, feed in self._group.feeds.items()}
        return self._handled(), sent

    def _is_kept(self, snapshot: bytes | None) -> bool:
        """Keep a snapshot, or None for a state that cannot be kept; as in Recovery."""
        if snapshot is not None:
            kept = self._file.keep(snapshot)
            self._on_trial = self._on_trial and not kept
            return kept
        if not self._plan.replay:
            self._forget()
        return not self._plan.replay

    def _forget(self) -> None:
        self._file.discard()
        if self._journal is not None:
            self._journal.forget(self._journal.number + 1)


AnyRecovery: TypeAlias = Recovery | GroupRecovery


def recoveries(
    plan: ProcessPlan,
    group: Group,
    outputs: Mapping[str, Outputs],
    snapshots: Path,
    lock: AbstractContextManager[object],
) -> dict[str, AnyRecovery]:
    """By node what keeps its state: one for the whole of a group, one for a single operator, none for a sink."""
    if plan.is_group:
        return dict.fromkeys(plan.members, GroupRecovery(plan, group, outputs, snapshots, lock))
    return {
        name: Recovery(plan.members[name], stage, outputs[name], snapshots, lock)
        for name, stage in group.readers.items()
        if isinstance(stage, Stage)
    }
