"""`caneflow check`: every mistake in a dataflow file, before anything is started."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.dataflow.loading import examine, read_rig
from caneflow.runtime.errors import Problem

MISTAKEN_STATUS = 1


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The dataflow, e.g. dataflow.yaml.", show_default=False)],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    rig: Annotated[Path | None, typer.Option(metavar="YAML", help="A rig to lay over the file's.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Find every mistake in a dataflow file; start nothing.

    Each mistake is one line, FILE:LINE:COLUMN: what is wrong; what would be right. Exit status 0: the flow can be
    started (there may be warnings). 1: it cannot.

    Example: caneflow check dataflow.yaml --set fusion.method=kalman
    """
    graph, problems = examine(file, settings or (), rig=None if rig is None else read_rig(rig))
    if as_json:
        print(json.dumps(described(file, graph, problems), indent=2))
    else:
        for problem in problems:
            print(problem)
        if graph is not None:
            print(f"{file}: ok, {_number(len(graph.nodes), 'node')}, {_number(len(graph.wires), 'wire')}")
    if graph is None:
        raise typer.Exit(MISTAKEN_STATUS)


def described(file: Path, graph: Graph | None, problems: tuple[Problem, ...]) -> dict[str, Any]:
    """What `check --json` prints."""
    return {
        "file": str(file),
        "ok": graph is not None,
        "nodes": None if graph is None else len(graph.nodes),
        "wires": None if graph is None else len(graph.wires),
        "mistakes": [_entry(problem) for problem in problems if not problem.warning],
        "warnings": [_entry(problem) for problem in problems if problem.warning],
    }


def _entry(problem: Problem) -> dict[str, Any]:
    place = problem.place
    return {
        "source": place.source,
        "line": place.line or None,
        "column": place.column or None,
        "path": problem.path,
        "text": problem.text,
    }


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
