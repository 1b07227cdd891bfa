"""Checks the wires of a graph: each leads from an output that is there to an input that takes its messages."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from caneflow.messages import Sample
from caneflow.runtime.dataflow.graph import Queue, Wire
from caneflow.runtime.dataflow.message_names import message_named
from caneflow.runtime.dataflow.programs import Located, inputs_of
from caneflow.runtime.dataflow.yaml_file import Document
from caneflow.runtime.dataflow.yaml_shape import ALL_LENGTH, FlowShape, InputShape, NodeShape, is_written
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.program import ANY_PORT, Operator, Program
from caneflow.runtime.wording import did_you_mean, listed


@dataclass(kw_only=True)
class Part:
    """A node while it is being checked."""

    shape: NodeShape
    where: Located = field(default_factory=Located)
    program: Program | None = None  # None: external, or it could not be had
    outputs: Mapping[str, type[Sample]] | None = None  # None: not known
    wires: dict[str, Wire] = field(default_factory=dict)


def external_outputs(document: Document, name: str, shape: NodeShape, base: Path) -> dict[str, type[Sample]]:
    """The outputs of a device that publishes by itself; all programs of the flow are imported already."""
    outputs = {}
    for port, message in shape.outputs.items():
        try:
            outputs[port] = message_named(message, base)
        except DataflowError as error:
            document.problem(("nodes", name, "outputs", port), str(error))
    return outputs


def check_wires(document: Document, flow: FlowShape, parts: Mapping[str, Part]) -> None:
    """Fill in the wires of all parts, and note every one that cannot be."""
    for name, part in parts.items():
        for port, written in part.shape.inputs.items():
            kind = _carried(document, parts, ("nodes", name, "inputs", port), written.source, reader=name)
            if part.program is not None and _takes(document, parts, name, port, kind) and kind is not None:
                part.wires[port] = _wire(written, kind)
        if part.program is not None:
            _check_missing(document, parts, name)
            part.wires = _in_order(part.program, part.wires)
    for i, stream in enumerate(flow.results):
        _carried(document, parts, ("results", i), stream)
    _check_cycles(document, parts)


def warn_of_unread(document: Document, flow: FlowShape, parts: Mapping[str, Part]) -> None:
    """Note the outputs that nobody reads: work for nothing, or a wire that was forgotten."""
    read = {wire.stream for part in parts.values() for wire in part.wires.values()} | set(flow.results)
    for name, part in parts.items():
        spare = _spare_outputs(part)
        for port, kind in (part.outputs or {}).items():
            if f"{name}/{port}" not in read and port != ANY_PORT and port not in spare:
                document.problem(
                    ("nodes", name),
                    f"no node reads its output {name}/{port} ({_named(kind)}); wire it, or list it under results",
                    key=True,
                    warning=True,
                )


def _spare_outputs(part: Part) -> frozenset[str]:
    """Ports that nobody needs to read."""
    program = part.program
    return program.optional_outputs if program is not None and issubclass(program, Operator) else frozenset()


def _carried(
    document: Document, parts: Mapping[str, Part], path: tuple[str | int, ...], stream: str, *, reader: str = ""
) -> type[Sample] | None:
    """The messages of `stream`; None when that is not known, which is noted unless it follows from a mistake."""
    node, _, port = stream.partition("/")
    if node == reader:
        document.problem(path, f"{node} reads its own output {stream}; a node cannot wait for itself")
        return None
    if node in parts:
        outputs = parts[node].outputs
        if outputs is None or port in outputs or is_written(document.value, ("nodes", node, "outputs", port)):
            return (outputs or {}).get(port)
    elif not stream or is_written(document.value, ("nodes", node)):
        return None
    there = [f"{name}/{p}" for name, part in parts.items() for p in part.outputs or () if name != reader]
    document.problem(path, f"no output {stream!r};{did_you_mean(stream, there)} there are {listed(there)}")
    return None


def _takes(document: Document, parts: Mapping[str, Part], name: str, port: str, kind: type[Sample] | None) -> bool:
    """Whether `port` of node `name` is there and takes messages of `kind`; what is wrong is noted."""
    part = parts[name]
    assert part.program is not None
    inputs = inputs_of(part.program)
    path = ("nodes", name, "inputs", port)
    takes = inputs.get(port, inputs.get(ANY_PORT))
    if takes is None:
        has = f"its inputs are {listed(inputs)}" if inputs else "it reads nothing"
        document.problem(path, f"{part.shape.run} has no input {port!r};{did_you_mean(port, inputs)} {has}", key=True)
        return False
    if kind is not None and not _fits(kind, takes):
        document.problem(
            path,
            f"{part.shape.inputs[port].source} carries {_named(kind)}, and this input takes {_named(takes)};"
            f" {_givers(parts, name, takes)}",
        )
        return False
    return True


def _check_missing(document: Document, parts: Mapping[str, Part], name: str) -> None:
    part = parts[name]
    if part.program is None or not issubclass(part.program, Operator):
        return
    inputs = inputs_of(part.program)
    needed = [port for port in inputs if port != ANY_PORT and port not in part.program.optional_inputs]
    for port in needed:
        path = ("nodes", name, "inputs", port)
        if not is_written(document.value, path):
            document.problem(
                path,
                f"is not wired; it takes {_named(inputs[port])}: {_givers(parts, name, inputs[port])}",
                key=True,
            )
    if not needed and not is_written(document.value, ("nodes", name, "inputs")):
        document.problem(
            ("nodes", name),
            f"{part.shape.run} reads nothing here, so it would never run; its inputs are {listed(inputs)}",
            key=True,
        )


def _givers(parts: Mapping[str, Part], reader: str, kind: type[Sample]) -> str:
    """Where messages of `kind` come from, as advice."""
    streams = [
        f"{name}/{port}"
        for name, part in parts.items()
        for port, given in (part.outputs or {}).items()
        if name != reader and _fits(given, kind)
    ]
    return f"wire it to {' or '.join(streams)}" if streams else "no node of this flow gives that"


def _fits(given: type[Sample], taken: type[Sample]) -> bool:
    """Whether a port that takes messages of one type takes those of another: by schema, not by class object."""
    return taken is Sample or given.schema == taken.schema


def _named(kind: type[Sample]) -> str:
    return kind.schema or "any message"


def _wire(written: InputShape, kind: type[Sample]) -> Wire:
    node, _, port = written.source.partition("/")
    mode, _, number = written.queue.partition(" ")
    length = {"latest": 1, "all": ALL_LENGTH}.get(mode) or int(number)
    return Wire(
        node=node,
        port=port,
        kind=kind,
        queue=Queue(mode="latest" if mode == "latest" else "fifo" if mode == "fifo" else "all", length=length),
        max_lag_ms=written.max_lag_ms,
        max_age_ms=written.max_age_ms,
    )


def _in_order(program: Program, wires: dict[str, Wire]) -> dict[str, Wire]:
    """Ports in the order of the program's table: how the yaml is laid out must not change a result."""
    ports = [port for port in inputs_of(program) if port in wires]
    return {port: wires[port] for port in (*ports, *(port for port in wires if port not in ports))}


