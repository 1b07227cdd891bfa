"""Attitude from gyro, accelerometer and magnetometer, each used for what it alone knows.

The gyro, less its bias, turns an attitude from sample to sample: exact, and it drifts. A reading counts for the
interval before it: a gyro averages over at least that, or its readings would alias. In the world so found the
motion's own acceleration averages out over a few seconds, since nobody speeds up forever, and what is left of the
specific force is gravity: it is low-passed *there*, not in the turning body, and the attitude is turned by just so
much that it points up. Yaw is corrected by the magnetometer alone, and only as far as the field looks undisturbed;
inclination never is. What has to be corrected again and again is the gyro's bias.

Low-passing in an almost inertial frame, by a Butterworth filter of order 2, is VQF's: D. Laidig, T. Seel, "VQF: Highly
accurate IMU orientation estimation with bias estimation and magnetic disturbance rejection", Information Fusion 91,
2023. Here its steps may differ in length, and a scalar Kalman filter follows yaw.

World: x east, y magnetic north, z up.
"""

import math
from dataclasses import dataclass, field
from typing import TypeVar, cast

from caneflow.algorithms.inertial.attitude_recovery import (
    FIELD_ERROR,
    SMALLEST,
    Covariance,
    Holes,
    Recovery,
    alike,
    covariance_sum,
    largest_spread,
)
from caneflow.algorithms.inertial.gyro_bias import (
    NOTHING_SEEN,
    GyroBias,
    GyroBiasSettings,
    RestDetector,
    Row,
    followed_row,
    horizontal_rows,
    vertical_row,
)
from caneflow.algorithms.inertial.imu_sample import LONGEST_INTERVAL, SampleClock
from caneflow.algorithms.inertial.initial_attitude import AttitudeEstimate, level, required_start
from caneflow.algorithms.inertial.magnetic_heading import MagneticHeading, MagneticHeadingSettings
from caneflow.algorithms.inertial.magnetometer_lag import MagnetometerLag
from caneflow.algorithms.inertial.mean_force import ForceWander
from caneflow.algorithms.inertial.unseen_turn import Bridged, UnseenTurn, turned_about
from caneflow.algorithms.quantities import Time
from caneflow.algorithms.rotations import (
    Quaternion,
    Vector,
    from_rotation_vector,
    from_yaw,
    multiply,
    normalized,
    rotate,
)

SETTLING = 3.0  # delays of the low pass after which its corrections tell of the gyro's bias
LEAST_FORCE = 1.0  # m/s^2; a mean specific force below is free fall, or no accelerometer


@dataclass(frozen=True, kw_only=True)
class AttitudeFilterSettings:
    """How long motion is averaged over; the magnetometer; the gyro's bias."""

    inclination_time: Time = 3.0  # s, delay of the low pass of the specific force
    heading: MagneticHeadingSettings = field(default_factory=MagneticHeadingSettings)
    bias: GyroBiasSettings = field(default_factory=GyroBiasSettings)


