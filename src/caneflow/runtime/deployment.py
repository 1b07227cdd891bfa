"""From a checked graph to one plan per node: live drivers or a recording in their place, a recorder, the links."""

import hashlib
import math
import uuid
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import msgspec

import caneflow
from caneflow.messages import MessageError, Sample, control_key, decode, sample_key
from caneflow.messages.control import LeftOut
from caneflow.messages.rig import overlaid, read_rig
from caneflow.recording import TRUTH, Recording
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.session import Ports, Sockets
from caneflow.runtime.plan import InputPlan, Links, NodePlan, OutputPlan
from caneflow.runtime.stages.byte_budget import SENT, share
from caneflow.runtime.wording import did_you_mean, listed

LeftOutStamps: TypeAlias = dict[tuple[str, str], set[int]]

RECORDER = "recorder"
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
class Site:
    """The machine that a launcher runs on, among those of its flow."""

    name: str
    leader: str  # the machine whose launcher says when all start and end
    others: tuple[str, ...]
    places: Mapping[str, str]  # by node the machine that it runs on
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    router: str | None = None  # an endpoint that all machines dial; None: they dial each other
    recorders: frozenset[str] = frozenset()  # the machines that may read every stream
    insecure: bool = False  # the file says that machines talk in the clear

    @property
    def leads(self) -> bool:
        """Whether this machine's launcher leads."""
        return self.name == self.leader


@dataclass(frozen=True, kw_only=True)
class Deployment:
    """Everything that a host needs to run a flow."""

    flow: str
    plans: dict[str, NodePlan]
    origin: int = 0  # ns: the stamp at which a replay begins
    site: Site | None = None  # when the flow runs on several machines
    door: Site | None = None  # when it runs on one, and others may listen there
    links: Literal["unix", "tcp"] = "unix"  # between the processes of this machine

    @property
    def replay(self) -> bool:
        """Whether the sources are recordings."""
        return any(plan.replay for plan in self.plans.values())

    def runs_here(self, node: str) -> bool:
        """Whether this launcher starts `node`."""
        return self.site is None or self.site.places[node] == self.site.name

    @property
    def records(self) -> bool:
        """Whether a recorder runs here."""
        return any(plan.module == RECORDER_MODULE and self.runs_here(name) for name, plan in self.plans.items())

    @property
    def digest(self) -> str:
        """What every machine of a run must agree on, in short: the wires, and what is replayed from where."""
        agreed = {
            name: (
                *sorted((port, wire.key, wire.schema, wire.left_out) for port, wire in plan.inputs.items()),
                *sorted((out.key, out.schema) for out in plan.outputs.values()),
                {key: value for key, value in plan.settings.items() if key != "recording"}
                if plan.module == REPLAYER_MODULE
                else None,
                (plan.rig, plan.seed, plan.replay, self.site.places[name] if self.site else None),
            )
            for name, plan in sorted(self.plans.items())
            if plan.module != RECORDER_MODULE
        }
        return hashlib.sha256(msgspec.json.encode((caneflow.__version__, agreed), order="sorted")).hexdigest()[:16]


def deploy(
    graph: Graph,
    *,
    replay: Replay | None = None,
    record: Path | None = None,
    recorder: Mapping[str, Any] | None = None,
    rig: dict[str, Any] | None = None,
    machine: str | None = None,
) -> Deployment:
    """The plans of one run; raises DataflowError when the recording does not fit the graph.

    `recorder`: its settings beyond where it writes. `machine`: this launcher starts only what runs there; None:
    everything.
    """
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
            _require_stamps(recording, replay, origin, plans)
    whole_rig = overlaid(base_rig, rig or {})
    _require_rig(whole_rig, replay)  # what is wrong with a recording's rig is said before anything starts
    site = None if machine is None else _site(graph, machine, nodes)
    if record is not None:
        name = recorder_name(machine if site else None)
        if site and (unheard := set(site.places.values()) - {site.name, *site.others}):
            raise DataflowError(f"--record: {machine} has no link with {min(unheard)}; record on {site.leader}")
        plan = _recorder(graph, name, plans, record, replay, whole_rig)
        plans[name] = msgspec.structs.replace(plan, settings={**plan.settings, **(recorder or {})})
        site = _with_recorder_on(site, machine) if site and machine else site
    plans = {name: _with_readers(plan, plans, whole_rig, replay is not None) for name, plan in plans.items()}
    door = _door(graph) if site is None and (machine is not None or replay is None) else None
    return Deployment(flow=graph.flow, plans=plans, origin=origin, site=site, door=door, links=graph.links)


