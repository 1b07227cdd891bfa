"""How a chip's axes lie in the body: which of them, with sign, are the body's x, y and z."""

import re
from typing import NamedTuple, TypeAlias

from caneflow.protocols.errors import ProtocolError

Vector: TypeAlias = tuple[float, float, float]

_AXES = re.compile(r"([+-])([xyz])([+-])([xyz])([+-])([xyz])")


class Mounting(NamedTuple):
    """A rotation by quarter turns."""

    axes: tuple[int, int, int]  # the chip's axis that is the body's x, y, z; 0 is x
    signs: tuple[int, int, int]  # 1 or -1

    def turned(self, vector: Vector) -> Vector:
        """What `vector`, in the chip's axes, is in the body's."""
        (i, j, k), (x, y, z) = self.axes, self.signs
        return x * vector[i], y * vector[j], z * vector[k]


def mounting(text: str) -> Mounting:
    """The mounting that `text` describes: which of the chip's axes are the body's x, y and z, e.g. "-y+x+z".

    Raises:
        ProtocolError: no such triple, or a left-handed one.
    """
    found = _AXES.fullmatch(text)
    if found is None or {found[2], found[4], found[6]} != set("xyz"):
        raise ProtocolError(f"{text!r}: the chip's axis for the body's x, y, z, each once, with sign, e.g. +x+y+z")
    x, y, z = ("xyz".index(found[i]) for i in (2, 4, 6))
    signs = (_sign(found[1]), _sign(found[3]), _sign(found[5]))
    swaps = (x > y) + (x > z) + (y > z)
    if (signs.count(-1) + swaps) % 2:
        raise ProtocolError(f"{text!r}: is a left-handed system, which no way of mounting makes; turn one sign round")
    return Mounting((x, y, z), signs)


def _sign(text: str) -> int:
    return -1 if text == "-" else 1
