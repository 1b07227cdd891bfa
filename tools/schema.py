"""`caneflow schema`: the JSON Schema of a message, or of everything that travels."""

import json
from typing import Annotated, Any

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, json_schema


def command(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="A message, e.g. Imu or caneflow.Imu/1; by default all.", show_default=False
        ),
    ] = None,
) -> None:
    """Print JSON Schemas: of one message, or one object with all of them by name.

    Example: caneflow schema Imu
    """
    print(json.dumps(schemas() if name is None else schema_of(name), indent=2))


def schemas() -> dict[str, dict[str, Any]]:
    """The JSON Schema of every message, by the message's full name."""
    return {full_name: json_schema(kind) for full_name, kind in SAMPLES.items()}


def schema_of(name: str) -> dict[str, Any]:
    """The JSON Schema of the message `name`: `Imu`, or `caneflow.Imu/1`. Raises CaneflowError for another name."""
    known = schemas()
    for full_name, schema in known.items():
        if name in (full_name, full_name.removeprefix("caneflow.").partition("/")[0]):
            return schema
    raise CaneflowError(f"no message {name!r}; there are {', '.join(known)}")
