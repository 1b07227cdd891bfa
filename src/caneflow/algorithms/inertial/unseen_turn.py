"""How a body turned while no samples came, from the turn rates and their changes at both ends of the hole.

The trapezium rule takes the turn rate to change evenly; its first correction, T^2 / 12 (change before - change after),
is exact for a cubic course. A smooth motion is told six times better with it, a jerky one worse. Which one this is has
just been seen: the same hole is made up in the seconds before, again and again, and the correction gets the share that
fits there. What is left there says how wrong the turn may be.
"""

import math
from collections import deque
from typing import NamedTuple

from caneflow.algorithms.rotations import (
    IDENTITY,
    Quaternion,
    Vector,
    from_rotation_vector,
    multiply,
    normalized,
)

REMEMBERED = 2.5  # s before the hole on which it is tried
LONGEST_HOLE = 1.0  # s
SLOPE = 0.02  # s over which a change of the turn rate is taken
TRIALS, FEWEST_TRIALS = 16, 6
MARGIN = 1.5  # times what was left in the trials: they are few, and overlap
STEPS = 16  # in which the course over the hole is integrated


class _Reading(NamedTuple):
    time: float  # s
    gyro: Vector  # rad/s
    turned: Vector  # rad, sum since the history began


class _Hole(NamedTuple):
    lasted: float  # s
    before: Vector  # rad/s
    change: Vector  # rad/s^2, before
    after: Vector  # rad/s
    share: float  # of the correction
    spread: float  # rad


class UnseenTurn:
    """Remembers the last seconds of turn rates; told of a hole, it says some readings later how the body turned."""

    def __init__(self) -> None:
        self._history: deque[_Reading] = deque()
        self._hole: _Hole | None = None

    def take(self, interval: float, gyro: Vector) -> None:
        """A reading (rad/s) after a usual `interval` (s)."""
        history = self._history
        if not history:
            history.append(_Reading(0.0, gyro, (0.0, 0.0, 0.0)))
            return
        time, _, (x, y, z) = history[-1]
        turned = x + interval * gyro[0], y + interval * gyro[1], z + interval * gyro[2]
        history.append(_Reading(time + interval, gyro, turned))
        while history[-1].time - history[0].time > REMEMBERED:
            history.popleft()

    def begin(self, interval: float, gyro: Vector) -> None:
        """A reading after a hole of `interval` s."""
        self._hole = self._tried(interval, gyro) if interval <= LONGEST_HOLE else None
        self._history.clear()
        self.take(0.0, gyro)

    def found(self) -> tuple[Quaternion, float] | None:
        """The turn in the last hole, in the body, and its sd (rad), once: when enough has been read since."""
        if self._hole is None or self._history[-1].time < SLOPE:
            return None
        hole, self._hole = self._hole, None
        first, last = self._history[0], self._history[-1]
        return _course(hole, _slope(first, last)), hole.spread

    def _tried(self, interval: float, gyro: Vector) -> _Hole | None:
        """The hole, with what the same one would have been like in the seconds before; None where there are too few."""
        history = list(self._history)
        if not history:
            return None
        explained = explaining = missed = 0.0
        trials, room = 0, history[-1].time - history[0].time - interval - 2.0 * SLOPE
        if room <= 0.0:
            return None
        places = [history[0].time + SLOPE + room * k / (TRIALS - 1) for k in range(TRIALS)]
        end = iter(places)
        index = 0
        for place in end:
            while history[index].time < place:
                index += 1
            trial = _trial(history, index, interval)
            if trial is None:
                continue
            error, correction = trial
            explained += _dot(error, correction)
            explaining += _dot(correction, correction)
            missed += _dot(error, error)
            trials += 1
        if trials < FEWEST_TRIALS:
            return None
        share = min(max(explained / explaining, 0.0), 1.0) if explaining > 0.0 else 0.0
        left = max(missed - share * (2.0 * explained - share * explaining), 0.0)
        first = next(k for k in range(len(history) - 1, -1, -1) if history[-1].time - history[k].time >= SLOPE)
        change = _slope(history[first], history[-1])
        return _Hole(interval, history[-1].gyro, change, gyro, share, MARGIN * math.sqrt(left / trials))


def _trial(history: list[_Reading], begin: int, lasting: float) -> tuple[Vector, Vector] | None:
    """By how much (rad) the trapezium rule is off over a hole that begins at a reading, and what the correction is."""
    end = _after(history, begin, history[begin].time + lasting)
    later = _after(history, end, history[min(end, len(history) - 1)].time + SLOPE)
    if later >= len(history):
        return None
    earlier = begin
    while earlier > 0 and history[begin].time - history[earlier].time < SLOPE:
        earlier -= 1
    (start, before, turned_before), (stop, after, turned_after) = history[begin], history[end]
    lasted = stop - start
    changes = _slope(history[earlier], history[begin]), _slope(history[end], history[later])
    error, correction = [], []
    for axis in range(3):
        evenly = 0.5 * lasted * (before[axis] + after[axis])
        error.append(turned_after[axis] - turned_before[axis] - evenly)
        correction.append(lasted * lasted / 12.0 * (changes[0][axis] - changes[1][axis]))
    return (error[0], error[1], error[2]), (correction[0], correction[1], correction[2])


def _after(history: list[_Reading], index: int, time: float) -> int:
    while index < len(history) and history[index].time < time - 1e-9:
        index += 1
    return index


def _slope(one: _Reading, other: _Reading) -> Vector:
    lasted = other.time - one.time
    if lasted <= 0.0:
        return 0.0, 0.0, 0.0
    (ax, ay, az), (bx, by, bz) = one.gyro, other.gyro
    return (bx - ax) / lasted, (by - ay) / lasted, (bz - az) / lasted


def _course(hole: _Hole, change_after: Vector) -> Quaternion:
    """The turn over the hole: an even course, and a share of the cubic one's difference from it."""
    turn, step = IDENTITY, hole.lasted / STEPS
    for k in range(STEPS):
        s = (k + 0.5) / STEPS
        rise, fall = hole.lasted * s * (1.0 - s) ** 2, hole.lasted * s * s * (1.0 - s)
        bend = s * (1.0 - s) * (2.0 * s - 1.0)
        rate = []
        for a, b, u, v in zip(hole.before, hole.after, hole.change, change_after, strict=True):
            evenly = a + s * (b - a)
            rate.append(evenly + hole.share * (bend * (b - a) + rise * u - fall * v))
        turn = multiply(turn, from_rotation_vector((step * rate[0], step * rate[1], step * rate[2])))
    return normalized(turn)


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
