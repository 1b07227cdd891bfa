"""Full swings of the cane: marks at its turning points, or each second without a swing, and what happened between.

Over a full swing the cane points on average where its bearer walks; at any instant it does not.
"""

from collections import deque
from typing import Final, NamedTuple

_SHORTEST_WAY: Final = 0.3  # s, of half a swing
_WAY_TIME: Final = 1.0  # s from mark to mark without swing
_LONGEST_SWING: Final = 1.5  # s of half a swing


class FullSwing(NamedTuple):
    """What happened since the mark before the last one."""

    elapsed: float  # s
    yaw: float  # rad, mean of the boresight's
    turned: float  # rad, the boresight from then to now
    arm: complex  # m, change of the arm from IMU to hand


class _Mark(NamedTuple):
    elapsed: float  # s since the mark before
    sum: float  # rad s, of the boresight's turn over that time
    turn: float  # rad, the boresight's since the start
    arm: complex  # m, from IMU to hand


class SwingMarks:
    """Marks at the turning points of the swing, or each second without one; what the cane did between them."""

    def __init__(self, back: float) -> None:
        """`back`: how far (rad) the cane goes back before it counts as having turned."""
        self._back = back
        self._turn = self._extreme = 0.0  # rad, the boresight's since the start
        self._rising = self._swings = False
        self._elapsed = self._sum = 0.0  # s, rad s since the last mark
        self._marks: deque[_Mark] = deque(maxlen=2)

    def update(self, elapsed: float, turned: float) -> bool:
        """Go on by `elapsed` s over which the boresight `turned` (rad); whether it is time for a mark."""
        self._turn += turned
        self._elapsed += elapsed
        self._sum += elapsed * self._turn
        further = self._turn - self._extreme if self._rising else self._extreme - self._turn
        if further > 0.0:
            self._extreme = self._turn
        elif further < -self._back:
            self._rising, self._extreme, self._swings = not self._rising, self._turn, True
            if self._elapsed > _SHORTEST_WAY:
                return True
        if self._elapsed < (_LONGEST_SWING if self._swings else _WAY_TIME):
            return False
        self._swings = False
        return True

    def full(self, yaw: float, arm: complex) -> FullSwing | None:
        """What happened since the mark before the last one, and a new mark; `yaw` (rad) is the boresight's."""
        new, since = _Mark(self._elapsed, self._sum, self._turn, arm), None
        if len(self._marks) == 2:
            older, last = self._marks
            elapsed = last.elapsed + new.elapsed
            mean = (last.sum + new.sum) / elapsed
            since = FullSwing(elapsed, yaw + mean - self._turn, self._turn - older.turn, arm - older.arm)
        self._marks.append(new)
        self._elapsed = self._sum = 0.0
        return since

    def forget(self) -> None:
        """All marks."""
        self._marks.clear()
        self._elapsed = self._sum = 0.0
