"""`caneflow schema`: the JSON Schema of a message, of all that travel, or of a dataflow file."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import SAMPLES, Sample, json_schema
from caneflow.messages.control import FlowStatus

DATAFLOW = "dataflow"  # the one schema that is not a message's
FILES = (".py", ".yaml", ".yml", ".mcap")  # which hold messages of a user's own


def command(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[FILE:]NAME|FILE",
            help="A message, e.g. Imu or caneflow.Imu/1, or dataflow; by default all messages. Of your own: FILE is "
            "the Python file that defines it, a flow that sends it, or a recording.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Print the JSON Schema of a message, of all messages by name, or of a dataflow file.

    Example: caneflow schema dataflow > dataflow.schema.json
    """
    print(json.dumps(_asked(name), indent=2))


def _asked(name: str | None) -> Any:
    if name is None:
        return schemas()
    file, _, inside = ("", "", name) if Path(name).suffix in FILES else name.rpartition(":")
    if Path(name).suffix in FILES:
        return schemas_in(Path(name))
    return schema_of(inside) if not file else _chosen(inside, schemas_in(Path(file)))


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
    return _chosen(name, schemas(), more=(DATAFLOW,))


def schemas_in(file: Path) -> dict[str, dict[str, Any]]:
    """The JSON Schemas of the messages in a user's Python file, a flow or a recording, by full name."""
    if not file.is_file():
        raise CaneflowError(f"{file}: no such file; expected one that ends in {', '.join(FILES)}")
    if file.suffix == ".mcap":
        return _recorded(file)
    kinds = _defined(file) if file.suffix == ".py" else _sent(file)
    return {kind.schema: json_schema(kind) for kind in kinds}


def _recorded(file: Path) -> dict[str, dict[str, Any]]:
    from caneflow.recording import Recording

    with Recording(file) as recording:
        return {stream.schema: recording.json_schema(*name) for name, stream in recording.streams.items()}


def _defined(file: Path) -> list[type[Sample]]:
    """The messages of a user's own that a Python file defines or imports."""
    from caneflow.runtime.user_files import OURS, messages_in

    kinds = [kind for kind in messages_in(file.resolve()) if not kind.__module__.startswith(OURS)]
    if not kinds:
        raise CaneflowError(f"{file}: defines no message; expected a class derived from Sample, with a schema")
    return kinds


def _sent(file: Path) -> list[type[Sample]]:
    """The messages that the nodes of a flow send."""
    from caneflow.runtime.dataflow.loading import load

    return [kind for node in load(file).nodes.values() for kind in node.outputs.values()]


def _chosen(name: str, known: dict[str, dict[str, Any]], more: tuple[str, ...] = ()) -> dict[str, Any]:
    for full_name, schema in known.items():
        if name in (full_name, full_name.partition("/")[0], full_name.partition("/")[0].rpartition(".")[2]):
            return schema
    raise CaneflowError(f"no schema {name!r}; there are {', '.join((*known, *more))}")