class AttitudeFilter:
    """Raw readings in, attitude out; every reading but the first may lack accelerometer or magnetometer."""

    def __init__(self, settings: AttitudeFilterSettings) -> None:
        self._clock = SampleClock()
        self._attitude: Quaternion | None = None  # body to world but for yaw, which the gyro integrates
        self._gyro: Vector = (0.0, 0.0, 0.0)  # of the sample before
        self._gravity = _Gravity(settings.inclination_time)
        self._heading = MagneticHeading(settings.heading)
        self._lag = MagnetometerLag()
        self._since_accel = self._since_field = 0.0  # s since the last reading of each
        self._rest = RestDetector(settings.bias)
        self._bias = GyroBias(settings.bias)
        self._holes = Holes()
        self._recovery: Recovery | None = None  # since the last hole
        self._opened = 0.0  # s, by which the variance of yaw was opened for it
        self._unseen = UnseenTurn()
        self._wander = ForceWander()
        self._bridged: Bridged | None = None  # until the turn in the last hole is known better

    @property
    def gaps(self) -> int:
        """How many intervals were longer than LONGEST_INTERVAL; after each the attitude starts again."""
        return self._clock.gaps

    @property
    def at_rest(self) -> bool:
        """Whether the last sample was one at rest, when the gyro's bias is learnt."""
        return self._rest.at_rest

    @property
    def disturbed(self) -> bool:
        """Whether the last magnetometer reading was out of tolerance."""
        return self._heading.disturbed

    @property
    def bias_sd(self) -> Vector:
        """rad/s, standard deviation of the gyro's bias per axis of the body."""
        return self._bias.sd

    def update(self, stamp_ns: int, gyro: Vector, accel: Vector | None, mag: Vector | None = None) -> AttitudeEstimate:
        """The estimate at `stamp_ns` from a reading in the body frame: rad/s, m/s^2, any unit.

        Raises ValueError when time does not go on, or for a first reading without `accel`.
        """
        attitude, interval = self._predicted(stamp_ns, gyro, accel)
        self._gyro = gyro
        if mag is not None:
            mag = self._less_lag(attitude, gyro, mag, interval)
        if self._recovery is None:
            self._attitude = self._corrected(attitude, gyro, accel, mag, interval)
            return AttitudeEstimate(self._with_yaw(self._attitude), self._bias.bias)
        recovery, self._attitude = self._recovery, attitude
        found = self._found(recovery, attitude, gyro, accel, mag, interval)
        if recovery.over:
            self._attitude, _ = self._with_recovery_ended(recovery, attitude)
        return AttitudeEstimate(self._with_yaw(found), self._bias.bias, recovery.spread)

    def _less_lag(self, attitude: Quaternion, gyro: Vector, mag: Vector, interval: float) -> Vector:
        """The magnetometer's reading, without what it lags behind the gyro."""
        if self._recovery is not None:
            self._lag.restart()
        else:
            self._lag.learn(rotate(attitude, mag), rotate(attitude, gyro), self._since_field + interval)
        return self._lag.taken_off(mag, gyro)

    def _predicted(self, stamp_ns: int, gyro: Vector, accel: Vector | None) -> tuple[Quaternion, float]:
        """The attitude by the gyro alone, and the s over which it was integrated."""
        if self._attitude is None:
            start = level(required_start(accel, "attitude_filter"))
            self._clock.interval(stamp_ns)
            return start, 0.0
        interval = self._clock.interval(stamp_ns)
        assert interval is not None  # the clock has had its first stamp
        spread = self._holes.spread(interval, gyro, accel)
        if spread == 0.0 and interval <= LONGEST_INTERVAL:
            self._unseen.take(interval, gyro)
            return self._turned(self._with_turn_found(self._attitude), gyro, interval), interval
        return self._over_hole(self._attitude, interval, gyro, spread)

    def _over_hole(self, before: Quaternion, interval: float, gyro: Vector, spread: float) -> tuple[Quaternion, float]:
        """By the turn rates at both ends, until it is known how they went on changing."""
        unknown = None
        if self._recovery is not None:
            before, unknown = self._with_recovery_ended(self._recovery, before)
        self._unseen.begin(interval)
        attitude = before
        if interval <= LONGEST_INTERVAL:
            (ax, ay, az), (bx, by, bz) = self._gyro, gyro
            attitude = self._turned(before, (0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz)), interval)
        elif spread == 0.0:  # a sensor that is always that slow
            spread = math.inf
        self._bridged = Bridged(before, attitude, interval, unknown)
        if spread > SMALLEST or unknown is not None:
            self._begin_recovery(covariance_sum(alike(spread), unknown))
            interval = 0.0
        return attitude, interval

    def _with_turn_found(self, attitude: Quaternion) -> Quaternion:
        """The attitude, with the turn in the last hole as it is known now, if it has just become known."""
        found = self._unseen.found()
        if found is None or self._bridged is None:
            return attitude
        bridged, self._bridged = self._bridged, None
        if self._recovery is not None:
            self._recovery = None
            self._heading.close(self._opened)
            covariance = covariance_sum(turned_about(bridged.before, found.covariance), bridged.unknown)
            if largest_spread(covariance) > SMALLEST:
                self._begin_recovery(covariance)
        return normalized(multiply(bridged.missing(found, self._bias.bias), attitude))

    def _turned(self, attitude: Quaternion, rate: Vector, interval: float) -> Quaternion:
        """At a turn rate (rad/s), less the bias."""
        x, y, z = rate
        bx, by, bz = self._bias.bias
        turn = from_rotation_vector((interval * (x - bx), interval * (y - by), interval * (z - bz)))
        return normalized(multiply(attitude, turn))

    def _begin_recovery(self, covariance: Covariance | None) -> None:
        """Look for a rotation of the world of which so much is known before; None: nothing."""
        self._rest.restart()
        self._wander.restart()
        tilt = self._wander.error(self._holes.speed)
        self._recovery = Recovery(covariance, tilt, self._heading.undisturbed())
        about_vertical = math.inf if covariance is None else math.sqrt(float(covariance[2, 2]))
        self._opened = self._heading.open(about_vertical / FIELD_ERROR)

    def _found(
        self,
        recovery: Recovery,
        attitude: Quaternion,
        gyro: Vector,
        accel: Vector | None,
        mag: Vector | None,
        interval: float,
    ) -> Quaternion:
        """The attitude with what was found of the turn in the hole."""
        recovery.update(attitude, accel, mag, interval)
        found = normalized(multiply(recovery.turn, attitude))
        self._since_field += interval
        if mag is not None:
            if not recovery.has_field:
                row = vertical_row(found, self._bias.bias)
                self._heading.update(rotate(found, mag), row, gyro, self._since_field, levelled=False)
            self._since_field = 0.0
        return found

    def _with_recovery_ended(self, recovery: Recovery, attitude: Quaternion) -> tuple[Quaternion, Covariance]:
        """The attitude with the rotation that was found, from which the steady state goes on, and its covariance."""
        self._gravity.restart(recovery.force, recovery.elapsed)
        if recovery.has_field:
            self._heading.averaged(recovery.elapsed)
        self._since_accel = self._since_field = 0.0
        self._recovery = None
        return normalized(multiply(recovery.turn, attitude)), recovery.covariance

    def _corrected(
        self, attitude: Quaternion, gyro: Vector, accel: Vector | None, mag: Vector | None, interval: float
    ) -> Quaternion:
        tilt = turn = None
        self._since_accel += interval
        self._since_field += interval
        if accel is not None:
            rows = horizontal_rows(attitude, self._bias.bias)
            force = rotate(attitude, accel)
            if self._gravity.levelled:
                self._wander.take(force, self._since_accel)
            correction = self._gravity.update(force, rows, self._since_accel)
            self._since_accel = 0.0
            if correction is not None:
                attitude = multiply(correction, attitude)
                tilt = 2.0 * correction[1], 2.0 * correction[2]
        if mag is not None:
            row = vertical_row(attitude, self._bias.bias)
            turn = self._heading.update(
                rotate(attitude, mag), row, gyro, self._since_field, levelled=self._gravity.levelled
            )
            self._since_field = 0.0
        if interval > 0.0:
            self._learn_bias(gyro, accel, tilt, turn, interval)
        return attitude

    def _learn_bias(
        self,
        gyro: Vector,
        accel: Vector | None,
        tilt: tuple[float, float] | None,
        turn: float | None,
        interval: float,
    ) -> None:
        if accel is not None and self._rest.update(gyro, accel, interval):
            self._bias.at_rest(gyro, self._rest.deviation, interval)
        if not self._gravity.settled:
            tilt = None
        self._bias.corrected(tilt, self._gravity.rows, turn, self._heading.row, interval)

    def _with_yaw(self, attitude: Quaternion) -> Quaternion:
        return normalized(multiply(from_yaw(self._heading.offset), attitude))


