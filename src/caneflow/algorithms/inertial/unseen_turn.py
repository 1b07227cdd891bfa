"""How a body turned while no samples came, from the turn rates at both ends of the hole.

A motion of a hand or a foot is smooth and repeats itself: how the turn rates in a hole follow from those before and
after it has been seen in the seconds before. It is learnt there by least squares, all three axes alike, as a departure
from the straight line between both ends, and what is left there says how wrong the turn may be. A swing is told to
a degree over half a second, a jerky motion hardly better than by the straight line.
"""

import math
from collections import deque
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from caneflow.algorithms.rotations import (
    IDENTITY,
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
)

Array: TypeAlias = npt.NDArray[np.float64]
# Time (s) and the turn rates' sums since the start (rad); plain, as names would be two thirds of a snapshot
_Knot: TypeAlias = tuple[float, float, float, float]

KNOT = 0.01  # s, between which turn rates are averaged
REMEMBERED = 450  # knots before the hole
BIN = 0.02  # s, roughly, of which a hole is made up; a whole number of bins fills it
BEFORE, AFTER = 10, 5  # bins at both ends that tell of the hole
LONGEST_HOLE = 1.0  # s
FEWEST_WINDOWS = 50  # of the seconds before; each axis of each is one example, and they overlap
RIDGE = 1e-5  # of the rates' mean square: the weight of the straight line
MARGIN = 1.5  # times what was left in the examples, sd: they were fitted, and overlap


class TurnFound(NamedTuple):
    """The turn in a hole."""

    turn: Quaternion  # of the body, from the hole's begin to its end
    covariance: Array  # (3, 3) rad^2, of a small rotation in the body as it was at the hole's begin


class Bridged(NamedTuple):
    """The attitudes at both ends of a hole, as they were taken, and how long it was."""

    before: Quaternion
    after: Quaternion
    lasted: float  # s
    unknown: Array | None  # (3, 3) rad^2, of the attitude before, after another hole

    def missing(self, found: TurnFound, bias: Vector) -> Quaternion:
        """The rotation of the world that is missing since then; `bias` of the gyro in rad/s."""
        x, y, z = bias
        drift = from_rotation_vector((-self.lasted * x, -self.lasted * y, -self.lasted * z))
        return multiply(multiply(multiply(self.before, found.turn), drift), conjugate(self.after))


class _Hole(NamedTuple):
    width: float  # s, of a bin
    before: Array  # (BEFORE, 3) rad/s
    weights: Array  # (BEFORE + AFTER, bins): how the rates in it follow from those before and after
    squares: Array  # (3, 3) rad^2, what was left of the turn in the examples


class UnseenTurn:
    """Remembers the last seconds of turn rates; told of a hole, it says some readings later how the body turned."""

    def __init__(self) -> None:
        self._knots: deque[_Knot] = deque(maxlen=REMEMBERED)
        self._now: _Knot = (0.0, 0.0, 0.0, 0.0)
        self._next = KNOT  # s, of the next knot
        self._hole: _Hole | None = None
        self._ended = 0.0  # s, of the hole

    def take(self, interval: float, gyro: Vector) -> None:
        """A reading (rad/s), which counts for the usual `interval` (s) before it."""
        p, q, r = gyro
        time, x, y, z = self._now
        self._now = time + interval, x + interval * p, y + interval * q, z + interval * r
        while self._next <= self._now[0]:
            since = self._next - time
            self._knots.append((self._next, x + since * p, y + since * q, z + since * r))
            self._next += KNOT

    def begin(self, interval: float) -> None:
        """The next reading comes after a hole of `interval` s."""
        self._hole = None
        if interval > LONGEST_HOLE:
            self._knots.clear()
        else:
            self._knots.append(self._now)
            self._hole = _learnt(np.array(self._knots), interval)
        self._ended = self._now[0] + interval
        self._now = (self._ended, *self._now[1:])
        self._next = self._ended + KNOT
        self._knots.append(self._now)

    def found(self) -> TurnFound | None:
        """The turn in the last hole, once: when enough has been read since."""
        hole = self._hole
        if hole is None or self._now[0] < self._ended + AFTER * hole.width:
            return None
        self._hole = None
        knots = np.array([knot for knot in self._knots if knot[0] >= self._ended] + [self._now])
        after = _rates(knots, self._ended + hole.width * np.arange(AFTER + 1.0))
        rates = hole.weights.T @ np.concatenate((hole.before, after))
        return _course(rates, hole.width, hole.squares)


