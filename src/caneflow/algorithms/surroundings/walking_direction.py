"""Which way the user walks: the chord of the hand over about one step; before the first step, where the cane points."""

import math

from caneflow.algorithms.rotations import wrapped

CHORD_NS = 700_000_000  # ns: about one step
SLOWEST = 0.25  # m/s of the chord; below it the direction is held
YAW_TIME = 0.65  # s over which the cane's yaw is averaged: the swing goes, a turn of the body stays
KEPT = 512  # places of the hand that are kept at most


class WalkingDirection:
    """Direction (rad, counter-clockwise from x0) and whether the user walks."""

    def __init__(self) -> None:
        self.heading = 0.0
        self.walking = False
        self.speed = 0.0  # m/s, of the chord
        self._walked = False
        self._yaw: float | None = None  # rad, mean of the cane's
        self._last_ns = 0
        self._hands: list[tuple[int, float, float]] = []  # ns, m, m

    def clear(self) -> None:
        """Forget where the hand was: the poses begin again elsewhere."""
        self._hands.clear()
        self.walking = False

    def update(self, stamp_ns: int, x: float, y: float, cane_yaw: float) -> None:
        """Take the hand's place (m) and the cane's yaw (rad) at `stamp_ns`."""
        self._average_yaw(stamp_ns, cane_yaw)
        self._hands.append((stamp_ns, x, y))
        oldest = 0
        while oldest + 1 < len(self._hands) and self._hands[oldest + 1][0] <= stamp_ns - CHORD_NS:
            oldest += 1
        if oldest > 16 or len(self._hands) > KEPT:
            del self._hands[: max(oldest, len(self._hands) - KEPT)]
            oldest = 0
        began_ns, began_x, began_y = self._hands[oldest]
        self.speed = math.hypot(x - began_x, y - began_y) / (CHORD_NS * 1e-9)
        self.walking = self.speed >= SLOWEST and stamp_ns - began_ns >= CHORD_NS // 2
        if self.walking:
            self.heading = math.atan2(y - began_y, x - began_x)
            self._walked = True
        elif not self._walked and self._yaw is not None:
            self.heading = wrapped(self._yaw)

    def _average_yaw(self, stamp_ns: int, yaw: float) -> None:
        if self._yaw is None:
            self._yaw = yaw
        else:
            elapsed = (stamp_ns - self._last_ns) * 1e-9
            self._yaw += wrapped(yaw - self._yaw) * -math.expm1(-elapsed / YAW_TIME)
        self._last_ns = stamp_ns
