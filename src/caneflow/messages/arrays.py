"""numpy arrays on the wire: msgpack ext type 1, as docs/messages.md lays it out.

byte 0 dtype letter, byte 1 number of dimensions d (1..4), d x uint32 little-endian sizes, then the elements,
little-endian, C order.
"""

import math
import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.messages.errors import MessageError

Array: TypeAlias = NDArray[Any]

EXT_TYPE = 1
MAX_DIMENSIONS = 4
LITTLE_ENDIAN = {
    letter: np.dtype(code)
    for letter, code in {
        "B": "u1",
        "h": "<i2",
        "i": "<i4",
        "q": "<i8",
        "f": "<f4",
        "d": "<f8",
        "F": "<c8",
        "D": "<c16",
    }.items()
}
# numpy has two letters for one width (l and q on Linux), so the wire's letter is looked up by kind and size.
LETTERS = {(dtype.kind, dtype.itemsize): letter for letter, dtype in LITTLE_ENDIAN.items()}


def to_bytes(array: Array) -> bytes:
    """The ext type's data for `array`; raises MessageError for a dtype or rank that the wire lacks."""
    letter = LETTERS.get((array.dtype.kind, array.dtype.itemsize))
    if letter is None:
        raise MessageError(
            f"array of dtype {array.dtype}; the wire knows {', '.join(map(str, LITTLE_ENDIAN.values()))}"
        )
    if not 1 <= array.ndim <= MAX_DIMENSIONS:
        raise MessageError(f"array of {array.ndim} dimensions; the wire knows 1..{MAX_DIMENSIONS}")
    head = struct.pack(f"<cB{array.ndim}I", letter.encode(), array.ndim, *array.shape)
    return head + array.astype(LITTLE_ENDIAN[letter], order="C", copy=False).tobytes()


def from_bytes(data: memoryview) -> Array:
    """The read-only array in an ext type's data, without a copy; raises MessageError when sizes disagree."""
    if len(data) < 2:
        raise MessageError(f"array of {len(data)} bytes; its dtype and dimensions alone take 2")
    letter, dimensions = chr(data[0]), data[1]
    dtype = LITTLE_ENDIAN.get(letter)
    if dtype is None:
        raise MessageError(f"array of dtype {letter!r}; the wire knows {', '.join(LITTLE_ENDIAN)}")
    if not 1 <= dimensions <= MAX_DIMENSIONS:
        raise MessageError(f"array of {dimensions} dimensions; the wire knows 1..{MAX_DIMENSIONS}")
    offset = 2 + 4 * dimensions
    if len(data) < offset:
        raise MessageError(f"array of {len(data)} bytes; {dimensions} sizes end at byte {offset}")
    shape = struct.unpack_from(f"<{dimensions}I", data, 2)
    expected = math.prod(shape) * dtype.itemsize
    if len(data) - offset != expected:
        raise MessageError(f"array of shape {shape} and dtype {dtype} has {len(data) - offset} bytes, not {expected}")
    try:
        return np.ndarray(shape, dtype, data, offset)
    except ValueError as error:  # no elements, but a size that no address has
        raise MessageError(f"array of shape {shape}: {error}") from error
