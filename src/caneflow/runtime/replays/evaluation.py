"""Methods side by side over recordings: several estimators of one graph in one run, held against the truth.

The estimator's node stands in the graph once for each method, so what all of them read is computed once. Nothing
is recorded; the poses are those of `caneflow run --in-process --set fusion.method=...`.
"""

import math
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args, get_origin, get_type_hints

import numpy as np

from caneflow.algorithms.cane.cane_filter import CaneFilterSettings
from caneflow.algorithms.judging.error_summary import normalized_error_squared
from caneflow.algorithms.judging.track_errors import Floats, Track, TrackErrors, final_offset, track_errors
from caneflow.algorithms.rotations import Vector
from caneflow.errors import CaneflowError
from caneflow.messages import Pose, Sample
from caneflow.recording import TRUTH, Recording
from caneflow.runtime.dataflow.graph import Graph, Node, Queue, Wire
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.in_process import InProcess
from caneflow.runtime.program import Sink
from caneflow.runtime.replayed import Replay
from caneflow.runtime.replays.smoothed_method import HINDSIGHT_OF, SMOOTHED, smoother
from caneflow.runtime.replays.workers import mapped, mapped_on_cluster
from caneflow.runtime.wording import did_you_mean, listed, one_line

ESTIMATOR = "fusion"  # the node whose methods are compared
METHOD = "method"  # its setting that selects one
POSE = "pose"  # its output
COLLECTOR = "evaluation.poses"  # no node of a file has such a name

Figures: TypeAlias = dict[str, float | None]  # by name, as in FIGURES
FIGURES = (*(each.name for each in fields(TrackErrors)), "nees")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What one method said of one recording."""

    track: Track
    covariance: Floats | None  # (6, 6) of the last pose, position and velocity; None: the method gives none


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What all methods said of one recording, and how well."""

    recording: Path
    figures: dict[str, Figures] = field(default_factory=dict)  # by method
    failures: dict[str, str] = field(default_factory=dict)  # by method: why there are no figures
    tracks: dict[str, Track] = field(default_factory=dict)  # by method, when they were to be kept
    truth: Track | None = None  # likewise


def offered_methods(graph: Graph) -> tuple[str, ...]:
    """The methods that the graph's estimator can be set to; raises DataflowError when it has none."""
    hints = get_type_hints(_estimator(graph).program.Settings)  # type: ignore[union-attr]  # checked there
    choice = hints.get(METHOD)
    if get_origin(choice) is not Literal:
        raise DataflowError(f"{graph.path}: nodes.{ESTIMATOR}: has no setting {METHOD!r} to choose from")
    return get_args(choice)


def chosen_methods(graph: Graph, wanted: Sequence[str] = ()) -> tuple[str, ...]:
    """`wanted`, or all that the estimator offers when there are none; raises DataflowError for one that is not there.

    `smoothed` sees the whole recording at once: it is there to be asked for, and not one of all.
    """
    online = offered_methods(graph)
    offered = (*online, SMOOTHED) if _hindsight(graph) is not None else online
    for method in wanted:
        if method not in offered:
            raise DataflowError(
                f"no method {method!r};{did_you_mean(method, offered)} {ESTIMATOR} offers {listed(offered)}"
            )
    return tuple(dict.fromkeys(wanted)) or online


def evaluated(
    flow: Path,
    recordings: Sequence[Path],
    methods: Sequence[str],
    *,
    overrides: Sequence[str] = (),
    jobs: int = 1,
    scheduler: str | None = None,
    keep_tracks: bool = False,
    without: Sequence[str] = (),
) -> Iterator[Evaluation]:
    """An evaluation of each recording, in their order; with `jobs` > 1 in as many processes.

    With the address of a Dask `scheduler`, by its workers. `without`: nodes of the graph that are left out. A
    recording or method that fails is in its evaluation's `failures`. Raises DataflowError for a graph that cannot run
    at all.
    """
    each = partial(_evaluate, flow, tuple(overrides), tuple(methods), keep_tracks, tuple(without))
    return mapped(each, recordings, jobs) if scheduler is None else mapped_on_cluster(each, recordings, scheduler)