def with_recorders_on(deployment: Deployment, machines: Iterable[str]) -> Deployment:
    """The same with the recorders of other machines, so that writers here know of these readers."""
    plans, site = dict(deployment.plans), deployment.site
    for machine in machines:
        name = recorder_name(machine)
        inputs = _all_outputs(plans)
        plans[name] = NodePlan(
            flow=deployment.flow, node=name, module=RECORDER_MODULE, inputs=inputs, replay=deployment.replay
        )
        site = _with_recorder_on(site, machine) if site else site
    plans = {name: _with_readers(plan, plans, plan.rig, plan.replay) for name, plan in plans.items()}
    return replace(deployment, plans=plans, site=site)


def linked(deployment: Deployment, ports: Ports | Sockets, launcher: str) -> Deployment:
    """The same with an endpoint for every writer here: readers dial writers, everybody dials the launcher."""
    here = {name: plan for name, plan in deployment.plans.items() if deployment.runs_here(name)}
    endpoints = {name: ports.endpoint() for name, plan in here.items() if any(map(here.get, plan.readers))}
    plans = dict(deployment.plans)
    for name, plan in here.items():
        writers = dict.fromkeys(wire.writer for wire in plan.inputs.values())
        connect = (launcher, *(endpoints[writer] for writer in writers if writer in endpoints))
        listen = (endpoints[name],) if name in endpoints else ()
        plan = msgspec.structs.replace(plan, links=Links(listen=listen, connect=connect))
        plans[name] = _with_clocks(plan, deployment.site) if deployment.site else plan
    return replace(deployment, plans=plans)


def _with_clocks(plan: NodePlan, site: Site) -> NodePlan:
    """The plan with the machine on whose clock each input is."""
    inputs = {
        port: msgspec.structs.replace(
            wire, clock="" if site.places[wire.writer] == site.name else site.places[wire.writer]
        )
        for port, wire in plan.inputs.items()
    }
    return msgspec.structs.replace(plan, inputs=inputs, machine=site.name)


def _site(graph: Graph, machine: str, nodes: Mapping[str, Node]) -> Site | None:
    """The place of `machine` in the graph; None when it is the only one."""
    if machine not in graph.machines:
        raise DataflowError(
            f"--machine {machine}: no such machine;{did_you_mean(machine, graph.machines)} "
            f"there are {listed(graph.machines)}"
        )
    places = {name: str(node.machine) for name, node in nodes.items()}
    used = [name for name in graph.machines if name in places.values()]
    if machine not in used:
        raise DataflowError(f"--machine {machine}: no node runs there")
    if len(used) == 1:
        return None
    leader = graph.leader if graph.leader in used else used[0]
    assert leader is not None
    written = graph.machines[machine]
    return Site(
        name=machine,
        leader=leader,
        others=tuple(name for name in used if name in written.linked),
        places=places,
        listen=written.listen,
        connect=(*written.connect, *filter(None, (graph.router,))),
        router=graph.router,
        recorders=frozenset(name for name in used if graph.machines[name].records),
        insecure=graph.insecure,
    )


def _door(graph: Graph) -> Site | None:
    """Where the only machine of the graph listens for others; None: nowhere."""
    used = list({node.machine: None for node in graph.nodes.values()})
    if len(used) != 1 or used[0] is None or not graph.machines[used[0]].listen:
        return None
    name, places = used[0], dict.fromkeys(graph.nodes, used[0])
    listen = graph.machines[name].listen
    return Site(name=name, leader=name, others=(), places=places, listen=listen, connect=(), insecure=graph.insecure)


def recorder_name(machine: str | None) -> str:
    """What a recorder is called: there may be one on each machine."""
    return RECORDER if machine is None else f"{RECORDER}_{machine}"


