"""What a process says of its nodes: how far each has come, what it has counted, what it left out."""

import time
from collections.abc import Iterator, Mapping

import msgspec

from caneflow.messages.control import Counters, Progress
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.group_recovery import AnyRecovery
from caneflow.runtime.hosts.process.inputs import Inputs
from caneflow.runtime.hosts.process.outputs import Outputs
from caneflow.runtime.hosts.process.reports import REPORT_PERIOD, Reports
from caneflow.runtime.hosts.process.sources import counted
from caneflow.runtime.plan import ProcessPlan
from caneflow.runtime.stages.group import Group
from caneflow.runtime.stages.operator_stage import Stage

LOOK_PERIOD = REPORT_PERIOD / 8  # s


class Sayings:
    """Composed from the state of the group; with the process's lock held."""

    def __init__(
        self,
        plan: ProcessPlan,
        bus: Bus,
        group: Group,
        inputs: Mapping[str, Inputs],
        outputs: Mapping[str, Outputs],
        recovery: Mapping[str, AnyRecovery],
    ) -> None:
        self.reports = {name: Reports(bus, replay=plan.replay) for name in plan.members}
        self._look_at = 0.0  # s, monotonic
        self._plan = plan
        self._bus = bus
        self._group = group
        self._inputs = inputs
        self._outputs = outputs
        self._recovery = recovery
        self._stages = {name: each for name, each in group.readers.items() if isinstance(each, Stage)}

    def _progress(self, name: str) -> Progress:
        """How far a node has come, and what its inputs' writers may forget."""
        if name in self._group.feeds:
            return self._group.feeds[name].progress()
        progress = self._group.readers[name].progress()
        if name in self._recovery:
            return msgspec.structs.replace(progress, confirmed=self._recovery[name].confirmed_by(name))
        return progress

    def what_is_due(self) -> None:
        """Say how far each node has come, when someone waits for it or it is due, and what was counted."""
        for name, feed in self._group.feeds.items():
            if feed.ended or self.reports[name].due():
                self.reports[name].progress(feed.progress())
            self.counters(name)
        for name, reader in self._group.readers.items():
            self.what_was_left_out(name)
            reports = self.reports[name]
            waited_for = isinstance(reader, Stage) and self._outputs[name].awaited and reader.tells_more_than_samples()
            if reader.finished or waited_for or reports.due():
                progress = self._progress(name)
                if reader.finished:
                    self.counters(name, at_once=progress != reports.said)
                reports.progress(progress)
            self.counters(name)

    def counters(self, name: str, *, at_once: bool = False) -> None:
        """Say what became of a node's samples, once a second or `at_once`."""
        reports = self.reports[name]
        if not (at_once or reports.counters_due()):
            return
        if name in self._group.feeds:
            reports.counters(counted(self._group.feeds[name], self._outputs[name]))
            return
        inputs = self._inputs[name]
        inputs.count_dropped()
        history = self._outputs[name].history if name in self._outputs else None
        reader = self._group.readers[name]
        counts = reader.input_counts()
        reports.counters(
            Counters(
                node=name,
                inputs=counts,
                outputs={port: out.sent for port, out in reader.outputs.items()} if isinstance(reader, Stage) else {},
                delays=inputs.delays(),
                ended=reader.finished,
                held=self._bus.held + inputs.held + (history.held if history else 0),
                let_go=history.let_go if history else 0,
            )
        )

    def may_be_due(self) -> bool:
        """Whether it is time to look what is to be said, while samples come without end."""
        now = time.monotonic()
        if now < self._look_at:
            return False
        self._look_at = now + LOOK_PERIOD
        return True

    def progress_that_is_due(self) -> Iterator[str]:
        """Say how far those nodes have come for which that is due; yields each."""
        for name, reports in self.reports.items():
            if reports.due():
                reports.progress(self._progress(name))
                yield name

    def to_who_waits(self) -> None:
        """Say at once how far a node has come, when a reader cannot see it from the samples and waits for it."""
        if self._plan.replay:
            return
        for name, stage in self._stages.items():
            if self._outputs[name].awaited and stage.tells_more_than_samples():
                self.reports[name].marks(stage.progress())

    def what_was_left_out(self, name: str) -> None:
        """Say what a node did not handle, once someone hears it."""
        if name in self._stages and self._bus.hears_left_out:
            for note in self._stages[name].left_out():
                self._bus.send_left_out(note)