def without_nodes(graph: Graph, names: Sequence[str]) -> Graph:
    """The graph without some nodes and the wires from them; raises DataflowError for a node that has no input then."""
    left_out = frozenset(names)
    if unknown := left_out - graph.nodes.keys():
        raise DataflowError(f"--without {min(unknown)}: no such node; there are {listed(graph.nodes)}")
    nodes = {}
    for name, node in graph.nodes.items():
        if name not in left_out:
            inputs = {port: wire for port, wire in node.inputs.items() if wire.node not in left_out}
            if node.inputs and not inputs:
                raise DataflowError(f"{name}: --without leaves it no input; leave it out too")
            nodes[name] = replace(node, inputs=inputs)
    return replace(graph, nodes=nodes)


def estimates(graph: Graph, recording: Path, methods: Sequence[str]) -> tuple[dict[str, Estimate], dict[str, str]]:
    """By method what it says of a recording, or why it says nothing.

    All methods run together; when that fails, each runs alone, so that a reason belongs to its method.
    """
    try:
        poses = _run(graph, recording, methods)
        return {method: _estimate(poses[method]) for method in methods}, {}
    except Exception as error:  # an operator may be a user's own and raise anything: here a node has died of it
        if len(methods) == 1:
            return {}, {methods[0]: _reason(error)}
    done: dict[str, Estimate] = {}
    failures: dict[str, str] = {}
    for method in methods:
        one, failure = estimates(graph, recording, [method])
        done |= one
        failures |= failure
    return done, failures


def figures_of(estimate: Estimate, truth: Track | None, boresight: Vector) -> Figures:
    """The errors of one estimate, named as in TrackErrors, and `nees`, that of the final horizontal position.

    Without truth only what needs none, the paper's distance between start and end among it; the rest is None.
    Raises ValueError when the estimate does not cover the truth.
    """
    track = estimate.track
    if truth is None:
        distance = float(np.linalg.norm((track.positions[-1] - track.positions[0])[:2]))
        duration = float(track.stamps[-1] - track.stamps[0]) * 1e-9
        known = {"poses": len(track.stamps), "duration": duration, "final_distance": distance}
        return dict.fromkeys(FIGURES) | known | {"growth_rate": distance / duration}
    nees = None
    if estimate.covariance is not None:
        offset = final_offset(track, truth, boresight=boresight)
        nees = normalized_error_squared(offset, estimate.covariance[:2, :2])
    return asdict(track_errors(track, truth, boresight=boresight)) | {"nees": nees}


def _evaluate(
    flow: Path,
    overrides: Sequence[str],
    methods: Sequence[str],
    keep_tracks: bool,
    without: Sequence[str],
    recording: Path,
) -> Evaluation:
    # The graph is loaded here, as a user's own program cannot be sent to another process.
    graph = without_nodes(load(flow, overrides), without)
    try:
        truth, boresight = _known_of(graph, recording)
    except (CaneflowError, ValueError) as error:  # ValueError: a rig or a truth that makes no sense
        return Evaluation(recording=recording, failures=dict.fromkeys(methods, one_line(error)))
    done, failures = estimates(graph, recording, methods)
    figures: dict[str, Figures] = {}
    for method, estimate in done.items():
        try:
            figures[method] = figures_of(estimate, truth, boresight)
        except ValueError as error:
            failures[method] = str(error)
    if not keep_tracks:
        return Evaluation(recording=recording, figures=figures, failures=failures)
    tracks = {method: estimate.track for method, estimate in done.items()}
    return Evaluation(recording=recording, figures=figures, failures=failures, tracks=tracks, truth=truth)


def _known_of(graph: Graph, path: Path) -> tuple[Track | None, Vector]:
    """A recording's truth, where there is any, and the boresight."""
    with Recording(path) as recording:
        rig = recording.validated_rig(below=graph.rig)
        if TRUTH not in recording.streams:
            return None, rig.boresight
        poses = [sample.decoded() for sample in recording.samples([TRUTH])]
    return _track([pose for pose in poses if isinstance(pose, Pose)]), rig.boresight


def _run(graph: Graph, recording: Path, methods: Sequence[str]) -> Mapping[str, list[Pose]]:
    """The poses that each method gives, by method."""
    poses: dict[str, list[Pose]] = {method: [] for method in methods}
    side_by_side = _with_methods(graph, methods, poses)
    programs = {name: node.program for name, node in side_by_side.nodes.items() if node.program is not None}
    deployment = deploy(side_by_side, replay=Replay(recording=recording, speed=math.inf))
    outcome = InProcess(deployment, programs).run()
    if outcome.failures:
        raise DataflowError("; ".join(outcome.failures))
    return poses


