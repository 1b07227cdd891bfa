"""How far away the floor still answers to a range sensor, learned from the floor that it sees."""

import math

import numpy as np
from numpy.typing import NDArray

QUANTILE = 0.9  # of the ranges to the floor in one reading
RISE_TIME, FALL_TIME = 0.3, 16.0  # s: a floor that answers is believed at once; at a stair none answers for a while
FARTHEST = 3.5  # m
FEWEST = 3  # zones on the floor, of which a quantile says something


class FloorReach:
    """The distance along a ray, m, within which no answer means no floor; 0 until a floor was seen."""

    def __init__(self) -> None:
        self.reach = 0.0
        self._last_ns: int | None = None

    def update(self, stamp_ns: int, floor_ranges: NDArray[np.float64]) -> None:
        """Take the ranges (m) of the zones that saw the floor in one reading."""
        elapsed = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        if len(floor_ranges) < FEWEST:
            return
        seen = float(np.sort(floor_ranges)[math.floor(QUANTILE * (len(floor_ranges) - 1))])
        time = RISE_TIME if seen > self.reach else FALL_TIME
        self.reach = min(self.reach + (seen - self.reach) * -math.expm1(-elapsed / time), FARTHEST)
