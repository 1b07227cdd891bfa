"""What is not seen of a turn follows from its course at both ends, as well as it did in the seconds before."""

import math

import numpy as np
import pytest

from caneflow.algorithms.inertial.unseen_turn import UnseenTurn
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


def found(rates: list[Vector], hole: float) -> tuple[Quaternion, float] | None:
    """What is said after a hole of so many s before the last ten readings."""
    unseen = UnseenTurn()
    for rate in rates[:-10]:
        unseen.take(PERIOD, rate)
    unseen.begin(hole, rates[-10])
    for rate in rates[-9:]:
        unseen.take(PERIOD, rate)
        if (told := unseen.found()) is not None:
            return told
    return None


@pytest.mark.parametrize(("hole", "bar"), [(0.1, 0.1), (0.2, 0.6), (0.3, 2.0)])
@pytest.mark.parametrize("begin", [3.0, 4.7, 7.3])
def test_a_smooth_turn_is_told_within_its_error(hole: float, bar: float, begin: float) -> None:
    """The trapezium rule alone is off by 0.6, 4 and 12 degrees at worst."""
    before = [smooth(begin - k * PERIOD) for k in range(500, -1, -1)]
    after = [smooth(begin + hole + k * PERIOD) for k in range(10)]
    told = found(before + after, hole)
    assert told is not None
    turn, spread = told
    w, x, y, z = multiply(conjugate(turn), over(begin, hole))
    error = 2.0 * math.atan2(math.hypot(x, y, z), abs(w))
    assert error < bar * DEGREE
    assert error < 3.0 * spread + 0.1 * DEGREE
    assert spread < (2.0 * bar + 0.2) * DEGREE  # 0.2: half a sample, between an instant and the interval before it


def test_of_a_jerky_motion_it_says_that_it_does_not_know() -> None:
    """Rates that nothing connects, held for 50 ms each: a hole of 0.2 s may hide what four of them turn."""
    random = np.random.default_rng(1)
    held = [(p, q, r) for p, q, r in random.normal(0.0, 5.0, (60, 3)).tolist() for _ in range(10)]
    told = found(held, 0.2)
    assert told is not None
    expected = 5.0 * math.sqrt(3 * 4) * 0.05  # rad
    assert 0.5 * expected < told[1] < 3.0 * expected


def test_without_a_past_or_over_a_long_hole_nothing_is_said() -> None:
    assert found([smooth(k * PERIOD) for k in range(60)], 0.3) is None
    assert found([smooth(k * PERIOD) for k in range(600)], 1.1) is None
