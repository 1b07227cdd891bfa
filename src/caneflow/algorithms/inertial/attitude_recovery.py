"""The attitude after a hole in the samples: how wrong it may be, and what the readings since then say about it.

Nothing tells how the body turned in a hole. From its end on the gyro turns the attitude exactly again, so one
rotation of the world is all that is wrong, the same until it is found. Each reading tells of it, turned into that
world and averaged there: the magnetic field at once and whatever the motion, all but the angle about the field;
the specific force the better the longer it lasts (mean_force).
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from caneflow.algorithms.inertial.initial_attitude import SHORTEST_VECTOR
from caneflow.algorithms.inertial.mean_force import MeanForce, TiltError, expected_speed
from caneflow.algorithms.rotations import (
    IDENTITY,
    Quaternion,
    Vector,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
)
from caneflow.physics import GRAVITY

Covariance: TypeAlias = npt.NDArray[np.float64]  # (3, 3) rad^2, of a small rotation of the world

SHORTEST_HOLE = 0.04  # s; below, the turn rates at both ends tell the turn well enough
HOLE = 2.5  # usual intervals, and more, are a hole
FOLLOWED = 0.1  # of an interval that differs, by which the usual one moves
SWING_SHARE = 1.5  # times what a swing at the present rate and rate of change deviates from the turn rates at both ends
MOST_UNSEEN = 0.5  # of the turn at the present rate: in a long hole a swing may have done anything
TURN_CHANGE = math.radians(40.0)  # rad/s^2, sd of a change of the turn rate that nobody saw, begun and ended in a hole
LEAST_LEVEL = 1e-3  # of a field's strength; one as steep as that has no yaw
UP: Vector = (0.0, 0.0, 1.0)
MOST_STEPS, SMALL_STEP = 10, 1e-3  # rad
LARGEST_SPREAD = math.pi  # rad; beyond, any attitude is as likely
LEAST_WEIGHT = 1e-6  # 1/rad^2, of the turn that was found: what nothing tells of stays as it is
LEAST_FIELD_ERROR = math.radians(2.0)  # rad, however long it is averaged
SMALLEST = math.radians(2.0)  # rad; a smaller spread is left to the filters of the steady state
FIELD_ERROR = math.radians(4.0)  # rad, sd of a field's mean direction over 1 s: disturbances too weak to be seen
MOTION_MEMORY = 2.0  # s, of that RMS
SOONEST = 0.1  # s, the least time over which the field is taken to be averaged
RECOVERY = 5.0  # s, after which the filters of the steady state take over


class Holes:
    """Tells an interval in which samples are missing from the usual ones, and what may have happened in it."""

    def __init__(self) -> None:
        self._usual: float | None = None  # s
        self._gyro: Vector = (0.0, 0.0, 0.0)  # rad/s, the last
        self._turning = 0.0  # rad^2/s^2, mean square of the turn rate
        self._changing = 0.0  # rad^2/s^4, mean square of its changes per second
        self._shaking = 0.0  # m^2/s^4, mean square of what the specific force is off gravity

    @property
    def speed(self) -> float:
        """m/s, sd of what the body's speed changes by in its present motion."""
        return expected_speed(math.sqrt(self._shaking))

    def spread(self, interval: float, gyro: Vector, accel: Vector | None) -> float:
        """rad, sd of the turn that nobody saw in the `interval` (s) before a reading; 0 where it is a usual one.

        Infinite where any turn is possible. `gyro` in rad/s, `accel` in m/s^2.
        """
        usual = self._usual
        if usual is None or not (interval > SHORTEST_HOLE and interval > HOLE * usual):
            self._usual = interval if usual is None else usual + FOLLOWED * (interval - usual)
            self._follow(interval, gyro, accel)
            return 0.0
        self._usual = usual + FOLLOWED * (HOLE - 1.0) * usual  # where no more come, this will be the usual interval
        before = self._gyro
        self._gyro = gyro
        return self._unseen(interval, max(math.hypot(*before), math.hypot(*gyro), math.sqrt(self._turning)))

    def _follow(self, interval: float, gyro: Vector, accel: Vector | None) -> None:
        share = interval / (MOTION_MEMORY + interval)
        if accel is not None:
            off = math.hypot(*accel) - GRAVITY
            self._shaking += share * (off * off - self._shaking)
        x, y, z = gyro
        change = math.dist(gyro, self._gyro) / interval
        self._turning += share * (x * x + y * y + z * z - self._turning)
        self._changing += share * (change * change - self._changing)
        self._gyro = gyro

    def _unseen(self, interval: float, turn_rate: float) -> float:
        """What a swing at the present rate and rate of change deviates from the turn rates at both ends of a hole.

        A swing of a at w, w = change / a, is off the trapezium rule by up to a T (w T)^2 / 12.
        """
        swing = SWING_SHARE * self._changing * interval**3 / (12.0 * max(turn_rate, 1e-6))
        spread = math.hypot(min(swing, MOST_UNSEEN * turn_rate * interval), TURN_CHANGE * interval * interval)
        return spread if spread < LARGEST_SPREAD else math.inf


def alike(spread: float) -> Covariance | None:
    """The covariance of a rotation about whose axes the same is known: `spread` in rad, None where it is infinite."""
    return None if math.isinf(spread) else spread * spread * np.eye(3)


def covariance_sum(one: Covariance | None, other: Covariance | None) -> Covariance | None:
    """Of a hole's own turn, None where it may be any, and of what was unknown before, None where nothing was."""
    return one if one is None or other is None else one + other


