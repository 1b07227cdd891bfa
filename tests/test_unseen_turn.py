"""What is not seen of a turn follows from its course at both ends, as well as it did in the seconds before."""

import math

import numpy as np
import pytest

from caneflow.algorithms.inertial.unseen_turn import TurnFound, UnseenTurn
from caneflow.algorithms.rotations import IDENTITY, Quaternion, Vector, conjugate, from_rotation_vector, multiply

PERIOD = 0.005  # s
DEGREE = math.radians(1.0)


def smooth(t: float) -> Vector:
    """rad/s: a hand that swings at 0.4 to 0.9 Hz."""
    return 3.0 * math.sin(5.6 * t), 2.0 * math.sin(3.1 * t + 1.0), 2.5 * math.sin(4.3 * t + 2.0)


def over(begin: float, lasting: float) -> Quaternion:
    """How a smooth motion turns, by small steps."""
    turn, steps = IDENTITY, 2000
    for k in range(steps):
        x, y, z = smooth(begin + (k + 0.5) * lasting / steps)
        h = lasting / steps
        turn = multiply(turn, from_rotation_vector((h * x, h * y, h * z)))
    return turn


def found(rates: list[Vector], hole: float, after: int = 40) -> TurnFound | None:
    """What is said after a hole of so many s before the last readings."""
    unseen = UnseenTurn()
    for rate in rates[:-after]:
        unseen.take(PERIOD, rate)
    unseen.begin(hole)
    for rate in rates[1 - after :]:
        unseen.take(PERIOD, rate)
        if (told := unseen.found()) is not None:
            return told
    return None


def spread_of(told: TurnFound) -> float:
    """rad, about the worst of the axes."""
    return float(np.sqrt(np.diag(told.covariance).max()))


@pytest.mark.parametrize(("hole", "bar"), [(0.1, 0.1), (0.2, 0.2), (0.3, 0.5), (0.6, 4.0)])
@pytest.mark.parametrize("begin", [4.7, 7.3, 9.1])
def test_a_smooth_turn_is_told_within_its_error(hole: float, bar: float, begin: float) -> None:
    """The trapezium rule alone is off by 0.6, 4, 12 and 60 degrees at worst."""
    # a reading counts for the interval before it, so it is the rate in the middle of that
    before = [smooth(begin - (k + 0.5) * PERIOD) for k in range(900, -1, -1)]
    after = [smooth(begin + hole + (k - 0.5) * PERIOD) for k in range(40)]
    told = found(before + after, hole)
    assert told is not None
    w, x, y, z = multiply(conjugate(told.turn), over(begin, hole))
    error = 2.0 * math.atan2(math.hypot(x, y, z), abs(w))
    assert error < bar * DEGREE
    assert error < 3.0 * spread_of(told) + 0.05 * DEGREE
    assert spread_of(told) < (2.0 * bar + 0.1) * DEGREE


def test_another_hole_in_the_seconds_before_takes_nothing_from_it() -> None:
    """One of many: what was seen between two holes teaches as well, and no hole is taken for a motion."""
    unseen = UnseenTurn()
    time = 0.0
    for _ in range(8):
        for _ in range(200):
            unseen.take(PERIOD, smooth(time + 0.5 * PERIOD))
            time += PERIOD
        unseen.found()
        begin, time = time, time + 0.2
        unseen.begin(0.2)
    for _ in range(40):
        unseen.take(PERIOD, smooth(time + 0.5 * PERIOD))
        time += PERIOD
    told = unseen.found()
    assert told is not None
    w, x, y, z = multiply(conjugate(told.turn), over(begin, 0.2))
    assert 2.0 * math.atan2(math.hypot(x, y, z), abs(w)) < 0.3 * DEGREE


def test_of_a_jerky_motion_it_says_that_it_does_not_know() -> None:
    """Rates that nothing connects, held for 50 ms each: a hole of 0.2 s may hide what four of them turn."""
    random = np.random.default_rng(1)
    held = [(p, q, r) for p, q, r in random.normal(0.0, 5.0, (90, 3)).tolist() for _ in range(10)]
    told = found(held, 0.2)
    assert told is not None
    expected = 5.0 * math.sqrt(3 * 4) * 0.05  # rad
    assert 0.5 * expected < spread_of(told) < 3.0 * expected


def test_without_a_past_or_over_a_long_hole_nothing_is_said() -> None:
    assert found([smooth(k * PERIOD) for k in range(100)], 0.3) is None
    assert found([smooth(k * PERIOD) for k in range(600)], 1.1) is None