def _with_recorder_on(site: Site, machine: str) -> Site:
    return replace(site, places={**site.places, recorder_name(machine): machine})


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
                raise DataflowError(
                    f"{replay.recording}: no stream {node.name}/{port}; it holds {recording.named()} "
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
    lost: dict[tuple[str, str], list[tuple[int, int]]] = {}  # by node and port the numbers, first and last
    for payload in recording.said(control_key(recording.flow, "late")):
        try:
            note = decode(payload, LeftOut)
        except MessageError as error:
            raise DataflowError(f"{recording.path}: what it says was left out cannot be read: {error}") from error
        reader = graph.nodes.get(note.node)
        if reader is None or note.port not in reader.inputs:
            continue  # another graph than the recorded one: what it leaves out is its own affair
        if note.stamp >= 0:
            stamps.setdefault((note.node, note.port), set()).add(note.stamp)
        else:
            lost.setdefault((note.node, note.port), []).append((note.first_seq, note.last_seq))
    for (node, port), ranges in lost.items():
        wire = graph.nodes[node].inputs[port]
        if (wire.node, wire.port) in recording.streams:  # never came there, but did come to the recorder
            numbers = _Numbers(ranges)
            samples = recording.samples([(wire.node, wire.port)])
            stamps.setdefault((node, port), set()).update(s.stamp for s in samples if s.seq in numbers)
    return stamps


class _Numbers:
    """Ranges of numbers, given by their first and last: many, so that looking through all for each sample is no way."""

    def __init__(self, ranges: Iterable[tuple[int, int]]) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []  # the largest so far
        for first, last in sorted(ranges):
            self._firsts.append(first)
            self._lasts.append(max([last, *self._lasts[-1:]]))

    def __contains__(self, number: int) -> bool:
        before = bisect_right(self._firsts, number)
        return before > 0 and number <= self._lasts[before - 1]


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


def _require_stamps(recording: Recording, replay: Replay, origin: int, plans: Mapping[str, NodePlan]) -> None:
    """Raise DataflowError for a stream whose stamps go back or are not its samples', up to the end of the replay.

    Before anything starts: half of such a stream would be refused on its way.
    """
    end = None if replay.duration_s is None else origin + round(replay.duration_s * 1e9)
    replayed = [(name, port) for name, plan in plans.items() if plan.module == REPLAYER_MODULE for port in plan.outputs]
    found = recording.examined(replayed, end_ns=end)
    for each in found.values():
        if each.fault:
            raise DataflowError(f"{replay.recording}: {each.fault}")


def _require_rig(rig: dict[str, Any], replay: Replay | None) -> None:
    """Raise an error that names the recording where there is one: most of a replay's rig is from there."""
    try:
        read_rig(rig)
    except MessageError as error:
        if replay is None:
            raise
        raise DataflowError(f"{replay.recording}, or what is laid over its rig: {error}") from error


def _loop_s(recording: Recording, replay: Replay, origin: int) -> float:
    """How long (s) one turn of a loop takes: from the first stamp to one mean sample spacing after the last."""
    first, last = _span(recording)
    longest = max(stream.count for stream in recording.streams.values())
    spacing = (last - first) / max(1, longest - 1)
    whole = (last - origin + spacing) / 1e9
    return whole if replay.duration_s is None else min(whole, replay.duration_s)


def _all_outputs(plans: Mapping[str, NodePlan]) -> dict[str, InputPlan]:
    """What a recorder reads."""
    return {
        f"{plan.node}/{port}": InputPlan(key=out.key, schema=out.schema, writer=plan.node)
        for plan in plans.values()
        for port, out in plan.outputs.items()
    }


def _recorder(
    graph: Graph, name: str, plans: dict[str, NodePlan], record: Path, replay: Replay | None, rig: dict[str, Any]
) -> NodePlan:
    if name in plans:
        raise DataflowError(f"{graph.path}: nodes.{name}: --record adds a node of that name; call yours otherwise")
    carries_truth = replay is not None and not replay.loop and TRUTH[0] not in plans
    settings = {
        "path": str(record.resolve()),
        "flow": graph.flow,
        "rig": rig,
        "source": "replayed" if replay else "live",
        "run": uuid.uuid4().hex,
        "truth_from": str(replay.recording.resolve()) if replay and carries_truth else None,
    }
    return NodePlan(
        flow=graph.flow,
        node=name,
        module=RECORDER_MODULE,
        settings=settings,
        inputs=_all_outputs(plans),
        hears_notes=replay is None,
    )


def _with_readers(plan: NodePlan, plans: dict[str, NodePlan], rig: dict[str, Any], replay: bool) -> NodePlan:
    outputs = {}
    for port, out in plan.outputs.items():
        readers = [other for other in plans.values() if any(wire.key == out.key for wire in other.inputs.values())]
        awaited = any(len(other.inputs) > 1 and other.outputs for other in readers)
        names = tuple(other.node for other in readers)
        outputs[port] = msgspec.structs.replace(
            out, readers=names, awaited=awaited, budget=_budget(out.key, plan, plans)
        )
    inputs = {
        port: msgspec.structs.replace(wire, budget=_budget(wire.key, plans[wire.writer], plans))
        for port, wire in plan.inputs.items()
    }
    if replay:  # nothing may be lost, and nobody has a clock to lag behind: the sources wait instead
        inputs = {
            port: msgspec.structs.replace(wire, length=None, max_lag_ms=None, max_age_ms=None)
            for port, wire in inputs.items()
        }
    return msgspec.structs.replace(plan, outputs=outputs, rig=rig, replay=replay, inputs=inputs)


def _budget(key: str, writer: NodePlan, plans: Mapping[str, NodePlan]) -> int:
    """How many bytes of one stream may be on their way, so that neither its writer nor a reader of it has too many."""
    most = [len(plan.inputs) for plan in plans.values() if any(wire.key == key for wire in plan.inputs.values())]
    return share(SENT, max(len(writer.outputs), *most, 1))


def program_arguments(plan: NodePlan) -> Sequence[str]:
    """What follows `python` to start the plan's program."""
    return (plan.file,) if plan.file is not None else ("-m", str(plan.module))
