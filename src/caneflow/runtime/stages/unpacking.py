"""From the nested lists of a snapshot back to the graph of objects: see `snapshot`."""

import enum
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from caneflow.runtime.stages.numpy_state import (
    array_from_data,
    bits_from_data,
    dtype_from_data,
    generator_from_data,
    scalar_from_data,
    seeds_from_data,
    view_from_data,
)
from caneflow.runtime.stages.references import (
    SnapshotError,
    bound_method,
    empty,
    references_of,
    require_key,
    set_attributes,
)

TABLES: dict[str, type[dict[Any, Any]]] = {kind.__name__: kind for kind in (dict, OrderedDict, Counter)}


class Unpacker:
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
        """The object that `packed` describes."""
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


def _int(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


def _text_from(data: bytes) -> str:
    return data.decode("utf-8", "surrogatepass")
