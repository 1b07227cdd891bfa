"""dataflow.yaml -> a checked graph, or every mistake in it, each with its line and column."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from caneflow.messages.rig import Rig
from caneflow.runtime.dataflow.graph import Graph, Machine, Node, Restart
from caneflow.runtime.dataflow.process_groups import check_processes
from caneflow.runtime.dataflow.programs import check_settings, load_program, locate, outputs_of
from caneflow.runtime.dataflow.topology import check_machines
from caneflow.runtime.dataflow.validation import Checked
from caneflow.runtime.dataflow.wiring import Part, check_wires, external_outputs, warn_of_unread
from caneflow.runtime.dataflow.yaml_file import MAX_DEPTH, Document, compose, read_yaml
from caneflow.runtime.dataflow.yaml_shape import FlowShape, NodeShape, RestartShape, is_written, read_shape
from caneflow.runtime.errors import DataflowError, Place, Problem
from caneflow.runtime.program import InFlow, Operator
from caneflow.runtime.wording import did_you_mean, listed, one_line, shown

GIVEN_RIG = "rig of the recording or --rig"
NOT_FOR_EXTERNAL = ("run", "process", "inputs", "settings", "restart", "ready_timeout_s")


def load(path: Path, overrides: Sequence[str] = (), *, rig: Mapping[str, Any] | None = None) -> Graph:
    """The graph in the file at `path`.

    `overrides` are `node.key=value` as given to `--set`; `rig` is laid over the file's. Raises DataflowError with
    one line for every mistake, before anything has been started.
    """
    graph, problems = examine(path, overrides, rig=rig)
    if graph is None:
        raise DataflowError("\n".join(map(str, problems)), problems)
    return graph


def examine(
    path: Path, overrides: Sequence[str] = (), *, rig: Mapping[str, Any] | None = None
) -> tuple[Graph | None, tuple[Problem, ...]]:
    """The graph in the file at `path` and what is odd about it; or None and what is wrong."""
    try:
        document = read_yaml(path)
    except DataflowError as error:
        return None, error.problems
    values = document.value
    if not isinstance(values, dict):
        found = "is empty" if values is None else f"is {_kind_of(values)}, not a mapping"
        document.problem((), f"{found}; a dataflow starts with `flow: NAME` and `nodes:`")
        return None, _sorted(document)
    _lay_rig_over(document, rig or {})
    for override in overrides:
        _lay_over(document, override)
    flow, mistakes = read_shape(values)
    for mistake in mistakes:
        document.problem(mistake.path, mistake.text, key=mistake.key)
    graph = _checked(document, flow, path)
    return graph, _sorted(document)


def read_rig(path: Path) -> dict[str, Any]:
    """The rig in a file of its own, as `--rig` takes it; raises DataflowError with one line for every mistake."""
    document = read_yaml(path)
    rig: Checked[Rig] = Checked(Rig)
    for mistake in rig(document.value)[1]:
        document.problem(mistake.path, mistake.text, key=mistake.key)
    if document.problems:
        raise DataflowError("\n".join(map(str, _sorted(document))), _sorted(document))
    written: dict[str, Any] = document.value
    return written


def _checked(document: Document, flow: FlowShape, path: Path) -> Graph | None:
    if not is_written(document.value, ("flow",)):
        document.problem(("flow",), "is missing; name the flow, e.g. `flow: cane`")
    if document.value.get("nodes", {}) == {}:
        document.problem(("nodes",), "there are none; a flow has at least one node")
    parts = {name: _part(document, name, shape, path.parent) for name, shape in flow.nodes.items()}
    for name, part in parts.items():
        if part.shape.external and is_written(document.value, ("nodes", name, "outputs")):
            part.outputs = external_outputs(document, name, part.shape, path.parent)
    check_wires(document, flow, parts)
    layout = check_machines(document, flow, parts)
    check_processes(document, parts, layout.places)
    nodes = {name: _node(document, name, part, layout.places[name]) for name, part in parts.items()}
    _ask_programs(document, nodes)
    if any(not problem.warning for problem in document.problems):
        document.problems = [problem for problem in document.problems if not problem.warning]
        return None
    warn_of_unread(document, flow, parts)
    return Graph(
        flow=flow.flow,
        seed=flow.seed,
        rig=document.value.get("rig", {}),
        machines={
            name: Machine(
                listen=tuple(machine.listen),
                connect=tuple(machine.connect),
                linked=layout.links[name],
                records=machine.records,
            )
            for name, machine in flow.machines.items()
        },
        nodes=nodes,
        results=tuple(flow.results),
        path=path,
        router=flow.router,
        insecure=flow.insecure,
        links=flow.links,
        leader=layout.leader,
        warnings=tuple(map(str, _sorted(document))),
    )


def _ask_programs(document: Document, nodes: Mapping[str, Node]) -> None:
    """Note what the programs themselves say against the graph around them."""
    rig = document.value.get("rig", {})
    for name, node in nodes.items():
        if node.program is not None and issubclass(node.program, Operator) and isinstance(rig, dict):
            writers = {
                port: nodes[wire.node].settings if wire.node in nodes else None for port, wire in node.inputs.items()
            }
            for path, text, warning in node.program.objections(InFlow(name, rig, writers)):
                document.problem(path, text, key=True, warning=warning)


def _part(document: Document, name: str, shape: NodeShape, base: Path) -> Part:
    part, path = Part(shape=shape), ("nodes", name)
    if shape.external:
        for key in NOT_FOR_EXTERNAL:
            if is_written(document.value, (*path, key)):
                document.problem(
                    (*path, key), "an external node publishes by itself; it has only outputs and machine", key=True
                )
        if not is_written(document.value, (*path, "outputs")):
            document.problem((*path, "outputs"), "is missing; an external node names them, e.g. {imu: Imu}")
        return part
    if is_written(document.value, (*path, "outputs")):
        document.problem(
            (*path, "outputs"), "the program says what it sends; only an external node lists outputs", key=True
        )
    if not shape.run:
        if not is_written(document.value, (*path, "run")):
            document.problem((*path, "run"), "is missing; name a program, e.g. `run: drivers.bno055`")
        return part
    try:
        part.where = locate(shape.run, base)
        part.program = load_program(shape.run, base)
        part.outputs = outputs_of(part.program)
    except DataflowError as error:
        document.problem((*path, "run"), str(error))
    return part


def _node(document: Document, name: str, part: Part, machine: str | None) -> Node:
    shape, path = part.shape, ("nodes", name)
    settings = None
    if part.program is not None:
        settings, mistakes = check_settings(part.program, shape.settings)
        for mistake in mistakes:
            document.problem((*path, "settings", *mistake.path), mistake.text, key=mistake.key)
    if shape.restart.delay_s > shape.restart.max_delay_s:
        document.problem(
            (*path, "restart", "delay_s"),
            f"is {shape.restart.delay_s:g} s, more than max_delay_s, {shape.restart.max_delay_s:g} s",
        )
    return Node(
        name=name,
        run=shape.run,
        module=part.where.module,
        file=part.where.file,
        program=part.program,
        machine=machine,
        process=shape.process,
        inputs=part.wires,
        outputs=dict(part.outputs or {}),
        settings=settings,
        settings_map=shape.settings,
        restart=_restart(shape.restart),
        external=shape.external,
        ready_timeout_s=shape.ready_timeout_s,
    )


def _restart(shape: RestartShape) -> Restart:
    return Restart(
        policy=shape.policy,
        max_restarts=shape.max_restarts,
        window_s=shape.window_s,
        delay_s=shape.delay_s,
        max_delay_s=shape.max_delay_s,
    )


def _lay_rig_over(document: Document, rig: Mapping[str, Any], path: tuple[str, ...] = ("rig",)) -> None:
    """Lay `rig` over the file's, key by key to any depth."""
    if not isinstance(document.value.get("rig", {}), dict):
        return  # a mistake of the file: it is to be seen, not covered up
    for key, value in rig.items():
        inside = (*path, key)
        if isinstance(value, Mapping) and (value or is_written(document.value, inside)):
            _lay_rig_over(document, value, inside)
        else:
            document.lay_over(inside, value, GIVEN_RIG)


