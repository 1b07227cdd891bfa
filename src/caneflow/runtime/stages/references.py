"""What a snapshot may name: classes and functions, each defined in the module that it is named with.

A name is looked up in modules that are imported already and in the dictionaries of their classes. So nothing is
imported, and no property, metaclass or function runs, because of what a snapshot says.
"""

import builtins
import collections
import enum
import math
import sys
from contextlib import suppress
from functools import lru_cache
from types import (
    BuiltinFunctionType,
    FunctionType,
    GetSetDescriptorType,
    MemberDescriptorType,
    MethodDescriptorType,
    MethodType,
)
from typing import Any, NamedTuple

import numpy as np

from caneflow.messages.registry import SAMPLES
from caneflow.runtime.errors import DataflowError

# Rooms of caneflow whose classes an operator's state may be made of: they do no I/O, so their functions are harmless.
ROOMS = (
    "caneflow.algorithms",
    "caneflow.messages",
    "caneflow.operators",
    "caneflow.protocols",
    "caneflow.runtime.program",
    "caneflow.simulation",
)
KEEPABLE = "only plain data and classes of the operator's own module, of messages or of caneflow can be kept"
BUILTINS = (
    "bool int float complex str bytes bytearray list tuple dict set frozenset object "
    "abs all any len max min pow round sorted sum"
)
COLLECTIONS = "deque defaultdict OrderedDict Counter"
PLAIN_KEYS = (type(None), bool, int, float, complex, str, bytes)
FOREIGN: dict[str, Any] = {
    **{f"builtins:{name}": getattr(builtins, name) for name in BUILTINS.split()},
    **{f"collections:{name}": getattr(collections, name) for name in COLLECTIONS.split()},
    **{f"math:{name}": found for name, found in vars(math).items() if isinstance(found, BuiltinFunctionType)},
    **{
        f"numpy:{name}": found
        for name, found in vars(np).items()
        if isinstance(found, np.ufunc) or (isinstance(found, type) and issubclass(found, np.generic))
    },
}
CONTAINERS = (list, set, dict, collections.deque)  # whose own methods may be kept, bound to them


class SnapshotError(DataflowError):
    """State that cannot be kept, or a snapshot that does not fit: names the attribute."""


class Layout(NamedTuple):
    """Where the instances of a class hold their attributes."""

    slots: dict[str, MemberDescriptorType]
    dictionary: GetSetDescriptorType | None


class References:
    """The names that snapshots of one operator may hold."""

    def __init__(self, own_module: str) -> None:
        self._own_module = own_module
        # By id, so that nothing is hashed: the name and what it names, which lives on so that its id stays its own.
        self._names: dict[int, tuple[str, Any]] = {id(found): (name, found) for name, found in FOREIGN.items()}

    def name(self, value: Any, path: str) -> str:
        """The name of a class or function; raises SnapshotError when it cannot be found by one."""
        known = self._names.get(id(value))
        if known is not None:
            return known[0]
        module, qualified = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
        name = f"{module}:{qualified}"
        if not self._may_name(module) or _defined(name) is not value:
            raise SnapshotError(f"{path} is a {module}.{qualified}; {KEEPABLE}")
        self._names[id(value)] = name, value
        return name

    def class_name(self, kind: type, path: str) -> str:
        """The name of a class whose instances can be kept; raises SnapshotError otherwise."""
        name = self.name(kind, path)
        if name in FOREIGN:
            raise SnapshotError(f"{path} is a {kind.__name__}; {KEEPABLE}")
        return name

    def found(self, name: str) -> Any:
        """The class or function of a name; raises SnapshotError when it is not defined there."""
        if name in FOREIGN:
            return FOREIGN[name]
        if not self._may_name(name.partition(":")[0]):
            raise SnapshotError(f"it names {name}; {KEEPABLE}")
        found = _defined(name)
        if found is None:
            raise SnapshotError(f"it names {name}, which is not defined there, or not imported")
        return found

    def found_class(self, name: str, base: type = object) -> Any:
        """The class of a name, derived from `base`; raises SnapshotError when it is none, or one of Python's own."""
        found = self.found(name)
        if name in FOREIGN or not isinstance(found, type) or not issubclass(found, base):
            raise SnapshotError(f"it names {name}, which is not a class of this kind")
        return found

    def _may_name(self, module: object) -> bool:
        return module == self._own_module or (isinstance(module, str) and (_in_a_room(module) or _has_messages(module)))


@lru_cache(maxsize=8)
def references_of(own_module: str) -> References:
    """The names that snapshots of an operator of `own_module` may hold."""
    return References(own_module)


def _has_messages(module: str) -> bool:
    """Whether it is a file of a user's own messages: an operator may keep the last one."""
    return any(kind.__module__ == module for kind in SAMPLES.values())


