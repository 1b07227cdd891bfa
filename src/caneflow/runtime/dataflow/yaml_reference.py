"""The reference of dataflow.yaml, written from its types: JSON Schema for editors, tables for docs/dataflow.md.

`python -m caneflow.runtime.dataflow.yaml_reference docs` writes both again.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from caneflow.messages.rig import Guidance, Ranger, Rig, Sensor, Start, User
from caneflow.runtime.dataflow.validation import Checked
from caneflow.runtime.dataflow.yaml_shape import (
    FlowShape,
    InputShape,
    MachineShape,
    NodeShape,
    RestartShape,
    yaml_schema,
)

TABLES: dict[str, type[BaseModel]] = {
    "flow": FlowShape,
    "node": NodeShape,
    "input": InputShape,
    "restart": RestartShape,
    "machine": MachineShape,
    "rig": Rig,
    "sensor": Sensor,
    "start": Start,
    "ranger": Ranger,
    "user": User,
    "guidance": Guidance,
}
REQUIRED = {"flow": {"flow", "nodes"}, "node": {"run"}}  # besides those that the types cannot do without


def write(docs: Path) -> None:
    """Write the schema and the tables into the folder `docs`."""
    (docs / "dataflow.schema.json").write_text(schema_text(), encoding="utf-8")
    page = docs / "dataflow.md"
    page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")


def schema_text() -> str:
    """docs/dataflow.schema.json."""
    return json.dumps(yaml_schema(), indent=2) + "\n"


def with_tables(page: str) -> str:
    """`page` with every table between `<!-- table NAME -->` and `<!-- end -->` written again."""
    return re.sub(
        r"<!-- table (\w+) -->\n.*?<!-- end -->",
        lambda found: f"<!-- table {found[1]} -->\n{table(found[1])}<!-- end -->",
        page,
        flags=re.DOTALL,
    )


def table(name: str) -> str:
    """The Markdown table of one kind of mapping."""
    model = TABLES[name]
    checked: Checked[Any] = Checked(model)
    schema = model.model_json_schema()
    required = REQUIRED.get(name, set()) | set(schema.get("required", ()))
    rows = ["| key | takes | default | meaning |", "|---|---|---|---|"]
    for key, about in schema["properties"].items():
        default = "required" if key in required else _default(about.get("default"))
        rows.append(f"| `{key}` | {checked.takes((key,))} | {default} | {checked.about((key,))} |")
    return "\n".join(rows) + "\n"


def _default(value: object) -> str:
    return "" if value in (None, [], {}) else f"`{value if isinstance(value, str) else json.dumps(value)}`"


if __name__ == "__main__":
    write(Path(sys.argv[1]))