def _lay_over(document: Document, override: str) -> None:
    """Lay one `node.key=value` over the settings in the file; what is wrong with it is noted."""
    place = Place(source=f"--set {one_line(override)}")
    way, equals, text = override.partition("=")
    node, *keys = way.split(".")
    nodes = document.value.get("nodes")
    if not equals or not keys or not all((node, *keys)) or len(keys) > MAX_DEPTH:
        document.problems.append(Problem(place=place, path="", text="is not NODE.KEY=VALUE, e.g. fusion.method=kalman"))
    elif isinstance(nodes, dict) and node not in nodes:
        said = f"no node {shown(node)};{did_you_mean(node, nodes)} there are {listed(nodes)}"
        document.problems.append(Problem(place=place, path="", text=said))
    elif isinstance(nodes, dict) and isinstance(nodes[node], dict):
        try:
            value = compose(text, place.source)
        except DataflowError as error:
            document.problems += [replace(problem, place=place) for problem in error.problems]
            return
        document.problems += [replace(problem, place=place) for problem in value.problems]
        if isinstance(nodes[node].get("settings", {}), dict):
            document.lay_over(("nodes", node, "settings", *keys), value.value, place.source)


def _kind_of(value: object) -> str:
    return "a list" if isinstance(value, list) else f"the value {shown(value)}"


def _sorted(document: Document) -> tuple[Problem, ...]:
    """In the order of the file; what was not written there comes after it."""
    return tuple(sorted(document.problems, key=lambda p: (p.place.line == 0, p.place.line, p.place.column)))
