"""The superior edge of a Doppler spectrum: where it falls off towards higher speed (paper IV.B, cane.md row 6)."""

import numpy as np
from numpy.typing import NDArray

# The fall of one line's magnitude is steepest 0.94 of a resolution cell (1 / window length) beyond it, by the Hann
# window's spectrum sinc(x) / (1 - x^2). Ground lies at many azimuths: their lines crowd below the fastest one and
# pull the steepest fall of the expected spectrum back to 0.86..0.77 cell for fastest lines at 3..12 cells, seen
# through a Gaussian beam of 50 deg. tests/test_edges.py works both out.
EDGE_BEYOND_SPEED = 0.8  # resolution cells
FLAT = np.float32(1e-30)
AROUND = np.arange(3)[:, None]  # a column and its two neighbours


def superior_edges(
    magnitudes: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.floating]]:
    """Where each row falls off most steeply, and by how much.

    Args:
        magnitudes: shape (K, F), rows of magnitude over growing Doppler, F at least 4.

    Returns:
        Fractional column indices, shape (K,): the vertex of the parabola through the greatest difference between
        neighbours and the two beside it; and those differences, shape (K,). A flat row gives some index, and 0:
        whether there is anything to see is not decided here.
    """
    falls = magnitudes[:, :-1] - magnitudes[:, 1:]
    steepest = falls[:, 1:-1].argmax(axis=1)  # counted from column 1: with a neighbour on either side
    left = steepest + np.arange(0, falls.size, falls.shape[1])
    before, top, after = falls.take(left + AROUND)
    rise, drop = top - before, top - after
    # FLAT keeps a flat row from dividing by 0; the clip holds where a neighbour at the rim falls still steeper.
    shift = np.minimum(np.maximum((rise - drop) / np.maximum(rise + drop, FLAT), -1), 1)
    # The difference between columns i and i + 1 belongs half way between them.
    return steepest + (1.5 + 0.5 * shift), top
