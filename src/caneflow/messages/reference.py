"""The tables of docs/messages.md, written by `python -m caneflow.messages.reference docs`."""

import math
import re
import sys
from pathlib import Path
from typing import Any

from caneflow.messages import SAMPLES, json_schema


def table(name: str) -> str:
    """The Markdown table of message `name`, e.g. `Imu`: field, type, bounds, meaning; without stamp and seq."""
    kind = next(kind for kind in SAMPLES.values() if kind.__name__ == name)
    schema = json_schema(kind)
    rows = ["| field | type | from, to | meaning |", "|---|---|---|---|"]
    for field, spec in schema["properties"].items():
        if field not in ("stamp", "seq"):
            optional = "" if field in schema["required"] else "?"
            rows.append(f"| `{field}`{optional} | {_type(spec)} | {_bounds(spec)} | {spec.get('description', '')} |")
    return "\n".join(rows) + "\n"


def with_tables(page: str) -> str:
    """`page` with every table between `<!-- table NAME -->` and `<!-- end -->` written again."""
    return re.sub(
        r"<!-- table (\w+) -->\n.*?<!-- end -->",
        lambda found: f"<!-- table {found[1]} -->\n{table(found[1])}<!-- end -->",
        page,
        flags=re.DOTALL,
    )


def _type(spec: dict[str, Any]) -> str:
    """A field's type in words."""
    for alternative in spec.get("anyOf", ()):
        if alternative.get("type") != "null":
            return _type(alternative)
    if "enum" in spec:
        return "one of " + ", ".join(word for word in spec["enum"] if word is not None)
    match spec.get("type"):
        case "array":
            return f"[{spec['minItems']}] of {_type(spec['prefixItems'][0])}"
        case "number":
            return "float"
        case "integer":
            return "int"
        case "string":
            return "str"
        case "boolean":
            return "bool"
        case _:
            return "array"


def _bounds(spec: dict[str, Any]) -> str:
    """The least and the greatest value of a field, or of each of its elements."""
    for inner in (*spec.get("anyOf", ()), *spec.get("prefixItems", ())):
        if found := _bounds(inner):
            return found
    if "minimum" not in spec:
        return ""
    return f"{spec['minimum']:g}, {spec.get('maximum', math.inf):g}"


if __name__ == "__main__":
    page = Path(sys.argv[1]) / "messages.md"
    page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
