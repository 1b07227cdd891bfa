"""docs/dataflow.md and docs/dataflow.schema.json say what the code does."""

import json
import re
from pathlib import Path

import pytest

from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.yaml_reference import TABLES, schema_text, with_tables
from caneflow.runtime.dataflow.yaml_shape import yaml_schema

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "dataflow.md").read_text(encoding="utf-8")
ANEW = "; run: python -m caneflow.runtime.dataflow.yaml_reference docs"


def test_the_schema_file_is_what_the_code_checks_by() -> None:
    assert (ROOT / "docs" / "dataflow.schema.json").read_text(encoding="utf-8") == schema_text(), ANEW


def test_the_tables_are_those_of_the_types() -> None:
    assert with_tables(PAGE) == PAGE, ANEW
    assert set(re.findall(r"<!-- table (\w+) -->", PAGE)) == set(TABLES)


def test_the_schema_knows_every_key_and_no_other() -> None:
    schema = yaml_schema()
    node = schema["$defs"]["NodeShape"]

    assert schema["required"] == ["flow", "nodes"]
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == {
        "flow",
        "seed",
        "rig",
        "machines",
        "router",
        "links",
        "insecure",
        "nodes",
        "results",
    }
    assert node["additionalProperties"] is False
    short, long = node["properties"]["inputs"]["patternProperties"]["^[a-z][a-z0-9_]*$"]["anyOf"]
    assert re.fullmatch(short["pattern"], "radar/frame")
    assert not re.fullmatch(short["pattern"], "radar.frame")
    assert set(long["properties"]) == {"from", "queue", "max_lag_ms", "max_age_ms"}


def test_the_example_of_the_page_is_sound(tmp_path: Path) -> None:
    match = re.search(r"```yaml\n(# yaml-language-server.*?)```", PAGE, re.DOTALL)
    assert match is not None
    path = tmp_path / "dataflow.yaml"
    path.write_text(match[1])

    assert load(path).warnings == ()


@pytest.mark.parametrize("file", sorted(ROOT.glob("dataflow*.yaml")) + sorted(ROOT.glob("dataflows/*.yaml")), ids=str)
def test_the_projects_flows_name_the_schema(file: Path) -> None:
    first = file.read_text(encoding="utf-8").splitlines()[0]
    match = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)

    assert match is not None
    assert json.loads((file.parent / match[1]).read_text(encoding="utf-8")) == yaml_schema()
