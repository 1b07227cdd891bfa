"""Runs a deployment in this process: the same operators and streams, no sockets, no clock, event time only.

For evaluation, tuning, debugging and fleets of recordings; and the oracle for the host of processes, which must
give the same bytes.
"""

import heapq
import importlib
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextvars import copy_context
from itertools import islice
from typing import NamedTuple, TypeAlias

from caneflow.errors import CaneflowError
from caneflow.messages import Sample
from caneflow.runtime.building import build
from caneflow.runtime.deployment import RECORDER_MODULE, Deployment
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.outcome import Outcome, note_losses
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Encoded, Program, Quiet, Source
from caneflow.runtime.replayed import REPLAYER_MODULE
from caneflow.runtime.stages.group import Group, in_order
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.wording import one_line

Arriving: TypeAlias = tuple[str, str, Sample | Encoded]  # node, port, sample

BATCH = 256  # samples of the sources that are spread before the operators run: bounds the memory
OWN_PROGRAMS = {REPLAYER_MODULE: "Replay", RECORDER_MODULE: "Recorder"}  # what a deployment adds to the graph


class InProcess:
    """One run of a deployment whose sources are recordings."""

    def __init__(self, deployment: Deployment, programs: Mapping[str, Program]) -> None:
        """`programs`: the class of each node of the graph, by name."""
        if not deployment.replay:
            raise DataflowError("--in-process runs on a recording; give --replay REC")
        self._group = Group(deployment.plans, received=_at_its_stamp, spares_marks=True)
        self._sources: dict[str, Source] = {}
        for name in in_order(deployment.plans):
            plan = deployment.plans[name]
            built = build(_program(plan, programs), plan)
            self._group.add(plan, built)
            if isinstance(built, Source):
                self._sources[name] = built

    def run(self) -> Outcome:
        """Run to the end of the recording; raises KeyboardInterrupt when that is not reached because of a signal."""
        outcome = self.run_until_interrupted()
        if outcome.interrupted:  # a part is never taken for the whole
            raise KeyboardInterrupt
        return outcome

    def run_until_interrupted(self, handled: Callable[[int], None] = lambda _: None) -> Outcome:
        """The same; after a signal the outcome says so, and holds what was counted up to there.

        `handled` is told now and then up to which stamp (ns) everything has been handled.
        """
        outcome = Outcome()
        try:
            copy_context().run(self._run, handled)  # numpy's errors are set for the operators, and for nobody else here
        except KeyboardInterrupt:
            outcome.interrupted = True
        finally:
            self._group.finish()
        outcome.counters = {counters.node: counters for counters in self._group.counters()}
        if not outcome.interrupted:
            note_losses(outcome)
        return outcome

    def _run(self, handled: Callable[[int], None]) -> None:
        arriving = self._merged()
        while batch := list(islice(arriving, BATCH)):
            for name, port, sample in batch:
                self._group.bring(name, port, sample)
            last = batch[-1][2].stamp
            for feed in self._group.feeds.values():
                feed.nothing_until(last - 1)
            self._handle_what_is_due()
            handled(last)
        for feed in self._group.feeds.values():
            feed.ended = True
        self._handle_what_is_due()

    def _merged(self) -> Iterator[Arriving]:
        """The samples of all sources in the order of their stamps."""
        each = [_samples(name, source) for name, source in self._sources.items()]
        return heapq.merge(*each, key=_stamp)  # equal stamps: in the order of the nodes

    def _handle_what_is_due(self) -> None:
        self._step()
        self._group.tell_all_marks()  # what the samples alone do not tell: once, and not after each of them
        self._step()

    def _step(self) -> None:
        while self._group.step() is not None:
            pass


class Failure(NamedTuple):
    """An exception of an operator, where it happened."""

    node: str
    at: str  # the sample, e.g. "imu seq 9"
    lines: tuple[str, ...]  # the traceback, from the operator's own frame on
    error: str


def failure_of(error: Exception) -> Failure | None:
    """What an operator raised while it handled a sample; None for an exception that came from elsewhere."""
    place = error.__traceback__
    while place is not None:
        local = place.tb_frame.f_locals
        stage, message = local.get("self"), local.get("message")
        if place.tb_frame.f_code.co_name == "_handled" and isinstance(stage, Stage) and place.tb_next is not None:
            lines = "".join(traceback.format_exception(type(error), error, place.tb_next)).rstrip().splitlines()
            at = f"{local['port']} seq {message.seq}" if isinstance(message, Sample) else str(local["port"])
            if isinstance(error, CaneflowError):
                return Failure(stage.node, at, (), one_line(str(error).removeprefix(f"{stage.node}: ")))
            return Failure(stage.node, at, tuple(lines), one_line(f"{type(error).__name__}: {error}"))
        place = place.tb_next
    return None


def _at_its_stamp(node: str, port: str, message: Sample) -> int:
    """There is no reception here; the stamp stands for it, so that a run gives the same file again."""
    return message.stamp


def _samples(name: str, source: Source) -> Iterator[Arriving]:
    return ((name, *item) for item in source.samples() if not isinstance(item, Quiet))


def _stamp(arriving: Arriving) -> int:
    return arriving[2].stamp


def _program(plan: NodePlan, programs: Mapping[str, Program]) -> Program:
    name = OWN_PROGRAMS.get(plan.module or "")
    if name is None:
        return programs[plan.node]
    program: Program = getattr(importlib.import_module(str(plan.module)), name)
    return program
