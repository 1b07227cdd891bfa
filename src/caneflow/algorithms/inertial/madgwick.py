"""Madgwick's orientation filter by gradient descent, in its original formulation.

S. O. H. Madgwick, A. J. L. Harrison, R. Vaidyanathan, "Estimation of IMU and MARG orientation using a gradient
descent algorithm", ICORR 2011: the filter that the room paper's IMU runs. The equation numbers are those of the
internal report of 2010 with the longer derivation. Two things differ: the world has y, not x, at magnetic north
(a turn by 90 degrees, which the filter does not notice), and it starts from the first reading instead of from
the identity. A third: its gain corrects 5 degrees per second, so that an attitude that a hole in the samples has
turned would stay wrong for long, or for good; for some seconds after one, attitude_recovery corrects it instead,
from the turn that unseen_turn has learnt of the seconds before. Without holes the filter is the printed one.
"""

import math
from dataclasses import dataclass

from caneflow.algorithms.inertial.attitude_recovery import (
    LEAST_LEVEL,
    SMALLEST,
    Covariance,
    Holes,
    Recovery,
    UndisturbedField,
    alike,
    covariance_sum,
    largest_spread,
)
from caneflow.algorithms.inertial.imu_sample import LONGEST_INTERVAL, SampleClock
from caneflow.algorithms.inertial.initial_attitude import AttitudeEstimate, initial_attitude, required_start
from caneflow.algorithms.inertial.magnetometer_lag import MagnetometerLag
from caneflow.algorithms.inertial.mean_force import TiltError
from caneflow.algorithms.inertial.unseen_turn import Bridged, UnseenTurn, turned_about
from caneflow.algorithms.quantities import Density, TurnRate, Zero
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    conjugate,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
)

FIELD_MEMORY = 20.0  # s, over which the field is averaged that a hole is bridged with
FIELD_TOLERANCE = 0.1  # relative, of its strength

Gradient = Quaternion  # of the objective function, by w x y z


@dataclass(frozen=True, kw_only=True)
class MadgwickSettings:
    """The two gains; Madgwick's own values for the MARG array."""

    gain: TurnRate | Zero = 0.041  # rad/s, beta: how fast gyro error is corrected (eq. 50)
    bias_gain: Density | Zero = 0.0  # rad/s^2, zeta: how fast the gyro's bias may drift (eq. 51)


