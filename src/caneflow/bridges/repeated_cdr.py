"""CDR of messages that come again and again: rosbags encodes the first, after that only the numbers are replaced.

The texts of a topic (its frames) and the lengths of its lists are the same in every message, so each number has its
place. Where that does not hold, and where the first message does not come out as rosbags has it, rosbags encodes.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import Any, Final, NamedTuple

FORMATS: Final = {  # of struct, by the names of ROS
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
HEADER: Final = 4  # bytes before the message, from whose end alignment counts
LENGTH: Final = 4  # bytes of a length: of a text, or of a list

Get = Callable[[Any], Any]


class RepeatedCdr:
    """An encoder for the messages of one topic."""

    def __init__(self, store: Any, kind: str, encode: Callable[[str, Any], bytes]) -> None:
        """`store`: rosbags' types, `kind` one of them; `encode`: what rosbags makes of a message of a kind."""
        self._kind, self._encode = kind, encode
        self._list, self._fields = _fields(store, kind)
        self._layout: _Layout | None = None

    def __call__(self, message: Any) -> bytes:
        """The message as CDR, little-endian, with its header of four bytes."""
        if self._layout is not None and (filled := self._layout.filled(message)) is not None:
            return filled
        encoded = self._encode(self._kind, message)
        if self._fields:
            layout = _Layout(self._list, self._fields, message, encoded)
            self._layout = layout if layout.filled(message) == encoded else None
        return encoded


class _Field(NamedTuple):
    """A number, an array of numbers, or a text in a message or in each element of its list."""

    path: str  # of attributes
    format: str = ""  # of struct; "": it is a text
    length: int | None = None  # of an array


class _Element(NamedTuple):
    """Where the fields of the message, or of one element of its list, are and go."""

    texts: Get | None
    said: Any  # those
    numbers: list[tuple[Get, struct.Struct, int]]  # numbers in a row, and where they begin
    arrays: list[tuple[Get, int, int]]  # the ends of each


class _Layout:
    """The bytes of one message, and the places of its numbers."""

    def __init__(self, list_name: str, fields: Sequence[_Field], message: Any, encoded: bytes) -> None:
        self._bytes = bytearray(encoded)
        self._list_name = list_name
        self._elements: list[_Element] = []
        at = HEADER + (LENGTH if list_name else 0)
        for each in self._listed(message):
            element, at = _placed(fields, each, at)
            self._elements.append(element)

    def filled(self, message: Any) -> bytes | None:
        """The bytes of another message; None where its texts or the length of its list are others."""
        listed = self._listed(message)
        if len(listed) != len(self._elements):
            return None
        for each, element in zip(listed, self._elements, strict=True):
            if element.texts is not None and element.texts(each) != element.said:
                return None
            for get, form, at in element.numbers:
                form.pack_into(self._bytes, at, *get(each))
            for get, begin, end in element.arrays:
                self._bytes[begin:end] = get(each).tobytes()
        return bytes(self._bytes)

    def _listed(self, message: Any) -> Sequence[Any]:
        return getattr(message, self._list_name) if self._list_name else (message,)


def _fields(store: Any, kind: str) -> tuple[str, list[_Field]]:
    """The name of the list that is all of a message ("": it is none), and its fields; none where lengths differ."""
    parts = store.fielddefs[kind][1]
    name, (node, about) = parts[0]
    is_list = len(parts) == 1 and node.name == "SEQUENCE" and about[0][0].name == "NAME"
    try:
        return (name, list(_leaves(store, about[0][1]))) if is_list else ("", list(_leaves(store, kind)))
    except KeyError:
        return "", []


def _leaves(store: Any, kind: str, before: str = "") -> Iterator[_Field]:
    """Every field of a kind, in order; raises KeyError for one that has no fixed length."""
    for name, (node, about) in store.fielddefs[kind][1]:
        path = f"{before}{name}"
        if node.name == "NAME":
            yield from _leaves(store, about, f"{path}.")
        elif node.name == "ARRAY" and about[0][0].name == "BASE":
            yield _Field(path, FORMATS[about[0][1][0]], about[1])
        elif node.name == "BASE":
            yield _Field(path) if about[0] == "string" else _Field(path, FORMATS[about[0]])
        else:
            raise KeyError(path)


def _placed(fields: Sequence[_Field], element: Any, at: int) -> tuple[_Element, int]:
    """Where the fields of `element` go that begins at `at`, and where it ends."""
    texts = [field.path for field in fields if not field.format]
    get_texts = attrgetter(*texts) if texts else None
    placed = _Element(get_texts, get_texts(element) if get_texts else None, [], [])
    row: list[str] = []  # paths of numbers side by side
    form, begin = "<", at

    def end_row() -> None:
        if row:
            get = attrgetter(*row) if len(row) > 1 else _as_tuple(row[0])
            placed.numbers.append((get, struct.Struct(form), begin))

    for field in fields:
        if not field.format or field.length is not None:
            end_row()
            size = LENGTH if not field.format else struct.calcsize(field.format)
            at = _aligned(at, size)
            if field.length is None:
                at += LENGTH + len(attrgetter(field.path)(element).encode()) + 1
            else:
                placed.arrays.append((attrgetter(field.path), at, at + size * field.length))
                at += size * field.length
            row, form, begin = [], "<", at
        else:
            size = struct.calcsize(field.format)
            form += f"{_aligned(at, size) - at}x{field.format}"
            at = _aligned(at, size) + size
            row.append(field.path)
    end_row()
    return placed, at


def _as_tuple(path: str) -> Get:
    get = attrgetter(path)
    return lambda element: (get(element),)


def _aligned(at: int, size: int) -> int:
    """The next place for a number of `size` bytes."""
    return HEADER + -(-(at - HEADER) // size) * size
