"""Flows from Python, for notebooks and scripts: run one on a recording in this process, judge methods by the truth.

from caneflow.evaluation import run_flow, table

poses = table(run_flow("dataflow.yaml", "walk.mcap", ["fusion.method=best"])["fusion/pose"])
print(poses["position"][-1])
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from caneflow.messages import Sample
from caneflow.recording.columns import structured as table
from caneflow.runtime.dataflow.graph import Graph, Node, Queue, Wire
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.in_process import InProcess
from caneflow.runtime.program import Sink
from caneflow.runtime.replayed import Replay
from caneflow.runtime.replays.evaluation import Evaluation, chosen_methods, evaluated
from caneflow.runtime.wording import listed

__all__ = ["Evaluation", "evaluate", "run_flow", "table"]

COLLECTOR = "run.flow"  # no node of a file has such a name


def run_flow(
    flow: str | Path, recording: str | Path, overrides: Sequence[str] = (), *, streams: Sequence[str] = ()
) -> dict[str, list[Sample]]:
    """Replay a recording through a flow in this process: the samples of `streams`, e.g. "fusion/pose".

    `overrides` are those of `caneflow run --set`: "fusion.method=best". Without `streams`: the flow's `results`, or
    where it names none all outputs of its operators. The bytes are those of `caneflow run --in-process`.

    Raises CaneflowError for a flow or a recording that is not right, and for a run that failed.
    """
    graph = load(Path(flow), tuple(overrides))
    wanted = tuple(streams) or graph.results or _outputs(graph)
    collected: dict[str, list[Sample]] = {stream: [] for stream in wanted}
    collecting = _with_collector(graph, collected)
    programs = {name: node.program for name, node in collecting.nodes.items() if node.program is not None}
    outcome = InProcess(deploy(collecting, replay=Replay(recording=Path(recording), speed=math.inf)), programs).run()
    if outcome.failures:
        raise DataflowError("; ".join(outcome.failures))
    return collected


def evaluate(
    flow: str | Path,
    recordings: Sequence[str | Path],
    methods: Sequence[str] = (),
    *,
    overrides: Sequence[str] = (),
    jobs: int = 1,
) -> list[Evaluation]:
    """How far the methods of a flow's `fusion` (none named: all) are from each recording's truth, as `caneflow eval`.

    Figures are by method in `Evaluation.figures`: m, m/s and s, see TrackErrors; tracks in `tracks` and `truth`.
    """
    chosen = chosen_methods(load(Path(flow), tuple(overrides)), methods)
    paths = [Path(each) for each in recordings]
    return list(evaluated(Path(flow), paths, chosen, overrides=overrides, jobs=jobs, keep_tracks=True))


def _outputs(graph: Graph) -> tuple[str, ...]:
    return tuple(f"{node.name}/{port}" for node in graph.nodes.values() if node.inputs for port in node.outputs)


def _with_collector(graph: Graph, collected: dict[str, list[Sample]]) -> Graph:
    """The graph with a sink more, which puts the samples of each stream into its list."""
    wires: dict[str, Wire] = {}
    for index, stream in enumerate(collected):
        name, _, port = stream.partition("/")
        node = graph.nodes.get(name)
        if node is None or port not in node.outputs:
            there = [f"{each.name}/{out}" for each in graph.nodes.values() for out in each.outputs]
            raise DataflowError(f"{graph.path}: no stream {stream}; there are {listed(there)}")
        queue = Queue(mode="all", length=1)  # in a replay everything is kept, whatever the length
        kind = node.outputs[port]
        wires[f"in{index}"] = Wire(node=name, port=port, kind=kind, queue=queue, max_lag_ms=None, max_age_ms=None)
    program = _collector(collected)
    collector: Node = replace(
        next(iter(graph.nodes.values())),
        name=COLLECTOR,
        program=program,
        inputs=wires,
        outputs={},
        settings=program.Settings(),
        settings_map={},
        external=False,
    )
    return replace(graph, nodes={**graph.nodes, COLLECTOR: collector})


def _collector(collected: dict[str, list[Sample]]) -> type[Sink]:
    class Collector(Sink):
        """Keeps what it is given; made for one run, as a program's settings are plain values."""

        def __init__(self, settings: Any, context: Any) -> None:
            pass

        def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
            """Keep a sample."""
            collected[key.partition("/")[2]].append(message)

        def idle(self, time: int) -> None:
            """Nothing to do."""

        def finish(self) -> None:
            """Nothing to do."""

    return Collector
