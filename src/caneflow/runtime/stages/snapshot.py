"""An operator's whole state as msgpack, and back: exact to the last bit, no pickle, no code from outside.

An object is its class's name and its attributes; arrays that share memory, objects that are referred to twice and
random generators stay what they are. Classes are looked up in caneflow and in the operator's own module only, and
nothing of theirs is called on the way back but for messages, which check themselves. So any operator that holds plain
data can be brought back after a kill; for one that holds an open file or an iterator SnapshotError names the attribute.
"""

import enum
import importlib
import sys
from collections import deque
from collections.abc import Callable, Collection
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import msgspec
import numpy as np

from caneflow.runtime.errors import DataflowError

INT64 = range(-(2**63), 2**63)
PLAIN = (type(None), bool, float, str, bytes)
JUST_PLAIN = frozenset(PLAIN)
PLAIN_OR_INT = JUST_PLAIN | {int}
OWN_PACKAGE = "caneflow."
KEEPABLE = "only plain data and caneflow's classes can be kept"
FOREIGN = ("builtins", "math", "numpy")  # whose types and functions may be referred to, by name


class SnapshotError(DataflowError):
    """State that cannot be kept, or a snapshot that does not fit: names the attribute."""


def pack(state: object, own_module: str) -> bytes:
    """`state` as msgpack; classes may be from caneflow and from `own_module`. Raises SnapshotError."""
    return msgspec.msgpack.encode(_Packer(own_module).packed(state, "state"))


def unpack(snapshot: bytes, own_module: str) -> Any:
    """The state in `snapshot`; raises SnapshotError when it does not fit what is installed."""
    try:
        return _Unpacker(own_module).unpacked(msgspec.msgpack.decode(snapshot))
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise SnapshotError(f"a snapshot that does not fit: {error}") from error


class _Packer:
    """Turns a graph of objects into nested lists: a tag, then what it takes."""

    def __init__(self, own_module: str) -> None:
        self._own_module = own_module
        self._numbers: dict[int, int] = {}  # id of an object -> its number in the snapshot
        self._alive: list[object] = []  # ids are unique only while their objects live

    def packed(self, value: Any, path: str) -> Any:
        if isinstance(value, PLAIN) and type(value) in PLAIN:
            return value
        if type(value) is int:
            return value if value in INT64 else ["int", str(value)]
        if type(value) is tuple:
            return ["tuple", None, self._items(value, path)]
        if type(value) is complex:
            return ["complex", value.real, value.imag]
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, value.tobytes()]
        if id(value) in self._numbers:
            return ["again", self._numbers[id(value)]]
        return self._new(value, path)

    def _new(self, value: Any, path: str) -> Any:
        if isinstance(value, (type, np.dtype, enum.Enum)) or _is_function(value):
            return self._named(value, path)
        if isinstance(value, tuple):
            return ["tuple", self._class_name(value, path), self._items(value, path)]
        if isinstance(value, np.ndarray) and isinstance(value.base, np.ndarray):
            return self._view(value, path)  # its base comes first, under a number of its own
        number = self._remember(value)
        if isinstance(value, np.ndarray):
            return ["array", number, *_array(value, path)]
        if type(value) is list:
            return ["list", number, self._items(value, path)]
        if type(value) in (set, frozenset):
            items = [self.packed(item, path) for item in sorted(value, key=repr)]
            return ["set", number, type(value) is frozenset, items]
        if type(value) is deque:
            return ["deque", number, value.maxlen, self._items(value, path)]
        if type(value) is dict:
            return ["dict", number, self._pairs(value, path)]
        if isinstance(value, np.random.Generator):
            kind = type(value.bit_generator).__name__
            return ["generator", number, kind, self.packed(value.bit_generator.state, f"{path}.state")]
        if isinstance(value, msgspec.Struct):
            fields = {name: getattr(value, name) for name in value.__struct_fields__}
            return ["struct", number, self._class_name(value, path), self._pairs(fields, path)]
        if type(value).__module__ in FOREIGN:  # an iterator, an open file: no plain data
            raise SnapshotError(
                f"{path} is a {type(value).__name__}; only plain data and caneflow's classes can be kept"
            )
        return ["object", number, self._class_name(value, path), self._pairs(_attributes(value), path)]

    def _items(self, values: Collection[Any], path: str) -> list[Any]:
        kinds = set(map(type, values))
        if kinds <= JUST_PLAIN:  # most are, and there are many
            return list(values)
        if kinds <= PLAIN_OR_INT and all(item in INT64 for item in values if type(item) is int):
            return list(values)
        return [self.packed(item, f"{path}[{i}]") for i, item in enumerate(values)]

    def _pairs(self, values: dict[Any, Any], path: str) -> list[Any]:
        return [[self.packed(key, path), self.packed(item, f"{path}.{key}")] for key, item in values.items()]

    def _view(self, value: "np.ndarray[Any, Any]", path: str) -> Any:
        base = value
        while isinstance(base.base, np.ndarray):
            base = base.base
        if base.base is not None:  # memory that belongs to something else, e.g. a sample's bytes: keep the elements
            return ["array", self._remember(value), *_array(value, path)]
        packed = self.packed(base, f"{path}.base")
        offset = value.__array_interface__["data"][0] - base.__array_interface__["data"][0]
        writes = value.flags.writeable
        about = [offset, list(value.shape), list(value.strides), writes]
        return ["view", self._remember(value), packed, value.dtype.str, *about]

    def _named(self, value: Any, path: str) -> Any:
        if isinstance(value, np.dtype):
            return ["dtype", value.str]
        if isinstance(value, enum.Enum):
            return ["member", self._class_name(value, path), value.name]
        owner = getattr(value, "__self__", None)
        if owner is not None and not isinstance(owner, type(sys)):  # a method of an object
            return ["method", self.packed(owner, path), value.__name__]
        return ["name", self._allowed(value.__module__, value.__qualname__, path)]

    def _class_name(self, value: object, path: str) -> str:
        kind = type(value)
        return self._allowed(kind.__module__, kind.__qualname__, path)

    def _allowed(self, module: str, name: str, path: str) -> str:
        known = module == self._own_module or module.startswith(OWN_PACKAGE) or module in FOREIGN
        if not known or "<" in name:
            raise SnapshotError(f"{path} is a {module}.{name}; {KEEPABLE}")
        return f"{module}:{name}"

    def _remember(self, value: object) -> int:
        self._alive.append(value)
        return self._numbers.setdefault(id(value), len(self._numbers))


