"""An operator's whole state as msgpack, and back: exact to the last bit or refused; data, never code.

An object is its class's name and its attributes; arrays that share memory, objects that are referred to twice and
random generators stay what they are. Any operator that holds plain data can be brought back after a kill; for one that
holds an open file or an iterator SnapshotError names the attribute. What is not in an attribute, e.g. a variable of
the module, is not kept.

On the way back objects are made empty and given their attributes: nothing of theirs is called, but messages and other
`msgspec.Struct`s check themselves. What may be named at all: see `references`.
"""

import enum
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Collection, Iterator
from itertools import permutations
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, TypeAlias

import msgspec
import numpy as np

from caneflow.runtime.stages.numpy_state import (
    BIT_GENERATORS,
    LARGEST_POOL,
    array_from_data,
    array_to_data,
    bits_from_data,
    dtype_from_data,
    dtype_to_data,
    generator_from_data,
    scalar_from_data,
    scalar_to_data,
    seeds_from_data,
    view_from_data,
    view_to_data,
    whole_of,
)
from caneflow.runtime.stages.references import (
    SnapshotError,
    attributes_of,
    bound_method,
    empty,
    references_of,
    require_key,
    set_attributes,
)

__all__ = ["SnapshotError", "pack", "unpack"]

INT64 = range(-(2**63), 2**63)
PLAIN = frozenset((type(None), bool, float, bytes))
PLAIN_OR_INT = PLAIN | {int}
NUMBERS = (bool, int, float, complex, np.number, np.bool_)
DEEPEST = 100  # levels of things in things; beyond, Python's own limit might end a node
TABLES: dict[str, type[dict[Any, Any]]] = {kind.__name__: kind for kind in (dict, OrderedDict, Counter)}
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
        return _Unpacker(own_module).whole(msgspec.msgpack.decode(snapshot))
    except SnapshotError:
        raise
    except Exception as error:  # the bytes may be damaged, or made by somebody
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