def _with_methods(graph: Graph, methods: Sequence[str], poses: dict[str, list[Pose]]) -> Graph:
    """The graph up to its estimator, which stands there once for each method, and what fills `poses` behind them."""
    estimator, collector = _estimator(graph), _collector(poses)
    nodes = {name: graph.nodes[name] for name in _upstream(graph, estimator)}
    queue = Queue(mode="all", length=1)  # in a replay everything is kept, whatever the length
    wires: dict[str, Wire] = {}
    for method in methods:
        name = f"{ESTIMATOR}.{method}"
        if method == SMOOTHED and (hindsight := _hindsight(graph)) is not None:
            program = smoother(hindsight, poses[method])
            nodes[name] = replace(
                estimator, name=name, program=program, outputs={}, settings=program.Settings(), settings_map={}
            )
            continue
        settings = {**estimator.settings_map, METHOD: method}
        nodes[name] = replace(estimator, name=name, settings_map=settings)
        wires[method] = Wire(node=name, port=POSE, kind=Pose, queue=queue, max_lag_ms=None, max_age_ms=None)
    if wires:
        nodes[COLLECTOR] = replace(
            estimator,
            name=COLLECTOR,
            program=collector,
            inputs=wires,
            outputs={},
            settings=collector.Settings(),
            settings_map={},
        )
    return replace(graph, nodes=nodes)


def _upstream(graph: Graph, node: Node) -> list[str]:
    """The names of the nodes that `node` depends on, in the order of the file."""
    found: set[str] = set()
    waiting = [wire.node for wire in node.inputs.values()]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += [wire.node for wire in graph.nodes[name].inputs.values()]
    return [name for name in graph.nodes if name in found]


def _collector(poses: dict[str, list[Pose]]) -> type[Sink]:
    """A sink that puts the poses of each method into its list."""
    by_node = {f"{ESTIMATOR}.{method}": into for method, into in poses.items()}

    class Collector(Sink):
        """Keeps what it is given; made for one run, as a program's settings are plain values."""

        def __init__(self, settings: Any, context: Any) -> None:
            pass

        def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
            """Keep a pose."""
            assert isinstance(message, Pose)
            by_node[key.split("/")[1]].append(message)

        def idle(self, time: int) -> None:
            """Nothing to do."""

        def finish(self) -> None:
            """Nothing to do."""

    return Collector


def _hindsight(graph: Graph) -> CaneFilterSettings | None:
    """What `smoothed` may be told: the settings of the method that it is the hindsight of, where there is that."""
    settings = getattr(_estimator(graph).settings, HINDSIGHT_OF, None)
    return settings if isinstance(settings, CaneFilterSettings) else None


def _estimator(graph: Graph) -> Node:
    node = graph.nodes.get(ESTIMATOR)
    if node is None:
        raise DataflowError(f"{graph.path}: no node {ESTIMATOR!r}; there are {listed(graph.nodes)}")
    if node.program is None or node.outputs.get(POSE) is not Pose:
        raise DataflowError(
            f"{graph.path}: nodes.{ESTIMATOR}: not a program with an output {POSE!r} of Pose; nothing to compare"
        )
    return node


def _estimate(poses: Sequence[Pose]) -> Estimate:
    if len(poses) < 2:
        raise DataflowError(f"{ESTIMATOR} gave {len(poses)} poses; a track takes 2")
    last = poses[-1].covariance
    return Estimate(track=_track(poses), covariance=None if last is None else last.astype(np.float64))


def _track(poses: Sequence[Pose]) -> Track:
    return Track(
        stamps=np.array([pose.stamp for pose in poses], dtype=np.int64),
        positions=np.array([pose.position for pose in poses], dtype=np.float64).reshape(-1, 3),
        orientations=np.array([pose.orientation for pose in poses], dtype=np.float64).reshape(-1, 4),
    )


def _reason(error: Exception) -> str:
    """What went wrong, in one line; for an error that nobody expected, also where."""
    if isinstance(error, CaneflowError):
        return one_line(error)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {one_line(error)} (line {frame.lineno} of {frame.filename})"
