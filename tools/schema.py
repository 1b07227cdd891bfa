"""`caneflow schema`: the JSON Schema of a message, of all that travel, or of a dataflow file."""

import json
from typing import Annotated, Any

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, json_schema
from caneflow.messages.control import FlowStatus

DATAFLOW = "dataflow"  # the one schema that is not a message's


def command(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME",
            help="A message, e.g. Imu or caneflow.Imu/1, or dataflow; by default all messages.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Print the JSON Schema of a message, of all messages by name, or of a dataflow file.

    Example: caneflow schema dataflow > dataflow.schema.json
    """
    print(json.dumps(schemas() if name is None else schema_of(name), indent=2))


def schemas() -> dict[str, dict[str, Any]]:
    """The JSON Schema of every message, by the message's full name."""
    return {full_name: json_schema(kind) for full_name, kind in SAMPLES.items()}


def schema_of(name: str) -> dict[str, Any]:
    """The JSON Schema of `name`: `Imu`, `caneflow.Imu/1` or `dataflow`. Raises CaneflowError for another name."""
    if name == DATAFLOW:
        from caneflow.runtime.dataflow.yaml_shape import yaml_schema  # here, as a message's schema needs no runtime

        return yaml_schema()
    if name in ("FlowStatus", "caneflow.FlowStatus/1"):
        return json_schema(FlowStatus)
    known = schemas()
    for full_name, schema in known.items():
        if name in (full_name, full_name.removeprefix("caneflow.").partition("/")[0]):
            return schema
    raise CaneflowError(f"no schema {name!r}; there are {', '.join((*known, DATAFLOW))}")
