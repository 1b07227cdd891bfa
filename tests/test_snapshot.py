"""Snapshots: state comes back exact, shared memory stays shared, and nothing foreign is taken."""

import enum
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.messages import Imu
from caneflow.runtime.stages.snapshot import SnapshotError, pack, unpack


class Colour(enum.Enum):
    RED = 1


class Point(NamedTuple):
    x: float
    y: float


@dataclass(frozen=True)
class Settings:
    gain: float = 0.5


class Slotted:
    __slots__ = ("left", "right")

    def __init__(self) -> None:
        self.left, self.right = 1, [2]


@dataclass
class State:
    settings: Settings = field(default_factory=Settings)
    things: dict[Any, Any] = field(default_factory=dict)


def again(state: object) -> Any:
    return unpack(pack(state, __name__), __name__)


def same(a: Any, b: Any) -> bool:
    """Equal in type and every bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return bool(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes())
    if isinstance(a, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    if isinstance(a, (list, tuple, deque)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return bool(a == b)


@pytest.mark.parametrize(
    "value",
    [
        None, True, 0, 1 - 2j, -(2**63), 2**200, 0.1, math.inf, -0.0, "text", b"bytes", (1, (2.0, "x")), [1, [2]],
        {"a": 1, 3: (4,)}, {1, 2}, frozenset("ab"), deque([1, 2], maxlen=2), Point(1.0, 2.0), Colour.RED,
        Settings(0.25), np.float32(0.1), np.arange(6, dtype=np.int16).reshape(2, 3), np.zeros((0, 3)), np.array(5.0),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.array([1 + 2j], np.complex64), np.dtype("<f4"),
        Imu(stamp=1, seq=4, gyro=(0.1, 0.2, 0.3)), float, math.sin,
    ],
)  # fmt: skip
def test_values_come_back_exact(value: Any) -> None:
    assert same(again(value), value)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(plain)
def test_any_plain_data_comes_back_exact(value: Any) -> None:
    assert same(again(value), value)


def test_objects_come_back_with_what_they_hold() -> None:
    state = State(things={"slots": Slotted(), "loop": None})
    state.things["loop"] = state
    back = again(state)
    assert isinstance(back, State)
    assert back.settings == Settings()
    assert back.things["slots"].right == [2]
    assert back.things["loop"] is back, "what is referred to twice is one object"


def test_arrays_that_share_memory_share_it_again() -> None:
    buffer = np.arange(12.0).reshape(3, 4)
    back = again({"buffer": buffer, "window": buffer[1:, ::2], "same": buffer})
    assert back["same"] is back["buffer"]
    np.testing.assert_array_equal(back["window"], buffer[1:, ::2])
    back["buffer"][1, 0] = -1.0
    assert back["window"][0, 0] == -1.0


def test_a_window_that_comes_before_its_buffer_shares_it_too() -> None:
    buffer = np.zeros(4)
    back = again([buffer[2:], buffer])
    back[1][3] = 7.0
    assert back[0][1] == 7.0


def test_an_array_over_a_samples_bytes_keeps_its_elements() -> None:
    back = again(np.frombuffer(b"\x01\x02\x03\x04", np.uint8)[1:3])
    assert back.tolist() == [2, 3]


def test_a_generator_goes_on_with_the_same_numbers() -> None:
    generator = np.random.default_rng(3)
    generator.normal(size=5)
    back = again(generator)
    assert back.normal(size=9).tolist() == generator.normal(size=9).tolist()


@pytest.mark.parametrize("value", [iter([1]), lambda: 1, open, msgspec.json.Encoder(), np.array([None])])
def test_what_cannot_be_kept_is_named(value: Any) -> None:
    with pytest.raises(SnapshotError, match=r"^state\.things\.held is "):
        pack(State(things={"held": value}), __name__)


@pytest.mark.parametrize(
    "hostile",
    [
        ["object", 0, "os:_Environ", []],
        ["name", "subprocess:Popen"],
        ["struct", 0, "builtins:nothing", []],
        ["again", 5],
        ["nonsense"],
        ["name", "builtins:eval"],
        ["array", 0, "<f8", [2], "C", b"123"],
    ],
)
def test_a_hostile_snapshot_is_refused(hostile: Any) -> None:
    with pytest.raises(SnapshotError):
        unpack(msgspec.msgpack.encode(hostile), __name__)


def test_bytes_that_are_no_snapshot_are_refused() -> None:
    with pytest.raises(SnapshotError, match="does not fit"):
        unpack(b"\xc1", __name__)
