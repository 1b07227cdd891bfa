"""Plain values checked against a type by pydantic, and its findings in our words.

What would be right is read from the type's JSON Schema: so one sentence serves every way of being wrong, and a key
that nobody knows is a mistake whatever the type's own stance on it.
"""

import json
from collections.abc import Iterator
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import CoreSchema, ErrorDetails

from caneflow.runtime.wording import KeyPath, did_you_mean, listed, one_line, shown

T = TypeVar("T")
JsonSchema = dict[str, Any]

UNKNOWN_KEY = {"extra_forbidden", "unexpected_keyword_argument"}
OWN_WORDS = {"value_error", "assertion_error"}  # raised by a type's own check: its sentence is the message


class Mistake(NamedTuple):
    """What is wrong at a path of the values."""

    path: KeyPath
    text: str
    key: bool = False  # it is the key that is wrong, not its value


class Checked(Generic[T]):
    """A type that values are checked against."""

    def __init__(self, kind: Any) -> None:
        self._adapter: TypeAdapter[T] = TypeAdapter(kind)

    @cached_property
    def _schema(self) -> JsonSchema:
        """What the type takes; made when it is first asked for, as it costs as much as all the rest."""
        return self._adapter.json_schema(schema_generator=_Lenient)

    def __call__(self, values: Any) -> tuple[T | None, list[Mistake]]:
        """`values` as the type, or None and every mistake that stands in the way, in the order of the values."""
        mistakes = {mistake.path: mistake for mistake in self._unknown_keys(values)}
        try:
            # JSON mode: a list may stand for a tuple, and nothing else for anything else.
            result = self._adapter.validate_json(json.dumps(values), strict=True)
        except ValidationError as error:
            for detail in error.errors(include_url=False):
                mistake = self._mistake(values, detail)
                mistakes.setdefault(mistake.path, mistake)
            return None, list(mistakes.values())
        return (None if mistakes else result), list(mistakes.values())

    def takes(self, path: KeyPath) -> str:
        """What would be right at `path`, as words."""
        words = dict.fromkeys(filter(None, map(_takes, self._at(path))))
        return " or ".join(words) or "something else"

    def about(self, path: KeyPath) -> str:
        """What the value at `path` means, with its unit; empty when the type does not say."""
        return next((str(s["description"]) for s in self._beside(path) if "description" in s), "")

    def _right(self, path: KeyPath) -> str:
        about = self.about(path)
        return f"it takes {self.takes(path)}{f' ({about})' if about else ''}"

    def _mistake(self, values: Any, detail: ErrorDetails) -> Mistake:
        kind = detail["type"]
        path, last = _path_in(values, detail["loc"])
        if kind in UNKNOWN_KEY:
            path = (*path, *last)
            return Mistake(path, self._unknown(path), key=True)
        if kind in OWN_WORDS:
            return _said_by_type(values, path, one_line(detail["ctx"]["error"]))
        if kind == "missing" and last and isinstance(last[0], str):
            return Mistake((*path, *last), f"is missing; {self._right((*path, *last))}", key=True)
        if last == ("[key]",):
            return Mistake(path, f"not a valid name; expected {_key_rule(self._at(path[:-1]))}", key=True)
        value = _value_at(values, path)
        choice = next((s["enum"] for s in self._at(path) if "enum" in s), ())
        hint = did_you_mean(value, map(str, choice)) if isinstance(value, str) else ""
        return Mistake(path, f"is {shown(value)};{hint} {self._right(path)}")

    def _unknown_keys(self, values: Any, path: KeyPath = ()) -> Iterator[Mistake]:
        if isinstance(values, dict):
            allowed = self._allowed(path)
            for key, value in values.items():
                inside = (*path, key)
                if allowed is not None and key not in allowed:
                    yield Mistake(inside, self._unknown(inside), key=True)
                else:
                    yield from self._unknown_keys(value, inside)
        elif isinstance(values, list):
            for i, value in enumerate(values):
                yield from self._unknown_keys(value, (*path, i))

    def _unknown(self, path: KeyPath) -> str:
        allowed = self._allowed(path[:-1]) or []
        return f"unknown key;{did_you_mean(str(path[-1]), allowed)} allowed are {listed(sorted(allowed))}"

    def _allowed(self, path: KeyPath) -> list[str] | None:
        """The keys that a mapping at `path` may have; None: any."""
        mappings = [s for s in self._at(path) if s.get("type") == "object"]
        if not mappings or any("properties" not in s and not _is_closed(s) for s in mappings):
            return None
        if any(s.get("additionalProperties", False) is not False for s in mappings):
            return None
        return [key for s in mappings for key in s.get("properties", {})]

    def _at(self, path: KeyPath) -> list[JsonSchema]:
        """The schemas of which a value at `path` has to fit one."""
        return [one for schema in self._beside(path) for one in self._alternatives(schema)]

    def _beside(self, path: KeyPath) -> list[JsonSchema]:
        """The same, before references and alternatives are followed: here stand the descriptions."""
        schemas = [self._schema]
        for key in path:
            schemas = [
                child for s in schemas for one in self._alternatives(s) if (child := _child(one, key)) is not None
            ]
        return schemas

    def _alternatives(self, schema: JsonSchema) -> Iterator[JsonSchema]:
        if "$ref" in schema:
            yield from self._alternatives(self._schema["$defs"][schema["$ref"].rpartition("/")[2]])
            return
        choices = [one for word in ("anyOf", "oneOf", "allOf") for one in schema.get(word, ())]
        if not choices:
            yield schema
        for one in choices:
            yield from self._alternatives(one)


