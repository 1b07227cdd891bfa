"""Which way the user walks: the chord of the hand over about one step, steadied by the middle of the cane's swing.

A chord is as noisy as the velocity across the way, which the radar hardly sees: 5 to 7 degrees over seconds. The gyro
sees every turn of the body, and the cane swings about where the body faces, up to an angle that belongs to the user's
grip. So that angle is averaged over the last seconds, and of what the chord says beyond it only a part is believed. Who
steps sideways without turning is far from it, and then the chord alone counts. Before the first step it is where the
cane points.
"""

import math

from caneflow.algorithms.rotations import wrapped
from caneflow.algorithms.surroundings.swing_centre import SwingCentre

CHORD_NS = 700_000_000  # ns: about one step
SLOWEST = 0.25  # m/s of the chord; below it the direction is held
YAW_TIME = 0.65  # s over which the cane's yaw is averaged: the swing goes, a turn of the body stays
KEPT = 512  # places of the hand that are kept at most
GRIP_TIME = 8.0  # s over which the angle between the swing's middle and the way is averaged
BELIEVED = 0.4  # of what the chord says beyond that
FARTHEST_OFF = math.radians(30)  # of the chord, beyond which it counts alone
LAG = CHORD_NS * 0.5e-9  # s by which a chord is late
LEAD = 0.2  # s of that which the turning of the swing's middle makes up for


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
        self._swing = SwingCentre()
        self._grip: float | None = None  # rad, of the way from the swing's middle, to the left
        self._known = 0.0  # s of walking that it is made of, up to GRIP_TIME

    def clear(self) -> None:
        """Forget where the hand was: the poses begin again elsewhere."""
        self._hands.clear()
        self._swing.clear()
        self.walking = False

    def update(self, stamp_ns: int, x: float, y: float, cane_yaw: float) -> None:
        """Take the hand's place (m) and the cane's yaw (rad) at `stamp_ns`."""
        elapsed = (stamp_ns - self._last_ns) * 1e-9
        self._average_yaw(stamp_ns, cane_yaw)
        self._swing.update(stamp_ns, cane_yaw)
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
            self.heading = self._steadied(math.atan2(y - began_y, x - began_x), elapsed)
            self._walked = True
        elif not self._walked and self._yaw is not None:
            self.heading = wrapped(self._yaw)

    def _steadied(self, chord: float, elapsed: float) -> float:
        """The direction by the chord's (rad) and the swing; `elapsed` s have passed since the last."""
        if self._swing.centre is None:
            return chord
        middle, rate = self._swing.centre
        angle = wrapped(chord - (middle - LAG * rate))
        self._known = min(self._known + elapsed, GRIP_TIME)
        if self._grip is None:
            self._grip = angle
        beyond = wrapped(angle - self._grip)
        share = min(elapsed / self._known, 1.0) if self._known > 0.0 else 1.0
        self._grip = wrapped(self._grip + share * beyond)
        beyond = wrapped(angle - self._grip)
        if abs(beyond) > FARTHEST_OFF:
            return chord
        return wrapped(middle - (LAG - LEAD) * rate + self._grip + BELIEVED * beyond)

    def _average_yaw(self, stamp_ns: int, yaw: float) -> None:
        if self._yaw is None:
            self._yaw = yaw
        else:
            elapsed = (stamp_ns - self._last_ns) * 1e-9
            self._yaw += wrapped(yaw - self._yaw) * -math.expm1(-elapsed / YAW_TIME)
        self._last_ns = stamp_ns
