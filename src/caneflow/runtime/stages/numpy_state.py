"""numpy's types, scalars, arrays and random generators as plain data, and back: exact to the last bit, or refused."""

import math
import re
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.runtime.stages.references import SnapshotError

Anything: TypeAlias = NDArray[Any]

NATIVE = {id(np.dtype(letter)): letter for letter in "?bBhHiIlLqQefdgFDG"}  # numpy has one object for each of them
SIMPLE = re.compile(r"[<>|][biufcmMSUV][0-9]{1,9}(\[[^\]]{1,20}\])?")  # as `dtype.str` spells the others
CHECKED_KINDS = "SUV"  # of scalars that may lose their end, or share memory with an array
BIT_GENERATORS = {
    kind.__name__: kind
    for kind in (np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64)
}
LARGEST_POSITION = {"MT19937": ("state", "pos", 624), "Philox": ("buffer_pos", 4)}  # numpy does not check them
LARGEST_POOL = 64  # words of a SeedSequence, whose work grows with their square


def dtype_to_data(dtype: "np.dtype[Any]", path: str) -> Any:
    """`dtype` as a string, or as lists when it has fields."""
    native = NATIVE.get(id(dtype))
    if native is not None:
        return native
    data = _dtype_to_data(dtype)
    try:
        exact = dtype.metadata is None and _same_dtype(dtype_from_data(data), dtype)
    except (SnapshotError, TypeError, ValueError):
        exact = False
    if not exact:
        raise SnapshotError(f"{path} has the dtype {dtype}; it cannot be kept exactly")
    return data


def _dtype_to_data(dtype: "np.dtype[Any]") -> Any:
    if dtype.subdtype is not None:
        return ["sub", _dtype_to_data(dtype.subdtype[0]), list(dtype.subdtype[1])]
    if dtype.names is None or dtype.fields is None:
        return dtype.str
    fields = [dtype.fields[name] for name in dtype.names]
    formats, offsets = [_dtype_to_data(field[0]) for field in fields], [field[1] for field in fields]
    return ["fields", list(dtype.names), formats, offsets, dtype.itemsize, dtype.isalignedstruct]


def dtype_from_data(data: Any) -> "np.dtype[Any]":
    """The dtype; raises SnapshotError for one whose elements are not plain data."""
    if isinstance(data, str):
        if data not in NATIVE.values() and not SIMPLE.fullmatch(data):
            raise SnapshotError(f"it names the dtype {data!r}; only plain ones are taken")
        return np.dtype(data)
    tag, *about = data
    if tag == "sub":
        base, shape = about
        return np.dtype((dtype_from_data(base), tuple(shape)))
    names, formats, offsets, size, aligned = about
    formats = [dtype_from_data(each) for each in formats]
    parts: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    made: np.dtype[Any] = np.dtype(parts, align=aligned)
    return made


def _same_dtype(made: "np.dtype[Any]", dtype: "np.dtype[Any]") -> bool:
    return made == dtype and made.isalignedstruct == dtype.isalignedstruct and made.type is dtype.type


def scalar_to_data(value: Any, path: str) -> list[Any]:
    """The dtype and the bytes of a numpy scalar."""
    data = [dtype_to_data(value.dtype, path), value.tobytes()]
    if value.dtype.kind in CHECKED_KINDS:
        exact = value.dtype.names is None and value.dtype.itemsize > 0 and scalar_from_data(*data) == value
    else:
        exact = True
    if not exact or type(value) is not value.dtype.type:
        raise SnapshotError(f"{path} is a {type(value).__name__} that cannot be kept exactly")
    return data


def scalar_from_data(dtype: Any, data: bytes) -> Any:
    """The numpy scalar."""
    (value,) = np.frombuffer(data, dtype_from_data(dtype))
    return value


def array_to_data(array: Anything, path: str) -> list[Any]:
    """The dtype, shape, order of the axes in memory, and elements of an array that is not a view of another one."""
    if type(array) is not np.ndarray:
        raise SnapshotError(f"{path} is a {type(array).__name__}; of arrays only plain ones can be kept")
    dtype = array.dtype
    if dtype.hasobject or dtype.itemsize == 0:
        raise SnapshotError(f"{path} is an array of {dtype}; its elements are not plain data")
    if not (array.flags.owndata or _is_constant(array.base)):
        raise SnapshotError(f"{path} is an array over memory of a {type(array.base).__name__}; it cannot be kept")
    axes = None if array.flags.c_contiguous else _axes(array)
    if axes is not None and not array.transpose(axes).flags.c_contiguous:
        raise SnapshotError(f"{path} is an array with gaps between its elements; it cannot be kept")
    return [dtype_to_data(dtype, path), list(array.shape), axes, array.transpose(axes or range(array.ndim)).tobytes()]


