"""A recording run again and held against the outputs that it holds: a bug in the field is a test for everybody."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caneflow.messages import MessageError, Sample, decode
from caneflow.recording import Platform, Recorded, Recording
from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.deployment import Deployment, deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.in_process import InProcess
from caneflow.runtime.plan import InputPlan, NodePlan
from caneflow.runtime.program import Context, Program, Sink
from caneflow.runtime.replayed import Replay

# On another platform the last digits differ, and filters carry that on. Measured on a walk of 54 s, x86-64 against
# aarch64 (qemu-user): speeds 5.4e-7 m/s, Luenberger 2.7e-8 m, `best` 1.7e-7 m, the firmware's model 9.5e-7 m.
ACROSS_PLATFORMS = 1e-5  # absolute, in a number's own SI unit
COMPARISON = "verification.comparison"  # no node of a file has such a name


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first sample of a stream that is not what was recorded."""

    seq: int
    stamp: int  # ns
    field: str  # of the message; "" when a whole sample is missing or added
    recorded: str
    now: str

    def __str__(self) -> str:
        if not self.field:
            return f"seq {self.seq} (stamp {self.stamp}): {self.recorded} recorded, {self.now} now"
        return f"seq {self.seq} (stamp {self.stamp}): {self.field} was {self.recorded}, is {self.now}"


@dataclass(kw_only=True)
class Verdict:
    """How one output stream came out."""

    stream: str  # node/port
    recorded: int  # samples
    now: int = 0  # samples
    equal: int = 0  # samples whose bytes are the same
    close: int = 0  # samples whose bytes are not, but every number is within the tolerance
    largest: float = 0.0  # the largest difference of a number among those
    first: Difference | None = None  # what breaks the test

    @property
    def holds(self) -> bool:
        """Whether the stream is as it was recorded, within the tolerance."""
        return self.first is None


@dataclass(kw_only=True)
class Verification:
    """What came of all output streams of a recording."""

    verdicts: list[Verdict] = field(default_factory=list)
    tolerance: float = 0.0  # that numbers were compared within
    differences: list[str] = field(default_factory=list)  # between the recording's platform and this one

    @property
    def holds(self) -> bool:
        """Whether every stream is as it was recorded."""
        return all(verdict.holds for verdict in self.verdicts)


def verify(graph: Graph, path: Path, *, tolerance: float | None = None) -> Verification:
    """Run the recording at `path` through `graph` and compare every operator's output that it holds.

    Equal bytes; or, where those differ, numbers within `tolerance` (absolute, SI units) and all else equal. None: 0 on
    the platform of the recording, ACROSS_PLATFORMS on another. What the recorded live run did not handle (`@/late`) is
    left out. Raises DataflowError when there is none to compare.
    """
    deployment = deploy(graph, replay=Replay(recording=path, speed=math.inf))
    with Recording(path) as recording:
        outputs = {
            (name, port): out
            for name, plan in deployment.plans.items()
            for port, out in plan.outputs.items()
            if plan.inputs and (name, port) in recording.streams
        }
        if not outputs:
            raise DataflowError(
                f"{path}: holds no output of {graph.path} ({recording.named()}); record a run with --record"
            )
        there = recording.platform
        differences = (
            there.differences(Platform.here()) if there else ["the recording does not say on what it was computed"]
        )
        if tolerance is None:
            tolerance = ACROSS_PLATFORMS if differences else 0.0
        comparison = _Comparison(recording, list(outputs), tolerance)
        inputs = {
            f"{node}/{port}": InputPlan(key=out.key, schema=out.schema, kind_at=out.kind_at, writer=node)
            for (node, port), out in outputs.items()
        }
        observer = NodePlan(flow=graph.flow, node=COMPARISON, inputs=inputs, replay=True)
        # Without the graph's own sinks: they have no outputs to compare, and write files or serve pages.
        compared = {name: plan for name, plan in deployment.plans.items() if plan.outputs}
        watched = Deployment(flow=deployment.flow, plans={**compared, COMPARISON: observer}, origin=deployment.origin)
        programs: dict[str, Program] = {n: node.program for n, node in graph.nodes.items() if node.program}
        InProcess(watched, {**programs, COMPARISON: comparison.as_program()}).run()
        return Verification(verdicts=comparison.verdicts(), tolerance=tolerance, differences=differences)


