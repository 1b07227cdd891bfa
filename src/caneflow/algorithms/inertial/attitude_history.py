"""How the cane was held a moment ago: attitudes and turn rates of the recent past, asked for by stamp."""

import math
from bisect import bisect_left, bisect_right
from typing import Final

from caneflow.algorithms.rotations import Quaternion, Vector, from_rotation_vector, multiply, normalized

LONGEST_STEP_NS: Final = 100_000_000  # ns between samples over which an attitude may be interpolated
# ns past the newest sample, over which the gyro tells how it went on. A hand turns the cane with up to 20 rad/s^2: half
# a degree in that time.
LONGEST_AHEAD_NS: Final = 30_000_000


class AttitudeHistory:
    """The newest samples of an IMU; memory is bounded by `samples`."""

    def __init__(self, samples: int = 2048) -> None:
        self._samples = samples
        self._stamps: list[int] = []  # ns
        self._orientations: list[Quaternion] = []
        self._gyro: Vector = (0.0, 0.0, 0.0)  # rad/s, of the newest
        self._turned: list[float] = []  # rad, path length of the rotation since the first sample

    def add(self, stamp_ns: int, orientation: Quaternion, gyro: Vector) -> None:
        """Append a sample: body-to-world `orientation`, `gyro` in rad/s.

        Raises:
            ValueError: a stamp that is not newer than the last.
        """
        turned = 0.0
        if self._stamps:
            elapsed_ns = stamp_ns - self._stamps[-1]
            if elapsed_ns <= 0:
                raise ValueError(f"attitude at {stamp_ns} ns is not newer than the last, {self._stamps[-1]} ns")
            turned = self._turned[-1] + math.hypot(*gyro) * elapsed_ns * 1e-9
        self._gyro = gyro
        self._stamps.append(stamp_ns)
        self._orientations.append(orientation)
        self._turned.append(turned)
        if len(self._stamps) >= 2 * self._samples:
            # In one go now and then: deleting the head of a list moves all the rest.
            for column in (self._stamps, self._orientations, self._turned):
                del column[: -self._samples]

    def at(self, stamp_ns: int) -> Quaternion | None:
        """The attitude at `stamp_ns`, between its neighbours; None where there are none close enough."""
        after = bisect_left(self._stamps, stamp_ns)
        if after == len(self._stamps):
            return None
        newer_ns, newer = self._stamps[after], self._orientations[after]
        if newer_ns == stamp_ns:
            return newer
        if after == 0 or newer_ns - self._stamps[after - 1] > LONGEST_STEP_NS:
            return None
        older_ns, older = self._stamps[after - 1], self._orientations[after - 1]
        return _between(older, newer, (stamp_ns - older_ns) / (newer_ns - older_ns))

    def near(self, stamp_ns: int) -> Quaternion | None:
        """As `at`, and for a short while past the newest sample the attitude to which its turn rate leads."""
        if not self._stamps or stamp_ns <= self._stamps[-1]:
            return self.at(stamp_ns)
        ahead_ns = stamp_ns - self._stamps[-1]
        if ahead_ns > LONGEST_AHEAD_NS:
            return None
        x, y, z = self._gyro
        ahead = ahead_ns * 1e-9
        return normalized(multiply(self._orientations[-1], from_rotation_vector((x * ahead, y * ahead, z * ahead))))

    def mean_turn_rate(self, start_ns: int, end_ns: int) -> float | None:
        """Mean norm of the turn rate (rad/s) of the samples in `start_ns`..`end_ns`; None if there are not two."""
        first, last = bisect_left(self._stamps, start_ns), bisect_right(self._stamps, end_ns) - 1
        if last <= first:
            return None
        elapsed = (self._stamps[last] - self._stamps[first]) * 1e-9
        return (self._turned[last] - self._turned[first]) / elapsed


def _between(older: Quaternion, newer: Quaternion, share: float) -> Quaternion:
    """The way from `older` to `newer`, along the shorter arc, gone to `share`: linear, then normalised."""
    (a, b, c, d), (w, x, y, z) = older, newer
    rest = 1.0 - share
    if a * w + b * x + c * y + d * z < 0.0:
        share = -share
    return normalized((rest * a + share * w, rest * b + share * x, rest * c + share * y, rest * d + share * z))
