"""Snapshots: state comes back exact or is refused by name, shared memory stays shared, and nothing is ever called."""

import enum
import math
import operator
import os
import re
import struct
import subprocess
import sys
from collections import Counter, OrderedDict, defaultdict, deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from pydantic import BaseModel

from caneflow.algorithms.inertial.gyro_bias import GyroBias
from caneflow.messages import Imu, RadarFrame, decode, numbered
from caneflow.runtime.stages.snapshot import SnapshotError, pack, unpack

CALLED: list[str] = []  # by a snapshot that is taken back: must stay empty


class Colour(enum.Enum):
    RED = 1


class Level(enum.IntEnum):
    HIGH = 3


class Rights(enum.Flag):
    READ = 1
    WRITE = 2


class Point(NamedTuple):
    x: float
    y: Any


class Metres(float):
    """A float with a name: its class is lost where it is packed as one."""


class Table(np.ndarray[Any, Any]):
    """An array with methods of its own."""


class Named(dict[str, int]):
    """Likewise."""


@dataclass(frozen=True)
class Settings:
    gain: float = 0.5


class Model(BaseModel):
    gain: float = 0.5
    names: list[str] = []


class Slotted:
    __slots__ = ("__hidden", "left", "right")

    def __init__(self) -> None:
        self.left, self.right, self.__hidden = 1, [2], 3

    def hidden(self) -> int:
        return self.__hidden


@dataclass
class State:
    settings: Settings = field(default_factory=Settings)
    things: dict[Any, Any] = field(default_factory=dict)


class Looping:
    """Refers to its own methods, as a table of handlers does."""

    def __init__(self) -> None:
        self.count = 0
        self.values: list[int] = []
        self.handlers = {"count": self.add, "note": self.values.append, "new": self.fresh}

    def add(self) -> None:
        self.count += 1

    @classmethod
    def fresh(cls) -> "Looping":
        return cls()


class Trap:
    """Says when anything of it is called."""

    __slots__ = ("__dict__", "slot")

    def __new__(cls) -> "Trap":
        CALLED.append("__new__")
        return object.__new__(cls)

    def __init__(self) -> None:
        CALLED.append("__init__")

    def __setattr__(self, name: str, value: object) -> None:
        CALLED.append("__setattr__")

    def __getattr__(self, name: str) -> object:
        CALLED.append("__getattr__")
        return None

    def __hash__(self) -> int:
        CALLED.append("__hash__")
        return 0

    def __eq__(self, other: object) -> bool:
        CALLED.append("__eq__")
        return self is other

    def __call__(self) -> None:
        CALLED.append("__call__")

    def __reduce__(self) -> str:
        CALLED.append("__reduce__")
        return "trap"

    def transpose(self, *_: object) -> None:
        CALLED.append("transpose")

    @property
    def shown(self) -> int:
        CALLED.append("property")
        return 0

    @shown.setter
    def shown(self, value: object) -> None:
        CALLED.append("setter")


class Mortal:
    """Does something when it is thrown away."""

    def __del__(self) -> None:
        CALLED.append("__del__")


def called(*_: object) -> None:
    CALLED.append("function")


def again(state: object) -> Any:
    return unpack(pack(state, __name__), __name__)


