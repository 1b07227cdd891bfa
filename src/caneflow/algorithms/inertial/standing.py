"""Whether the bearer stands still, by gyro and accelerometer over the last moment.

A standing hand drifts and trembles (some 0.1 m/s^2, a few deg/s); a walking one bobs: 12 mm at 1.1 steps per second is
0.6 m/s^2, whether the cane swings or not. A shaft at the height of its turn stands still for a tenth of a second only.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from caneflow.algorithms.quantities import Acceleration, Time, TurnRate
from caneflow.algorithms.rotations import Vector

_ONE: Final = 2**32  # rad/s and m/s^2 are counted in steps of 1 / _ONE


@dataclass(frozen=True, kw_only=True)
class StandingSettings:
    """What counts as standing still."""

    window: Time = 0.6  # s
    largest_turn_rate: TurnRate = math.radians(5.0)  # rad/s, mean norm: bias, drift and tremor
    largest_acceleration: Acceleration = 0.12  # m/s^2, sd about its mean, on the worst axis


class StandingDetector:
    """Sums over a sliding window, in whole numbers: what has left the window has left no rounding behind."""

    def __init__(self, settings: StandingSettings) -> None:
        self._settings = settings
        self._samples: deque[tuple[int, int, int, int, int]] = deque()
        self._sums = (0,) * 7  # of turn rate, accelerations, and their squares

    def update(self, stamp_ns: int, gyro: Vector, acceleration: Vector) -> bool:
        """Take a sample: turn rate (rad/s) and acceleration in R0 without gravity (m/s^2)."""
        turning = math.sqrt(gyro[0] ** 2 + gyro[1] ** 2 + gyro[2] ** 2)
        x, y, z = acceleration
        sample = stamp_ns, int(turning * _ONE), int(x * _ONE), int(y * _ONE), int(z * _ONE)
        self._samples.append(sample)
        self._add(sample, 1)
        window_ns = round(self._settings.window * 1e9)
        full = False
        while self._samples[0][0] <= stamp_ns - window_ns:
            self._add(self._samples.popleft(), -1)
            full = True
        return full and self._is_still()

    def _is_still(self) -> bool:
        count = len(self._samples)
        if count < 4:  # a gap
            return False
        if self._sums[0] / (count * _ONE) > self._settings.largest_turn_rate:
            return False
        limit = (self._settings.largest_acceleration * count * _ONE) ** 2
        sums = self._sums
        return all(count * sums[axis + 3] - sums[axis] ** 2 <= limit for axis in (1, 2, 3))

    def _add(self, sample: tuple[int, int, int, int, int], sign: int) -> None:
        _, turning, x, y, z = sample
        turned, sx, sy, sz, sxx, syy, szz = self._sums
        dx, dy, dz = sign * x, sign * y, sign * z
        self._sums = (
            turned + sign * turning, sx + dx, sy + dy, sz + dz, sxx + dx * x, syy + dy * y, szz + dz * z,
        )  # fmt: skip
