"""Systematic resampling: which particles live on, and how often.

One random number places a comb of N equally spaced teeth over the cumulated weights. A particle of weight w gets
floor(N w) or ceil(N w) copies, N w on average; no other scheme with one draw spreads less (R. Douc, O. Cappe,
E. Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005).
"""

import numpy as np
from numpy.typing import NDArray


def systematic(weights: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.intp]:
    """Indices, shape (N,), increasing, of the particles to copy; `weights`, shape (N,), are not negative."""
    count = len(weights)
    cumulated = np.cumsum(weights)
    # how many teeth (i + r) / N lie below each cumulated weight; the last is N whatever the rounding
    below = np.ceil(cumulated * (count / cumulated[-1]) - random.random()).astype(np.intp).clip(0, count)
    below[-1] = count
    return np.repeat(np.arange(count), np.diff(below, prepend=0))


def effective_number(weights: NDArray[np.float64]) -> float:
    """How many equally weighted particles would say as much: 1 / sum of squares, 1..N."""
    return 1.0 / float(np.dot(weights, weights))
