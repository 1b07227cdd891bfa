"""The paper's Kalman filter (eq. 10), position carried along so that its covariance is known.

Per axis of R0: state (a, v), m/s^2 and m/s; p the position, m, integrated and never corrected, as in the paper.
Q and R are the same on every axis, so one covariance of (a, v, p) serves all three.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.cane.dead_reckoning import (
    DeadReckoning,
    DelayCompensation,
    GroundVelocity,
    PoseEstimate,
    VelocityMeasurement,
)
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import (
    LONGEST_INTERVAL,
    SampleClock,
    required_orientation,
    world_acceleration,
)
from caneflow.algorithms.quantities import Angle, Density, Factor, Fraction, Speed, Time, Zero
from caneflow.algorithms.rotations import Vector
from caneflow.algorithms.scalar_update import updated

INITIAL_ACCELERATION = 3.0  # m/s^2, sd before the first sample and after a gap: the swing's own
INITIAL_VELOCITY = 1.0  # m/s, sd likewise: somewhere between standing and walking
_NO_QUALITY: Final = 1e3  # m/s, a quality that says no more than infinity does


@dataclass(frozen=True, kw_only=True)
class KalmanSettings:
    """Q, R and the slow errors; where each number comes from is in docs/methods/kalman.md."""

    acceleration_walk: Density = 8.0  # m/s^2/sqrt(s), Q: the acceleration's own changes
    velocity_walk: Density | Zero = 0.25  # m/s/sqrt(s), Q: what the acceleration does not explain
    acceleration_noise: Density = 0.1  # m/s^2, R: noise, bias and tilt of the accelerometer
    speed_noise: Density = 0.5  # m/s, R: white equivalent of a speed correlated over its window
    noise_from_quality: bool = False  # R of the speed from its quality index q (eq. 4) instead
    quality_scale: Factor = 8.0  # R = (scale max(q, floor))^2; 8 = sqrt(64 scans in a window)
    quality_floor: Speed = 0.05  # m/s
    heading_error: Angle | Zero = 0.17  # rad, sd of the chip's yaw; covariance only
    heading_correlation: Time = 8.0  # s
    scale_error: Fraction | Zero = 0.05  # relative sd of the speed, constant in a walk; covariance only
    compensate_delay: DelayCompensation = "none"


class AxisCovariance:
    """Covariance of (a, v, p) on one axis: six numbers, symmetric by construction."""

    def __init__(self) -> None:
        self.aa, self.av, self.ap = INITIAL_ACCELERATION**2, 0.0, 0.0
        self.vv, self.vp, self.pp = INITIAL_VELOCITY**2, 0.0, 0.0

    def correct_acceleration(self, noise: float) -> tuple[float, float]:
        """Gains on (a, v) of a measured a with variance `noise`; none on p."""
        return self._correct((self.aa, self.av, self.ap), self.aa + noise)

    def correct_velocity(self, noise: float) -> tuple[float, float]:
        """Gains on (a, v) of a measured v with variance `noise`; none on p."""
        return self._correct((self.av, self.vv, self.vp), self.vv + noise)

    def predict(self, interval: float, acceleration_noise: float, velocity_noise: float) -> None:
        """One step of a' = a + w_a, v' = v + T a + w_v, p' = p + T v'; the noises are variances of the step."""
        aa, av, ap = self.aa, self.av, self.ap
        vp = self.vp + interval * ap  # of the new v with the old p
        self.vv += 2.0 * interval * av + interval * interval * aa + velocity_noise
        self.av = av + interval * aa
        self.aa = aa + acceleration_noise
        self.ap = ap + interval * self.av
        self.pp += 2.0 * interval * vp + interval * interval * self.vv
        self.vp = vp + interval * self.vv

    def _correct(self, across: Vector, spread: float) -> tuple[float, float]:
        # without the gain on p, pp stays as it was; by Joseph's form nothing else depends on that gain
        covariance = self.aa, self.av, self.ap, self.vv, self.vp, self.pp
        (k_a, k_v, _), (self.aa, self.av, self.ap, self.vv, self.vp, _) = updated(covariance, across, spread)
        return k_a, k_v

    def forget(self, interval: float) -> None:
        """A gap, where Q does not reach: a and v as unknown as at the start, p by what such a v may have added."""
        self.aa, self.av, self.ap = INITIAL_ACCELERATION**2, 0.0, 0.0
        self.vv = INITIAL_VELOCITY**2
        self.vp = interval * self.vv
        self.pp += interval * self.vp


class SlowError:
    """What an error that outlives the filter's memory does to the position: first-order Gauss-Markov, sd and time.

    The velocity's error is `direction` times the scalar error, the position's its integral. The filter follows
    such an error as if it were motion, so it is in no innovation; it must be carried beside the filter.
    """

    def __init__(self, sd: float, correlation: float) -> None:
        self._variance = sd * sd
        self._correlation = correlation  # s
        self._jx = self._jy = 0.0  # direction of the velocity's error
        self._mx = self._my = 0.0  # covariance of the position's error with the scalar error
        self.xx = self.xy = self.yy = 0.0  # m^2, covariance of the position's error

    def advance(self, interval: float, jx: float, jy: float) -> None:
        """One step: the error decays, the position's error grows along (jx, jy)."""
        decay = math.exp(-interval / self._correlation)
        mx, my = decay * self._mx, decay * self._my
        gx, gy = interval * jx, interval * jy
        variance = self._variance
        self.xx += gx * (2.0 * mx + gx * variance)
        self.xy += gx * my + gy * mx + gx * gy * variance
        self.yy += gy * (2.0 * my + gy * variance)
        self._mx, self._my = mx + gx * variance, my + gy * variance
        self._jx, self._jy = jx, jy

    def velocity_terms(self) -> tuple[float, float, float]:
        """Covariance xx, xy, yy of the velocity's error, m^2/s^2."""
        jx, jy, variance = self._jx, self._jy, self._variance
        return jx * jx * variance, jx * jy * variance, jy * jy * variance

    def cross_terms(self) -> tuple[float, float, float, float]:
        """Covariance of position (row) and velocity (column): xx, xy, yx, yy, m^2/s."""
        jx, jy, mx, my = self._jx, self._jy, self._mx, self._my
        return mx * jx, mx * jy, my * jx, my * jy