def array_from_data(dtype: Any, shape: list[int], axes: list[int] | None, data: bytes) -> Anything:
    """The array, which owns its memory; what a header claims takes no memory without its elements."""
    kind = dtype_from_data(dtype)
    flat: Anything = np.frombuffer(data, kind)
    if axes is None:
        made = flat.reshape(shape).copy()
    else:
        in_memory = flat.reshape([shape[axis] for axis in axes])
        made = in_memory.transpose([axes.index(axis) for axis in range(len(axes))]).copy(order="K")
    if kind.names is not None:  # of those numpy has copied the fields, not what is between them
        _memory_of(made)[:] = np.frombuffer(data, np.uint8)
    return made


def view_to_data(view: Anything, whole: Anything, path: str) -> list[Any]:
    """Where in the memory of `whole` the elements of `view` are."""
    if type(view) is not np.ndarray:
        raise SnapshotError(f"{path} is a {type(view).__name__}; of arrays only plain ones can be kept")
    offset = view.__array_interface__["data"][0] - whole.__array_interface__["data"][0]
    if view.size == 0 or whole.size == 0:  # it has no place
        offset = 0
    return [dtype_to_data(view.dtype, path), offset, list(view.shape), list(view.strides)]


def view_from_data(whole: Anything, dtype: Any, offset: int, shape: list[int], strides: list[int]) -> Anything:
    """A view of `whole` that shares its memory."""
    _require(whole, np.ndarray)
    memory = _memory_of(whole)
    if math.prod(shape) == 0:
        return np.ndarray(tuple(shape), dtype_from_data(dtype), memory)
    return np.ndarray(tuple(shape), dtype_from_data(dtype), memory, offset, tuple(strides))


def whole_of(view: Anything) -> Anything:
    """The array whose memory `view` shares."""
    while isinstance(view.base, np.ndarray):
        view = view.base
    return view


def _axes(array: Anything) -> list[int]:
    """The axes of `array`, from the one with the widest steps in memory."""
    return sorted(range(array.ndim), key=lambda axis: (array.shape[axis] == 1, -array.strides[axis]))


def _memory_of(array: Anything) -> Anything:
    """The bytes of an array without gaps, as they are in memory; they are the array's own."""
    return array.transpose(_axes(array)).reshape(-1).view(np.uint8)


def _is_constant(memory: object) -> bool:
    """Whether nobody can change `memory`, so that a copy of it is as good: that of a message."""
    return isinstance(memory, bytes) or (
        isinstance(memory, memoryview) and memory.readonly and isinstance(memory.obj, bytes)
    )


def seeds_from_data(entropy: Any, spawn_key: tuple[int, ...], pool_size: int, spawned: int) -> np.random.SeedSequence:
    """The seeds that a generator was made from, which know how many children they have had."""
    if pool_size > LARGEST_POOL:
        raise SnapshotError(f"it holds a SeedSequence with a pool of {pool_size} words; {LARGEST_POOL} is the most")
    return np.random.SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=spawned)


def bits_from_data(name: str, state: Any, seeds: Any) -> np.random.BitGenerator:
    """A bit generator in its state; raises SnapshotError for a state that it cannot be in."""
    _require(seeds, np.random.SeedSequence)
    bits = BIT_GENERATORS[name](seeds)
    if name in LARGEST_POSITION:
        *keys, largest = LARGEST_POSITION[name]
        position = state
        for key in keys:
            position = position[key]
        if not 0 <= position <= largest:
            raise SnapshotError(f"it holds a {name} at {position}; 0 to {largest} is possible")
    bits.state = state
    return bits


def generator_from_data(bits: Any) -> np.random.Generator:
    """The generator that draws from `bits`."""
    if type(bits) not in BIT_GENERATORS.values():
        raise SnapshotError(f"it holds a Generator of a {type(bits).__name__}")
    return np.random.Generator(bits)


def _require(value: object, kind: type) -> None:
    """Raise SnapshotError for anything but a `kind`: of something else nothing is called."""
    if type(value) is not kind:
        raise SnapshotError(f"it holds a {type(value).__name__} where a {kind.__name__} is expected")
