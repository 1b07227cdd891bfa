"""The superior edge of a Doppler spectrum: where it falls off towards higher speed (paper IV.B, cane.md row 6)."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

# The fall of one line's magnitude is steepest 0.94 of a resolution cell (1 / window length) beyond it, by the Hann
# window's spectrum sinc(x) / (1 - x^2). Ground lies at many azimuths: their lines crowd below the fastest one and
# pull the steepest fall of the expected spectrum back to 0.86..0.77 cell for fastest lines at 3..12 cells, seen
# through a Gaussian beam of 50 deg. tests/test_edges.py works both out.
EDGE_BEYOND_SPEED = 0.8  # resolution cells


def superior_edges(magnitudes: NDArray[np.floating]) -> tuple[list[float], list[float]]:
    """Where each row falls off most steeply, and by how much.

    Args:
        magnitudes: shape (K, F), rows of magnitude over growing Doppler, F at least 4.

    Returns:
        K fractional column indices: the vertex of the parabola through the greatest difference between neighbours
        and the two beside it; and K such differences. A flat row gives some index, and 0: whether there is anything
        to see is not decided here.
    """
    # In one piece over all rows: where one ends and the next begins stands nonsense, and is not looked at.
    falls, flat = np.empty(magnitudes.shape, magnitudes.dtype), magnitudes.reshape(-1)
    np.subtract(flat[:-1], flat[1:], out=falls.reshape(-1)[:-1])
    steepest = falls[:, 1:-2].argmax(axis=1)  # counted from column 1: with a neighbour on either side
    before, top, after = falls.take(steepest + _around(*falls.shape)).tolist()
    edges = []
    # Plain Python from here on: for a handful of numbers, numpy's calls cost more.
    for column, left, middle, right in zip(steepest.tolist(), before, top, after, strict=True):
        rise, drop = middle - left, middle - right
        if rise < 0.0 or drop < 0.0:  # a neighbour at the rim falls still steeper
            shift = -0.5 if rise < drop else 0.5
        else:
            shift = 0.5 * (rise - drop) / (rise + drop) if rise + drop > 0.0 else 0.0
        edges.append(column + 1.5 + shift)  # the difference between columns i and i + 1 belongs half way between them
    return edges, top


@cache
def _around(rows: int, columns: int) -> NDArray[np.intp]:
    """What to add to a column index of each of K rows for it and its neighbours in the flat array; shape (3, K)."""
    return np.arange(0, rows * columns, columns) + np.arange(3)[:, None]
