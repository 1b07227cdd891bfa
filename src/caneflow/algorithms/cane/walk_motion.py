"""Velocity and position over ground in the gyro's frame: a Kalman filter on accelerometer, radar and gait.

State x = (p_x, p_y, v_x, v_y, b_x, b_y, b_z, t_x, t_y, beta, m_x, m_y, n_x, n_y): position m and velocity m/s of the
IMU's origin in the gyro's frame, bias of the accelerometer along the body's axes, m/s^2, what the chip's error of tilt
makes of gravity, m/s^2 in the gyro's frame, the angle by which the cane points to the right of where its bearer walks,
rad, and the position at the last mark and the one before, m, so that the way since then can be measured.

Bias and tilt are two things: the bias turns with the cane and stays for a walk, the tilt errs in the world, for
seconds. A corner turns the one by 90 deg and the other not at all.

The gyro's frame turns with the errors of the gyro; a turn of a degree in three seconds does not touch velocities. What
it does to the track is the business of heading_hypotheses.py.
"""

import math
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Acceleration, Angle, Density, Factor, Speed, Time, Zero
from caneflow.algorithms.rotations import Vector
from caneflow.algorithms.scalar_update import update

Floats = NDArray[np.float64]

_PX, _PY, _VX, _VY, _BX, _BY, _BZ, _TX, _TY, _BETA, _MX, _MY, _NX, _NY = range(14)
STATES: Final = 14
_ANYWHERE: Final = 3600.0  # s
_IDENTITY: Final = np.eye(STATES)
_MARKED: Final = [*range(_MX), _PX, _PY, _MX, _MY]  # states that become the states when the position is marked
_MARKED_BOTH: Final = np.ix_(_MARKED, _MARKED)

# Body axes in the gyro's frame: the horizontal parts of x, y, z, as x + jy.
Axes: TypeAlias = tuple[complex, complex, complex]


@dataclass(frozen=True, kw_only=True)
class WalkMotionSettings:
    """Noises of the filter."""

    velocity: Speed = 1.0  # m/s, sd at the start and after a gap
    # m/s^2 / sqrt(Hz): a swing sampled at 100 Hz; chosen with the three below on walks of another simulator
    acceleration_noise: Density = 0.01
    bias: Acceleration = 0.07  # m/s^2, sd per axis at the start (cane.md)
    bias_walk: Density = 0.002  # m/s^2 / sqrt(s)
    tilt: Acceleration = 0.045  # m/s^2, sd of what 0.26 deg of tilt makes of gravity (cane.md)
    tilt_time: Time = 8.0  # s, over which it is correlated
    pointing: Angle = 0.06  # rad, sd of beta at the start
    pointing_walk: Density | Zero = 0.005  # rad / sqrt(s): a wander of 1 deg over some steps
    outlier: Factor = 3.0  # sd, from which on a measurement counts as that far off and no farther


