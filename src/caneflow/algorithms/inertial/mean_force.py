"""What a mean of the specific force tells of what is up, and how well: learnt in the motion itself.

In a world that does not turn, the mean force over T is gravity and what the body's speed changed by, over T. The mean
with the weights t (T - t) is the slope of the least-squares line through the sum of the force, the change of speed
itself. Where a hand moves to and fro it is gravity twice as well as the plain mean as soon as that is for more than
once, since speed at both ends counts no more than in between; before, and where speed wanders off, it is a seventh to
a quarter worse. So the plain mean goes over into it between 1 and 2 s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from caneflow.algorithms.rotations import Vector
from caneflow.physics import GRAVITY

SPANS = (1.0, 2.0, 4.0)  # s, over which the mean is tried
GATHERED = 0.05  # s, of readings that are taken as one
MEMORY = 20.0  # s, of these trials
PRIOR = 2.0  # trials that the expectation counts for
LEAST_SPEED, SPEED_TIME = 0.5, 0.25  # m/s, s: see expected_speed
SHORTEST = 0.1  # s, the least time over which a force is taken to be averaged
LEAST_POWER, LARGEST_POWER = 1.0, 3.0  # of time, by which a variance falls: speed wanders; speed to and fro


def expected_speed(shaking: float) -> float:
    """m/s, sd of what a body's speed changes by: a walk's at least, more where the force is `shaking` (m/s^2, RMS)."""
    return LEAST_SPEED + SPEED_TIME * shaking


class MeanForce:
    """The mean of a force since its first reading."""

    def __init__(self) -> None:
        self.lasted = 0.0  # s
        self._first: Vector | None = None
        self._sums = [0.0, 0.0]  # of t, of t^2,
        self._forces: list[Vector] = [(0.0, 0.0, 0.0)] * 3  # of force, of t force, of t^2 force

    def take(self, force: Vector, interval: float) -> None:
        """A reading that counts for the `interval` (s) before it; the first for none."""
        if self._first is None:
            self._first = force
        t = self.lasted + 0.5 * interval
        self.lasted += interval
        weights = interval, interval * t, interval * t * t
        self._sums = [self._sums[0] + weights[1], self._sums[1] + weights[2]]
        x, y, z = force
        self._forces = [(a + w * x, b + w * y, c + w * z) for w, (a, b, c) in zip(weights, self._forces, strict=True)]

    @property
    def mean(self) -> Vector:
        """In the unit of the force; zero before the first."""
        if not self.lasted > 0.0:
            return self._first or (0.0, 0.0, 0.0)
        plain, once, twice = self._forces
        share = min(max((self.lasted - SPANS[0]) / (SPANS[1] - SPANS[0]), 0.0), 1.0)
        evenly = (1.0 - share) / self.lasted
        bent = share / (self.lasted * self._sums[0] - self._sums[1]) if share > 0.0 else 0.0
        x, y, z = (evenly * a + bent * (self.lasted * b - c) for a, b, c in zip(plain, once, twice, strict=True))
        return x, y, z


@dataclass(frozen=True)
class TiltError:
    """How wrong a mean force is about what is up."""

    speed: float  # m/s, expected
    measured: Sequence[tuple[float, float]] = ()  # trials and mean square, rad^2 per axis, for each of SPANS

    def variance(self, lasted: float) -> float:
        """rad^2 per axis, of a mean over `lasted` s."""
        lasted = max(lasted, SHORTEST)
        known = [self._known(k) for k in range(len(SPANS))]
        if lasted <= SPANS[0]:
            return known[0] * (SPANS[0] / lasted) ** 2
        k = 1 if lasted <= SPANS[1] else 2
        fallen: float = math.log(known[k - 1] / known[k]) / math.log(SPANS[k] / SPANS[k - 1])
        power = min(max(fallen, LEAST_POWER), LARGEST_POWER)
        found: float = known[k] * (SPANS[k] / lasted) ** power
        return max(found, (LEAST_SPEED / (GRAVITY * lasted)) ** 2)

    def _known(self, k: int) -> float:
        expected = (self.speed / (GRAVITY * SPANS[k])) ** 2
        trials, square = self.measured[k] if self.measured else (0.0, 0.0)
        least = (LEAST_SPEED / (GRAVITY * SPANS[k])) ** 2
        return max((PRIOR * expected + trials * square) / (PRIOR + trials), least)


class ForceWander:
    """Tries over and over how far the mean force is off the vertical of an attitude that is known."""

    def __init__(self) -> None:
        self._trials = [(0.0, 0.0) for _ in SPANS]
        self._means = [MeanForce() for _ in SPANS]
        self._gathered: Vector = (0.0, 0.0, 0.0)  # m/s
        self._lasted = 0.0  # s

    def take(self, force: Vector, interval: float) -> None:
        """A reading (m/s^2) in the world, `interval` s after the one before."""
        a, b, c = self._gathered
        self._gathered = a + interval * force[0], b + interval * force[1], c + interval * force[2]
        self._lasted += interval
        if self._lasted >= GATHERED:
            a, b, c = self._gathered
            self._try((a / self._lasted, b / self._lasted, c / self._lasted), self._lasted)
            self._gathered, self._lasted = (0.0, 0.0, 0.0), 0.0

    def _try(self, force: Vector, interval: float) -> None:
        for k, span in enumerate(SPANS):
            mean = self._means[k]
            mean.take(force, interval)
            if mean.lasted >= span:
                self._count(k, mean.mean)
                self._means[k] = MeanForce()

    def restart(self) -> None:
        """The attitude was not known: what is being averaged counts for nothing."""
        self._means = [MeanForce() for _ in SPANS]
        self._gathered, self._lasted = (0.0, 0.0, 0.0), 0.0

    def error(self, speed: float) -> TiltError:
        """As it is now, where without trials a change of `speed` (m/s) would be expected."""
        return TiltError(speed, tuple(self._trials))

    def _count(self, k: int, mean: Vector) -> None:
        x, y, _ = mean
        trials, square = self._trials[k]
        trials = min(trials + 1.0, MEMORY / SPANS[k])
        self._trials[k] = trials, square + ((x * x + y * y) / (2.0 * GRAVITY**2) - square) / trials
