"""Options that several tools share: where the running flow is that they attach to, and whether files are replaced."""

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