def largest_spread(covariance: Covariance | None) -> float:
    """rad, about the least known of the three axes; infinite without one."""
    return math.inf if covariance is None else math.sqrt(float(np.diag(covariance).max()))


@dataclass(frozen=True, kw_only=True)
class UndisturbedField:
    """What the magnetic field was before the hole."""

    direction: Vector  # in the attitude's world
    strength: float
    tolerance: float  # relative, of the strength


class Recovery:
    """Finds the rotation of the world that is missing since a hole."""

    def __init__(self, covariance: Covariance | None, tilt: TiltError, field: UndisturbedField | None) -> None:
        """What it may be, None where nothing is known; what a mean force tells; `field` where one can be trusted."""
        self._weights = np.zeros((3, 3)) if covariance is None else np.linalg.inv(covariance)
        self._tilt = tilt
        self._reference = field
        self._force = MeanForce()
        self._field: Vector = (0.0, 0.0, 0.0)
        self._fields = 0
        self._begun = False
        self._since_force = 0.0  # s
        self._precision = self._weights + LEAST_WEIGHT * np.eye(3)  # of what has been found
        self.elapsed = 0.0  # s
        self.turn: Quaternion = IDENTITY  # of the world, from the attitude given to the true one

    @property
    def over(self) -> bool:
        """Whether it has lasted for long enough."""
        return self.elapsed >= RECOVERY

    @property
    def covariance(self) -> Covariance:
        """(3, 3) rad^2, of what is still unknown, in the world."""
        return np.linalg.inv(self._precision).astype(np.float64)

    @property
    def spread(self) -> float:
        """rad, largest sd of what is still unknown; about the vertical only where a field could tell."""
        variances = np.diag(self.covariance)
        return math.sqrt(float(max(variances[: 2 if self._reference is None else 3])))

    @property
    def force(self) -> Vector:
        """Mean specific force since the hole, m/s^2, in the true world."""
        return rotate(self.turn, self._force.mean)

    def update(self, attitude: Quaternion, accel: Vector | None, mag: Vector | None, interval: float) -> None:
        """Take a reading in the body frame, `attitude` being the gyro's since the hole; `interval` in s."""
        if self._begun:  # the first reading ends the hole
            self.elapsed += interval
            self._since_force += interval
        self._begun = True
        if accel is not None:
            self._force.take(rotate(attitude, accel), self._since_force)
            self._since_force = 0.0
        if mag is not None:
            self._field = _added(self._field, rotate(attitude, mag))
            self._fields += 1
        self._find()

    def _find(self) -> None:
        """Least squares over the three angles, by Gauss and Newton; from sample to sample one step is enough."""
        wanted = []
        force = self._force.mean
        if math.hypot(*force) > SHORTEST_VECTOR:
            wanted.append((force, UP, 1.0 / self._tilt.variance(self._force.lasted)))
        if (reference := self._trusted()) is not None:
            wanted.append((self._field, reference, 1.0 / self._field_variance()))
        for _ in range(MOST_STEPS):
            step = self._step(wanted)
            self.turn = normalized(multiply(from_rotation_vector(step), self.turn))
            if math.hypot(*step) < SMALL_STEP:
                break

    def _step(self, wanted: list[tuple[Vector, Vector, float]]) -> Vector:
        """The rotation, rad, that brings each direction nearer to the one it should have, by their weights."""
        gradient = -self._weights @ np.array(_rotation_vector(self.turn))
        precision = self._weights + LEAST_WEIGHT * np.eye(3)
        for seen, direction, weight in wanted:
            gradient += weight * np.array(_turn_to(rotate(self.turn, seen), direction))
            precision += weight * (np.eye(3) - np.outer(direction, direction))
        self._precision = precision
        x, y, z = np.linalg.solve(precision, gradient).tolist()
        return x, y, z

    @property
    def has_field(self) -> bool:
        """Whether the magnetic field is believed to be the one before the hole."""
        return self._trusted() is not None

    def _trusted(self) -> Vector | None:
        if self._reference is None or not self._fields:
            return None
        strength = math.hypot(*self._field) / self._fields
        off = abs(strength - self._reference.strength)
        return self._reference.direction if off < self._reference.tolerance * self._reference.strength else None

    def _field_variance(self) -> float:
        return max(FIELD_ERROR**2 / (self.elapsed + SOONEST), LEAST_FIELD_ERROR**2)


def _added(one: Vector, other: Vector) -> Vector:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _scaled(vector: Vector, factor: float) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]


def _turn_to(one: Vector, other: Vector) -> Vector:
    """The rotation vector, rad, of the shortest turn from the direction of one to that of the other."""
    x, y, z = one
    a, b, c = other
    cx, cy, cz = y * c - z * b, z * a - x * c, x * b - y * a
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    return _scaled((cx, cy, cz), math.atan2(sine, x * a + y * b + z * c) / sine)


def _rotation_vector(rotation: Quaternion) -> Vector:
    """rad, of at most half a turn."""
    w, x, y, z = rotation if rotation[0] >= 0.0 else (-rotation[0], -rotation[1], -rotation[2], -rotation[3])
    sine = math.sqrt(x * x + y * y + z * z)
    return _scaled((x, y, z), 2.0 * math.atan2(sine, w) / sine) if sine > 0.0 else (0.0, 0.0, 0.0)
