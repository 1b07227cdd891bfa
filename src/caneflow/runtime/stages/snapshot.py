"""An operator's whole state as msgpack, and back: exact to the last bit or refused; data, never code.

An object is its class's name and its attributes; arrays that share memory, objects that are referred to twice and
random generators stay what they are. Any operator that holds plain data can be brought back after a kill; for one that
holds an open file or an iterator SnapshotError names the attribute. What is not in an attribute, e.g. a variable of
the module, is not kept.

On the way back objects are made empty and given their attributes: nothing of theirs is called, but messages and other
`msgspec.Struct`s check themselves. What may be named at all: see `references`.
"""

import enum
from collections import defaultdict, deque
from collections.abc import Callable, Collection
from itertools import permutations
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, TypeAlias

import msgspec
import numpy as np

from caneflow.runtime.stages.numpy_state import (
    BIT_GENERATORS,
    LARGEST_POOL,
    array_to_data,
    dtype_to_data,
    scalar_to_data,
    view_to_data,
    whole_of,
)
from caneflow.runtime.stages.references import (
    SnapshotError,
    attributes_of,
    bound_method,
    references_of,
    require_key,
)
from caneflow.runtime.stages.unpacking import TABLES, Unpacker

__all__ = ["SnapshotError", "pack", "unpack"]

INT64 = range(-(2**63), 2**63)
PLAIN = frozenset((type(None), bool, float, bytes))
PLAIN_OR_INT = PLAIN | {int}
NUMBERS = (bool, int, float, complex, np.number, np.bool_)
DEEPEST = 100  # levels of things in things; beyond, Python's own limit might end a node
NAMED = (type, FunctionType, BuiltinFunctionType, MethodType, np.ufunc)
RANDOM = (np.random.Generator, np.random.BitGenerator, np.random.SeedSequence)

_Way: TypeAlias = Callable[[Any, str], list[Any]]


def pack(state: object, own_module: str) -> bytes:
    """`state` as msgpack; its classes are of `own_module` or of caneflow. Raises SnapshotError."""
    try:
        return msgspec.msgpack.encode(_Packer(own_module).packed(state, "state"))
    except SnapshotError:
        raise
    except Exception as error:  # a snapshot is a luxury: no attribute, whatever it is, may end the operator
        raise SnapshotError(f"state cannot be kept: {type(error).__name__}: {error}") from error


def unpack(snapshot: bytes, own_module: str) -> Any:
    """The state in `snapshot`; raises SnapshotError when it does not fit what is imported here."""
    try:
        return Unpacker(own_module).whole(msgspec.msgpack.decode(snapshot))
    except SnapshotError:
        raise
    except Exception as error:  # the bytes may be damaged, or made by someone
        raise SnapshotError(f"it does not fit: {type(error).__name__}: {error}") from error