def _rates(knots: Array, edges: Array) -> Array:
    """Mean turn rates (bins, 3), rad/s, between `edges`; NaN where samples were missing."""
    times = knots[:, 0]
    turned = np.stack([np.interp(edges, times, knots[:, axis]) for axis in (1, 2, 3)], axis=1)
    part = np.concatenate(([0.0], np.cumsum(np.diff(times) > 1.5 * KNOT)))
    begun = np.interp(edges, times, part, left=math.nan)
    rates = np.diff(turned, axis=0) / np.diff(edges)[:, None]
    rates[np.diff(begun) != 0.0] = math.nan
    return rates


def _learnt(knots: Array, lasted: float) -> _Hole | None:
    """How a hole of `lasted` s that begins at the last of the knots (n, 4) is filled; None if too little is known."""
    bins = max(round(lasted / BIN), 1)
    width, length = lasted / bins, BEFORE + bins + AFTER
    end = knots[-1, 0]
    count = int((end - knots[0, 0]) / width)
    if count < length:
        return None
    rates = _rates(knots, end + width * np.arange(-count, 1.0))
    windows = np.lib.stride_tricks.sliding_window_view(rates, length, axis=0)
    windows = windows[np.isfinite(windows).all(axis=(1, 2))]
    before = rates[-BEFORE:]
    if len(windows) < FEWEST_WINDOWS or not np.isfinite(before).all():
        return None
    examples = windows.reshape(-1, length)
    given, wanted = examples[:, np.r_[0:BEFORE, BEFORE + bins : length]], examples[:, BEFORE : BEFORE + bins]
    products = given.T @ given
    products += (RIDGE * np.trace(products) / len(products) + np.finfo(float).tiny) * np.eye(len(products))
    line = _straight_line(bins)
    left = wanted - given @ line
    weights = np.linalg.solve(products, given.T @ left)
    turned = width * (left - given @ weights).sum(axis=1).reshape(-1, 3)
    return _Hole(width, before, line + weights, MARGIN**2 * (turned.T @ turned) / len(turned))


def _straight_line(bins: int) -> Array:
    """Weights (BEFORE + AFTER, bins) of the rates at both ends, by which the last and the first are joined."""
    share = (np.arange(bins) + 1.0) / (bins + 1.0)
    weights = np.zeros((BEFORE + AFTER, bins))
    weights[BEFORE - 1], weights[BEFORE] = 1.0 - share, share
    return weights


def _course(rates: Array, width: float, squares: Array) -> TurnFound:
    """The turn at these rates, and its covariance: an error may lie anywhere on the way."""
    turn, covariance = IDENTITY, np.zeros((3, 3))
    for x, y, z in (0.5 * width * rates).tolist():
        half = from_rotation_vector((x, y, z))
        middle = multiply(turn, half)
        covariance += turned_about(middle, squares) / len(rates)
        turn = multiply(middle, half)
    bent = (0.5 * np.trace(covariance)) ** 2  # a turn by an unknown angle bends what is told of the other axes
    return TurnFound(normalized(turn), covariance + bent * np.eye(3))


def turned_about(orientation: Quaternion, covariance: Array) -> Array:
    """The covariance (3, 3) of a vector in the body as one in the world."""
    axes = np.array([rotate(orientation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T
    turned: Array = axes @ covariance @ axes.T
    return turned
