"""Yaw by the gyro alone, beside a chip whose tilt is good and whose yaw is pulled by the magnetic field.

The chip's orientation is kept but for a turn about the vertical: what the gyro turned more than the chip's orientation
did. Two level components of that difference must average to nothing, because gravity holds the chip's tilt: what is
left of them is the gyro's bias.
"""

import math
from typing import Final

from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, multiply, rotate

_TILT_ERROR: Final = math.radians(0.26) * math.sqrt(2.0)  # rad, between start and end (cane.md)
_SCALE_ACROSS: Final = math.radians(0.01)  # rad/s, sd of what scale errors leave about the level axis across,
_SCALE_ALONG: Final = math.radians(0.04)  # and along: there two axes with different scales share every turn


_RATE_TIME: Final = 0.3  # s over which the rate is averaged at which the chip's yaw is pulled
_APART: Final = math.radians(120.0)  # rad/s, between gyro and chip, from which on one of them is wild


class GyroYaw:
    """What the gyro turned more than the chip says; its state is the last sample and three sums."""

    def __init__(self) -> None:
        self._orientation: Quaternion | None = None
        self._gyro: Vector = (0.0, 0.0, 0.0)
        self._elapsed = 0.0
        self._begins = True  # no two samples have agreed since the start or a gap
        self._across = self._along = 0.0  # rad
        self._rate = 0.0  # rad/s, of the offset
        self.offset = 0.0  # rad, gyro's yaw less the chip's

    def update(self, interval: float, orientation: Quaternion, gyro: Vector, cos_yaw: float, sin_yaw: float) -> None:
        """Take a sample `interval` s after the last one; (cos, sin) of the boresight's yaw by the chip.

        With an interval of 0 nothing is compared: at the start, and after a gap, over which the chip's yaw holds.
        Nor is it as long as gyro and chip contradict each other there: a wild first sample would turn all that follows.
        """
        if self._orientation is None or interval <= 0.0:
            self._begins = True
        else:
            turned = _rotation_vector(multiply(conjugate(self._orientation), orientation))
            half = 0.5 * interval
            x, y, z = rotate(
                orientation,
                (
                    half * (gyro[0] + self._gyro[0]) - turned[0],
                    half * (gyro[1] + self._gyro[1]) - turned[1],
                    half * (gyro[2] + self._gyro[2]) - turned[2],
                ),
            )
            if not self._begins or max(abs(x), abs(y), abs(z)) <= _APART * interval:
                self._begins = False
                self.offset += z
                self._rate += min(interval / _RATE_TIME, 1.0) * (z / interval - self._rate)
                self._along += cos_yaw * x + sin_yaw * y
                self._across += cos_yaw * y - sin_yaw * x
                self._elapsed += interval
        self._orientation, self._gyro = orientation, gyro

    def bridge(self, elapsed: float) -> None:
        """Go on by `elapsed` s without a sample: the chip turns with the cane, and is pulled as it was before."""
        self.offset += self._rate * elapsed

    def level_biases(self) -> tuple[float, float, float, float] | None:
        """Bias across the boresight, its sd, along it, its sd, rad/s; None in the first second."""
        if self._elapsed < 1.0:
            return None
        tilt = _TILT_ERROR / self._elapsed
        return self._across / self._elapsed, tilt + _SCALE_ACROSS, self._along / self._elapsed, tilt + _SCALE_ALONG


def _rotation_vector(rotation: Quaternion) -> Vector:
    """The vector of a small rotation, rad; inverse of the exponential map."""
    w, x, y, z = rotation
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return scale * x, scale * y, scale * z
