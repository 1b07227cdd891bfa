"""Up and down: the height of the sensors and its rate, from the accelerometer and what the rig says of the height.

State x = (z, v, b): height m, vertical speed m/s, bias of the vertical acceleration m/s^2. A walker's hand bobs about
the nominal height; the accelerometer sees how, the rig sees where. Between them lies a corner at about 0.2 Hz.
"""

from dataclasses import dataclass
from typing import Final

from caneflow.algorithms.quantities import Acceleration, Density, Length

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
    """A Kalman filter of three states, written out: numpy's calls would cost more than its sums."""

    def __init__(self, settings: HeaveSettings) -> None:
        self._settings = settings
        self._started = False
        self.height = 0.0
        self.rate = 0.0
        self._bias = 0.0
        self._zz, self._zv, self._zb = 0.02**2, 0.0, 0.0
        self._vv, self._vb, self._bb = 0.05**2, 0.0, settings.bias**2

    @property
    def height_variance(self) -> float:
        """Of the height, m^2, but for the person's own difference from the nominal height."""
        return self._zz

    @property
    def rate_variance(self) -> float:
        """Of the vertical speed, (m/s)^2."""
        return self._vv

    def update(self, interval: float, acceleration: float, nominal_height: float) -> None:
        """Go on by `interval` s at a vertical `acceleration` (m/s^2, gravity removed); then see the nominal height."""
        if not self._started:
            self.height, self._started = nominal_height, True
        self._predict(interval, acceleration - self._bias)
        variance = self._zz + self._settings.height_noise**2
        gain_z, gain_v, gain_b = self._zz / variance, self._zv / variance, self._zb / variance
        off = nominal_height - self.height
        self.height += gain_z * off
        self.rate += gain_v * off
        self._bias += gain_b * off
        self._vv -= gain_v * self._zv
        self._vb -= gain_v * self._zb
        self._bb -= gain_b * self._zb
        self._zv -= gain_z * self._zv
        self._zb -= gain_z * self._zb
        self._zz -= gain_z * self._zz

    def bridge(self, elapsed: float) -> None:
        """Go on by `elapsed` s without a sample: the height stays, its rate is as unknown as at the start."""
        self._zz += self._vv * elapsed * elapsed
        self._zv = self._vb = 0.0
        self.rate, self._vv = 0.0, _UNKNOWN_RATE**2
        self._bb += elapsed * self._settings.bias_walk**2

    def _predict(self, t: float, acceleration: float) -> None:
        self.height += t * (self.rate + 0.5 * t * acceleration)
        self.rate += t * acceleration
        self._zz += t * (2.0 * self._zv + t * self._vv)
        self._zv += t * (self._vv - self._zb - t * self._vb)
        self._zb += t * self._vb
        self._vv += t * (self._settings.acceleration_noise**2 - 2.0 * self._vb + t * self._bb)
        self._vb -= t * self._bb
        self._bb += t * self._settings.bias_walk**2