def _check_cycles(document: Document, parts: Mapping[str, Part]) -> None:
    for cycle in _cycles(parts):
        reader = cycle[0]
        port = next(port for port, wire in parts[reader].wires.items() if wire.node == cycle[-1])
        around = " -> ".join((*cycle, reader))
        document.problem(
            ("nodes", reader, "inputs", port),
            f"closes the cycle {around}: each would wait for the others; take one of these wires out",
        )


def _cycles(parts: Mapping[str, Part]) -> Iterator[list[str]]:
    """One cycle out of every knot of nodes, in the direction of the samples, first node of the file first."""
    left = {name: {wire.node for wire in part.wires.values()} for name, part in parts.items()}
    while left:
        free = [
            name
            for name, writers in left.items()
            if not writers & left.keys() or not any(name in others for others in left.values())
        ]
        if free:
            for name in free:
                del left[name]
            continue
        # Everybody left is read by someone left and reads from someone left: walking upstream meets itself.
        walk = [next(iter(left))]
        while (writer := next(name for name in left if name in left[walk[-1]])) not in walk:
            walk.append(writer)
        cycle = walk[walk.index(writer) :][::-1]
        first = cycle.index(next(name for name in parts if name in cycle))
        yield cycle[first:] + cycle[:first]
        for name in cycle:
            del left[name]
