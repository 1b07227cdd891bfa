"""The state of a whole group between two samples, as bytes and back."""

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

import caneflow
from caneflow.messages import MessageError, decode, encode
from caneflow.runtime.stages.group import Group
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.sent_samples import History, Kept
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.snapshot_keeper import SnapshotKeeper
from caneflow.runtime.stages.source_stage import FeedState
from caneflow.runtime.wording import listed

LAYOUT = 1


class GroupSnapshot(msgspec.Struct, frozen=True):
    """What a new process needs to go on as if nothing had happened."""

    version: str  # of caneflow
    operators: dict[str, bytes]  # by node, each a Snapshot
    sources: dict[str, FeedState]
    sinks: dict[str, dict[str, tuple[int, int]]]  # by node and port the seq and stamp (ns) of the last sample taken
    waiting: dict[str, dict[str, list[bytes]]]  # by node and port what came from another member and was not handled
    history: dict[str, dict[str, list[Kept]]]  # by source and port what its readers outside have not made sure of
    journal: int  # the file in which what the sources brought since then begins
    layout: int = LAYOUT


class GroupState:
    """Takes the state of a group, and brings it back."""

    def __init__(self, group: Group, histories: Mapping[str, History], path: Path) -> None:
        """`histories`: of each member that sends. `path`: of the snapshots."""
        self._group = group
        self._histories = histories
        self._stages = {name: each for name, each in group.readers.items() if isinstance(each, Stage)}
        self._taps = {name: each for name, each in group.readers.items() if isinstance(each, Tap)}
        self._keepers = {name: SnapshotKeeper(path, stage.operator) for name, stage in self._stages.items()}

    def taken(self, journal: int) -> bytes | None:
        """The state between two samples; None, said once, when it cannot be kept."""
        operators: dict[str, bytes] = {}
        for name, stage in self._stages.items():
            keeper = self._keepers[name]
            snapshot = keeper.taken(stage.state(), self._histories[name].kept(), stage.operator)
            if snapshot is None or keeper.state is None:
                return None
            stage.note_packed(keeper.state)
            operators[name] = snapshot
        return msgspec.msgpack.encode(
            GroupSnapshot(
                version=caneflow.__version__,
                operators=operators,
                sources={name: feed.state() for name, feed in self._group.feeds.items()},
                sinks={name: tap.state() for name, tap in self._taps.items()},
                waiting={
                    name: {port: [*map(encode, stage.waiting(port))] for port in self._group.local_ports(name)}
                    for name, stage in self._stages.items()
                },
                history={name: self._histories[name].kept() for name in self._group.feeds},
                journal=journal,
            )
        )

    def resume(self, data: bytes, decide: Callable[[int], None], *, live: bool) -> None:
        """Go on where `data` was taken; raises SnapshotError.

        `decide`: takes the number of the journal's file that follows, before any sample is taken. `live`: sources go on
        with their numbers; those of a replay begin again.
        """
        try:
            snapshot = msgspec.msgpack.decode(data, type=GroupSnapshot)
        except Exception as error:  # it may hold anything
            raise SnapshotError(f"it is damaged: {error}") from error
        self._require_ours(snapshot)
        operators = {name: self._keepers[name].resumed(operator) for name, operator in snapshot.operators.items()}
        for name, resumed in operators.items():
            self._stages[name].resume(resumed.stage, resumed.operator)
            self._keepers[name].go_on_with(resumed.operator)
            self._keep(name, resumed.history)
        for name, sink in snapshot.sinks.items():
            self._taps[name].resume(sink)
        if live:
            for name, source in snapshot.sources.items():
                self._group.feeds[name].resume(source)
                self._keep(name, snapshot.history[name])
        decide(snapshot.journal)
        for name, ports in snapshot.waiting.items():
            for port, payloads in ports.items():
                self._let_wait(name, port, payloads)

    def _require_ours(self, snapshot: GroupSnapshot) -> None:
        if (snapshot.layout, snapshot.version) != (LAYOUT, caneflow.__version__):
            raise SnapshotError(f"it is of layout {snapshot.layout}, of caneflow {snapshot.version}")
        found = {*snapshot.operators, *snapshot.sources, *snapshot.sinks}
        members = {*self._stages, *self._group.feeds, *self._taps}
        if found != members or snapshot.history.keys() != snapshot.sources.keys():
            raise SnapshotError(f"it is of the nodes {listed(sorted(found))}")

    def _keep(self, name: str, history: Mapping[str, list[Kept]]) -> None:
        for port, samples in history.items():
            for seq, payload in samples:
                self._histories[name].keep(port, seq, payload)

    def _let_wait(self, name: str, port: str, payloads: list[bytes]) -> None:
        for payload in payloads:
            try:
                message = decode(payload, self._stages[name].inputs[port].plan.kind)
            except (MessageError, KeyError) as error:
                raise SnapshotError(f"a sample in it cannot be read: {error}") from error
            self._group.take(name, port, message, payload, message.stamp)
