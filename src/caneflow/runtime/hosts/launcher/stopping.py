"""The end of a run: sources first, then operators, sinks, recorders; each still takes what was on its way.

Else a recorder may hear a sample that an operator, which ended sooner, has neither handled nor left out.
"""

import queue
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from caneflow.runtime.deployment import RECORDER_MODULE
from caneflow.runtime.hosts.launcher.hearing import Ready, Said
from caneflow.runtime.hosts.launcher.nodes import Nodes
from caneflow.runtime.hosts.launcher.processes import Exited, Line, Processes
from caneflow.runtime.hosts.launcher.watcher import Say
from caneflow.runtime.outcome import Outcome
from caneflow.runtime.plan import NodePlan

STOP_PATIENCE = 2.5  # s that nodes have to end, and then as long for the sinks behind them
SOURCES_PATIENCE = 1.5  # s before that for the sources of groups that end later
RECORDER_PATIENCE = 10.0  # s that recorders have, behind all others: who kills one loses the end of its recording


class Turns(NamedTuple):
    """The processes of a run, each by its first node, in the order in which they end."""

    sources: list[str]  # with sources alone
    operators: list[list[str]]  # writers before their readers, as far as those are not each other's
    sinks: list[str]
    recorders: list[str]
    sharing: list[str]  # those above with sources that have to end before another process does


class Stopping:
    """Ends the processes of one run."""

    def __init__(self, nodes: Nodes, processes: Processes, events: "queue.SimpleQueue[object]", say: Say) -> None:
        self._nodes = nodes
        self._processes = processes
        self._events = events
        self._say = say

    def stop(self, outcome: Outcome, *, begun: bool) -> None:
        """End them all; `begun`: the sources have begun."""
        turns = turns_of(self._nodes.plans)
        if begun:
            self._end_sources(turns.sharing)
        killed = self._processes.end(turns.sources, *turns.operators, patience=STOP_PATIENCE)
        killed += self._processes.end(turns.sinks, patience=STOP_PATIENCE - 0.5)
        for name in killed:
            self._say(name, f"did not end within {STOP_PATIENCE:g} s; killed", "warning")
        for name in self._processes.end(turns.recorders, patience=RECORDER_PATIENCE):
            self._say(name, f"did not end within {RECORDER_PATIENCE:g} s; killed", "warning")
            outcome.unrecorded.append(f"{name}: the recording is incomplete: it was killed at the end")
        while not self._events.empty():
            self._take(self._events.get_nowait())

    def _end_sources(self, sharing: Sequence[str]) -> None:
        """End the sources of groups, and wait until what they brought is handled there and sent."""
        ending = {head: _sources(self._nodes.plans[head]) for head in sharing}
        ending = {head: sources for head, sources in ending.items() if self._processes.ask_sources_to_end(head)}
        until = time.monotonic() + SOURCES_PATIENCE
        while any(ending.values()):
            try:
                event = self._events.get(timeout=max(0.0, until - time.monotonic()))
            except queue.Empty:
                return  # it says itself which source is left behind
            match event:
                case Ready(node, there=False):
                    for sources in ending.values():
                        sources.discard(node)
                case Exited(head):
                    ending.pop(head, None)
            self._take(event)

    def _take(self, event: object) -> None:
        match event:
            case Line(node, text):
                self._nodes.take_line(node, text)
            case Said() as said:
                self._nodes.take_said(said)


def turns_of(processes: Mapping[str, Sequence[NodePlan]]) -> Turns:
    """In which order processes end; `processes`: what each runs, by its first node."""
    turns = Turns([], [], [], [], [])
    operators = {}
    for head, plans in processes.items():
        if any(plan.module == RECORDER_MODULE for plan in plans):
            turns.recorders.append(head)
        elif any(plan.inputs and not plan.outputs for plan in plans):
            turns.sinks.append(head)
        elif any(plan.inputs for plan in plans):
            operators[head] = plans
        else:
            turns.sources.append(head)
    turns.operators.extend(_writers_first(operators))
    later = [*turns.operators, turns.sinks, turns.recorders]
    first = next((heads for heads in later if heads), [])
    turns.sharing.extend(head for heads in later for head in heads if _sources(processes[head]) and head not in first)
    return turns


def _writers_first(processes: Mapping[str, Sequence[NodePlan]]) -> list[list[str]]:
    """Processes with operators, those that others read before these; together where they read each other."""
    runs_in = {plan.node: head for head, plans in processes.items() for plan in plans if plan.inputs}
    writers = {
        head: {runs_in.get(wire.writer, head) for plan in plans for wire in plan.inputs.values()} - {head}
        for head, plans in processes.items()
    }
    found = []
    while writers:
        first = [head for head, names in writers.items() if not names & writers.keys()] or list(writers)
        found.append(first)
        for head in first:
            del writers[head]
    return found


def _sources(plans: Sequence[NodePlan]) -> set[str]:
    return {plan.node for plan in plans if not plan.inputs}
