"""Runs a deployment in this process: the same operators and streams, no sockets, no clock, event time only.

For evaluation, tuning, debugging and fleets of recordings; and the oracle for the host of processes, which must
give the same bytes.
"""

import heapq
import importlib
from collections.abc import Iterator, Mapping
from contextvars import copy_context
from itertools import islice
from typing import TypeAlias

from caneflow.messages import MessageError, Sample, decode, encode, with_number
from caneflow.messages.control import Counters
from caneflow.runtime.building import build
from caneflow.runtime.deployment import RECORDER_MODULE, Deployment
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.outcome import Outcome, note_losses
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.program import Encoded, Operator, Program, Quiet, Sink, Source
from caneflow.runtime.replayed import REPLAYER_MODULE
from caneflow.runtime.stages.operator_stage import Stage
from caneflow.runtime.stages.sink_stage import Tap
from caneflow.runtime.stages.source_stage import Feed

Arriving: TypeAlias = tuple[str, str, Sample | Encoded]  # node, port, sample

BATCH = 256  # samples of the sources that are spread before the operators run: bounds the memory
OWN_PROGRAMS = {REPLAYER_MODULE: "Replay", RECORDER_MODULE: "Recorder"}  # what a deployment adds to the graph


class InProcess:
    """One run of a deployment whose sources are recordings."""

    def __init__(self, deployment: Deployment, programs: Mapping[str, Program]) -> None:
        """`programs`: the class of each node of the graph, by name."""
        if not deployment.replay:
            raise DataflowError("--in-process runs on a recording; give --replay REC")
        self._deployment = deployment
        self._feeds: dict[str, tuple[Feed, Source]] = {}
        self._readers: dict[str, Stage | Tap] = {}  # writers before their readers
        for name in _in_order(deployment.plans):
            plan = deployment.plans[name]
            self._add(plan, build(_program(plan, programs), plan))
        # (node, port) -> who reads it on which port
        self._wires: dict[tuple[str, str], list[tuple[Stage | Tap, str]]] = {
            (name, port): [] for name, plan in deployment.plans.items() for port in plan.outputs
        }
        for name, reader in self._readers.items():
            for port, wire in deployment.plans[name].inputs.items():
                self._wires.setdefault((wire.writer, wire.key.rpartition("/")[2]), []).append((reader, port))

    def run(self) -> Outcome:
        """Run to the end of the recording; raises KeyboardInterrupt when that is not reached because of a signal."""
        outcome = self.run_until_interrupted()
        if outcome.interrupted:  # a part is never taken for the whole
            raise KeyboardInterrupt
        return outcome

    def run_until_interrupted(self) -> Outcome:
        """The same; after a signal the outcome says so, and holds what was counted up to there."""
        outcome = Outcome()
        try:
            copy_context().run(self._run)  # numpy's errors are set for the operators, and for nobody else here
        except KeyboardInterrupt:
            outcome.interrupted = True
        finally:
            for reader in self._readers.values():
                if isinstance(reader, Tap):
                    reader.finish()
        outcome.counters = self._counters()
        if not outcome.interrupted:
            note_losses(outcome)
        return outcome

    def _run(self) -> None:
        arriving = self._merged()
        while batch := list(islice(arriving, BATCH)):
            for name, port, sample in batch:
                self._bring(name, port, sample)
            last = batch[-1][2].stamp
            for feed, _ in self._feeds.values():
                feed.nothing_until(last - 1)
            self._run_readers()
        for feed, _ in self._feeds.values():
            feed.ended = True
        self._run_readers()

    def _merged(self) -> Iterator[Arriving]:
        """The samples of all sources in the order of their stamps."""
        each = [_samples(name, source) for name, (_, source) in self._feeds.items()]
        return heapq.merge(*each, key=_stamp)  # equal stamps: in the order of the nodes

    def _bring(self, name: str, port: str, sample: Sample | Encoded) -> None:
        """Let a source's sample reach all its readers, decoded once."""
        feed, _ = self._feeds[name]
        payload = feed.take(port, sample)
        readers = self._wires[name, port]
        if payload is None or not readers:
            return
        try:
            message = decode(payload, feed.outputs[port].plan.kind)
        except MessageError as error:
            for reader, at in readers:
                reader.refuse(at, error)
        else:
            self._spread(name, port, message, payload)

    def _spread(self, name: str, port: str, message: Sample, payload: bytes | None = None) -> None:
        """Hand one sample to all its readers; `payload` are its bytes, where there are any yet."""
        for reader, at in self._wires[name, port]:
            if isinstance(reader, Stage):
                reader.offer(at, message)
            else:
                # There is no reception here; the stamp stands for it, so that a run gives the same file again.
                reader.offer(at, message, payload or encode(message), message.stamp)

    def _run_readers(self) -> None:
        """Let every node handle what is due; writers come first, so one round is enough."""
        for name, (feed, _) in self._feeds.items():
            self._pass_marks(name, feed)
        for name, reader in self._readers.items():
            if isinstance(reader, Tap):
                if reader.ended:
                    reader.finish()
                continue
            while (emitted := reader.step()) is not None:
                for port, message, seq in emitted:
                    self._spread(name, port, with_number(message, seq))
            self._pass_marks(name, reader)

    def _pass_marks(self, name: str, writer: Feed | Stage) -> None:
        for port, mark in writer.progress().ports.items():
            for reader, at in self._wires[name, port]:
                reader.mark(at, mark)

    def _add(self, plan: NodePlan, built: Operator | Source | Sink) -> None:
        if isinstance(built, Source):
            self._feeds[plan.node] = (Feed(plan.node, plan.outputs, ordered=built.ordered), built)
        elif isinstance(built, Sink):
            self._readers[plan.node] = Tap(plan.node, built, plan.inputs)
        else:
            self._readers[plan.node] = Stage(plan.node, built, plan.inputs, plan.outputs)

    def _counters(self) -> dict[str, Counters]:
        counters = {}
        for name, (feed, _) in self._feeds.items():
            sent = {port: out.sent for port, out in feed.outputs.items()}
            counters[name] = Counters(node=name, inputs={}, outputs=sent, refused=feed.refused, unsent=feed.unsent)
        for name, reader in self._readers.items():
            outputs = {} if isinstance(reader, Tap) else {port: out.sent for port, out in reader.outputs.items()}
            counters[name] = Counters(node=name, inputs=reader.input_counts(), outputs=outputs)
        return counters


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


def _in_order(plans: Mapping[str, NodePlan]) -> list[str]:
    """The nodes, writers before their readers; the graph has been checked to have no cycle."""
    done: dict[str, None] = {}
    while len(done) < len(plans):
        for name, plan in plans.items():
            if all(wire.writer in done for wire in plan.inputs.values()):
                done.setdefault(name)
    return list(done)