class _Gravity:
    """The specific force behind a Butterworth low pass of order 2, in a world that is turned until it points up.

    Its delay is `delay`, as that of two first-order low passes of half of it each, but a motion's acceleration, above
    the corner of sqrt(2) / delay, gets through half as much.
    """

    def __init__(self, delay: float) -> None:
        self._delay = delay  # s
        self._step = _LowPassStep(0.0, delay)
        self.restart()

    def restart(self, force: Vector | None = None, elapsed: float = 0.0) -> None:
        """Take `force`, a mean over `elapsed` s, or the next as it is; from there the mean, while that is younger."""
        self._mean: Vector | None = force
        self._rise: Vector = (0.0, 0.0, 0.0)  # what it changes by, in units of the corner frequency
        self.rows = (NOTHING_SEEN, NOTHING_SEEN)
        self._row_rises = (NOTHING_SEEN, NOTHING_SEEN)
        self._elapsed = elapsed  # s

    @property
    def levelled(self) -> bool:
        """Whether most of an error of the start is gone."""
        return self._elapsed > self._delay

    @property
    def settled(self) -> bool:
        """Whether what is corrected is no longer an error of the start."""
        return self._elapsed > SETTLING * self._delay

    @staticmethod
    def usable(force: Vector) -> bool:
        """Whether a force has a direction; one in free fall has none."""
        return force[0] ** 2 + force[1] ** 2 + force[2] ** 2 > LEAST_FORCE**2

    def update(self, force: Vector, rows: tuple[Row, Row], interval: float) -> Quaternion | None:
        """The turn that keeps gravity up; None for the first force, and where nothing tells what is up."""
        if self._mean is None:
            self._mean = force
            return None
        self._elapsed += interval
        if self._elapsed < self._delay:
            share = interval / self._elapsed if self._elapsed > 0.0 else 1.0
            self._mean = _followed(self._mean, force, share)
            self.rows = followed_row(self.rows[0], rows[0], share), followed_row(self.rows[1], rows[1], share)
        else:
            self._follow(force, rows, interval)
        if not self.usable(self._mean):
            return None
        correction = level(self._mean)
        self._mean, self._rise = rotate(correction, self._mean), rotate(correction, self._rise)
        return correction

    def _follow(self, force: Vector, rows: tuple[Row, Row], interval: float) -> None:
        if interval != self._step.interval:
            self._step = _LowPassStep(interval, self._delay)
        assert self._mean is not None
        (x_row, y_row), (x_rise, y_rise) = self.rows, self._row_rises
        self._mean, self._rise = self._step.of(self._mean, self._rise, force)
        x_row, x_rise = self._step.of(x_row, x_rise, rows[0])
        y_row, y_rise = self._step.of(y_row, y_rise, rows[1])
        self.rows, self._row_rises = (x_row, y_row), (x_rise, y_rise)


