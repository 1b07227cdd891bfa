"""Doppler bins of a radar, told from the values that it gave: whole steps, and a power of two of them."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

_LEAST = 1e-4  # m/s, below which a Doppler is 0


class DopplerBins(NamedTuple):
    """What is told."""

    step: float  # m/s
    limit: float  # m/s, unambiguous to either side


def doppler_bins(speeds: ArrayLike) -> DopplerBins | None:
    """The bins in which `speeds` (m/s, of many points) lie; None when nothing moved.

    The step is the least that occurs, refined by all; the limit the least power of two of steps that none exceeds, so
    that both are too large where the slow or the fast bins never occur.
    """
    moving = np.abs(np.asarray(speeds, np.float64).ravel())
    moving = moving[np.isfinite(moving) & (moving > _LEAST)]
    if not len(moving):
        return None
    least = float(moving.min())
    step = float(np.median(moving / np.rint(moving / least)))
    return DopplerBins(step, step * 2.0 ** max(math.ceil(math.log2(float(moving.max()) / step - 1e-3)), 2))