class _Unpacker:
    """Turns nested lists back into the graph of objects."""

    def __init__(self, own_module: str) -> None:
        self._own_module = own_module
        self._made: dict[int, Any] = {}

    def unpacked(self, packed: Any) -> Any:
        if not isinstance(packed, list):
            return packed
        make: Callable[..., Any] = getattr(self, f"_{packed[0]}")
        return make(*packed[1:])

    def _keep(self, number: int, value: Any) -> Any:
        self._made[number] = value
        return value

    def _int(self, digits: str) -> int:
        return int(digits)

    def _complex(self, real: float, imaginary: float) -> complex:
        return complex(real, imaginary)

    def _scalar(self, dtype: str, data: bytes) -> Any:
        return np.frombuffer(data, dtype)[0]

    def _again(self, number: int) -> Any:
        return self._made[number]

    def _tuple(self, name: str | None, items: list[Any]) -> Any:
        values = tuple(map(self.unpacked, items))
        return values if name is None else tuple.__new__(self._found(name), values)

    def _array(self, number: int, dtype: str, shape: list[int], order: str, data: bytes) -> Any:
        flat = np.frombuffer(bytearray(data), dtype)
        array = np.empty(shape, dtype, order="F" if order == "F" else "C")  # owns its memory, as it did
        array[...] = flat.reshape(shape)
        return self._keep(number, array)

    def _view(
        self, number: int, base: Any, dtype: str, offset: int, shape: list[int], strides: list[int], writes: bool
    ) -> Any:
        whole = self.unpacked(base)
        view: np.ndarray[Any, Any] = np.ndarray(tuple(shape), dtype, whole, offset, tuple(strides))
        view.flags.writeable = writes
        return self._keep(number, view)

    def _list(self, number: int, items: list[Any]) -> Any:
        made: list[Any] = self._keep(number, [])
        made.extend(map(self.unpacked, items))
        return made

    def _set(self, number: int, frozen: bool, items: list[Any]) -> Any:
        return self._keep(number, (frozenset if frozen else set)(map(self.unpacked, items)))

    def _deque(self, number: int, longest: int | None, items: list[Any]) -> Any:
        made: deque[Any] = self._keep(number, deque(maxlen=longest))
        made.extend(map(self.unpacked, items))
        return made

    def _dict(self, number: int, pairs: list[Any]) -> Any:
        made: dict[Any, Any] = self._keep(number, {})
        made.update(self._values(pairs))
        return made

    def _generator(self, number: int, kind: str, state: Any) -> Any:
        bits = getattr(np.random, kind)()
        bits.state = self.unpacked(state)
        return self._keep(number, np.random.Generator(bits))

    def _struct(self, number: int, name: str, pairs: list[Any]) -> Any:
        return self._keep(number, self._found(name)(**self._values(pairs)))

    def _object(self, number: int, name: str, pairs: list[Any]) -> Any:
        kind = self._found(name)
        made = self._keep(number, object.__new__(kind))
        for attribute, value in self._values(pairs).items():
            object.__setattr__(made, attribute, value)  # a frozen dataclass is set up this way as well
        return made

    def _dtype(self, text: str) -> Any:
        return np.dtype(text)

    def _member(self, name: str, member: str) -> Any:
        return self._found(name)[member]

    def _method(self, owner: Any, name: str) -> Any:
        return getattr(self.unpacked(owner), name)

    def _name(self, name: str) -> Any:
        return self._found(name)

    def _values(self, pairs: list[Any]) -> dict[Any, Any]:
        return {self.unpacked(key): self.unpacked(value) for key, value in pairs}

    def _found(self, name: str) -> Any:
        module, _, qualified = name.partition(":")
        if module.startswith(OWN_PACKAGE):
            importlib.import_module(module)
        elif module not in (self._own_module, *FOREIGN):
            raise SnapshotError(f"a snapshot names {name}; only caneflow's and the operator's own classes are taken")
        found: Any = sys.modules[module]
        for part in qualified.split("."):
            found = getattr(found, part)
        if module == "builtins" and not isinstance(found, type):
            raise SnapshotError(f"a snapshot names {name}; of Python itself only types are taken")
        return found


def _is_function(value: object) -> bool:
    return isinstance(value, (FunctionType, MethodType, BuiltinFunctionType, np.ufunc))


def _array(value: "np.ndarray[Any, Any]", path: str) -> list[Any]:
    if value.dtype.hasobject:
        raise SnapshotError(f"{path} is an array of objects; it cannot be kept")
    order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
    return [value.dtype.str, list(value.shape), order, value.tobytes()]


def _attributes(value: object) -> dict[str, Any]:
    """What an object holds, in its dictionary and its slots."""
    held = dict(getattr(value, "__dict__", {}))
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                held[name] = getattr(value, name)
    return held