def is_inside(values: Any, key: int | str) -> bool:
    """Whether a mapping or list has something at `key`."""
    if isinstance(values, list):
        return isinstance(key, int) and key < len(values)
    return isinstance(values, dict) and key in values


class _Lenient(GenerateJsonSchema):
    """Says nothing about a part of a type that JSON Schema has no words for, instead of giving up."""

    def handle_invalid_for_json_schema(self, schema: CoreSchema, error_info: str) -> JsonSchema:
        return {}


def _path_in(values: Any, loc: tuple[int | str, ...]) -> tuple[KeyPath, KeyPath]:
    """The part of pydantic's `loc` that leads through `values`, and the rest if it is a key that is not there.

    Between the two pydantic names the alternatives that it tried; nobody wrote those.
    """
    path: list[int | str] = []
    for key in loc:
        inside = _value_at(values, tuple(path))
        if is_inside(inside, key):
            path.append(key)
    there = len(path) > 0 and loc[-1] == path[-1]
    return tuple(path), (() if there or not loc else (loc[-1],))


def _said_by_type(values: Any, path: KeyPath, text: str) -> Mistake:
    """The sentence of a type's own check, moved to the key that it begins with."""
    name, _, rest = text.partition(" ")
    name = name.removesuffix(":")
    return Mistake((*path, name), rest) if is_inside(_value_at(values, path), name) else Mistake(path, text)


def _value_at(values: Any, path: KeyPath) -> Any:
    for key in path:
        values = values[key]
    return values


def _child(schema: JsonSchema, key: int | str) -> JsonSchema | None:
    if isinstance(key, int):
        items = schema.get("prefixItems", [])
        found = items[key] if key < len(items) else schema.get("items")
    else:
        others = [*schema.get("patternProperties", {}).values(), schema.get("additionalProperties")]
        found = schema.get("properties", {}).get(key, others[0])
    return found if isinstance(found, dict) else None


def _is_closed(schema: JsonSchema) -> bool:
    """Whether a mapping without `properties` is one that has no keys, such as the settings of `NoSettings`."""
    return "patternProperties" not in schema and schema.get("additionalProperties", False) is False


def _key_rule(schemas: list[JsonSchema]) -> str:
    return listed(s["propertyNames"].get("description", "") for s in schemas if "propertyNames" in s)


def _takes(schema: JsonSchema) -> str:
    """What a schema without alternatives asks for, as words."""
    if "enum" in schema or "const" in schema:
        return f"one of {listed(map(str, schema.get('enum', [schema.get('const')])))}"
    kind = schema.get("type")
    if kind in ("integer", "number"):
        if "minimum" in schema and schema["minimum"] == schema.get("maximum"):
            return _number(schema["minimum"])
        return ("a whole number" if kind == "integer" else "a number") + _bounds(schema)
    if kind == "string":
        examples = schema.get("examples")
        return f"text such as {listed(map(str, examples))}" if examples else "text"
    if kind == "array":
        least, most = schema.get("minItems"), schema.get("maxItems")
        return f"a list of {least}" if least is not None and least == most else "a list"
    return {"boolean": "true or false", "object": "a mapping", "null": ""}.get(str(kind), "")


def _bounds(schema: JsonSchema) -> str:
    words = {
        "multipleOf": "a multiple of",
        "exclusiveMinimum": "above",
        "minimum": "at least",
        "exclusiveMaximum": "below",
        "maximum": "at most",
    }
    bounds = [f"{word} {_number(schema[key])}" for key, word in words.items() if key in schema]
    return f", {' and '.join(bounds)}" if bounds else ""


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) and abs(value) < 1e12 else f"{value:g}"
