"""A graph as a picture: Mermaid for Markdown pages, Graphviz for SVG, plain data for programs."""

import shutil
import subprocess
from typing import Any

from caneflow.messages import Sample
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.errors import DataflowError

DOT_PATIENCE = 60  # s that Graphviz has


def as_data(graph: Graph) -> dict[str, Any]:
    """Nodes and edges as plain values, writers before their readers."""
    return {
        "flow": graph.flow,
        "nodes": [
            {
                "name": node.name,
                "run": node.run or None,
                "external": node.external,
                "machine": node.machine,
                "outputs": {port: kind.schema for port, kind in node.outputs.items()},
            }
            for node in (graph.nodes[name] for name in graph.order())
        ],
        "edges": [
            {
                "from": wire.stream,
                "to": f"{reader}/{port}",
                "type": wire.kind.schema,
                "queue": wire.queue.mode,
                "length": wire.queue.length,
                "max_lag_ms": wire.max_lag_ms,
                "max_age_ms": wire.max_age_ms,
            }
            for reader, port, wire in graph.wires
        ],
    }


def as_mermaid(graph: Graph) -> str:
    """The graph as a Mermaid flowchart: programs in boxes, messages on arrows, machines as frames."""
    lines = ["flowchart LR"]
    for machine, nodes in _by_machine(graph).items():
        inside = [f'    node_{node.name}["{_mermaid_text(node, "<br/>")}"]' for node in nodes]
        if machine is not None:
            inside = [f"    subgraph machine_{machine}[{machine}]", *(f"    {line}" for line in inside), "    end"]
        lines += inside
    lines += [
        f'    node_{wire.node} -- "{_label(wire.port, wire.kind)}" --> node_{reader}' for reader, _, wire in graph.wires
    ]
    return "\n".join(lines) + "\n"


def as_dot(graph: Graph) -> str:
    """The same in Graphviz's language."""
    lines = [f'digraph "{graph.flow}" {{', "  rankdir=LR;", "  node [shape=box, style=rounded];"]
    for machine, nodes in _by_machine(graph).items():
        inside = [f'  "{node.name}" [label="{_dot_text(node)}"];' for node in nodes]
        if machine is not None:
            head = f'  subgraph "cluster_{machine}" {{ label="{machine}";'
            inside = [head, *(f"  {line}" for line in inside), "  }"]
        lines += inside
    lines += [
        f'  "{wire.node}" -> "{reader}" [label="{_label(wire.port, wire.kind)}"];' for reader, _, wire in graph.wires
    ]
    return "\n".join([*lines, "}"]) + "\n"


def as_svg(graph: Graph) -> str:
    """The graph drawn by Graphviz; raises DataflowError when its `dot` is not there or fails."""
    dot = shutil.which("dot")
    if dot is None:
        raise DataflowError("no `dot` on this machine; install Graphviz, or use --format mermaid")
    try:
        drawn = subprocess.run(
            [dot, "-Tsvg"], input=as_dot(graph), capture_output=True, text=True, timeout=DOT_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise DataflowError(f"{dot} did not draw the graph: {error}") from error
    return drawn.stdout


def _by_machine(graph: Graph) -> dict[str | None, list[Node]]:
    grouped: dict[str | None, list[Node]] = {}
    for node in graph.nodes.values():
        grouped.setdefault(node.machine, []).append(node)
    return grouped


def _label(port: str, kind: type[Sample]) -> str:
    return f"{port}: {kind.__name__}"


def _program(node: Node) -> str:
    return node.run or "external"


def _mermaid_text(node: Node, line_end: str) -> str:
    return f"{node.name}{line_end}{_program(node)}".replace('"', "#quot;")


def _dot_text(node: Node) -> str:
    return f"{node.name}\\n{_program(node).replace(chr(92), chr(92) * 2)}".replace('"', '\\"')