class Madgwick:
    """q' = q/2 * gyro - beta grad f / |grad f|, with f the misfit of gravity and of the magnetic field."""

    def __init__(self, settings: MadgwickSettings) -> None:
        self._settings = settings
        self._clock = SampleClock()
        self._orientation: Quaternion | None = None
        self._bias: Vector = (0.0, 0.0, 0.0)  # rad/s
        self._gyro: Vector = (0.0, 0.0, 0.0)  # rad/s, of the sample before
        self._holes = Holes()
        self._recovery: Recovery | None = None  # since the last hole
        self._unseen = UnseenTurn()
        self._bridged: Bridged | None = None  # until the turn in the last hole is known
        self._unknown: Covariance | None = None  # of the attitude before the last hole, after another one
        self._lag = MagnetometerLag()  # taken off in a recovery, where a second of the field counts
        self._field = (0.0, 0.0)  # horizontal and vertical, mean of what was read
        self._field_time = 0.0  # s, that it has been averaged over

    @property
    def gaps(self) -> int:
        """How many intervals were longer than LONGEST_INTERVAL; the gyro is not integrated over them."""
        return self._clock.gaps

    def update(self, stamp_ns: int, gyro: Vector, accel: Vector | None, mag: Vector | None = None) -> AttitudeEstimate:
        """The estimate at `stamp_ns` from a reading in the body frame: rad/s, m/s^2, any unit.

        Without `accel` the gyro alone goes on; without `mag` nothing corrects the yaw.
        Raises ValueError when time does not go on, or for a first reading without `accel`.
        """
        if self._orientation is None:
            start = initial_attitude(required_start(accel, "madgwick"), mag)
            self._clock.interval(stamp_ns)
            self._orientation, self._gyro = start, gyro
            return AttitudeEstimate(start, self._bias)
        interval = self._clock.interval(stamp_ns)
        assert interval is not None  # the clock has had its first stamp
        if self._is_hole(interval, gyro, accel):
            self._orientation = self._over_hole(self._orientation, gyro, interval)
        elif interval <= LONGEST_INTERVAL:
            self._orientation = self._turned(self._orientation, gyro, accel, mag, interval)
        self._gyro = gyro
        if self._recovery is not None:
            recovery = self._recovery
            mag = None if mag is None else self._lag.taken_off(mag, gyro)
            return AttitudeEstimate(self._recovered(recovery, accel, mag, interval), self._bias, recovery.spread)
        return AttitudeEstimate(self._orientation, self._bias)

    def _turned(
        self, q: Quaternion, gyro: Vector, accel: Vector | None, mag: Vector | None, interval: float
    ) -> Quaternion:
        self._unseen.take(interval, gyro)
        q = self._with_turn_found(q)
        if self._recovery is not None:
            return self._advanced(q, gyro, None, None, interval)
        q = self._advanced(q, gyro, accel, mag, interval)
        self._remember_field(q, gyro, mag, interval)
        return q

    def _is_hole(self, interval: float, gyro: Vector, accel: Vector | None) -> bool:
        """Whether samples are missing; where that may matter, a recovery begins."""
        spread = self._holes.spread(interval, gyro, accel)
        if spread == 0.0:
            return False
        self._unknown = None
        if self._recovery is not None:
            self._unknown = self._recovery.covariance
            self._end_recovery(self._recovery)
        self._unseen.begin(interval)
        if spread > SMALLEST or self._unknown is not None:
            self._begin_recovery(covariance_sum(alike(spread), self._unknown))
        return True

    def _begin_recovery(self, covariance: Covariance | None) -> None:
        self._lag.restart()
        self._recovery = Recovery(covariance, TiltError(self._holes.speed), self._undisturbed())

    def _over_hole(self, q: Quaternion, gyro: Vector, interval: float) -> Quaternion:
        """By the mean of the readings at both ends, until it is known how they went on changing."""
        (ax, ay, az), (x, y, z), (bx, by, bz) = self._gyro, gyro, self._bias
        turn = interval * (0.5 * (ax + x) - bx), interval * (0.5 * (ay + y) - by), interval * (0.5 * (az + z) - bz)
        after = normalized(multiply(q, from_rotation_vector(turn))) if interval <= LONGEST_INTERVAL else q
        self._bridged = Bridged(q, after, interval, self._unknown)
        return after

    def _with_turn_found(self, q: Quaternion) -> Quaternion:
        """The attitude, with the turn in the last hole as it is known now, if it has just become known."""
        found = self._unseen.found()
        if found is None or self._bridged is None:
            return q
        bridged, self._bridged = self._bridged, None
        if self._recovery is not None:
            self._recovery = None
            covariance = covariance_sum(turned_about(bridged.before, found.covariance), bridged.unknown)
            if largest_spread(covariance) > SMALLEST:
                self._begin_recovery(covariance)
        return normalized(multiply(bridged.missing(found, self._bias), q))

    def _recovered(self, recovery: Recovery, accel: Vector | None, mag: Vector | None, interval: float) -> Quaternion:
        """The gyro's attitude with what was found of the turn in the hole."""
        assert self._orientation is not None
        recovery.update(self._orientation, accel, mag, interval)
        found = normalized(multiply(recovery.turn, self._orientation))
        if recovery.over:
            self._end_recovery(recovery)
        return found

    def _end_recovery(self, recovery: Recovery) -> None:
        assert self._orientation is not None
        self._orientation = normalized(multiply(recovery.turn, self._orientation))
        self._recovery = None

    def _remember_field(self, q: Quaternion, gyro: Vector, mag: Vector | None, interval: float) -> None:
        if mag is None:
            return
        self._lag.learn(rotate(q, mag), rotate(q, gyro), interval)
        east, north, vertical = rotate(q, mag)
        self._field_time = min(self._field_time + interval, FIELD_MEMORY)
        share, (level, up) = interval / self._field_time, self._field
        self._field = level + share * (math.hypot(east, north) - level), up + share * (vertical - up)

    def _undisturbed(self) -> UndisturbedField | None:
        level, up = self._field
        strength = math.hypot(level, up)
        if not level > LEAST_LEVEL * strength:
            return None
        direction = 0.0, level / strength, up / strength
        return UndisturbedField(direction=direction, strength=strength, tolerance=FIELD_TOLERANCE)

    def _advanced(
        self, q: Quaternion, gyro: Vector, accel: Vector | None, mag: Vector | None, interval: float
    ) -> Quaternion:
        step = objective_gradient(q, accel, mag)
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + step[3] ** 2)
        gain = self._settings.gain
        # where there is nothing to correct, nothing is corrected
        if length > 1e-12:
            step = step[0] / length, step[1] / length, step[2] / length, step[3] / length
            self._correct_bias(q, step, interval)
        bx, by, bz = self._bias
        turn = multiply(q, (0.0, gyro[0] - bx, gyro[1] - by, gyro[2] - bz))
        return normalized(
            (
                q[0] + interval * (0.5 * turn[0] - gain * step[0]),
                q[1] + interval * (0.5 * turn[1] - gain * step[1]),
                q[2] + interval * (0.5 * turn[2] - gain * step[2]),
                q[3] + interval * (0.5 * turn[3] - gain * step[3]),
            )
        )

    def _correct_bias(self, q: Quaternion, step: Gradient, interval: float) -> None:
        """Eq. 47 to 49: the direction of the error, as a rate of turn, summed up."""
        _, ex, ey, ez = multiply(conjugate(q), step)
        rate = 2.0 * self._settings.bias_gain * interval
        bx, by, bz = self._bias
        self._bias = bx + rate * ex, by + rate * ey, bz + rate * ez


