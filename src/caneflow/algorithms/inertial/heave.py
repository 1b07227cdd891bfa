"""Up and down: the height of the sensors and its rate, from the accelerometer and what the rig says of the height.

State x = (z, v, b): height m, vertical speed m/s, bias of the vertical acceleration m/s^2. A walker's hand bobs about
the nominal height; the accelerometer sees how, the rig sees where. Between them lies a corner at about 0.2 Hz.
"""

from dataclasses import dataclass
from typing import Final

from caneflow.algorithms.quantities import Acceleration, Density, Length
from caneflow.algorithms.scalar_update import Covariance, updated

_UNKNOWN_RATE: Final = 0.12  # m/s, sd: a bob of 12 mm at 1.1 Hz


@dataclass(frozen=True, kw_only=True)
class HeaveSettings:
    """Noises of the Kalman filter."""

    # the hand's height about the nominal one: 20 mm, correlated over 0.3 s, as white noise at 100 Hz
    height_noise: Length = 0.11  # m
    acceleration_noise: Density = 0.02  # m/s^2 / sqrt(Hz), of a sampled swing rather than of the chip
    bias: Acceleration = 0.1  # m/s^2, sd at the start (BNO055: 0.07)
    bias_walk: Density = 0.01  # m/s^2 / sqrt(s)


class HeaveObserver:
    """A Kalman filter of three states, its prediction written out."""

    def __init__(self, settings: HeaveSettings) -> None:
        self._settings = settings
        self._started = False
        self.height = 0.0
        self.rate = 0.0
        self._bias = 0.0
        self._p: Covariance = 0.02**2, 0.0, 0.0, 0.05**2, 0.0, settings.bias**2  # zz, zv, zb, vv, vb, bb

    @property
    def height_variance(self) -> float:
        """Of the height, m^2, but for the person's own difference from the nominal height."""
        return self._p[0]

    @property
    def rate_variance(self) -> float:
        """Of the vertical speed, (m/s)^2."""
        return self._p[3]

    def update(self, interval: float, acceleration: float, nominal_height: float) -> None:
        """Go on by `interval` s at a vertical `acceleration` (m/s^2, gravity removed); then see the nominal height."""
        if not self._started:
            self.height, self._started = nominal_height, True
        self._predict(interval, acceleration - self._bias)
        across = self._p[:3]
        (gain_z, gain_v, gain_b), self._p = updated(self._p, across, across[0] + self._settings.height_noise**2)
        off = nominal_height - self.height
        self.height += gain_z * off
        self.rate += gain_v * off
        self._bias += gain_b * off

    def bridge(self, elapsed: float) -> None:
        """Go on by `elapsed` s without a sample: the height stays, its rate is as unknown as at the start."""
        zz, _, zb, vv, _, bb = self._p
        zz, bb = zz + vv * elapsed * elapsed, bb + elapsed * self._settings.bias_walk**2
        self._p = zz, 0.0, zb, _UNKNOWN_RATE**2, 0.0, bb
        self.rate = 0.0

    def _predict(self, t: float, acceleration: float) -> None:
        self.height += t * (self.rate + 0.5 * t * acceleration)
        self.rate += t * acceleration
        zz, zv, zb, vv, vb, bb = self._p
        self._p = (
            zz + t * (2.0 * zv + t * vv),
            zv + t * (vv - zb - t * vb),
            zb + t * vb,
            vv + t * (self._settings.acceleration_noise**2 - 2.0 * vb + t * bb),
            vb - t * bb,
            bb + t * self._settings.bias_walk**2,
        )
