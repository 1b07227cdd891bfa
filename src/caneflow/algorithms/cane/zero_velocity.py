"""Strapdown inertial navigation of a foot, which stands still once in every step.

Gyro and accelerometer are integrated to attitude, velocity and position; an error-state Kalman filter follows what
they are off by. While the foot stands, its velocity is zero: an error seen, and with it, by their correlations,
the position's and the tilt's. Between two stances the error grows for a second instead of for the walk.

E. Foxlin, "Pedestrian tracking with shoe-mounted inertial sensors", IEEE CG&A 25(6), 2005; the stance detector
(SHOE) from I. Skog, P. Haendel, J.-O. Nilsson, J. Rantakokko, "Zero-velocity detection - an algorithm evaluation",
IEEE TBME 57(11), 2010.

State error: position, velocity, attitude (a small turn in the world), gyro bias, accelerometer bias; each three.
World: z up, origin and yaw those of the first sample.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import LONGEST_INTERVAL, SampleClock, required_force
from caneflow.algorithms.inertial.initial_attitude import level
from caneflow.algorithms.quantities import Acceleration, Angle, Density, Time, TurnRate
from caneflow.algorithms.rotations import Quaternion, Vector, from_rotation_vector, multiply, normalized, rotate
from caneflow.physics import GRAVITY

Matrix: TypeAlias = NDArray[np.float64]

WALKING = 1.5  # m/s, sd of a foot's velocity when nothing is known
STATES = 15
POSITION, VELOCITY, TILT, GYRO_BIAS, ACCEL_BIAS = (slice(3 * k, 3 * k + 3) for k in range(5))


@dataclass(frozen=True, kw_only=True)
class StanceSettings:
    """When the foot counts as standing: SHOE's test statistic, with noises and threshold as one pair of numbers.

    At the threshold the specific force deviates from gravity by `accel`, or the foot turns by `gyro`: RMS over the
    window, either alone. Skog's noises and threshold, 0.01 m/s^2, 0.1 deg/s and 0.3e5, are 1.7 m/s^2, 17 deg/s.
    """

    window: Time = 0.04  # s; the newest samples
    accel: Acceleration = 1.7  # m/s^2
    gyro: TurnRate = math.radians(17.0)  # rad/s


def worn_on_a_foot() -> GlitchSettings:
    """What is wild on a foot, whose heel strikes: 5 g and 360 deg/s from sample to sample are a step at 100 Hz."""
    return GlitchSettings(acceleration=100.0, turn_rate=math.radians(1000.0))


@dataclass(frozen=True, kw_only=True)
class ZeroVelocitySettings:
    """Noises of the sensors and of a standing foot."""

    stance: StanceSettings = field(default_factory=StanceSettings)
    glitches: GlitchSettings = field(default_factory=worn_on_a_foot)  # of accel and gyro; nothing else is used
    velocity_noise: Density = 0.01  # m/s/sqrt(Hz), of a standing foot, which still rolls a little
    rest_time: Time = 1.0  # s; a stance that lasts longer is not a step: the foot does not turn either
    turn_noise: Density = math.radians(0.05)  # rad/s/sqrt(Hz), of a foot at rest
    accel_noise: Density = 0.02  # m/s^2/sqrt(Hz); with what a foot adds: scale, bandwidth, impacts
    gyro_noise: Density = math.radians(0.02)  # rad/s/sqrt(Hz), likewise
    accel_bias: Acceleration = 0.1  # m/s^2, sd at the start
    gyro_bias: TurnRate = math.radians(0.3)  # rad/s, sd at the start
    accel_bias_walk: Density = 1e-4  # m/s^2/sqrt(s)
    gyro_bias_walk: Density = math.radians(1e-3)  # rad/s/sqrt(s)
    tilt: Angle = math.radians(1.0)  # rad, sd of the inclination read off the first sample


class StanceDetector:
    """SHOE: whether gravity, along the mean specific force, and no turn explain the window."""

    def __init__(self, settings: StanceSettings) -> None:
        self._settings = settings
        self._window: deque[tuple[int, Vector, Vector]] = deque()  # stamp, gyro, accel
        self._span_ns = round(settings.window * 1e9)

    def restart(self) -> None:
        """Forget what was: after a gap."""
        self._window.clear()

    def update(self, stamp_ns: int, gyro: Vector, accel: Vector) -> bool:
        """Whether the foot stands at `stamp_ns`; never before a whole window has been seen."""
        window = self._window
        window.append((stamp_ns, gyro, accel))
        if stamp_ns - window[0][0] < self._span_ns:
            return False
        while stamp_ns - window[1][0] >= self._span_ns:
            window.popleft()
        return self.statistic() < 1.0

    def statistic(self) -> float:
        """The mean over the window of both squared deviations, each over its settings' square."""
        count = len(self._window)
        x = y = z = 0.0
        for _, _, (a, b, c) in self._window:
            x, y, z = x + a, y + b, z + c
        norm = math.sqrt(x * x + y * y + z * z)
        if norm == 0.0:
            return math.inf
        x, y, z = GRAVITY * x / norm, GRAVITY * y / norm, GRAVITY * z / norm
        shaken = turned = 0.0
        for _, (p, q, r), (a, b, c) in self._window:
            shaken += (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2
            turned += p * p + q * q + r * r
        return (shaken / self._settings.accel**2 + turned / self._settings.gyro**2) / count


class ZeroVelocity(DeadReckoning):
    """The strapdown and its error filter; has the shape of a dead reckoning method and needs no orientation."""

    def __init__(self, settings: ZeroVelocitySettings) -> None:
        self._settings = settings
        self._clock = SampleClock()
        self._stance = StanceDetector(settings.stance)
        self._orientation: Quaternion | None = None
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)
        self._gyro_bias: Vector = (0.0, 0.0, 0.0)  # rad/s
        self._accel_bias: Vector = (0.0, 0.0, 0.0)  # m/s^2
        self._gyro: Vector = (0.0, 0.0, 0.0)  # of the sample before, less the bias
        self._force: Vector = (0.0, 0.0, 0.0)  # likewise, in the world
        self._covariance = _initial_covariance(settings)
        self._stood = 0.0  # s, since the last movement
        self.standing = False  # as of the last sample

    @property
    def gaps(self) -> int:
        """How many intervals were longer than LONGEST_INTERVAL; nothing is integrated over them."""
        return self._clock.gaps

    @property
    def gyro_bias(self) -> Vector:
        """rad/s, body."""
        return self._gyro_bias

    @property
    def accel_bias(self) -> Vector:
        """m/s^2, body."""
        return self._accel_bias

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns` from rad/s and m/s^2 in the body frame; it must begin at rest.

        An orientation or linear acceleration by the chip is not used: they are not the strapdown's.
        Raises ValueError without `accel`, or when time does not go on.
        """
        gyro, accel = reading.gyro, required_force(reading.accel, "zero_velocity")
        before = level(accel) if self._orientation is None else self._orientation
        interval = self._clock.interval(stamp_ns)
        gyro_used, force_used = self._less_bias(gyro, accel)
        if interval is None:
            self._orientation, self._force = before, rotate(before, force_used)
        elif interval > LONGEST_INTERVAL:
            self._orientation, self._force = before, rotate(before, force_used)
            self._forget(interval)
        else:
            self._orientation = self._integrate(before, gyro_used, force_used, interval)
            self._propagate(self._orientation, interval)
        self._gyro = gyro_used
        self.standing = self._stance.update(stamp_ns, gyro, accel)
        if self.standing:
            assert interval is not None  # a window is longer than one sample
            self._stop(gyro_used, interval)
        else:
            self._stood = 0.0
        return PoseEstimate(self._position, self._velocity, self._orientation, self._covariance[:6, :6].copy())

    def _less_bias(self, gyro: Vector, accel: Vector) -> tuple[Vector, Vector]:
        a, b, c = self._gyro_bias
        x, y, z = self._accel_bias
        return (gyro[0] - a, gyro[1] - b, gyro[2] - c), (accel[0] - x, accel[1] - y, accel[2] - z)

    def _integrate(self, orientation: Quaternion, gyro: Vector, force: Vector, interval: float) -> Quaternion:
        """One step by the trapezium rule, the force being turned at either end by the attitude of that end."""
        half = 0.5 * interval
        turn = (
            half * (self._gyro[0] + gyro[0]),
            half * (self._gyro[1] + gyro[1]),
            half * (self._gyro[2] + gyro[2]),
        )
        orientation = normalized(multiply(orientation, from_rotation_vector(turn)))
        ax, ay, az = self._force
        bx, by, bz = self._force = rotate(orientation, force)
        vx, vy, vz = self._velocity
        gained_x, gained_y, gained_z = half * (ax + bx), half * (ay + by), half * (az + bz) - interval * GRAVITY
        px, py, pz = self._position
        self._position = (
            px + interval * (vx + 0.5 * gained_x),
            py + interval * (vy + 0.5 * gained_y),
            pz + interval * (vz + 0.5 * gained_z),
        )
        self._velocity = vx + gained_x, vy + gained_y, vz + gained_z
        return orientation

    def _propagate(self, orientation: Quaternion, interval: float) -> None:
        """P over one step: F P F' + Q with F = I + A interval, biases acting in the body."""
        settings = self._settings
        step = np.eye(STATES)
        turned = interval * _matrix(orientation)
        step[0, 3] = step[1, 4] = step[2, 5] = interval
        step[VELOCITY, TILT] = -interval * _cross(self._force)
        step[VELOCITY, ACCEL_BIAS] = -turned
        step[TILT, GYRO_BIAS] = -turned
        noise = np.zeros(STATES)
        noise[VELOCITY] = settings.accel_noise**2 * interval
        noise[TILT] = settings.gyro_noise**2 * interval
        noise[GYRO_BIAS] = settings.gyro_bias_walk**2 * interval
        noise[ACCEL_BIAS] = settings.accel_bias_walk**2 * interval
        covariance = step @ self._covariance @ step.T
        self._covariance = 0.5 * (covariance + covariance.T)
        self._covariance.flat[:: STATES + 1] += noise

    def _forget(self, interval: float) -> None:
        """Integrate nothing over a gap: the state gets as unknown as a walk makes it."""
        self._stance.restart()
        self._stood, self._velocity = 0.0, (0.0, 0.0, 0.0)
        p = self._covariance
        for block, added in ((POSITION, WALKING * interval), (VELOCITY, WALKING), (TILT, 1.0)):
            p[block, block] += added**2 * np.eye(3)

    def _stop(self, gyro: Vector, interval: float) -> None:
        """What a standing foot tells: a velocity of zero and, if it is not a step, a gyro that reads its bias."""
        settings = self._settings
        x, y, z = self._velocity
        self._correct(VELOCITY, (-x, -y, -z), settings.velocity_noise**2 / interval)
        self._stood += interval
        if self._stood >= settings.rest_time:
            self._correct(GYRO_BIAS, gyro, settings.turn_noise**2 / interval)

    def _correct(self, seen: slice, residual: Vector, variance: float) -> None:
        """The Kalman filter's update by three of the states, each seen with a noise of `variance`; Joseph form."""
        p = self._covariance
        across = p[:, seen]  # (STATES, 3)
        spread = p[seen, seen] + variance * np.eye(3)
        gain = np.asarray(np.linalg.solve(spread, across.T).T, dtype=np.float64)
        lost = gain @ across.T
        # (I - K H) P (I - K H)' + K R K', multiplied out: H only picks columns
        self._covariance = p - lost - lost.T + gain @ spread @ gain.T
        self._apply((gain @ np.array(residual)).tolist())

    def _apply(self, error: list[float]) -> None:
        assert self._orientation is not None  # only called with one
        turn = from_rotation_vector((error[6], error[7], error[8]))
        self._position = _sum(self._position, error, 0)
        self._velocity = _sum(self._velocity, error, 3)
        self._gyro_bias = _sum(self._gyro_bias, error, 9)
        self._accel_bias = _sum(self._accel_bias, error, 12)
        self._orientation = normalized(multiply(turn, self._orientation))
        self._force = rotate(turn, self._force)


def _initial_covariance(settings: ZeroVelocitySettings) -> Matrix:
    """Position, velocity and yaw are given by definition."""
    small = 1e-4
    sd = np.empty(STATES)
    sd[POSITION] = sd[VELOCITY] = small
    sd[TILT] = settings.tilt, settings.tilt, small
    sd[GYRO_BIAS], sd[ACCEL_BIAS] = settings.gyro_bias, settings.accel_bias
    return np.diag(sd**2)


def _matrix(orientation: Quaternion) -> Matrix:
    w, x, y, z = orientation
    return np.array(
        (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
    )


def _cross(vector: Vector) -> Matrix:
    x, y, z = vector
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _sum(value: Vector, error: list[float], first: int) -> Vector:
    return value[0] + error[first], value[1] + error[first + 1], value[2] + error[first + 2]