def objective_gradient(q: Quaternion, accel: Vector | None, mag: Vector | None) -> Gradient:
    """J' f of eq. 34 for gravity and, where there is one, the magnetic field; zero without either.

    The field's reference has no east part: its direction in the plane is what is looked for, and its dip is taken
    from the reading itself (eq. 45 and 46), so that a disturbance can turn yaw alone.
    """
    gradient = 0.0, 0.0, 0.0, 0.0
    up = None if accel is None else _direction(accel)
    if up is not None:
        gradient = _misfit_gradient(q, 0.0, 1.0, up)
    field = None if mag is None else _direction(mag)
    if field is not None:
        east, north, vertical = rotate(q, field)
        w, x, y, z = _misfit_gradient(q, math.hypot(east, north), vertical, field)
        gradient = gradient[0] + w, gradient[1] + x, gradient[2] + y, gradient[3] + z
    return gradient


def _misfit_gradient(q: Quaternion, north: float, vertical: float, measured: Vector) -> Gradient:
    """J' f for f = q* (0, north, vertical) q - measured (eq. 21 to 31)."""
    w, x, y, z = q
    fx = 2.0 * (north * (x * y + w * z) + vertical * (x * z - w * y)) - measured[0]
    fy = 2.0 * (north * (0.5 - x * x - z * z) + vertical * (y * z + w * x)) - measured[1]
    fz = 2.0 * (north * (y * z - w * x) + vertical * (0.5 - x * x - y * y)) - measured[2]
    n, v = 2.0 * north, 2.0 * vertical
    return (
        (n * z - v * y) * fx + v * x * fy - n * x * fz,
        (n * y + v * z) * fx + (v * w - 2.0 * n * x) * fy - (n * w + 2.0 * v * x) * fz,
        (n * x - v * w) * fx + v * z * fy + (n * z - 2.0 * v * y) * fz,
        (n * w + v * x) * fx + (v * y - 2.0 * n * z) * fy + n * y * fz,
    )


def _direction(vector: Vector) -> Vector | None:
    x, y, z = vector
    norm = math.sqrt(x * x + y * y + z * z)
    return (x / norm, y / norm, z / norm) if norm > 1e-9 else None