def same(a: Any, b: Any) -> bool:
    """Equal in type and every bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, (np.ndarray, np.generic)):
        if a.dtype != b.dtype or a.shape != b.shape or a.tobytes("A") != b.tobytes("A"):
            return False
        steps = [(x, y) for x, y, size in zip(a.strides, b.strides, a.shape, strict=True) if size > 1 and a.size]
        return a.flags.writeable == b.flags.writeable and all(x == y for x, y in steps)
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    if isinstance(a, complex):
        return same(a.real, b.real) and same(a.imag, b.imag)
    if isinstance(a, deque) and a.maxlen != b.maxlen:
        return False
    if isinstance(a, (set, frozenset)) and any(isinstance(each, str) for each in a):
        return bool(a == b)  # the order of text differs in each process
    if isinstance(a, (list, tuple, deque, set, frozenset)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, defaultdict) and a.default_factory is not b.default_factory:
        return False
    if isinstance(a, dict):
        return len(a) == len(b) and all(map(same, a, b)) and all(map(same, a.values(), b.values()))
    return bool(a == b)


def read_only(array: "np.ndarray[Any, Any]") -> "np.ndarray[Any, Any]":
    array.flags.writeable = False
    return array


SIGNALLING = struct.unpack("d", struct.pack("Q", 0x7FF0_0000_0000_0123))[0]
CUBE = np.arange(24.0).reshape(2, 3, 4)
PADDED = np.dtype({"names": ["a", "b"], "formats": ["<i2", (">f8", (2,))], "offsets": [4, 8], "itemsize": 32})


@pytest.mark.parametrize(
    "value",
    [
        None, True, 0, 1 - 2j, -(2**63), 2**63 - 1, 2**63, 2**200, -(2**64), 0.1, math.inf, -0.0, math.nan,
        SIGNALLING, complex(-0.0, math.nan), "text", "gr\xfc\xdfe", "half \ud800", b"bytes", (1, (2.0, "x")),
        [1, [2]], {"a": 1, 3: (4,)},
        {1: 1, 2.5: 2, None: 3, (1, "a"): 4, Colour.RED: 5, np.int8(3): 6, frozenset([1]): 7}, OrderedDict(b=1, a=2),
        Counter("abca"), defaultdict(list, {2: [1]}), defaultdict(None, {1: 1}), deque([1, 2], maxlen=2), deque(),
        {1, 2}, {8, 0}, {0, 8}, {-1, -2, 2**61 - 2}, {2.5, 1, 1j}, set(range(100, 0, -7)), frozenset({3, (1, 2)}),
        frozenset("ab"), Point(1.0, 2.0), Colour.RED, Level.HIGH, Rights.WRITE, Settings(0.25),
        Model(gain=2.0, names=["a"]), np.float32(0.1), np.longdouble(1) / 3, np.longlong(3), np.bool_(True),
        np.complex64(1j), np.array("2026-01-01", "M8[25us]")[()], np.timedelta64(3), np.datetime64("NaT"),
        np.str_("ab"), np.bytes_(b"ab"), np.float16("nan"), np.arange(6, dtype=np.int16).reshape(2, 3),
        np.zeros((0, 3)), np.array(5.0), np.zeros((2, 0, 3), ">i2"), np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.copy(CUBE.transpose(1, 0, 2), order="K"), CUBE.transpose(2, 0, 1), CUBE[::-1, ::2, ::-3], CUBE[:, 1],
        CUBE[1:1], CUBE.T[3, 2, 1:2], np.broadcast_to(np.arange(3.0), (4, 3)), np.arange(3, dtype=">u4"),
        np.array([1 + 2j], np.complex64), np.array([SIGNALLING]), np.array(["a", "bc"]), np.array([b"a", b"bc"]),
        np.array([True]), np.array(["2026-01-01"], "M8[D]"), np.ones(3, np.longdouble), np.zeros(2, "V3"),
        np.array([(1, (2.0, 3.0))], PADDED), np.array([(1, 2.0)], np.dtype("i1,f8", align=True)),
        np.zeros(2, PADDED)["b"], read_only(np.arange(3.0)), read_only(np.arange(4.0))[::2],
        np.frombuffer(b"abcdefgh", np.uint16)[::-1], np.dtype("<f4"), np.dtype(">f4"), PADDED, np.dtype("M8[3ns]"),
        np.dtype((np.int8, (2, 3))), Imu(stamp=1, seq=4, gyro=(0.1, 0.2, 0.3)), float, math.sin, len, deque, np.sin,
        np.float32, called, Looping.add, State, State(),
    ],
)  # fmt: skip
def test_values_come_back_exact(value: Any) -> None:
    assert same(again(value), value)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)
dtypes = (
    arrays_of.boolean_dtypes()
    | arrays_of.integer_dtypes(endianness="?")
    | arrays_of.floating_dtypes(endianness="?")
    | arrays_of.complex_number_dtypes(endianness="?")
    | arrays_of.datetime64_dtypes(endianness="?")
    | arrays_of.byte_string_dtypes(min_len=1, max_len=3)
    | arrays_of.unicode_string_dtypes(min_len=1, max_len=2)
)
fields: st.SearchStrategy[Any] = arrays_of.array_dtypes(dtypes, max_size=3, allow_subarrays=True).filter(
    lambda dtype: all(len(each) == 2 for each in (dtype.fields or {}).values())  # without titles
)


@given(plain)
def test_any_plain_data_comes_back_exact(value: Any) -> None:
    assert same(again(value), value)


@given(st.data(), dtypes | fields, arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
def test_any_array_and_its_views_come_back_exact(data: st.DataObject, dtype: Any, shape: tuple[int, ...]) -> None:
    """Whatever its elements, the order of its axes, the steps of a view and who may write."""
    count = math.prod(shape) * dtype.itemsize
    elements = data.draw(st.binary(min_size=count, max_size=count))
    whole = np.frombuffer(elements, dtype, count=math.prod(shape)).reshape(shape) if count else np.zeros(shape, dtype)
    axes = data.draw(st.permutations(range(whole.ndim)))
    whole = np.copy(whole.transpose(axes), order="K")
    index = data.draw(arrays_of.basic_indices(whole.shape, allow_ellipsis=False, allow_newaxis=True))
    held: list[Any] = [whole[(*(index if isinstance(index, tuple) else (index,)), ...)], whole.T, whole]
    for each in held:
        each.flags.writeable = data.draw(st.booleans())
    back = again(held)
    assert all(map(same, back, held))
    assert np.shares_memory(back[1], back[2]) == np.shares_memory(held[1], held[2])


def test_objects_come_back_with_what_they_hold() -> None:
    state = State(things={"slots": Slotted(), "loop": None})
    state.things["loop"] = state
    back = again(state)
    assert isinstance(back, State)
    assert back.settings == Settings()
    assert back.things["slots"].right == [2]
    assert back.things["slots"].hidden() == 3
    assert back.things["loop"] is back, "what is referred to twice is one object"


def test_tuples_of_a_class_are_the_same_ones_again() -> None:
    best = Point(1.0, [2])
    back = again({"all": [Point(0.0, []), best], "best": best, "rest": {best.x: best}})
    assert back["best"] is back["all"][1]
    assert back["best"] is back["rest"][1.0]


def test_methods_are_bound_to_the_object_that_comes_back() -> None:
    back = again(Looping())
    back.handlers["count"]()
    back.handlers["note"](5)
    assert (back.count, back.values) == (1, [5])
    assert isinstance(back.handlers["new"](), Looping)


def test_arrays_that_share_memory_share_it_again() -> None:
    buffer = np.arange(12.0).reshape(3, 4)
    back = again({"buffer": buffer, "window": buffer[1:, ::2], "same": buffer, "bytes": buffer.view(np.uint8)})
    assert back["same"] is back["buffer"]
    np.testing.assert_array_equal(back["window"], buffer[1:, ::2])
    back["buffer"][1, 0] = -1.0
    assert back["window"][0, 0] == -1.0
    assert back["bytes"].tobytes() == back["buffer"].tobytes()


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_window_that_comes_before_its_buffer_shares_it_too(order: Any) -> None:
    buffer = np.zeros((2, 4), order=order)
    back = again([buffer[1, 2:], buffer])
    back[1][1, 3] = 7.0
    assert back[0][1] == 7.0


def test_who_may_write_is_kept_for_each_view() -> None:
    buffer = np.zeros(4)
    window = buffer[1:]
    buffer.flags.writeable = False
    back = again([buffer, window, buffer[2:]])
    assert [each.flags.writeable for each in back] == [False, True, False]
    back[1][0] = 3.0
    assert back[0][1] == 3.0


def test_an_array_over_a_samples_bytes_comes_back() -> None:
    frame = RadarFrame(
        stamp=1,
        scans=np.arange(6, dtype=np.int16).reshape(2, 3),
        scan_period=0.1,
        range_start=0.0,
        range_step=0.1,
        carrier=4e9,
        bandwidth=1e9,
    )
    scans = decode(numbered(frame, 0), RadarFrame).scans
    assert same(again(scans), scans)
    assert same(again(scans[:, ::2]), scans[:, ::2])


BITS: Any = [np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64]


@pytest.mark.parametrize("bits", BITS)
def test_a_generator_goes_on_with_the_same_numbers_and_the_same_children(bits: Any) -> None:
    seeds = np.random.SeedSequence(3, spawn_key=(7,))
    one = np.random.Generator(bits(seeds))
    held: dict[str, Any] = {
        "one": one,
        "other": np.random.Generator(one.bit_generator),
        "seeds": seeds,
        "draw": one.normal,
    }
    one.normal(size=5)
    one.integers(0, 9, dtype=np.int8)
    one.spawn(2)
    back = again(held)
    draws = []
    for state in (held, back):
        first: Any = state["one"]
        drawn = [first.normal(), state["other"].normal(), state["draw"](), *first.integers(0, 9, 5, np.int8)]
        (child,), (more,) = first.spawn(1), state["seeds"].spawn(1)
        draws.append([*drawn, child.normal(), *more.generate_state(2), state["seeds"].n_children_spawned])
    assert draws[0] == draws[1]


def deep(levels: int) -> Any:
    value: Any = 1.5
    for _ in range(levels):
        value = [value]
    return value


def holding_itself() -> Any:
    point = Point(1.0, [])
    point.y.append(point)
    return point


def with_a_title() -> Any:
    return np.zeros(1, np.dtype({"names": ["a"], "formats": ["f4"], "titles": ["x"]}))


def churned() -> set[int]:
    """A set whose table is larger than that of a new one with its elements, so that these are in another order."""
    numbers = set(range(1000))
    numbers -= set(range(1000)) - {9, 2}
    return numbers if list(numbers) != list({9, 2}) else set()


@pytest.mark.parametrize(
    "value",
    [
        iter([1]), lambda: 1, open, print, msgspec.json.Encoder(), range(3), slice(1), bytearray(b"a"),
        memoryview(b"a"), Metres(1.0), Named(), ValueError("x"), re.compile("a"), operator.itemgetter(1), Mortal,
        (Mortal,)[0](), Rights.READ | Rights.WRITE, np.array([None]), np.array([(1, None)], "i4,O"),
        np.ma.array([1.0, 2.0], mask=[False, True]), np.ma.masked, np.arange(2).view(Table),
        np.zeros(2, "i4,f8").view(np.recarray), np.ma.array([1.0, 2.0])[1:], np.arange(4).view(Table)[1:],
        np.zeros(2, np.dtypes.StringDType()), np.zeros(2, np.dtype("f8", metadata={"a": 1})), with_a_title(),
        np.frombuffer(bytearray(8)), np.bytes_(b"a\0"), np.str_(""), np.zeros(1, "i4,i4")[0], np.mean,
        np.random.RandomState(3), np.random.Generator(np.random.PCG64(np.random.SeedSequence(1, pool_size=1000))),
        {Settings(): 1}, {Metres(2.0)}, {Imu(stamp=1, gyro=(0.0, 0.0, 0.0)): 1}, deep(101), deep(5000),
        holding_itself(), churned(), subprocess.Popen, os.system, sys.modules[__name__], np.vectorize(abs),
        enum.Enum, type,
    ],
)  # fmt: skip
def test_what_cannot_be_kept_is_named(value: Any) -> None:
    if value is Mortal:
        pack(value, __name__)  # a class may be referred to
        return
    with pytest.raises(SnapshotError, match=r"^state\.things\.held"):
        pack(State(things={"held": value}), __name__)


def test_a_hundred_levels_are_kept() -> None:
    assert again(deep(99)) == deep(99)


HERE = __name__
HOSTILE = [
    ["object", 0, "os:_Environ", []],
    ["name", "subprocess:Popen"],
    ["struct", 0, "builtins:nothing", []],
    ["again", 5],
    ["nonsense"],
    ["whole", 1],
    ["name", "builtins:eval"],
    ["name", "builtins:getattr"],
    ["name", "numpy:load"],
    ["array", 0, True, "<f8", [2], None, b"123"],
    # Imported into a module that may be named, but not defined there, whatever it is named as:
    *(
        [tag, *number, name, *rest]
        for name in (
            "caneflow.command:os.system",
            "caneflow.messages.motion:math.sin",
            "caneflow.messages.arrays:struct.pack",
            f"{HERE}:os.system",
            f"{HERE}:subprocess.Popen",
            f"{HERE}:sys.exit",
            f"{HERE}:Imu",
            f"{HERE}:State.__init__",
            "caneflow.runtime.hosts.launcher.launcher:Launcher",
            "caneflow.algorithms.no_such_module:Thing",
        )
        for tag, number, rest in (
            ("name", (), ()),
            ("object", (0,), ([],)),
            ("struct", (0,), (["command", "true"],)),
            ("named tuple", (0,), (["true"],)),
            ("member", (), ("RED",)),
        )
        if not (name.endswith("__init__") and tag == "name")
    ),
    # Classes of another kind than the tag says, or with other contents:
    ["object", 0, f"{HERE}:Metres", []],
    ["object", 0, f"{HERE}:Mortal", []],
    ["object", 0, f"{HERE}:called", []],
    ["object", 0, f"{HERE}:Slotted", ["nowhere", 1]],
    ["object", 0, f"{HERE}:State", [5, 1]],
    ["object", 0, f"{HERE}:State", ["odd"]],
    ["object", 0, "builtins:dict", []],
    ["named tuple", 0, f"{HERE}:Point", [1.0]],
    ["named tuple", 0, f"{HERE}:State", [1.0]],
    ["struct", 0, "caneflow.messages.motion:Imu", ["stamp", 1]],
    ["struct", 0, f"{HERE}:State", []],
    ["member", f"{HERE}:Colour", "GREEN"],
    ["member", f"{HERE}:Colour", "__class__"],
    ["method", ["object", 0, f"{HERE}:Trap", []], "shown"],
    ["method", ["object", 0, f"{HERE}:Trap", []], "__class__"],
    ["method", ["name", f"{HERE}:Trap"], "__call__"],
    ["method", "text", "upper"],
    ["table", 0, "Named", []],
    # What would call something of theirs:
    ["table", 0, "dict", [["object", 0, f"{HERE}:Trap", []], 1]],
    ["set", 0, [["object", 0, f"{HERE}:Trap", []]]],
    ["frozenset", 0, [["named tuple", 0, f"{HERE}:Point", [["object", 0, f"{HERE}:Trap", []], 1]]]],
    ["view", 0, True, ["object", 1, f"{HERE}:Trap", []], "d", 0, [1], [8]],
    ["generator", 0, ["object", 1, f"{HERE}:Trap", []]],
    ["bits", 0, "PCG64", {}, ["object", 1, f"{HERE}:Trap", []]],
    # Memory that is not there, and bytes that would be taken for objects:
    ["array", 0, True, "d", [2**40], None, b""],
    ["array", 0, True, "d", [0, 2**63], None, b""],
    ["array", 0, True, "O", [1], None, b"12345678"],
    ["array", 0, True, "|O", [1], None, b"12345678"],
    ["array", 0, True, ["fields", ["a"], ["O"], [0], 8, False], [1], None, b"12345678"],
    ["array", 0, True, "T", [1], None, b"1234567890123456"],
    ["array", 0, True, "f8,O", [1], None, b"1234567890123456"],
    ["array", 0, True, "d", [1], [5], b"12345678"],
    ["scalar", "O", b"12345678"],
    ["scalar", "d", b"12345678" * 2],
    ["view", 0, True, ["array", 1, True, "d", [1], None, b"12345678"], "O", 0, [1], [8]],
    ["view", 0, True, ["array", 1, True, "d", [1], None, b"12345678"], "d", 8, [1], [8]],
    ["view", 0, True, ["array", 1, True, "d", [1], None, b"12345678"], "d", 0, [2**40], [8]],
    ["view", 0, True, ["array", 1, True, "d", [1], None, b"12345678"], "d", -8, [1], [8]],
    ["deque", 0, 2**63, []],
    # Random generators in states that they cannot be in:
    ["bits", 0, "os", {}, None],
    ["bits", 0, "PCG64", {}, ["seeds", 1, 1, ["tuple", []], 4, 0]],
    ["seeds", 1, 1, ["tuple", []], 2**30, 0],
    ["seeds", 1, -1, ["tuple", []], 4, 0],
]


@pytest.mark.parametrize("hostile", HOSTILE, ids=str)
def test_a_hostile_snapshot_is_refused(hostile: Any) -> None:
    CALLED.clear()
    before = set(sys.modules)
    with pytest.raises(SnapshotError):
        unpack(msgspec.msgpack.encode(hostile), __name__)
    assert CALLED == []
    assert set(sys.modules) == before


@pytest.mark.parametrize(
    ("kind", "key", "position"), [("MT19937", "pos", 625), ("MT19937", "pos", -1), ("Philox", "buffer_pos", 5)]
)
def test_a_generator_never_reads_beyond_its_memory(kind: str, key: str, position: int) -> None:
    good = pack(getattr(np.random, kind)(1), __name__)
    name = msgspec.msgpack.encode(key)
    i = good.index(name) + len(name)
    was = msgspec.msgpack.encode(624 if kind == "MT19937" else 4)
    bad = good[:i] + msgspec.msgpack.encode(position) + good[i + len(was) :]
    assert again(unpack(good, __name__)) is not None
    with pytest.raises(SnapshotError, match=f"a {kind} at {position}"):
        unpack(bad, __name__)


def test_nothing_of_an_object_is_called_when_it_comes_back() -> None:
    trap = [
        "object",
        0,
        f"{HERE}:Trap",
        ["shown", 1, "slot", 2, "__class__", 3, "other", ["method", ["again", 0], "__call__"]],
    ]
    CALLED.clear()
    back = unpack(msgspec.msgpack.encode(trap), __name__)
    assert CALLED == []
    assert (vars(back)["shown"], back.slot, vars(back)["__class__"]) == (1, 2, 3)
    assert type(back) is Trap


def test_a_module_is_not_imported_because_a_snapshot_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    state = pack(GyroBias, __name__)
    assert unpack(state, __name__) is GyroBias
    monkeypatch.delitem(sys.modules, GyroBias.__module__)
    with pytest.raises(SnapshotError, match="not imported"):
        unpack(state, __name__)
    assert GyroBias.__module__ not in sys.modules


def test_a_struct_is_what_it_was_whatever_its_check_makes_of_it() -> None:
    assert again(Doubling(1)).value == 2


class Doubling(msgspec.Struct):
    value: int

    def __post_init__(self) -> None:
        self.value *= 2


whole_state = {
    "objects": [State(), Slotted(), Point(1.0, [2]), Colour.RED, Imu(stamp=1, gyro=(0.0, 0.0, 0.0))],
    "arrays": [CUBE, CUBE[::-1], np.zeros(2, PADDED)],
    "random": np.random.default_rng(3),
    "plain": {"a": 1, 2: {3, 4}, None: deque([1], maxlen=3)},
}


@given(st.data())
def test_a_damaged_snapshot_is_taken_or_refused_never_worse(data: st.DataObject) -> None:
    damaged = bytearray(pack(whole_state, __name__))
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, 2 * len(damaged)))
    with suppress(SnapshotError):
        unpack(bytes(damaged[:cut]), __name__)


@pytest.mark.parametrize("data", [b"\xc1", b"", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\x91" * 100_000])
def test_bytes_that_are_no_snapshot_are_refused(data: bytes) -> None:
    with pytest.raises(SnapshotError, match="does not fit"):
        unpack(data, __name__)


def test_a_number_without_end_comes_back() -> None:
    assert again(-(7**9000)) == -(7**9000)  # of more digits than Python writes