class _Comparison:
    """Takes what a run gives and holds each sample against the next recorded one of its stream."""

    def __init__(self, recording: Recording, streams: list[tuple[str, str]], tolerance: float) -> None:
        self._tolerance = tolerance
        # A live run is cut off where it was ended: its inputs may be recorded a little further than its outputs.
        self._open_ended = recording.metadata.get("source") == "live" or not recording.complete
        self._recorded: dict[str, Iterator[Recorded]] = {}
        self._verdicts: dict[str, Verdict] = {}
        for node, port in streams:
            stream = f"{node}/{port}"
            self._recorded[stream] = recording.samples([(node, port)])
            self._verdicts[stream] = Verdict(stream=stream, recorded=recording.streams[node, port].count)

    def as_program(self) -> Program:
        """A sink that brings every sample here."""
        comparison = self

        class Bring(Sink):
            def __init__(self, settings: object, context: Context) -> None: ...

            def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
                comparison.take(key.partition("/")[2], message, payload)

            def idle(self, time: int) -> None: ...

            def finish(self) -> None: ...

        return Bring

    def take(self, stream: str, message: Sample, payload: bytes) -> None:
        """Hold one sample against the next recorded one."""
        verdict = self._verdicts[stream]
        verdict.now += 1
        recorded = next(self._recorded[stream], None)
        if recorded is None:
            if not self._open_ended and verdict.first is None:
                verdict.first = _whole(message.seq, message.stamp, "nothing", "a sample")
        elif recorded.payload == payload:
            verdict.equal += 1
        elif verdict.first is None:
            verdict.first = self._compared(verdict, recorded, message)

    def verdicts(self) -> list[Verdict]:
        """What came of each stream, after the run."""
        for stream, verdict in self._verdicts.items():
            missing = next(self._recorded[stream], None)
            if missing is not None and verdict.first is None:
                verdict.first = _whole(missing.seq, missing.stamp, "a sample", "nothing")
        return list(self._verdicts.values())

    def _compared(self, verdict: Verdict, recorded: Recorded, now: Sample) -> Difference | None:
        try:
            then = decode(recorded.payload, type(now))
        except MessageError as error:
            return Difference(
                seq=recorded.seq, stamp=recorded.stamp, field="sample", recorded=str(error), now="readable"
            )
        largest = 0.0
        for name, before in msgspec.structs.asdict(then).items():
            after = getattr(now, name)
            distance = _distance(before, after)
            exact = name in ("stamp", "seq")  # these are not measurements
            if distance is None or distance > (0.0 if exact else self._tolerance):
                return Difference(
                    seq=recorded.seq, stamp=recorded.stamp, field=name, recorded=_shown(before), now=_shown(after)
                )
            largest = max(largest, distance)
        verdict.close += 1
        verdict.largest = max(verdict.largest, largest)
        return None


def _distance(before: Any, after: Any) -> float | None:
    """The largest absolute difference of two fields' numbers; None when they cannot be compared."""
    if type(before) is not type(after):
        return None
    if isinstance(before, (str, bool)) or before is None:
        return 0.0 if before == after else None
    a, b = np.asarray(before), np.asarray(after)
    if a.shape != b.shape:
        return None
    differ = a != b  # equal infinities have no difference
    if not differ.any():
        return 0.0
    # In integers' own arithmetic stamps would wrap or lose digits; only their being different matters.
    distance = float(np.max(np.abs(a[differ].astype(complex) - b[differ].astype(complex))))
    return max(distance, np.nextafter(0.0, 1.0)) if np.isfinite(distance) else None


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} array of shape {value.shape}"
    return repr(value)


def _whole(seq: int, stamp: int, recorded: str, now: str) -> Difference:
    return Difference(seq=seq, stamp=stamp, field="", recorded=recorded, now=now)