def _in_a_room(module: str) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in ROOMS)


def _defined(name: str) -> Any:
    """The class or function that is defined under `name`, in a module that is imported; None when there is none."""
    module, _, qualified = name.partition(":")
    found: Any = sys.modules.get(module)
    for part in qualified.split("."):
        if not isinstance(found, (type, type(sys))):
            return None
        found = vars(found).get(part)
    if isinstance(found, staticmethod):
        found = found.__func__
    if not isinstance(found, (type, FunctionType)):
        return None
    return found if (found.__module__, found.__qualname__) == (module, qualified) else None


def bound_method(owner: Any, name: str) -> Any:
    """The method `name` of `owner`, found without asking it; None when it has none that is kept."""
    kind = owner if isinstance(owner, type) else type(owner)
    found: Any = next((vars(each)[name] for each in kind.__mro__ if name in vars(each)), None)
    if isinstance(owner, type):
        return MethodType(found.__func__, owner) if isinstance(found, classmethod) else None
    if kind in CONTAINERS:
        return found.__get__(owner) if isinstance(found, MethodDescriptorType) else None
    if isinstance(found, FunctionType) or (kind is np.random.Generator and callable(found)):
        return MethodType(found, owner)
    return None


@lru_cache(maxsize=256)
def _layout_of(kind: Any) -> Layout:
    """How instances of `kind` are read and made without calling anything of theirs.

    Raises SnapshotError when they hold more than attributes, e.g. what a base in C keeps, or do something at their end.
    """
    slots: dict[str, MemberDescriptorType] = {}
    dictionary = None
    for each in kind.__mro__:
        for name, found in vars(each).items():
            if name == "__del__":
                raise SnapshotError(f"a {kind.__qualname__}, which has a __del__; {KEEPABLE}")
            if isinstance(found, MemberDescriptorType):
                if name in slots:
                    raise SnapshotError(f"a {kind.__qualname__}, which has two slots {name}; {KEEPABLE}")
                slots[name] = found
        dictionary = dictionary or vars(each).get("__dict__")
    if dictionary is not None and not isinstance(dictionary, GetSetDescriptorType):
        raise SnapshotError(f"a {kind.__qualname__}, which has a __dict__ of its own; {KEEPABLE}")
    try:
        object.__new__(kind)
    except TypeError as error:
        raise SnapshotError(f"a {kind.__qualname__}, which holds more than attributes; {KEEPABLE}") from error
    return Layout(slots, dictionary)


def attributes_of(value: Any, path: str) -> dict[str, Any]:
    """What an object holds in its dictionary and its slots; raises SnapshotError when it holds more."""
    kind: Any = type(value)
    try:
        slots, dictionary = _layout_of(kind)
    except SnapshotError as error:
        raise SnapshotError(f"{path} is {error}") from error
    held = {} if dictionary is None else dict(dictionary.__get__(value))
    for name, slot in slots.items():
        with suppress(AttributeError):  # it is not set
            held[name] = slot.__get__(value)
    return held


def empty(kind: Any) -> Any:
    """An instance without attributes; raises SnapshotError for a class whose instances hold more than those."""
    _layout_of(kind)
    return object.__new__(kind)


def set_attributes(made: Any, attributes: dict[str, Any]) -> None:
    """Give an empty object its attributes; raises SnapshotError for one that it cannot hold."""
    kind: Any = type(made)
    slots, dictionary = _layout_of(kind)
    held = None if dictionary is None else dictionary.__get__(made)
    for name, value in attributes.items():
        if name in slots:
            slots[name].__set__(made, value)
        elif held is not None and type(name) is str:
            held[name] = value
        else:
            raise SnapshotError(f"a {kind.__qualname__} has no attribute {name!r}")


def require_key(key: Any, path: str) -> None:
    """Raise SnapshotError for a key of a dictionary, or an element of a set, whose class brings its own hash."""
    kind: Any = type(key)
    if isinstance(key, (tuple, frozenset)):
        for item in key:
            require_key(item, path)
        known = _hashed_as(kind, tuple if isinstance(key, tuple) else frozenset)
    elif isinstance(key, enum.Enum):
        functions = [each for each in (kind.__hash__, kind.__eq__) if isinstance(each, FunctionType)]
        known = all(each is enum.Enum.__hash__ for each in functions)
    else:
        known = isinstance(key, np.generic) or kind in PLAIN_KEYS or _hashed_as(kind, object)
    if not known:
        raise SnapshotError(f"{path} has a {kind.__qualname__} as a key; keys can be plain data only")


def _hashed_as(kind: Any, base: Any) -> bool:
    return kind.__hash__ is base.__hash__ and kind.__eq__ is base.__eq__