class _Unpacker:
    """Turns nested lists back into the graph of objects."""

    def __init__(self, own_module: str) -> None:
        self._references = references_of(own_module)
        self._made: dict[int, Any] = {}
        self._constant: list[Any] = []  # arrays that must not be written to once all is there
        self._makers: dict[str, Callable[..., Any]] = {
            "again": self._made.__getitem__,
            "array": self._array,
            "bits": self._bits,
            "complex": complex,
            "default table": self._default_table,
            "deque": self._deque,
            "dtype": dtype_from_data,
            "frozenset": self._frozenset,
            "generator": self._generator,
            "int": _int,
            "list": self._list,
            "member": self._member,
            "method": self._method,
            "name": self._references.found,
            "named tuple": self._named_tuple,
            "object": self._object,
            "scalar": scalar_from_data,
            "seeds": self._seeds,
            "set": self._set,
            "struct": self._struct,
            "table": self._table,
            "text": _text_from,
            "tuple": self._tuple,
            "view": self._view,
        }

    def whole(self, packed: Any) -> Any:
        made = self._unpacked(packed)
        for array in self._constant:
            array.flags.writeable = False
        return made

    def _unpacked(self, packed: Any) -> Any:
        return self._makers[packed[0]](*packed[1:]) if isinstance(packed, list) else packed

    def _keep(self, number: int, value: Any) -> Any:
        self._made[number] = value
        return value

    def _tuple(self, items: list[Any]) -> Any:
        return tuple(map(self._unpacked, items))

    def _named_tuple(self, number: int, name: str, items: list[Any]) -> Any:
        kind = self._references.found_class(name, tuple)
        if len(items) != len(vars(kind).get("_fields", items)):
            raise SnapshotError(f"it holds {len(items)} values for {name}")
        return self._keep(number, tuple.__new__(kind, map(self._unpacked, items)))

    def _array(self, number: int, writes: bool, *about: Any) -> Any:
        return self._keep_array(number, array_from_data(*about), writes)

    def _view(self, number: int, writes: bool, packed: Any, *about: Any) -> Any:
        return self._keep_array(number, view_from_data(self._unpacked(packed), *about), writes)

    def _keep_array(self, number: int, array: Any, writes: bool) -> Any:
        if not writes:
            self._constant.append(array)
        return self._keep(number, array)

    def _list(self, number: int, items: list[Any]) -> Any:
        made: list[Any] = self._keep(number, [])
        made.extend(map(self._unpacked, items))
        return made

    def _deque(self, number: int, longest: int | None, items: list[Any]) -> Any:
        made: deque[Any] = self._keep(number, deque(maxlen=longest))
        made.extend(map(self._unpacked, items))
        return made

    def _set(self, number: int, items: list[Any]) -> Any:
        made: set[Any] = self._keep(number, set())
        made.update(list(map(self._key, items)))
        return made

    def _frozenset(self, number: int, items: list[Any]) -> Any:
        return self._keep(number, frozenset(list(map(self._key, items))))

    def _table(self, number: int, name: str, pairs: list[Any]) -> Any:
        return self._filled(self._keep(number, TABLES[name]()), pairs)

    def _default_table(self, number: int, factory: Any, pairs: list[Any]) -> Any:
        return self._filled(self._keep(number, defaultdict(self._unpacked(factory))), pairs)

    def _filled(self, made: Any, pairs: list[Any]) -> Any:
        for key, value in _by_two(pairs):
            made[self._key(key)] = self._unpacked(value)
        return made

    def _key(self, packed: Any) -> Any:
        key = self._unpacked(packed)
        require_key(key, "it")
        return key

    def _seeds(self, number: int, entropy: Any, spawn_key: Any, pool_size: int, spawned: int) -> Any:
        return self._keep(
            number, seeds_from_data(self._unpacked(entropy), self._unpacked(spawn_key), pool_size, spawned)
        )

    def _bits(self, number: int, name: str, state: Any, seeds: Any) -> Any:
        return self._keep(number, bits_from_data(name, self._unpacked(state), self._unpacked(seeds)))

    def _generator(self, number: int, bits: Any) -> Any:
        return self._keep(number, generator_from_data(self._unpacked(bits)))

    def _struct(self, number: int, name: str, pairs: list[Any]) -> Any:
        kind = self._references.found_class(name, msgspec.Struct)
        fields = self._values(pairs)
        if fields.keys() != set(kind.__struct_fields__):
            raise SnapshotError(f"it holds {name} with the fields {', '.join(fields)}")
        made = self._keep(number, kind(**fields))
        for field, value in fields.items():
            msgspec.structs.force_setattr(made, field, value)  # should its own check have changed it
        return made

    def _object(self, number: int, name: str, pairs: list[Any]) -> Any:
        made = self._keep(number, empty(self._references.found_class(name)))
        set_attributes(made, self._values(pairs))
        return made

    def _member(self, name: str, member: str) -> Any:
        return vars(self._references.found_class(name, enum.Enum))["_member_map_"][member]

    def _method(self, owner: Any, name: str) -> Any:
        method = bound_method(self._unpacked(owner), name)
        if method is None:
            raise SnapshotError(f"it names a method {name} that its object does not have")
        return method

    def _values(self, pairs: list[Any]) -> dict[str, Any]:
        return {name: self._unpacked(value) for name, value in _by_two(pairs)}


def _by_two(pairs: list[Any]) -> Iterator[tuple[Any, Any]]:
    each = iter(pairs)
    return zip(each, each, strict=True)


def _bytes_of(value: int) -> bytes:
    return value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)


def _int(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


def _text(value: str) -> Any:
    """`value`, or its bytes when msgpack does not take it: half of a surrogate pair, as names of files may have."""
    data = value.encode("utf-8", "surrogatepass")
    return value if data.decode("utf-8", "replace") == value else ["text", data]


def _text_from(data: bytes) -> str:
    return data.decode("utf-8", "surrogatepass")


def _is_numbers(value: object) -> bool:
    """Whether the hash of `value` is the same in every process: with text in it, it is not."""
    return isinstance(value, NUMBERS) or (isinstance(value, tuple) and all(map(_is_numbers, value)))