V = TypeVar("V", Vector, Row)


class _LowPassStep:
    """One step of a second-order Butterworth low pass, exact for an input that holds over it."""

    def __init__(self, interval: float, delay: float) -> None:
        """Both in s; the corner is at sqrt(2) / delay, rad/s."""
        self.interval = interval
        angle = interval / delay
        fallen = math.exp(-angle)
        cosine, sine = fallen * math.cos(angle), fallen * math.sin(angle)
        self._off_off, self._off_rise = cosine + sine, math.sqrt(2.0) * sine
        self._rise_off, self._rise_rise = -math.sqrt(2.0) * sine, cosine - sine

    def of(self, mean: V, rise: V, target: V) -> tuple[V, V]:
        """The output and what it changes by, after a step with the input `target`."""
        a, b, c, d = self._off_off, self._off_rise, self._rise_off, self._rise_rise
        off = [m - t for m, t in zip(mean, target, strict=True)]
        moved = tuple([t + a * o + b * r for t, o, r in zip(target, off, rise, strict=True)])
        risen = tuple([c * o + d * r for o, r in zip(off, rise, strict=True)])
        return cast(V, moved), cast(V, risen)


def _followed(value: Vector, target: Vector, share: float) -> Vector:
    x, y, z = value
    return x + share * (target[0] - x), y + share * (target[1] - y), z + share * (target[2] - z)
