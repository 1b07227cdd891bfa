"""Velocity and position over ground in the gyro's frame: a Kalman filter on accelerometer, radar and gait.

State x = (p_x, p_y, v_x, v_y, b_f, b_l, beta): position m and velocity m/s of the IMU's origin in the gyro's frame,
bias of the accelerometer along the boresight's projection and to its left, m/s^2 (the chip's tilt error included),
and the angle by which the cane points to the right of where its bearer walks, rad.

The gyro's frame turns with the errors of the gyro; a turn of a degree in three seconds does not touch velocities. What
it does to the track is the business of heading_hypotheses.py.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Acceleration, Angle, Density, Factor, Speed, Zero
from caneflow.algorithms.scalar_update import update

Floats = NDArray[np.float64]

_PX, _PY, _VX, _VY, _BF, _BL, _BETA = range(7)
_IDENTITY: Final = np.eye(7)


@dataclass(frozen=True, kw_only=True)
class WalkMotionSettings:
    """Noises of the filter."""

    velocity: Speed = 1.0  # m/s, sd at the start and after a gap
    acceleration_noise: Density = 0.03  # m/s^2 / sqrt(Hz): a swing, sampled at 100 Hz
    bias: Acceleration = 0.1  # m/s^2, sd at the start: 0.07 of the chip, 0.045 of 0.26 deg of tilt
    bias_walk: Density = 0.0225  # m/s^2 / sqrt(s): that tilt, correlated over 8 s
    pointing: Angle = 0.06  # rad, sd of beta at the start
    pointing_walk: Density | Zero = 0.01  # rad / sqrt(s): a wander of 1.5 deg over some steps
    outlier: Factor = 3.0  # sd, from which on a measurement counts as that far off and no farther


class WalkMotion:
    """The filter; measurements are scalar, one at a time."""

    def __init__(self, settings: WalkMotionSettings) -> None:
        self._settings = settings
        self._x: list[float] = [0.0] * 7
        sd = (1e-6, 1e-6, settings.velocity, settings.velocity, settings.bias, settings.bias, settings.pointing)
        self._p: Floats = np.diag(np.square(sd))
        self._f: Floats = _IDENTITY.copy()
        accelerations, biases = settings.acceleration_noise**2, settings.bias_walk**2
        walks = (0.0, 0.0, accelerations, accelerations, biases, biases, settings.pointing_walk**2)
        self._noise_rates: Floats = np.array(walks)  # variances per s

    @property
    def position(self) -> tuple[float, float]:
        """Position of the IMU's origin, m, in the gyro's frame."""
        return self._x[_PX], self._x[_PY]

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity, m/s, in the gyro's frame."""
        return self._x[_VX], self._x[_VY]

    @property
    def pointing(self) -> float:
        """The angle beta, rad."""
        return self._x[_BETA]

    @property
    def covariance(self) -> Floats:
        """Of position and velocity, (4, 4); a view."""
        return self._p[:4, :4]

    def predict(self, t: float, acceleration: tuple[float, float], cos_yaw: float, sin_yaw: float) -> complex:
        """Go on by `t` s at a measured `acceleration` (m/s^2) in the gyro's frame; the boresight's yaw goes with it.

        Returns the velocity gained, m/s, as x + jy.
        """
        x = self._x
        gained_x = t * (acceleration[0] - cos_yaw * x[_BF] + sin_yaw * x[_BL])
        gained_y = t * (acceleration[1] - sin_yaw * x[_BF] - cos_yaw * x[_BL])
        x[_PX] += t * (x[_VX] + 0.5 * gained_x)
        x[_PY] += t * (x[_VY] + 0.5 * gained_y)
        x[_VX] += gained_x
        x[_VY] += gained_y
        f = self._f
        f[_PX, _VX] = f[_PY, _VY] = t
        f[_VX, _BF] = f[_VY, _BL] = -t * cos_yaw
        f[_VX, _BL], f[_VY, _BF] = t * sin_yaw, -t * sin_yaw
        # 7 x 7 is below the size at which any BLAS takes more than one thread
        self._p = f @ self._p @ f.T
        diagonal = self._p.reshape(-1)[::8]
        diagonal += self._noise_rates * t
        return complex(gained_x, gained_y)

    def bridge(self, t: float, moved: complex, gained: complex, speed_error: float) -> None:
        """Go on by `t` s over which nothing was measured: at the velocity of before, but for what is known.

        Which is a way `moved` (m) and a change `gained` (m/s), x + jy; the rest of the change has the sd `speed_error`
        (m/s per axis) and comes about evenly in time.
        """
        x = self._x
        x[_PX] += t * x[_VX] + moved.real
        x[_PY] += t * x[_VY] + moved.imag
        x[_VX] += gained.real
        x[_VY] += gained.imag
        f = self._f
        f[_PX, _VX] = f[_PY, _VY] = t
        f[_VX, _BF] = f[_VY, _BL] = f[_VX, _BL] = f[_VY, _BF] = 0.0
        self._p = f @ self._p @ f.T
        diagonal = self._p.reshape(-1)[::8]
        diagonal[_BF:] += self._noise_rates[_BF:] * t
        variance = speed_error**2
        for position, velocity in ((_PX, _VX), (_PY, _VY)):
            self._p[velocity, velocity] += variance
            self._p[position, position] += variance * t * t / 3.0
            self._p[position, velocity] += 0.5 * variance * t
            self._p[velocity, position] += 0.5 * variance * t

    def coast(self, t: float) -> None:
        """Go on by `t` s over which nothing was measured: the velocity holds, and is as unknown as at the start."""
        self.predict(t, self._bias_in(1.0, 0.0), 1.0, 0.0)
        for axis in (_VX, _VY):
            self._p[axis, :] = self._p[:, axis] = 0.0
            self._p[axis, axis] = self._settings.velocity**2
        for axis in (_PX, _PY):
            self._p[axis, axis] += (self._settings.velocity * t) ** 2

    def observe_velocity(
        self, along: tuple[float, float], value: float, variance: float, *, per_pointing: float = 0.0
    ) -> float:
        """Correct by the velocity's component `along` a direction, m/s, plus `per_pointing` times beta.

        Returns by how many standard deviations it was off.
        """
        (nx, ny), x = along, self._x
        ph = nx * self._p[:, _VX] + ny * self._p[:, _VY]
        expected = nx * x[_VX] + ny * x[_VY]
        if per_pointing:
            ph += per_pointing * self._p[:, _BETA]
            expected += per_pointing * x[_BETA]
        spread = float(nx * ph[_VX] + ny * ph[_VY] + per_pointing * ph[_BETA]) + variance
        innovation = value - expected
        off = abs(innovation) / math.sqrt(spread)
        # an outlier is believed to be as uncertain as it is far off
        spread = max(spread, (innovation / self._settings.outlier) ** 2)
        gain = update(self._p, ph, spread)
        self._x = [a + g * innovation for a, g in zip(x, gain.tolist(), strict=True)]
        return off

    def doubt(self, speed: float, lasting: float) -> None:
        """The velocity may be off by `speed` (m/s, sd per axis), and may have been for `lasting` s."""
        for position, velocity in ((_PX, _VX), (_PY, _VY)):
            self._p[velocity, velocity] += speed**2
            self._p[position, position] += (speed * lasting) ** 2
            self._p[position, velocity] += speed**2 * lasting
            self._p[velocity, position] += speed**2 * lasting

    def _bias_in(self, cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
        forward, left = self._x[_BF], self._x[_BL]
        return cos_yaw * forward - sin_yaw * left, sin_yaw * forward + cos_yaw * left