class KalmanFilter(DeadReckoning):
    """One state (a, v) per axis of R0 and one covariance for all; predicts from IMU sample to IMU sample.

    As in eq. 9 the sample k corrects the state at k, and what is given out at k+1 is the prediction from it.
    Over a gap (more than LONGEST_INTERVAL) the last velocity holds and the covariance forgets it.
    """

    def __init__(self, settings: KalmanSettings, *, boresight: Vector) -> None:
        self._settings = settings
        self._clock = SampleClock()
        self._ground = GroundVelocity(boresight, compensate_delay=settings.compensate_delay)
        self._axis = AxisCovariance()
        self._heading_error = SlowError(settings.heading_error, settings.heading_correlation)
        self._scale_error = SlowError(settings.scale_error, math.inf)
        self._measured: Vector = (0.0, 0.0, 0.0)  # acceleration of the last sample
        self._acceleration: Vector = (0.0, 0.0, 0.0)
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._clock.gaps

    @property
    def acceleration(self) -> Vector:
        """The acceleration part of the state, m/s^2, R0."""
        return self._acceleration

    @property
    def axis_covariance(self) -> NDArray[np.float64]:
        """Covariance of (a, v, p) on any one axis, shape (3, 3), without the slow errors."""
        axis = self._axis
        return np.array(((axis.aa, axis.av, axis.ap), (axis.av, axis.vv, axis.vp), (axis.ap, axis.vp, axis.pp)))

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Take a new ground speed (m/s) and its quality (m/s)."""
        self._ground.speed(stamp_ns, speed, quality, valid, delay)

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`, with the covariance of position and velocity.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        orientation = required_orientation(reading.orientation, "kalman")
        acceleration = world_acceleration(orientation, reading, "kalman")
        interval = self._clock.interval(stamp_ns)
        if interval is not None:
            self._correct(self._ground.take(stamp_ns))
            self._predict(interval)
        self._ground.imu(stamp_ns, orientation, acceleration, interval)
        self._measured = acceleration
        return PoseEstimate(self._position, self._velocity, orientation, self._covariance())

    def _correct(self, ground: VelocityMeasurement | None) -> None:
        gains = self._axis.correct_acceleration(self._settings.acceleration_noise**2)
        self._apply(gains, _difference(self._measured, self._acceleration))
        if ground is not None:
            gains = self._axis.correct_velocity(self._speed_variance(ground.quality))
            self._apply(gains, _difference((ground.x, ground.y, 0.0), self._velocity))

    def _apply(self, gains: tuple[float, float], innovation: Vector) -> None:
        k_a, k_v = gains
        dx, dy, dz = innovation
        ax, ay, az = self._acceleration
        vx, vy, vz = self._velocity
        self._acceleration = ax + k_a * dx, ay + k_a * dy, az + k_a * dz
        self._velocity = vx + k_v * dx, vy + k_v * dy, vz + k_v * dz

    def _predict(self, interval: float) -> None:
        settings = self._settings
        step = interval
        if interval > LONGEST_INTERVAL:
            step = 0.0
            self._axis.forget(interval)
        else:
            self._axis.predict(interval, settings.acceleration_walk**2 * interval, settings.velocity_walk**2 * interval)
        ax, ay, az = self._acceleration
        vx, vy, vz = self._velocity
        vx, vy, vz = vx + step * ax, vy + step * ay, vz + step * az
        px, py, pz = self._position
        self._velocity = vx, vy, vz
        self._position = px + interval * vx, py + interval * vy, pz + interval * vz
        self._heading_error.advance(interval, -vy, vx)
        self._scale_error.advance(interval, vx, vy)

    def _speed_variance(self, quality: float) -> float:
        settings = self._settings
        if not settings.noise_from_quality:
            return settings.speed_noise**2
        return (settings.quality_scale * min(max(quality, settings.quality_floor), _NO_QUALITY)) ** 2

    def _covariance(self) -> NDArray[np.float64]:
        """(6, 6) of position and velocity: the filter's own plus the slow errors' in the plane."""
        pp, vp, vv = self._axis.pp, self._axis.vp, self._axis.vv
        h, s = self._heading_error, self._scale_error
        (hvxx, hvxy, hvyy), (svxx, svxy, svyy) = h.velocity_terms(), s.velocity_terms()
        (hxx, hxy, hyx, hyy), (sxx, sxy, syx, syy) = h.cross_terms(), s.cross_terms()
        xy, cross_xy, cross_yx, velocity_xy = h.xy + s.xy, hxy + sxy, hyx + syx, hvxy + svxy
        cross_xx, cross_yy = vp + hxx + sxx, vp + hyy + syy
        return np.array(
            (
                (pp + h.xx + s.xx, xy, 0.0, cross_xx, cross_xy, 0.0),
                (xy, pp + h.yy + s.yy, 0.0, cross_yx, cross_yy, 0.0),
                (0.0, 0.0, pp, 0.0, 0.0, vp),
                (cross_xx, cross_yx, 0.0, vv + hvxx + svxx, velocity_xy, 0.0),
                (cross_xy, cross_yy, 0.0, velocity_xy, vv + hvyy + svyy, 0.0),
                (0.0, 0.0, vp, 0.0, 0.0, vv),
            )
        )


def _difference(left: Vector, right: Vector) -> Vector:
    return left[0] - right[0], left[1] - right[1], left[2] - right[2]
