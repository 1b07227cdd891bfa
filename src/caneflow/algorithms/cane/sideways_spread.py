"""How fast the antenna goes sideways, from how wide its Doppler is: the coefficients are learnt on the way.

The front end tells s, the speed to the side that would widen the Doppler as much (ground_velocity.md). Ground, beam and
way of walking have their share in it,

    s^2 = a v_l^2 + b v_f^2 + error,

and fixed coefficients ruin walks in clutter. So a and b are the least squares over the last seconds, with the
velocities v_l and v_f that the filter has, and what is left of the error says how much to believe. Where ground is
sparse or the beam narrow, a is small or the error large, and nothing is said.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Factor, Speed, Time

_PRIOR: Final = (0.8, 0.2)  # a and b, in the open
_PRIOR_WEIGHT: Final = 2 * 0.2**4  # (m/s)^4: of two values at 0.2 m/s
_FASTEST: Final = 10.0  # m/s; a filter that says more has lost its way, and the coefficients must not


@dataclass(frozen=True, kw_only=True)
class SidewaysSpreadSettings:
    """When the Doppler's width is believed; chosen on walks of another simulator (`least_share`: seeds 301 to 306)."""

    memory: Time = 40.0  # s over which the coefficients are learnt
    fewest: Annotated[int, Ge(1), Le(10_000)] = 20  # values with sideways speed before one is believed
    least_speed: Speed = 0.15  # m/s to the side, below which the width does not tell it
    least_share: Factor = 0.35  # of a, likewise: brisk walks have 0.45, sparse ground less
    largest_error: Speed = 0.2  # m/s, sd of what is left of it, likewise
    inflation: Factor = 2.0  # of the variance that is left


class Sideways(NamedTuple):
    """What the Doppler's width says."""

    speed: float  # m/s to the left, with the sign that the filter has
    variance: float  # (m/s)^2


class SidewaysSpread:
    """Sums of the least squares, forgotten as time goes on."""

    def __init__(self, settings: SidewaysSpreadSettings) -> None:
        self._settings = settings
        self._last_ns: int | None = None
        self._ll = self._lf = self._ff = self._sl = self._sf = 0.0  # (m/s)^4
        self._weight = self._square = 0.0  # of values with sideways speed; (m/s)^2, of their errors

    @property
    def coefficients(self) -> tuple[float, float]:
        """The coefficients a and b."""
        ll, ff = self._ll + _PRIOR_WEIGHT, self._ff + _PRIOR_WEIGHT
        sl, sf = self._sl + _PRIOR_WEIGHT * _PRIOR[0], self._sf + _PRIOR_WEIGHT * _PRIOR[1]
        determinant = ll * ff - self._lf**2
        return (sl * ff - sf * self._lf) / determinant, (sf * ll - sl * self._lf) / determinant

    def update(self, stamp_ns: int, spread: float, forward: float, left: float) -> Sideways | None:
        """Take a `spread` (m/s), with the antenna's velocity as the filter has it; None where it tells nothing."""
        settings = self._settings
        if not math.hypot(forward, left) < _FASTEST:
            return None
        if self._last_ns is not None:
            kept = math.exp(min(self._last_ns - stamp_ns, 0) * 1e-9 / settings.memory)
            self._ll, self._lf, self._ff = self._ll * kept, self._lf * kept, self._ff * kept
            self._sl, self._sf = self._sl * kept, self._sf * kept
            self._weight, self._square = self._weight * kept, self._square * kept
        self._last_ns = stamp_ns
        a, b = self.coefficients
        found = None
        if abs(left) > settings.least_speed and a > 0.0:
            speed = math.sqrt(max(spread**2 - b * forward**2, 0.0) / a)
            error = speed - abs(left)
            if self._weight >= settings.fewest and a > settings.least_share:
                variance = self._square / self._weight
                if variance < settings.largest_error**2:
                    found = Sideways(math.copysign(speed, left), settings.inflation * variance)
            self._weight += 1.0
            self._square += error**2
        ll, ff, ss = left**2, forward**2, spread**2
        self._ll += ll * ll
        self._lf += ll * ff
        self._ff += ff * ff
        self._sl += ss * ll
        self._sf += ss * ff
        return found
