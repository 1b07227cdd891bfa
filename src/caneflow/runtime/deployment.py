"""From a checked graph to one plan per node: live drivers or a recording in their place, and a recorder."""

import hashlib
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec

import caneflow
from caneflow.messages import MessageError, sample_key
from caneflow.messages.rig import overlaid, read_rig
from caneflow.recording import TRUTH, Recording
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.dataflow.topology import NOBODY_LISTENS
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import InputPlan, NodePlan
from caneflow.runtime.replayed import (
    REPLAYER_MODULE,
    LeftOutStamps,
    Replay,
    last_of,
    left_out_of,
    origin_of,
    outputs_of,
    replayed_plan,
    require_stamps,
)
from caneflow.runtime.site import Site, door_of, site_of, with_endpoint
from caneflow.runtime.stages.byte_budget import SENT, share
from caneflow.runtime.user_files import place_of
from caneflow.runtime.wording import listed

RECORDER = "recorder"
RECORDER_MODULE = "caneflow.tools.record"
VIEW_MODULE = "caneflow.tools.view"


@dataclass(frozen=True, kw_only=True)
class Deployment:
    """Everything that a host needs to run a flow."""

    flow: str
    plans: dict[str, NodePlan]
    origin: int = 0  # ns: the stamp at which a replay begins
    last: int | None = None  # ns: the last stamp of a replay; None: a loop has none, nor does a live run
    site: Site | None = None  # when the flow runs on several machines
    door: Site | None = None  # when it runs on one, and others may listen there
    links: Literal["unix", "tcp"] = "unix"  # between the processes of this machine

    @property
    def replay(self) -> bool:
        """Whether the sources are recordings."""
        return any(plan.replay for plan in self.plans.values())

    @property
    def streams(self) -> dict[str, tuple[str, ...]]:
        """By node its output ports."""
        return {name: tuple(plan.outputs) for name, plan in self.plans.items()}

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
    listen: str | None = None,
    one_process: bool = False,
) -> Deployment:
    """The plans of one run; raises DataflowError when the recording does not fit the graph.

    `recorder`: its settings beyond where it writes. `machine`: this launcher starts only what runs there; None:
    everything. `one_process`: all nodes of a machine share one, but the recorder and a view. `listen`: an endpoint at
    which other programs may attach, beside those of the file.
    """
    if replay and record and record.exists() and record.samefile(replay.recording):
        raise DataflowError(f"--record {record}: is the recording that is replayed; write to another file")
    without = replay.without if replay else frozenset()
    if unknown := without - graph.nodes.keys():
        raise DataflowError(f"--without {min(unknown)}: no such node; there are {', '.join(graph.nodes)}")
    nodes = {name: node for name, node in graph.nodes.items() if name not in without}
    origin, last, base_rig = 0, None, graph.rig
    if replay is None:
        plans = {name: _plan(graph, node, nodes) for name, node in nodes.items()}
    else:
        with Recording(replay.recording) as recording:
            origin = origin_of(recording, replay)
            last = last_of(recording, replay, origin)
            base_rig = overlaid(graph.rig, recording.rig)
            left_out = left_out_of(graph, recording)
            plans = {
                name: _plan(graph, node, nodes, left_out)
                if node.inputs
                else replayed_plan(graph, node, nodes, replay, recording, origin)
                for name, node in nodes.items()
            }
            require_stamps(recording, replay, origin, plans)
    if one_process:
        plans = _in_one_process(graph, plans)
    whole_rig = overlaid(base_rig, rig or {})
    _require_rig(whole_rig, replay)  # what is wrong with a recording's rig is said before anything starts
    site = None if machine is None else site_of(graph, machine, nodes)
    if record is not None:
        name = recorder_name(machine if site else None)
        if site and (unheard := set(site.places.values()) - {site.name, *site.others}):
            raise DataflowError(f"--record: {machine} has no link with {min(unheard)}; record on {site.leader}")
        plan = _recorder(graph, name, plans, record, replay, whole_rig)
        plans[name] = msgspec.structs.replace(plan, settings={**plan.settings, **(recorder or {})})
        plans = _with_recorder_in_group(plans, name, site)
        site = _with_recorder_on(site, machine) if site and machine else site
    plans = {name: _with_readers(plan, plans, whole_rig, replay is not None) for name, plan in plans.items()}
    if site is not None:
        site = with_endpoint(site, listen)
    opens = site is None and (machine is not None or replay is None or listen is not None)
    door = door_of(graph, listen) if opens else None
    _require_open(graph, plans, site or door)
    return Deployment(flow=graph.flow, plans=plans, origin=origin, last=last, site=site, door=door, links=graph.links)


def _in_one_process(graph: Graph, plans: Mapping[str, NodePlan]) -> dict[str, NodePlan]:
    """The same with one process for each machine; raises DataflowError when their nodes restart in different ways."""
    grouped = [name for name, plan in plans.items() if not plan.external and plan.module != VIEW_MODULE]
    policies = {graph.nodes[name].restart: name for name in grouped}
    if len(policies) > 1:
        raise DataflowError(f"--one-process: {listed(policies.values())} have a `restart` each; a process has one")
    shared = graph.flow if graph.flow not in plans or graph.flow in grouped else f"{graph.flow}_nodes"
    return {
        name: msgspec.structs.replace(plan, process=shared) if name in grouped else plan for name, plan in plans.items()
    }


def _with_recorder_in_group(plans: Mapping[str, NodePlan], recorder: str, site: Site | None) -> dict[str, NodePlan]:
    """The same with the recorder of this machine under its own name where nodes share its process."""
    return {
        name: msgspec.structs.replace(plan, process=recorder)
        if plan.process == RECORDER and (site is None or site.places[name] == site.name)
        else plan
        for name, plan in plans.items()
    }


def _require_open(graph: Graph, plans: Mapping[str, NodePlan], here: Site | None) -> None:
    """Raise DataflowError when a program of someone else's is part of the flow here and nobody listens for it."""
    for name in (name for name, plan in plans.items() if plan.external):
        listens = here is not None and bool(here.listen or here.router)
        if not listens and (here is None or here.places[name] == here.name):
            raise DataflowError(f"{graph.path}: nodes.{name}: {NOBODY_LISTENS}")


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
            kind_at=place_of(wire.kind),
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
        process=node.process or "",
        module=node.module,
        file=str(node.file) if node.file else None,
        settings=node.settings_map,
        seed=graph.seed,
        inputs=inputs,
        outputs=outputs_of(graph.flow, node.name, node.outputs),
        ready_timeout_s=node.ready_timeout_s,
    )


def _require_rig(rig: dict[str, Any], replay: Replay | None) -> None:
    """Raise an error that names the recording where there is one: most of a replay's rig is from there."""
    try:
        read_rig(rig)
    except MessageError as error:
        if replay is None:
            raise
        raise DataflowError(f"{replay.recording}, or what is laid over its rig: {error}") from error


def _all_outputs(plans: Mapping[str, NodePlan]) -> dict[str, InputPlan]:
    """What a recorder reads."""
    return {
        f"{plan.node}/{port}": InputPlan(key=out.key, schema=out.schema, kind_at=out.kind_at, writer=plan.node)
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
        port: msgspec.structs.replace(
            wire, budget=_budget(wire.key, plans[wire.writer], plans), external=plans[wire.writer].external
        )
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
