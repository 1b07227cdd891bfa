"""From a checked graph to one plan per node: live drivers or a recording in their place, a recorder, the links."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from caneflow.messages import Sample, control_key, decode, sample_key
from caneflow.messages.control import LeftOut
from caneflow.messages.rig import overlaid, read_rig
from caneflow.recording import Recording
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links import Ports
from caneflow.runtime.plan import InputPlan, Links, NodePlan, OutputPlan

LeftOutStamps: TypeAlias = dict[tuple[str, str], set[int]]

RECORDER = "recorder"
TRUTH = ("truth", "pose")
REPLAYER_MODULE = "caneflow.drivers.replay"
RECORDER_MODULE = "caneflow.tools.record"


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A recording in the place of every node without inputs."""

    recording: Path
    speed: float = 1.0  # times real time; inf: as fast as the readers can
    start_s: float = 0.0  # from the recording's first stamp
    duration_s: float | None = None
    loop: bool = False
    without: frozenset[str] = frozenset()  # nodes that are left out


@dataclass(frozen=True, kw_only=True)
class Deployment:
    """Everything that a host needs to run a flow."""

    flow: str
    plans: dict[str, NodePlan]
    origin: int = 0  # ns: the stamp at which a replay begins

    @property
    def replay(self) -> bool:
        """Whether the sources are recordings."""
        return any(plan.replay for plan in self.plans.values())


def deploy(
    graph: Graph, *, replay: Replay | None = None, record: Path | None = None, rig: dict[str, Any] | None = None
) -> Deployment:
    """The plans of one run; raises DataflowError when the recording does not fit the graph."""
    if replay and record and record.exists() and record.samefile(replay.recording):
        raise DataflowError(f"--record {record}: is the recording that is replayed; write to another file")
    without = replay.without if replay else frozenset()
    if unknown := without - graph.nodes.keys():
        raise DataflowError(f"--without {min(unknown)}: no such node; there are {', '.join(graph.nodes)}")
    nodes = {name: node for name, node in graph.nodes.items() if name not in without}
    origin, base_rig = 0, graph.rig
    if replay is None:
        plans = {name: _plan(graph, node, nodes) for name, node in nodes.items()}
    else:
        with Recording(replay.recording) as recording:
            origin = _origin(recording, replay)
            base_rig = overlaid(graph.rig, recording.rig)
            left_out = _left_out(graph, recording)
            plans = {
                name: _plan(graph, node, nodes, left_out)
                if node.inputs
                else _replayed(graph, node, nodes, replay, recording, origin)
                for name, node in nodes.items()
            }
    whole_rig = overlaid(base_rig, rig or {})
    read_rig(whole_rig)  # what is wrong with a recording's rig is said before anything starts
    if record is not None:
        plans[RECORDER] = _recorder(graph, plans, record, replay, whole_rig)
    plans = {name: _with_readers(plan, plans, whole_rig, replay is not None) for name, plan in plans.items()}
    return Deployment(flow=graph.flow, plans=plans, origin=origin)


def linked(deployment: Deployment, ports: Ports, launcher: str) -> Deployment:
    """The same with an endpoint for every writer: readers dial writers, everybody dials the launcher."""
    endpoints = {name: ports.endpoint() for name, plan in deployment.plans.items() if plan.readers}
    plans = {}
    for name, plan in deployment.plans.items():
        writers = dict.fromkeys(wire.writer for wire in plan.inputs.values())
        connect = (launcher, *(endpoints[writer] for writer in writers if writer in endpoints))
        listen = (endpoints[name],) if name in endpoints else ()
        plans[name] = msgspec.structs.replace(plan, links=Links(listen=listen, connect=connect))
    return Deployment(flow=deployment.flow, plans=plans, origin=deployment.origin)


def _plan(graph: Graph, node: Node, nodes: dict[str, Node], left_out: LeftOutStamps | None = None) -> NodePlan:
    inputs = {
        port: InputPlan(
            key=sample_key(graph.flow, wire.node, wire.port),
            schema=wire.kind.schema,
            writer=wire.node,
            length=wire.queue.length,
            max_lag_ms=wire.max_lag_ms,
            max_age_ms=wire.max_age_ms,
            left_out=tuple(sorted((left_out or {}).get((node.name, port), ()))),
        )
        for port, wire in node.inputs.items()
        if wire.node in nodes
    }
    if node.inputs and not inputs:
        raise DataflowError(f"{node.name}: --without leaves it no input; leave it out too")
    return NodePlan(
        flow=graph.flow,
        node=node.name,
        module=node.module,
        file=str(node.file) if node.file else None,
        settings=node.settings_map,
        seed=graph.seed,
        inputs=inputs,
        outputs=_outputs(graph.flow, node.name, node.outputs),
        ready_timeout_s=node.ready_timeout_s,
    )


def _outputs(flow: str, node: str, kinds: dict[str, type[Sample]]) -> dict[str, OutputPlan]:
    return {port: OutputPlan(key=sample_key(flow, node, port), schema=kind.schema) for port, kind in kinds.items()}


