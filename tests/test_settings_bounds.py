"""Every number that a dataflow.yaml may hold has a least and a greatest value, and `check` finds what lies outside."""

import importlib
import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from caneflow.messages.errors import MessageError
from caneflow.messages.rig import Rig, read_rig
from caneflow.runtime import Operator, Source
from caneflow.runtime.dataflow.loading import examine
from caneflow.runtime.dataflow.programs import check_settings
from caneflow.runtime.dataflow.yaml_shape import FlowShape, read_shape
from caneflow.runtime.program import Program, Sink

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    f"{folder}.{file.stem}"
    for folder in ("operators", "drivers", "tools")
    for file in (ROOT / folder).glob("*.py")
    if file.stem not in ("__init__", "new")  # `new` holds the text of programs, not programs
)
SLIPS = (1e308, -1e308, 1e-300)  # of a float
INT_SLIPS = (10**18 + 1, -(10**18) - 1)


def programs() -> Iterator[Program]:
    for name in MODULES:
        for found in vars(importlib.import_module(name)).values():
            if inspect.isclass(found) and found.__module__ == name and issubclass(found, Operator | Source | Sink):
                yield found


PROGRAMS = [pytest.param(program, id=f"{program.__module__}.{program.__name__}") for program in programs()]
Way = tuple[str | int, ...]


def numbers(kind: Any) -> list[tuple[Way, list[dict[str, Any]]]]:
    """Every number in a type of settings: the way to it, and the schemas of which it has to fit one."""
    schema = TypeAdapter(kind).json_schema()
    return list(_numbers(schema, schema.get("$defs", {}), ()))


def _numbers(schema: dict[str, Any], defs: dict[str, Any], way: Way) -> Iterator[tuple[Way, list[dict[str, Any]]]]:
    if "$ref" in schema:
        schema = defs[schema["$ref"].rpartition("/")[2]]
    choices = [one for word in ("anyOf", "oneOf", "allOf") for one in schema.get(word, ())] or [schema]
    if found := [
        one for one in choices if one.get("type") in ("number", "integer") and not {"enum", "const"} & one.keys()
    ]:
        yield way, found
    for one in choices:
        if one is not schema:
            if one.get("type") not in ("number", "integer"):
                yield from _numbers(one, defs, way)
            continue
        for name, inner in one.get("properties", {}).items():
            yield from _numbers(inner, defs, (*way, name))
        for i, inner in enumerate(one.get("prefixItems", ())):
            yield from _numbers(inner, defs, (*way, i))
        for inner in (*one.get("patternProperties", {}).values(), one.get("additionalProperties")):
            if isinstance(inner, dict):
                yield from _numbers(inner, defs, (*way, "any"))
        if isinstance(inner := one.get("items"), dict):
            yield from _numbers(inner, defs, (*way, 0))


def ends(schema: dict[str, Any]) -> tuple[float, float]:
    """The least and the greatest value; NaN: there is none."""
    least = schema.get("minimum", schema.get("exclusiveMinimum", math.nan))
    return least, schema.get("maximum", schema.get("exclusiveMaximum", math.nan))


def fits(schema: dict[str, Any], value: float) -> bool:
    least, most = ends(schema)
    return least <= value <= most and value not in (schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum"))


def slips(schemas: list[dict[str, Any]]) -> list[float]:
    """Absurd values of a number that are outside its bounds."""
    values = INT_SLIPS if all(schema["type"] == "integer" for schema in schemas) else SLIPS
    return [value for value in values if not any(fits(schema, value) for schema in schemas)]


def written(way: Way, value: float) -> Any:
    """Settings with nothing but a value at the end of a way."""
    for key in reversed(way):
        value = {key: value} if isinstance(key, str) else [*[0.0] * key, value]  # type: ignore[assignment]
    return value


@pytest.mark.parametrize("kind", [*(program.values[0].Settings for program in PROGRAMS), Rig, FlowShape])  # type: ignore[union-attr]
def test_every_number_has_a_least_and_a_greatest_value(kind: Any) -> None:
    for way, schemas in numbers(kind):
        assert all(math.isfinite(end) for schema in schemas for end in ends(schema)), f"{way} is not bounded"


def test_the_walk_over_the_settings_finds_what_it_should() -> None:
    """It would be no test if it saw nothing: by name what is known to be there."""
    found = {way for program in PROGRAMS for way, _ in numbers(program.values[0].Settings)}  # type: ignore[union-attr]
    assert {("kalman", "heading_error"), ("best", "heading", "bias_spreads", 0), ("period",), ("k",)} <= found
    assert {("step_length",), ("pivot", 2), ("sensors", "any", "position", 1)} <= {way for way, _ in numbers(Rig)}
    assert ("nodes", "any", "inputs", "any", "max_lag_ms") in {way for way, _ in numbers(FlowShape)}
    assert len(found) > 200


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_slip_in_a_setting_is_a_mistake_that_says_the_bound(program: Program) -> None:
    for way, schemas in numbers(program.Settings):
        for value in slips(schemas):
            mistakes = check_settings(program, written(way, value))[1]
            said = [mistake.text for mistake in mistakes if mistake.path == way]
            assert said, f"{way}: {value} was taken"
            assert re.search(r"it takes (a|a whole) number, .*(at least|above) .* and (at most|below) ", said[0]), said


def test_a_slip_in_the_rig_is_a_mistake_in_the_file_and_in_a_recording() -> None:
    for way, schemas in numbers(Rig):
        for value in slips(schemas):
            values = written(way, value)
            assert ("rig", *way) in {mistake.path for mistake in read_shape({"flow": "x", "rig": values})[1]}
            with pytest.raises(MessageError, match=r"^rig\.") as caught:
                read_rig(values)
            assert "\n" not in str(caught.value)


def test_a_slip_in_what_the_runtime_itself_is_told_is_a_mistake() -> None:
    for way, schemas in numbers(FlowShape):
        for value in slips(schemas):
            assert way in {mistake.path for mistake in read_shape(written(way, value))[1]}, f"{way}: {value} was taken"


FLOW = """\
flow: cane
rig: {pivot: [0.0, 0.6, 0.0], step_length: 0.42}
nodes:
  imu: {external: true, outputs: {imu: Imu}}
  ground: {external: true, outputs: {speed: GroundSpeed}}
  fusion: {run: operators.fusion, inputs: {imu: imu/imu, speed: ground/speed}, settings: {}}
results: [fusion/pose]
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "step_length: 0.42", "step_length: 1e308",
            "rig.step_length: is 1e+308; it takes a number, at least 0.01 and at most 10",
        ),
        ("0.6, 0.0]", "1e308, 0.0]", "rig.pivot.1: is 1e+308; it takes a number, at least -10 and at most 10"),
        (
            "settings: {}", "settings: {kalman: {heading_error: 1e-300}}",
            "nodes.fusion.settings.kalman.heading_error: is 1e-300; it takes a number, at least 1e-06 and at most "
            "6.28319 or 0",
        ),
        (
            "speed: ground/speed",
            "speed: {from: ground/speed, max_lag_ms: 1e300}",
            "nodes.fusion.inputs.speed.max_lag_ms: is 1e+300; it takes a number, at least 0 and at most 3600000",
        ),
    ],
)  # fmt: skip
def test_check_says_a_slip_in_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = tmp_path / "dataflow.yaml"
    file.write_text(FLOW)
    assert examine(file)[0] is not None
    assert old in FLOW
    file.write_text(FLOW.replace(old, new))
    graph, problems = examine(file)
    assert graph is None
    assert [said in str(problem) for problem in problems] == [True], problems