class WalkMotion:
    """The filter; measurements are scalar, one at a time."""

    def __init__(self, settings: WalkMotionSettings) -> None:
        self._settings = settings
        self._x: list[float] = [0.0] * STATES
        s = settings
        sd = (1e-6, 1e-6, s.velocity, s.velocity, s.bias, s.bias, s.bias, s.tilt, s.tilt, s.pointing, *[1e-6] * 4)
        self._p: Floats = np.diag(np.square(sd))
        self._f: Floats = _IDENTITY.copy()
        accelerations, biases, tilts = s.acceleration_noise**2, s.bias_walk**2, 2.0 * s.tilt**2 / s.tilt_time
        walks = (
            0.0,
            0.0,
            accelerations,
            accelerations,
            biases,
            biases,
            biases,
            tilts,
            tilts,
            s.pointing_walk**2,
            *[0.0] * 4,
        )
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
    def bias(self) -> Vector:
        """Bias of the accelerometer along the body's axes, m/s^2."""
        return self._x[_BX], self._x[_BY], self._x[_BZ]

    @property
    def tilt(self) -> complex:
        """What the chip's error of tilt adds to the acceleration, m/s^2 in the gyro's frame, x + jy."""
        return complex(self._x[_TX], self._x[_TY])

    @property
    def covariance(self) -> Floats:
        """Of position and velocity, (4, 4); a view."""
        return self._p[:4, :4]

    def predict(self, t: float, acceleration: complex, axes: Axes) -> complex:
        """Go on by `t` s at a measured `acceleration` (m/s^2, x + jy) in the gyro's frame; `axes` are the body's there.

        Returns the velocity gained, m/s, as x + jy.
        """
        x, (a, b, c) = self._x, axes
        tilt = complex(x[_TX], x[_TY])
        gained = t * (acceleration - x[_BX] * a - x[_BY] * b - x[_BZ] * c - tilt)
        x[_PX] += t * (x[_VX] + 0.5 * gained.real)
        x[_PY] += t * (x[_VY] + 0.5 * gained.imag)
        x[_VX] += gained.real
        x[_VY] += gained.imag
        f = self._f
        f[_PX, _VX] = f[_PY, _VY] = t
        f[_VX, _BX:_TY] = -t * a.real, -t * b.real, -t * c.real, -t
        f[_VY, _BX:_BETA] = -t * a.imag, -t * b.imag, -t * c.imag, 0.0, -t
        self._keep_tilt(t)
        # 14 x 14 is below the size at which any BLAS takes more than one thread
        self._p = f @ self._p @ f.T
        diagonal = self._p.reshape(-1)[:: STATES + 1]
        diagonal += self._noise_rates * t
        return gained

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
        f[_VX:_BX, _BX:] = 0.0
        self._keep_tilt(t)
        self._p = f @ self._p @ f.T
        diagonal = self._p.reshape(-1)[:: STATES + 1]
        diagonal[_BX:] += self._noise_rates[_BX:] * t
        variance = speed_error**2
        for position, velocity in ((_PX, _VX), (_PY, _VY)):
            self._p[velocity, velocity] += variance
            self._p[position, position] += variance * t * t / 3.0
            self._p[position, velocity] += 0.5 * variance * t
            self._p[velocity, position] += 0.5 * variance * t

    def coast(self, t: float) -> None:
        """Go on by `t` s over which nothing was measured: the velocity holds, and is as unknown as at the start.

        Longer than an hour is as long: the bearer is anywhere.
        """
        t = min(t, _ANYWHERE)
        self.predict(t, complex(self._x[_TX], self._x[_TY]), (0j, 0j, 0j))
        for axis in (_VX, _VY):
            self._p[axis, :] = self._p[:, axis] = 0.0
            self._p[axis, axis] = self._settings.velocity**2
        for axis in (_PX, _PY):
            self._p[axis, axis] += (self._settings.velocity * t) ** 2
        if t > self._settings.tilt_time:  # nothing is left of what was known of it
            for axis in (_TX, _TY):
                self._p[axis, :] = self._p[:, axis] = 0.0
                self._p[axis, axis] = self._settings.tilt**2

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
        return self._correct(ph, value - expected, spread)

    def observe_way(self, across: tuple[float, float], value: float, variance: float, *, per_pointing: float) -> float:
        """Correct by the component `across` a direction of the way (m) since the mark before the last one.

        Plus `per_pointing` times beta. Returns by how many standard deviations it was off.
        """
        (nx, ny), x, p = across, self._x, self._p
        ph = nx * (p[:, _PX] - p[:, _NX]) + ny * (p[:, _PY] - p[:, _NY]) + per_pointing * p[:, _BETA]
        expected = nx * (x[_PX] - x[_NX]) + ny * (x[_PY] - x[_NY]) + per_pointing * x[_BETA]
        spread = float(nx * (ph[_PX] - ph[_NX]) + ny * (ph[_PY] - ph[_NY]) + per_pointing * ph[_BETA]) + variance
        return self._correct(ph, value - expected, spread)

    def mark(self) -> None:
        """Remember the position, and forget the mark before the last one."""
        self._x = [self._x[index] for index in _MARKED]
        self._p = self._p[_MARKED_BOTH]

    @property
    def way(self) -> complex:
        """The way since the mark before the last one, m, x + jy."""
        x = self._x
        return complex(x[_PX] - x[_NX], x[_PY] - x[_NY])

    @property
    def way_covariance(self) -> Floats:
        """Of that way, (2, 2) m^2."""
        p = self._p
        across: Floats = p[:2, _NX:]
        covariance: Floats = p[:2, :2] + p[_NX:, _NX:] - across - across.T
        return covariance

    def _correct(self, across: Floats, innovation: float, spread: float) -> float:
        """Kalman's correction; returns by how many standard deviations the innovation was off."""
        off = abs(innovation) / math.sqrt(spread)
        # an outlier is believed to be as uncertain as it is far off
        spread = max(spread, (innovation / self._settings.outlier) ** 2)
        gain = update(self._p, across, spread)
        self._x = [a + g * innovation for a, g in zip(self._x, gain.tolist(), strict=True)]
        return off

    def doubt(self, speed: float, lasting: float) -> None:
        """The velocity may be off by `speed` (m/s, sd per axis), and may have been for `lasting` s."""
        for position, velocity in ((_PX, _VX), (_PY, _VY)):
            self._p[velocity, velocity] += speed**2
            self._p[position, position] += (speed * lasting) ** 2
            self._p[position, velocity] += speed**2 * lasting
            self._p[velocity, position] += speed**2 * lasting

    def _keep_tilt(self, t: float) -> None:
        """What is left of the tilt's error after `t` s."""
        left = math.exp(-t / self._settings.tilt_time)
        self._x[_TX] *= left
        self._x[_TY] *= left
        self._f[_TX, _TX] = self._f[_TY, _TY] = left