def _replayed(
    graph: Graph, node: Node, nodes: dict[str, Node], replay: Replay, recording: Recording, origin: int
) -> NodePlan:
    """The replayer in the place of a node without inputs: it plays the streams that the recording holds of it."""
    kinds = {}
    for port, kind in node.outputs.items():
        stream = recording.streams.get((node.name, port))
        if stream is None:
            if any(
                wire.node == node.name and wire.port == port
                for reader in nodes.values()
                for wire in reader.inputs.values()
            ):
                held = ", ".join(f"{n}/{p}" for n, p in recording.streams) or "none"
                raise DataflowError(
                    f"{replay.recording}: no stream {node.name}/{port}; it holds {held} "
                    f"(--without {node.name} leaves the node out)"
                )
        elif stream.schema != kind.schema:
            raise DataflowError(
                f"{replay.recording}: {node.name}/{port} holds {stream.schema}, the graph says {kind.schema}"
            )
        else:
            kinds[port] = kind
    settings = {
        "recording": str(replay.recording.resolve()),
        "speed": None if math.isinf(replay.speed) else replay.speed,
        "origin_ns": origin,
        "duration_s": replay.duration_s,
        "loop_s": _loop_s(recording, replay, origin) if replay.loop else None,
    }
    return NodePlan(
        flow=graph.flow,
        node=node.name,
        module=REPLAYER_MODULE,
        settings=settings,
        seed=graph.seed,
        outputs=_outputs(graph.flow, node.name, kinds),
        ready_timeout_s=node.ready_timeout_s,
    )


def _left_out(graph: Graph, recording: Recording) -> LeftOutStamps:
    """What the nodes of a recorded live run said that they did not handle: by node and port, the stamps (ns)."""
    stamps: LeftOutStamps = {}
    for payload in recording.said(control_key(recording.flow, "late")):
        note = decode(payload, LeftOut)
        reader = graph.nodes.get(note.node)
        wire = reader.inputs.get(note.port) if reader else None
        if wire is None:
            continue  # another graph than the recorded one: what it leaves out is its own affair
        found = stamps.setdefault((note.node, note.port), set())
        if note.stamp >= 0:
            found.add(note.stamp)
        elif (wire.node, wire.port) in recording.streams:  # never came there, but did come to the recorder
            lost = range(note.first_seq, note.last_seq + 1)
            found.update(s.stamp for s in recording.samples([(wire.node, wire.port)]) if s.seq in lost)
    return stamps


def _span(recording: Recording) -> tuple[int, int]:
    span = recording.span()
    if span is None:
        raise DataflowError(f"{recording.path}: holds no sample; there is nothing to replay")
    return span


def _origin(recording: Recording, replay: Replay) -> int:
    """The stamp (ns) at which the replay begins."""
    first, last = _span(recording)
    if replay.start_s * 1e9 > last - first:
        raise DataflowError(
            f"{replay.recording}: --start {replay.start_s:g} s lies beyond its end at {(last - first) / 1e9:.3f} s"
        )
    return first + round(replay.start_s * 1e9)


def _loop_s(recording: Recording, replay: Replay, origin: int) -> float:
    """How long (s) one turn of a loop takes: from the first stamp to one mean sample spacing after the last."""
    first, last = _span(recording)
    longest = max(stream.count for stream in recording.streams.values())
    spacing = (last - first) / max(1, longest - 1)
    whole = (last - origin + spacing) / 1e9
    return whole if replay.duration_s is None else min(whole, replay.duration_s)


def _recorder(
    graph: Graph, plans: dict[str, NodePlan], record: Path, replay: Replay | None, rig: dict[str, Any]
) -> NodePlan:
    if RECORDER in plans:
        raise DataflowError(f"{graph.path}: nodes.{RECORDER}: --record adds a node of that name; call yours otherwise")
    inputs = {
        f"{plan.node}/{port}": InputPlan(key=out.key, schema=out.schema, writer=plan.node)
        for plan in plans.values()
        for port, out in plan.outputs.items()
    }
    carries_truth = replay is not None and not replay.loop and TRUTH[0] not in plans
    settings = {
        "path": str(record.resolve()),
        "flow": graph.flow,
        "rig": rig,
        "source": "replayed" if replay else "live",
        "truth_from": str(replay.recording.resolve()) if replay and carries_truth else None,
    }
    return NodePlan(
        flow=graph.flow,
        node=RECORDER,
        module=RECORDER_MODULE,
        settings=settings,
        inputs=inputs,
        hears_notes=replay is None,
    )


def _with_readers(plan: NodePlan, plans: dict[str, NodePlan], rig: dict[str, Any], replay: bool) -> NodePlan:
    outputs = {
        port: msgspec.structs.replace(
            out,
            readers=tuple(
                other.node for other in plans.values() if any(wire.key == out.key for wire in other.inputs.values())
            ),
        )
        for port, out in plan.outputs.items()
    }
    inputs = plan.inputs
    if replay:  # nothing may be lost, and nobody has a clock to lag behind: the sources wait instead
        inputs = {
            port: msgspec.structs.replace(wire, length=None, max_lag_ms=None, max_age_ms=None)
            for port, wire in plan.inputs.items()
        }
    return msgspec.structs.replace(plan, outputs=outputs, rig=rig, replay=replay, inputs=inputs)


def program_arguments(plan: NodePlan) -> Sequence[str]:
    """What follows `python` to start the plan's program."""
    return (plan.file,) if plan.file is not None else ("-m", str(plan.module))
