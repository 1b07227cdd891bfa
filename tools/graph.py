"""`caneflow graph`: a picture of a flow."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.runtime.dataflow.graph import Graph
from caneflow.runtime.dataflow.graph_pictures import as_data, as_mermaid, as_svg
from caneflow.runtime.dataflow.loading import load

DRAW: dict[str, Callable[[Graph], str]] = {
    "mermaid": as_mermaid,
    "svg": as_svg,
    "json": lambda graph: json.dumps(as_data(graph), indent=2) + "\n",
}


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The dataflow, e.g. dataflow.yaml.", show_default=False)],
    kind: Annotated[
        Literal["mermaid", "svg", "json"],
        typer.Option(
            "--format", help="mermaid: text for Markdown pages; svg: drawn by Graphviz; json: nodes and edges."
        ),
    ] = "mermaid",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write it there; by default it is printed."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw a flow: its programs, the messages between them, the machines they are on.

    A picture of a flow in the same format is replaced; any other file only with --overwrite.

    Example: caneflow graph dataflow.yaml --format svg -o flow.svg
    """
    with whole(output, inputs=[file], overwrite=overwrite, picture=kind) as path:
        picture = DRAW[kind](load(file))
        if path is None:
            print(picture, end="")
        else:
            path.write_text(picture, encoding="utf-8")
