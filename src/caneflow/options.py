"""Options that several tools share: where the flow runs or lies that they mean, and whether files are replaced."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

At: TypeAlias = Annotated[
    str | None,
    typer.Option("--at", metavar="ENDPOINT", help="Where it runs, if not here, e.g. tcp/gateway.local:7447."),
]
Keys: TypeAlias = Annotated[
    Path, typer.Option("--keys", metavar="DIR", help="Of --at tls/...: the folder with a key and ca.crt.")
]
Overwrite: TypeAlias = Annotated[bool, typer.Option("--overwrite", help="Replace what exists under the output's name.")]
FlowFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--flow",
        metavar="FILE",
        help="The dataflow; by default dataflow.yaml here or beside the recording, else a shipped one that fits.",
        show_default=False,
    ),
]
