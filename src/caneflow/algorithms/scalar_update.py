"""The Kalman filter's update by one scalar measurement: written out for three states, and with numpy for any number.

A measurement z = h . x + noise of the variance R. All of it that the filter needs is `across`, P h', and `spread`,
h P h' + R, the variance of what z differs by from what was expected: K = P h' / (h P h' + R), and P - K (P h')'. Who
wants an outlier to count for less gives a larger spread. The states are the caller's: x + K (z - h . x).

Not here: one state, where gain and variance are one line each (magnetic_heading.py, ground_velocity.py); three
measurements at once (zero_velocity.py); a covariance that keeps what the sign of a residual leaves open (room_ekf.py).
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.rotations import Vector

Covariance: TypeAlias = tuple[float, float, float, float, float, float]  # xx, xy, xz, yy, yz, zz; symmetric by shape


def updated(covariance: Covariance, across: Vector, spread: float) -> tuple[Vector, Covariance]:
    """Gains on three states, and their covariance after it; numpy's calls would cost more than these sums."""
    xx, xy, xz, yy, yz, zz = covariance
    x, y, z = across
    gain_x, gain_y, gain_z = x / spread, y / spread, z / spread
    return (gain_x, gain_y, gain_z), (
        xx - gain_x * x,
        xy - gain_x * y,
        xz - gain_x * z,
        yy - gain_y * y,
        yz - gain_y * z,
        zz - gain_z * z,
    )


def update(covariance: NDArray[np.float64], across: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """Gains (n,) on any number of states; their `covariance` (n, n) is changed in place."""
    gain: NDArray[np.float64] = across / spread
    covariance -= gain[:, None] * across
    return gain