class _Packer:
    """Turns a graph of objects into nested lists: a tag, then what it takes."""

    def __init__(self, own_module: str) -> None:
        self._references = references_of(own_module)
        self._numbers: dict[int, int] = {}  # id of an object -> its number in the snapshot
        self._alive: list[object] = []  # ids are unique only while their objects live
        self._unfinished: set[int] = set()  # numbers of what is made after all that it holds
        self._ways: dict[type, _Way] = {}  # by type: each is looked for once
        self._depth = 0

    def packed(self, value: Any, path: str) -> Any:
        kind = type(value)
        if kind in PLAIN:
            return value
        if kind is int:
            return value if value in INT64 else ["int", _bytes_of(value)]
        if kind is str:
            return value if value.isascii() else _text(value)
        if kind is tuple:
            return ["tuple", self._items(value, path)]
        if kind is complex:
            return ["complex", value.real, value.imag]
        number = self._numbers.get(id(value))
        if number is None:
            way = self._ways.get(kind)
            if way is None:
                way = self._ways[kind] = self._way(kind)
            return way(value, path)
        if number in self._unfinished:
            raise SnapshotError(f"{path} is a {kind.__name__} that holds itself; it cannot be kept")
        return ["again", number]

    def _way(self, kind: type) -> _Way:
        """How values of the type `kind` are packed."""
        for kinds, way in (
            (np.generic, self._scalar),
            (enum.Enum, self._member),
            (NAMED, self._name),
            (np.dtype, self._dtype),
            (np.ndarray, self._array),
            ((tuple, frozenset, msgspec.Struct), self._closed),
            (RANDOM, self._random),
        ):
            if issubclass(kind, kinds):
                return way
        own: dict[type, _Way] = {list: self._list, deque: self._deque, set: self._set, defaultdict: self._table}
        return self._table if kind in TABLES.values() else own.get(kind, self._object)

    def _scalar(self, value: Any, path: str) -> list[Any]:
        return ["scalar", *scalar_to_data(value, path)]

    def _member(self, value: Any, path: str) -> list[Any]:
        name = self._references.class_name(type(value), path)
        if vars(type(value))["_member_map_"].get(value._name_) is not value:  # several flags at once
            raise SnapshotError(f"{path} is {value!r}, which has no name of its own; it cannot be kept")
        return ["member", name, value._name_]

    def _dtype(self, value: Any, path: str) -> list[Any]:
        return ["dtype", dtype_to_data(value, path)]

    def _name(self, value: Any, path: str) -> list[Any]:
        """A class or function by its name, and the object that it is bound to, if it is."""
        owner = None if isinstance(value, type) else getattr(value, "__self__", None)
        if owner is None or isinstance(owner, ModuleType):
            return ["name", self._references.name(value, path)]
        if bound_method(owner, value.__name__) != value:
            raise SnapshotError(f"{path} is a method {value.__name__} that its object does not have; it cannot be kept")
        return ["method", self.packed(owner, f"{path}.__self__"), value.__name__]

    def _list(self, value: Any, path: str) -> list[Any]:
        return ["list", self._remember(value), self._items(value, path)]

    def _deque(self, value: Any, path: str) -> list[Any]:
        return ["deque", self._remember(value), value.maxlen, self._items(value, path)]

    def _set(self, value: Any, path: str) -> list[Any]:
        return ["set", self._remember(value), self._elements(value, path)]

    def _object(self, value: Any, path: str) -> list[Any]:
        name = self._references.class_name(type(value), path)
        return ["object", self._remember(value), name, self._attributes(attributes_of(value, path), path)]

    def _closed(self, value: Any, path: str) -> list[Any]:
        """What cannot be changed once it is made, so that all that it holds is made before."""
        kind, number = type(value), self._remember(value)
        self._unfinished.add(number)
        if kind is frozenset:
            packed = ["frozenset", number, self._elements(value, path)]
        else:
            name = self._references.class_name(kind, path)
            if kind.__dictoffset__ and vars(value):
                raise SnapshotError(f"{path} is a {kind.__name__} with more attributes; it cannot be kept")
            if isinstance(value, tuple):
                packed = ["named tuple", number, name, self._items(value, path)]
            else:
                fields = {field: getattr(value, field) for field in value.__struct_fields__}
                packed = ["struct", number, name, self._attributes(fields, path)]
        self._unfinished.remove(number)
        return packed

    def _array(self, value: Any, path: str) -> list[Any]:
        writes = value.flags.writeable
        if isinstance(value.base, np.ndarray):
            whole = whole_of(value)
            packed = self.packed(whole, f"{path}.base")  # comes first, under a number of its own
            return ["view", self._remember(value), writes, packed, *view_to_data(value, whole, path)]
        return ["array", self._remember(value), writes, *array_to_data(value, path)]

    def _table(self, value: dict[Any, Any], path: str) -> list[Any]:
        number = self._remember(value)
        if getattr(value, "__dict__", None):
            raise SnapshotError(f"{path} is a {type(value).__name__} with attributes; it cannot be kept")
        factory = self.packed(getattr(value, "default_factory", None), f"{path}.default_factory")
        self._enter(path)
        pairs: list[Any] = []
        for key, item in value.items():
            require_key(key, path)
            pairs += (self.packed(key, path), self.packed(item, f"{path}.{key}"))
        self._depth -= 1
        if type(value) is defaultdict:
            return ["default table", number, factory, pairs]
        return ["table", number, type(value).__name__, pairs]

    def _elements(self, value: "set[Any] | frozenset[Any]", path: str) -> list[Any]:
        """The elements of a set, such that a new one of them has the same order."""
        for item in value:
            require_key(item, path)
        items = list(value)
        if not all(map(_is_numbers, items)):
            # The order of text is another one in each process; here one that is the same for the same elements.
            return self._items(sorted(items, key=repr), path)
        # The order in which they are put in decides, where two want the same place.
        orders = permutations(items) if len(items) < 6 else (items, items[::-1], sorted(items, key=repr))
        for order in orders:
            if all(a is b for a, b in zip(set(order), items, strict=True)):
                return self._items(order, path)
        raise SnapshotError(f"{path} is a set whose order cannot be kept; a dict keeps its order")

    def _random(self, value: Any, path: str) -> list[Any]:
        number = self._remember(value)
        if type(value) is np.random.Generator:
            return ["generator", number, self.packed(value.bit_generator, f"{path}.bit_generator")]
        if type(value) is np.random.SeedSequence and value.pool_size <= LARGEST_POOL:
            entropy, spawn_key = (self.packed(each, path) for each in (value.entropy, value.spawn_key))
            return ["seeds", number, entropy, spawn_key, value.pool_size, value.n_children_spawned]
        name = type(value).__name__
        if BIT_GENERATORS.get(name) is not type(value) or type(value.seed_seq) is not np.random.SeedSequence:
            raise SnapshotError(f"{path} is a {name}; of random generators only numpy's own can be kept")
        seeds = self.packed(value.seed_seq, f"{path}.seed_seq")
        return ["bits", number, name, self.packed(value.state, f"{path}.state"), seeds]

    def _items(self, values: Collection[Any], path: str) -> list[Any]:
        kinds = set(map(type, values))
        if kinds <= PLAIN:  # most are, and there are many
            return list(values)
        if kinds <= PLAIN_OR_INT and all(item in INT64 for item in values if type(item) is int):
            return list(values)
        self._enter(path)
        packed = [self.packed(item, f"{path}[{i}]") for i, item in enumerate(values)]
        self._depth -= 1
        return packed

    def _attributes(self, values: dict[str, Any], path: str) -> list[Any]:
        self._enter(path)
        pairs: list[Any] = []
        for name, value in values.items():
            if type(name) is not str:
                raise SnapshotError(f"{path} has the attribute {name!r}, which is not a name; it cannot be kept")
            pairs += (name, self.packed(value, f"{path}.{name}"))
        self._depth -= 1
        return pairs

    def _enter(self, path: str) -> None:
        self._depth += 1
        if self._depth > DEEPEST:
            raise SnapshotError(f"{path[:40]}... is nested more than {DEEPEST} levels deep; it cannot be kept")

    def _remember(self, value: object) -> int:
        self._alive.append(value)
        return self._numbers.setdefault(id(value), len(self._numbers))


def _bytes_of(value: int) -> bytes:
    return value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)


def _text(value: str) -> Any:
    """`value`, or its bytes when msgpack does not take it: half of a surrogate pair, as names of files may have."""
    data = value.encode("utf-8", "surrogatepass")
    return value if data.decode("utf-8", "replace") == value else ["text", data]


def _is_numbers(value: object) -> bool:
    """Whether the hash of `value` is the same in every process: with text in it, it is not."""
    return isinstance(value, NUMBERS) or (isinstance(value, tuple) and all(map(_is_numbers, value)))
