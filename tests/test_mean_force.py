"""A mean of the specific force tells what is up, and how well was measured in the motion before."""

import math

import numpy as np
import pytest

from caneflow.algorithms.inertial.mean_force import LEAST_SPEED, ForceWander, MeanForce, TiltError
from caneflow.physics import GRAVITY

PERIOD = 0.01  # s


def mean_of(forces: np.ndarray) -> MeanForce:
    mean = MeanForce()
    for k, (x, y, z) in enumerate(forces.tolist()):
        mean.take((x, y, z), PERIOD if k else 0.0)
    return mean


def test_it_is_the_slope_of_the_line_through_the_sum() -> None:
    """Beyond 2 s; the slow way: least squares through the sum of the force."""
    random = np.random.default_rng(1)
    forces = random.normal(0.0, 3.0, (301, 3))
    times = PERIOD * np.arange(301)
    summed = PERIOD * (np.cumsum(forces, axis=0) - forces[0])
    slope = np.polyfit(times, summed, 1)[0]
    assert mean_of(forces).mean == pytest.approx(slope, abs=0.02)


def test_up_to_a_second_it_is_the_plain_mean() -> None:
    forces = np.random.default_rng(2).normal(0.0, 3.0, (90, 3))
    assert mean_of(forces).mean == pytest.approx(forces[1:].mean(axis=0))
    assert MeanForce().mean == (0.0, 0.0, 0.0)


def errors(lasted: float, force_of: object, wander: ForceWander) -> tuple[float, float]:
    """rad: RMS of many means, and what is said of them."""
    assert callable(force_of)
    count = round(lasted / PERIOD)
    squares = []
    for _ in range(40):
        x, y, _ = mean_of(force_of(count)).mean
        squares.append((x * x + y * y) / (2.0 * GRAVITY**2))
    return math.sqrt(np.mean(squares)), math.sqrt(wander.error(1.0).variance(lasted))


@pytest.mark.parametrize("lasted", [2.0, 5.0])
def test_what_is_said_of_a_wandering_speed_is_so(lasted: float) -> None:
    """White acceleration: a speed that wanders without bound."""
    random = np.random.default_rng(3)

    def force_of(count: int) -> np.ndarray:
        return random.normal((0.0, 0.0, GRAVITY), 8.0, (count, 3))

    wander = ForceWander()
    for x, y, z in force_of(6000).tolist():
        wander.take((x, y, z), PERIOD)
    seen, said = errors(lasted, force_of, wander)
    assert 0.6 * seen < said < 1.7 * seen


def test_nothing_is_known_better_than_by_a_walk() -> None:
    wander = ForceWander()
    for _ in range(6000):
        wander.take((0.0, 0.0, GRAVITY), PERIOD)
    assert math.sqrt(wander.error(0.5).variance(4.0)) == pytest.approx(LEAST_SPEED / (4.0 * GRAVITY))


def test_the_longer_the_better() -> None:
    told = [TiltError(2.0).variance(lasted) for lasted in (0.0, 0.1, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0)]
    assert told == sorted(told, reverse=True)
