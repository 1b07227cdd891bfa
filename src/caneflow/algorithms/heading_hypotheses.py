"""Where a walk led under many hypotheses of the gyro's errors, and how well each explains the magnetic field.

The gyro's yaw drifts by its bias b and its scale error s; indoors the compass errs by ten degrees and more, but it
errs by the same amount at the same place. So each hypothesis (b, s) keeps a track of its own, and is weighed by how
smooth a map of the field's direction its track leads to: a Gaussian process over places, unknown in its mean.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_DEGREE: Final = math.pi / 180.0


@dataclass(frozen=True, kw_only=True)
class HeadingSettings:
    """What is believed of gyro and field before a walk."""

    biases: Annotated[int, Ge(3)] = 41  # hypotheses of the bias
    largest_bias: Annotated[float, Gt(0)] = 0.8 * _DEGREE  # rad/s
    scale_error: Annotated[float, Gt(0)] = 0.01  # sd of the gyro's scale about the vertical
    knot_interval: Annotated[float, Gt(0)] = 0.7  # s over which the field's direction is averaged
    knots: Annotated[int, Ge(8)] = 128  # places kept; every second one goes when there are more
    field_error: Annotated[float, Gt(0)] = 14.0 * _DEGREE  # rad, sd of the field's direction from place to place
    field_scale: Annotated[float, Gt(0)] = 1.8  # m over which it changes
    rough_error: Annotated[float, Gt(0)] = 1.5 * _DEGREE  # rad, sd of what changes over shorter ways
    rough_scale: Annotated[float, Gt(0)] = 0.5  # m
    field_noise: Annotated[float, Gt(0)] = 0.8 * _DEGREE  # rad, of one average


# deg/s, standard deviations of a gyro's bias that are thought equally likely: none is known, and the two axes that
# gravity shows tell which it is
SPREADS: Final = np.array([0.025, 0.05, 0.1, 0.2, 0.4]) * _DEGREE


class HeadingHypotheses:
    """A weighted set of headings and tracks."""

    def __init__(self, settings: HeadingSettings) -> None:
        self._settings = settings
        self._elapsed = 0.0  # s since the start
        self._turned = 0.0  # rad by the gyro since the start
        self._pending = 0j  # m, moved since tracks were advanced, in the gyro's frame
        self._horizontal: tuple[float, float, float, float] | None = None
        # knots: what the tracks are made of again when hypotheses change
        self._times: list[float] = []
        self._turns: list[float] = []
        self._moves: list[complex] = []  # to a knot from the one before
        self._fields: list[float] = []
        self._variances: list[float] = []
        self.variance = 0.0
        self._since_knot = 0j
        self._knot_start = 0.0
        self._field_sum = 0j
        self._field_count = 0
        grid = np.sinh(np.linspace(-2.0, 2.0, settings.biases)) / math.sinh(2.0) * settings.largest_bias
        self._spread(grid)

    def _spread(self, biases: Floats) -> None:
        """Start over with these biases, each with three scale errors (Gauss-Hermite)."""
        cells = np.gradient(biases)
        scales = math.sqrt(3.0) * self._settings.scale_error * np.array([-1.0, 0.0, 1.0])
        masses = np.array([1.0, 4.0, 1.0]) / 6.0
        self.biases = np.repeat(biases, 3)
        self.scales = np.tile(scales, len(biases))
        self._log_cell = np.log(np.repeat(cells, 3) * np.tile(masses, len(biases)))
        count, knots = len(self.biases), self._settings.knots
        self.tracks: Complexes = np.zeros(count, np.complex128)
        self._at: Complexes = np.zeros((count, knots), np.complex128)
        self._inverse: Floats = np.zeros((count, knots, knots))
        self._white: Floats = np.zeros((count, knots))
        self._log_likelihood: Floats = np.zeros(count)
        self.weights: Floats = np.ones(count)
        self._reweigh()

    def headings(self, elapsed: float, turned: float) -> Floats:
        """Yaw (rad) to be added to the gyro's, by hypothesis."""
        angles: Floats = -(self.biases * elapsed + self.scales * turned)
        return angles

    def move(self, interval: float, turn: float, dx: float, dy: float) -> None:
        """`interval` s on: turned by `turn` rad by the gyro, moved by (dx, dy) m in the gyro's frame."""
        self._elapsed += interval
        self._turned += turn
        self._pending += complex(dx, dy)

    def field(self, direction: float) -> None:
        """Direction (rad) of the horizontal field in the gyro's frame."""
        self._field_sum += complex(math.cos(direction), math.sin(direction))
        self._field_count += 1

    def advance(self) -> None:
        """Bring the tracks up to now, and take in a knot when it is due."""
        turns = np.exp(1j * self.headings(self._elapsed, self._turned))
        self.tracks += turns * self._pending
        self._since_knot += self._pending
        self._pending = 0j
        if self._elapsed - self._knot_start >= self._settings.knot_interval:
            if self._field_count:
                self._add_knot()
            self._knot_start = self._elapsed
            self._field_sum, self._field_count = 0j, 0

    def horizontal_bias(self, first: float, first_sd: float, second: float, second_sd: float) -> None:
        """What the two horizontal axes show of the gyro's bias, rad/s, and how well."""
        self._horizontal = first, first_sd, second, second_sd

    def mean(self) -> tuple[complex, float, Floats]:
        """Position (m, x + jy), yaw (rad) to be added to the gyro's, covariance (2, 2) of the position, now."""
        heading = float(self.weights @ self.headings(self._elapsed, self._turned))
        centre = complex((self.weights * self.tracks).sum())
        off = self.tracks - centre
        xx = float((self.weights * off.real**2).sum())
        xy = float((self.weights * off.real * off.imag).sum())
        yy = float((self.weights * off.imag**2).sum())
        turned = complex(math.cos(heading), math.sin(heading))
        return centre + turned * self._pending, heading, np.array([[xx, xy], [xy, yy]])

    def _add_knot(self) -> None:
        direction = math.atan2(self._field_sum.imag, self._field_sum.real)
        if len(self._times) == self._settings.knots:
            self._thin()
        self._times.append(self._elapsed)
        self._variances.append(max(self.variance, self._variances[-1] if self._variances else 0.0))
        self._turns.append(self._turned)
        self._moves.append(self._since_knot)
        self._since_knot = 0j
        if self._fields:
            direction = self._fields[0] + math.remainder(direction - self._fields[0], 2 * math.pi)
        self._fields.append(direction)
        self._at[:, len(self._times) - 1] = self.tracks
        self._condition(len(self._times) - 1)
        self._reweigh()

    def _condition(self, n: int) -> None:
        """Take knot n into the Gaussian process of every hypothesis: one more row of the inverse Cholesky factor."""
        s = self._settings
        residual = self._fields[n] - self._fields[0] + self.headings(self._times[n], self._turns[n])
        apart = np.abs(self._at[:, :n] - self._at[:, n : n + 1])
        wide = s.field_scale**2 + self._variances[n] - np.array(self._variances[:n])
        kernel = (
            s.field_error**2 * (s.field_scale**2 / wide) * np.exp(-0.5 * apart**2 / wide)
            + s.rough_error**2 * np.exp(-apart / s.rough_scale)
            + 1.0
        )
        inverse = self._inverse[:, :n, :n]
        w = np.einsum("hij,hj->hi", inverse, kernel)
        own = s.field_error**2 + s.rough_error**2 + 1.0 + s.field_noise**2
        d = np.sqrt(np.maximum(own - (w * w).sum(axis=1), 0.25 * s.field_noise**2))
        self._inverse[:, n, :n] = -np.einsum("hi,hij->hj", w, inverse) / d[:, None]
        self._inverse[:, n, n] = 1.0 / d
        white = (residual - (w * self._white[:, :n]).sum(axis=1)) / d
        self._white[:, n] = white
        self._log_likelihood -= 0.5 * white * white + np.log(d)

    def _thin(self) -> None:
        raise NotImplementedError

    def _log_prior(self) -> Floats:
        spreads = SPREADS
        log = np.zeros(len(spreads))
        if self._horizontal is not None:
            first, first_sd, second, second_sd = self._horizontal
            for value, sd in ((first, first_sd), (second, second_sd)):
                variance = spreads**2 + sd**2
                log -= 0.5 * value**2 / variance + 0.5 * np.log(variance)
        log -= log.max()
        share = np.exp(log)
        share /= share.sum()
        density = (share / spreads * np.exp(-0.5 * (self.biases[:, None] / spreads) ** 2)).sum(axis=1)
        return np.log(density + 1e-300) + self._log_cell

    def _reweigh(self) -> None:
        log = self._log_prior() + self._log_likelihood
        log -= log.max()
        weights = np.exp(log)
        self.weights = weights / weights.sum()
