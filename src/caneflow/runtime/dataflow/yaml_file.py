"""A YAML text as plain values, each with its line and column; what YAML itself gets wrong becomes problems.

Values are composed here instead of by a YAML loader, because loaders stop at the first double key, build objects
out of tags, and forget where a value stood.
"""

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from caneflow.near_files import near_file
from caneflow.runtime.errors import DataflowError, Place, Problem
from caneflow.runtime.wording import KeyPath, dotted, one_line, shown

MCAP = b"\x89MCAP"  # how a recording begins
MAX_BYTES = 2**20  # a graph of hundreds of nodes has 100 kB
MAX_DEPTH = 32  # mappings and lists inside each other
MAX_VALUES = 50_000  # aliases of aliases may stand for more values than fit into memory
MAX_BITS = 1024  # of a whole number: what no float holds, no setting takes

TAG = "tag:yaml.org,2002:"
MERGE = TAG + "merge"  # the key `<<`
NUMBERS = {TAG + "int", TAG + "float"}
TEXTS = {TAG + "str", TAG + "timestamp", TAG + "value"}  # a date is text: no field of ours is one


class Document:
    """The values of a YAML text; it knows where each was written and keeps what was wrong with the text."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.value: Any = None
        self.problems: list[Problem] = []
        self.places: dict[KeyPath, Place] = {}
        self.key_places: dict[KeyPath, Place] = {}
        self.unreadable: set[KeyPath] = set()
        self._laid_over: dict[KeyPath, Place] = {}

    def place(self, path: KeyPath, *, key: bool = False) -> Place:
        """Where the value at `path` (or its key) was written; the nearest thing above it if it is not there."""
        for end in range(len(path), -1, -1):
            if (over := self._laid_over.get(path[:end])) is not None:
                return over
        exact = (self.key_places if key else self.places).get(path)
        if exact is not None:
            return exact
        for laid, over in self._laid_over.items():
            if laid[: len(path)] == path:
                return over
        for end in range(len(path), 0, -1):
            if (above := self.key_places.get(path[:end]) or self.places.get(path[:end])) is not None:
                return above
        return self.places.get((), Place(source=self.source, line=1, column=1))

    def lay_over(self, path: KeyPath, value: Any, source: str) -> None:
        """Put `value` at `path`, making the mappings on the way there; `source` says who wants it so."""
        *way, last = path
        inside = self.value
        for key in way:
            if not isinstance(inside.get(key), dict):
                inside[key] = {}
            inside = inside[key]
        inside[last] = value
        self._laid_over[path] = Place(source=source)

    def problem(self, path: KeyPath, text: str, *, key: bool = False, warning: bool = False) -> None:
        """Note what is wrong (or only odd) at `path`; what YAML could not read there is not judged again."""
        where = dotted(path)
        if path not in self.unreadable:
            place = self.place(path, key=key)
            self.problems.append(Problem(place=place, path=where, text=text, warning=warning))

    def refuse(self, path: KeyPath, text: str, *, key: bool = False) -> None:
        """Note that there is no plain value at `path`."""
        self.problem(path, text, key=key)
        self.unreadable.add(path)


def read_yaml(path: Path) -> Document:
    """The values of the file at `path`; raises DataflowError when there are none to be had."""
    source = str(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        reason = getattr(error, "strerror", None) or error
        raise _broken(Place(source=source), f"cannot be read: {reason}{near_file(path)}") from error
    if data.startswith(MCAP):
        example = f"caneflow run dataflow.yaml --replay {source}"
        raise _broken(Place(source=source), f"a recording, not a dataflow; expected e.g. {example}")
    if len(data) > MAX_BYTES:
        raise _broken(Place(source=source), f"larger than {MAX_BYTES} bytes, the limit for a dataflow file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        start = error.start
        place = Place(source=source, line=data.count(b"\n", 0, start) + 1, column=_column(data, start))
        raise _broken(place, f"byte 0x{data[start]:02x} not UTF-8; save the file as UTF-8 text") from error
    return compose(text, source)


def compose(text: str, source: str) -> Document:
    """The values of `text`; raises DataflowError when it is not YAML at all."""
    yaml = YAML(typ="safe", pure=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ruamel warns on stderr of anchors that are used twice, and the like
            root = yaml.compose(text)
            document = Document(source)
            if root is not None:
                document.value = _Plain(document, yaml).value(root, ())
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Place(source=source, line=mark.line + 1, column=mark.column + 1)
        said = error.problem if error.problem is not None else error.context
        raise _broken(place, f"not YAML: {one_line(said)}{_advice(one_line(said))}") from error
    except ReaderError as error:
        place = Place(source=source, line=text.count("\n", 0, error.position) + 1, column=_column(text, error.position))
        raise _broken(place, f"not YAML: character {ord(text[error.position]):#06x} is not allowed") from error
    except RecursionError as error:
        raise _broken(Place(source=source, line=1, column=1), f"is nested more than {MAX_DEPTH} deep") from error
    except _TooMuch as error:
        raise _broken(Place(source=source, line=1, column=1), str(error)) from error
    except (YAMLError, ValueError, TypeError, LookupError, AttributeError, AssertionError) as error:
        # ruamel's scanner has its own slips on texts that are not YAML (an AttributeError after a bad directive).
        raise _broken(Place(source=source, line=1, column=1), f"not YAML: {one_line(error)}") from error
    return document


class _TooMuch(Exception):
    """The text stands for more values than any dataflow has."""


class _Plain:
    """Turns composed nodes into plain values, and notes their places in a document."""

    def __init__(self, document: Document, yaml: YAML) -> None:
        self._document = document
        self._constructor = yaml.constructor
        self._open: set[int] = set()  # the nodes that are being turned: an alias may lead back into them
        self._count = 0

    def value(self, node: Node, path: KeyPath) -> Any:
        """The plain value of `node`."""
        self._count_one(len(path))
        self._document.places[path] = self._place(node)
        if id(node) in self._open:
            self._document.refuse(path, "contains itself; an alias may not lead to what it stands in")
            return None
        self._open.add(id(node))
        plain = self._of_kind(node, path)
        self._open.discard(id(node))
        return plain

    def _count_one(self, depth: int) -> None:
        """Count a value that the text stands for, or that a merge brings."""
        self._count += 1
        if self._count > MAX_VALUES:
            raise _TooMuch(f"stands for more than {MAX_VALUES} values, the limit for a dataflow file")
        if depth > MAX_DEPTH:
            raise _TooMuch(f"is nested more than {MAX_DEPTH} deep, the limit for a dataflow file")

    def _of_kind(self, node: Node, path: KeyPath) -> Any:
        if isinstance(node, MappingNode) and str(node.tag) == TAG + "map":
            return self._mapping(node, path)
        if isinstance(node, SequenceNode) and str(node.tag) == TAG + "seq":
            return [self.value(item, (*path, i)) for i, item in enumerate(node.value)]
        if isinstance(node, ScalarNode):
            return self._scalar(node, path)
        self._document.refuse(path, f"has the tag {node.tag}; only plain values are read")
        return None

    def _mapping(self, node: MappingNode, path: KeyPath) -> dict[str, Any]:
        plain: dict[str, Any] = {}
        for key, item in self._pairs(node):
            name = _name_of(key)
            if name in plain:
                self._twice((*path, name), key)
            else:
                plain[name] = self._item(key, item, (*path, name))
        for merged in self._merged(node, path):
            for key, item in self._pairs(merged):
                self._count_one(len(path))
                if (name := _name_of(key)) not in plain:
                    plain[name] = self._item(key, item, (*path, name))
        return plain

    def _item(self, key: Node, item: Node, path: KeyPath) -> Any:
        """The value of one entry of a mapping."""
        self._document.key_places[path] = self._place(key)
        if str(key.tag) not in TEXTS or not _is_text(key.value):
            self._document.refuse(path, "not a key; expected text, in quotes if need be", key=True)
        return self.value(item, path)

    def _pairs(self, node: MappingNode) -> Iterator[tuple[Node, Node]]:
        yield from ((key, item) for key, item in node.value if str(key.tag) != MERGE)

    def _merged(self, node: MappingNode, path: KeyPath, within: tuple[int, ...] = ()) -> Iterator[MappingNode]:
        """What `<<` brings in, and what is merged there in its turn; what comes first goes before what comes later."""
        for key, item in node.value:
            if str(key.tag) != MERGE:
                continue
            for merged in item.value if isinstance(item, SequenceNode) else [item]:
                self._count_one(len(path) + len(within))
                if isinstance(merged, MappingNode) and id(merged) not in (id(node), *within):
                    yield merged
                    yield from self._merged(merged, path, (*within, id(node)))
                    continue
                self._document.key_places[*path, "<<"] = self._place(key)
                wrong = "merges itself" if isinstance(merged, MappingNode) else "merges what is not a mapping"
                self._document.refuse((*path, "<<"), wrong, key=True)

    def _scalar(self, node: ScalarNode, path: KeyPath) -> Any:
        tag = str(node.tag)
        if tag in TEXTS:
            if not _is_text(node.value):
                self._document.refuse(path, "holds half a surrogate pair; that is not text")
                return ""
            return node.value
        if tag == TAG + "null":
            return None
        if tag not in (TAG + "bool", *NUMBERS):
            self._document.refuse(path, f"has the tag {tag}; only plain values are read")
            return node.value
        try:
            value = self._constructor.construct_object(node)
        except (ValueError, LookupError) as error:
            self._document.refuse(
                path, f"{shown(node.value)} is not of type {tag.removeprefix(TAG)}: {one_line(error)}"
            )
            return None
        if isinstance(value, float) and math.isnan(value):
            self._document.refuse(path, "is not a number; nothing can be set to that")
        if isinstance(value, int) and value.bit_length() > MAX_BITS:
            self._document.refuse(path, "is a number that is too large for any setting")
            return None
        return value

    def _twice(self, path: KeyPath, key: Node) -> None:
        first = self._document.key_places[path]
        problem = Problem(
            place=self._place(key),
            path=dotted(path),
            text=f"is written twice, first in line {first.line}; keep one",
        )
        self._document.problems.append(problem)

    def _place(self, node: Node) -> Place:
        mark = node.start_mark
        return Place(source=self._document.source, line=mark.line + 1, column=mark.column + 1)


def _broken(place: Place, text: str) -> DataflowError:
    problem = Problem(place=place, path="", text=text)
    return DataflowError(str(problem), [problem])


def _advice(said: str) -> str:
    if "'\\t'" in said:
        return "; indent with spaces, not with tabs"
    if "expected a single document" in said or "another document" in said:
        return "; one file is one dataflow"
    if "expected <block end>" in said:
        return "; check the indentation of this line"
    return ""


def _name_of(key: Node) -> str:
    """A key as text, whatever it is."""
    name = str(key.value) if isinstance(key, ScalarNode) else "?"
    return name.encode(errors="backslashreplace").decode()


def _is_text(text: str) -> bool:
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _column(text: Any, position: int) -> int:
    """The column (from 1) of `position` in a str or bytes."""
    newline = "\n" if isinstance(text, str) else b"\n"
    return int(position - (text.rfind(newline, 0, position) + 1) + 1)
