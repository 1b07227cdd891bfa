"""`caneflow bench`: how many times faster than real time a recording runs in one process, and where the time goes."""

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from caneflow.messages import MessageError, Sample, decode
from caneflow.options import FlowFile
from caneflow.recording import Recording
from caneflow.runtime import Emitted, Operator
from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.shipped import flow_for
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.in_process import InProcess
from caneflow.runtime.program import Program
from caneflow.runtime.replayed import Replay

clock = time.process_time  # CPU time: other programs on the machine count less


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """What one recording costs: the fastest of several runs."""

    duration: float  # s of the recording
    cpu: float  # s, of the whole run after start-up
    stages: dict[str, float]  # s, of its parts, which add up to `cpu`; merging is all that the host does besides
    reference: float  # s, of a fixed load in the same process: how fast the machine is just now


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="The recording.", show_default=False)],
    file: FlowFile = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    repeat: Annotated[int, typer.Option(metavar="N", min=1, help="Runs, of which the fastest counts.")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure how fast a recording runs in one process, and where the time goes.

    CPU time of one core, without start-up. Run it alone: other programs take the caches away.

    Example: caneflow bench walk.mcap --set ground_speed.with_velocity=false
    """
    measured = benchmark(load(flow_for([recording], file), settings or ()), recording, repeat)
    if as_json:
        print(json.dumps(described(recording, measured), indent=2))
        return
    print(
        f"{recording}: {measured.duration:.1f} s in {measured.cpu:.2f} s of CPU: "
        f"{measured.duration / measured.cpu:.0f} x real time"
    )
    for name, spent in measured.stages.items():
        share = spent / measured.cpu
        print(f"  {name:<16} {spent:6.3f} s  {share:4.0%}  {_per_10_ms(spent, measured):6.1f} us per 10 ms")
    print(f"  reference load   {measured.reference:6.3f} s  (fixed: how fast the machine is just now)")


def described(recording: Path, measured: Benchmark) -> dict[str, Any]:
    """What `bench --json` prints; times in s."""
    return {
        "recording": str(recording),
        "duration": measured.duration,
        "cpu": measured.cpu,
        "times_real_time": measured.duration / measured.cpu,
        "stages": measured.stages,
        "us_per_10_ms": {name: _per_10_ms(spent, measured) for name, spent in measured.stages.items()},
        "reference": measured.reference,
    }


def benchmark(graph: Graph, recording: Path, repeat: int) -> Benchmark:
    """Run `graph` on `recording`; raises DataflowError when there is nothing to run."""
    with Recording(recording) as opened:
        span = opened.span()
    if span is None or span[0] == span[1]:
        raise DataflowError(f"{recording}: holds no time; there is nothing to measure")
    programs = {name: node.program for name, node in graph.nodes.items() if node.program is not None}
    runs = [_run(graph, recording, programs) for _ in range(repeat)]
    stages = min(runs, key=lambda stages: sum(stages.values()))
    return Benchmark(
        duration=(span[1] - span[0]) * 1e-9,
        cpu=sum(stages.values()),
        stages=stages,
        reference=min(reference_load() for _ in range(repeat)),
    )


def reference_load() -> float:
    """CPU time (s) of work that never changes: plain Python, small arrays and transforms, as the chain has them."""
    small, spectra = np.ones(300, np.float32), np.ones((16, 256), np.complex64)
    begin = clock()
    for i in range(2_000):
        np.fft.fft(spectra, norm="forward")
        for _ in range(10):
            np.multiply(small, 1.0, out=small)
        sum([j * 0.5 for j in range(i, i + 200)])
    return clock() - begin


def _run(graph: Graph, recording: Path, programs: Mapping[str, Program]) -> dict[str, float]:
    """CPU time (s) of one run, by its parts."""
    spent: dict[str, float] = {}
    timed = {
        name: _timed(program, name, spent) if issubclass(program, Operator) else program
        for name, program in programs.items()
    }
    host = InProcess(deploy(graph, replay=Replay(recording=recording, speed=math.inf)), timed)
    begin = clock()
    host.run()
    rest = clock() - begin - sum(spent.values())
    reading, decoding = _sources(graph, recording)
    # By themselves, these two may take a little longer than between other work.
    merging = max(rest - reading - decoding, 0.0)
    return {"reading": reading, "decoding": decoding, **spent, "merging": merging}


def _sources(graph: Graph, recording: Path) -> tuple[float, float]:
    """CPU time (s) of reading what the graph's sources bring, and of decoding it."""
    begin = clock()
    found = list(_read(graph, recording))
    read = clock()
    for kind, payload in found:
        with suppress(MessageError):  # a host counts it and goes on
            decode(payload, kind)
    return read - begin, clock() - read


def _read(graph: Graph, recording: Path) -> Iterator[tuple[type[Sample], bytes]]:
    with Recording(recording) as opened:
        sources = [name for name in opened.streams if name[0] in graph.nodes and not graph.nodes[name[0]].inputs]
        for sample in opened.samples(sources):
            if sample.kind is not None:
                yield sample.kind, sample.payload


def _timed(program: type[Operator], name: str, spent: dict[str, float]) -> type[Operator]:
    """`program`, adding the time in its `handle` to that of `name`."""
    spent[name] = 0.0

    def handle(self: Operator, port: str, message: Sample) -> Emitted:
        begin = clock()
        try:
            return list(program.handle(self, port, message))
        finally:
            spent[name] += clock() - begin

    return type(program.__name__, (program,), {"handle": handle})


def _per_10_ms(spent: float, measured: Benchmark) -> float:
    return spent / measured.duration * 1e4  # us
