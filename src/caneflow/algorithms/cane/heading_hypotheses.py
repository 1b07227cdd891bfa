"""Where a walk led under many hypotheses of the gyro's errors, and how well each explains the magnetic field.

The gyro's yaw drifts with its bias b and its scale error s. Indoors the compass errs by ten degrees and more, but by
the same amount at the same place. So each hypothesis (b, s) has a track of its own, and is weighed by how well the
directions of the field along it make one smooth map: a Gaussian process over places, its mean unknown. Nothing is
linearised: a bias that bends the whole track is weighed with the places where it puts the knots.

Letters: knot, a stretch of the walk over which the field's direction is averaged; H hypotheses; n knots.
"""

import cmath
import math
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
from annotated_types import Ge, Le, Len, MultipleOf
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Angle, Fraction, Length, Time, TurnRate

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_DEGREE: Final = math.pi / 180.0
_CONSTANT: Final = 1.0  # rad^2, variance of the field's mean direction: nearly unknown
_SCALES: Final = math.sqrt(3.0) * np.array([-1.0, 0.0, 1.0])  # Gauss-Hermite points of a normal density,
_SCALE_MASSES: Final = np.array([1.0, 4.0, 1.0]) / 6.0  # and their weights
_REFINE_EVERY: Final = 16  # knots
_TOO_FEW: Final = 4.0  # biases that carry the weight: fewer, and the grid is too coarse


@dataclass(frozen=True, kw_only=True)
class HeadingSettings:
    """What is believed of gyro and field before a walk."""

    biases: Annotated[int, Ge(5), Le(1001)] = 21  # hypotheses of the gyro's bias, three scale errors each
    largest_bias: TurnRate = 0.8 * _DEGREE  # rad/s
    # rad/s, sd of a gyro's bias (cane.md: 0.02 to 0.3 deg/s); all equally likely, gravity's axes tell which it is
    bias_spreads: Annotated[tuple[TurnRate, ...], Len(1, 32)] = (
        0.025 * _DEGREE,
        0.05 * _DEGREE,
        0.1 * _DEGREE,
        0.2 * _DEGREE,
        0.4 * _DEGREE,
    )
    scale_error: Fraction = 0.007  # sd of the gyro's scale (cane.md)
    knot_interval: Time = 1.0  # s
    knots: Annotated[int, Ge(8), Le(1024), MultipleOf(2)] = 64  # kept; when full, every second one goes
    field_error: Angle = 14.0 * _DEGREE  # rad, sd of the field's direction indoors
    field_scale: Length = 1.8  # m over which it changes (cane.md: 10 deg over 2 m)
    rough_error: Angle = 3.0 * _DEGREE  # rad, sd of what changes over shorter ways
    rough_scale: Length = 0.5  # m
    field_noise: Angle = 0.8 * _DEGREE  # rad, sd of a knot's average: mostly of tilt
    chip_noise: Angle = 4.0 * _DEGREE  # rad, where the chip's yaw stands in for the field: it lags


class Knot(NamedTuple):
    """One average of the field's direction, and what leads to it from the knot before."""

    elapsed: float  # s since the start
    turned: float  # rad, by the gyro since the start
    move: complex  # m, from the knot before, x + jy in the gyro's frame
    direction: float  # rad, in the gyro's frame, unwrapped
    noise: float  # rad, sd of the direction
    variance: float  # m^2 per axis, of the position whatever the heading; never falls
    doubt: float  # rad^2, variance of the turns over holes in the gyro's samples, since the start


class Heading(NamedTuple):
    """What the hypotheses say together."""

    position: complex  # m, x + jy
    yaw: float  # rad, to be added to the gyro's
    yaw_variance: float  # rad^2
    xx: float  # m^2, spread of the position over the hypotheses
    xy: float
    yy: float


class HeadingHypotheses:
    """A weighted set of tracks."""

    def __init__(self, settings: HeadingSettings) -> None:
        self._settings = settings
        self._elapsed = 0.0
        self._turned = 0.0
        self._pending = 0j  # m, moved since the tracks were advanced
        self._since_knot = 0j  # m, moved since the last knot
        self._knot_due = settings.knot_interval
        self._field_sum, self._field_noise = 0j, 0.0
        self._doubt = 0.0  # rad^2
        self._knots: list[Knot] = []
        self._spreads: Floats = np.array(settings.bias_spreads)
        self._spread_share = np.full(len(self._spreads), 1.0 / len(self._spreads))
        grid = np.sinh(np.linspace(-2.0, 2.0, settings.biases)) / math.sinh(2.0)
        self._summary = Heading(0j, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._drift = 0.0, 0.0  # rad/s, 1
        self._start(settings.largest_bias * grid)

    @property
    def drift(self) -> tuple[float, float]:
        """Bias (rad/s) and scale error of the gyro about the vertical, as of the last `advance`."""
        return self._drift

    @property
    def bias(self) -> float:
        """The gyro's bias about the vertical, rad/s."""
        return float((self._weights * self._biases).sum())

    def move(self, interval: float, turn: float, dx: float, dy: float) -> None:
        """Go on by `interval` s, `turn` rad by the gyro, and (dx, dy) m in the gyro's frame."""
        self._elapsed += interval
        self._turned += turn
        self._pending += complex(dx, dy)

    def doubt(self, variance: float) -> None:
        """The last turn was over a hole in the gyro's samples, and is known with this variance (rad^2) only."""
        self._doubt += variance

    def field(self, direction: float, *, from_chip: bool) -> None:
        """Take the direction (rad) of the horizontal field in the gyro's frame, from the chip's yaw if need be."""
        self._field_sum += cmath.rect(1.0, direction)
        self._field_noise = self._settings.chip_noise if from_chip else self._settings.field_noise

    def level_biases(self, across: float, across_sd: float, along: float, along_sd: float) -> None:
        """What gravity shows of the bias about two level axes (rad/s): it tells how good a gyro this is."""
        log = np.zeros(len(self._spreads))
        for value, sd in ((across, across_sd), (along, along_sd)):
            variance = self._spreads**2 + sd**2
            log -= 0.5 * value**2 / variance + 0.5 * np.log(variance)
        share = np.exp(log - log.max())
        self._spread_share = share / share.sum()

    def advance(self, variance: float) -> None:
        """Bring the tracks up to now, and take in a knot when it is due.

        `variance` (m^2, per axis) is the position's for a known heading: it blurs the map.
        """
        self._tracks += np.exp(1j * self._yaws(self._elapsed, self._turned)) * self._pending
        self._since_knot += self._pending
        self._pending = 0j
        if self._elapsed >= self._knot_due:
            if self._field_sum:
                self._take_knot(variance)
            self._knot_due = self._elapsed + self._settings.knot_interval
            self._field_sum = 0j
        self._summarise()

    def heading(self) -> Heading:
        """The mean over all hypotheses as of the last `advance`, but for the position, which is of now."""
        moved = cmath.rect(1.0, self._summary.yaw) * self._pending
        return Heading(self._summary.position + moved, *self._summary[1:])

    @property
    def clock(self) -> tuple[float, float]:
        """Time (s) and turn by the gyro (rad) since the start."""
        return self._elapsed, self._turned

    def hindsight(self, elapsed: Floats, turned: Floats, moves: Complexes) -> list[Heading]:
        """What today's weights say of n earlier instants: their clocks, (n,), and the moves to each, m, (n,)."""
        yaws = -(np.outer(elapsed, self._biases) + np.outer(turned, self._scales))
        tracks = np.cumsum(np.exp(1j * yaws) * moves[:, None], axis=0)
        return [self._mean(yaw, track) for yaw, track in zip(yaws, tracks, strict=True)]

    def _summarise(self) -> None:
        self._summary = self._mean(self._yaws(self._elapsed, self._turned), self._tracks)
        weights, total = self._weights, np.add.reduce
        self._drift = float(total(weights * self._biases)), float(total(weights * self._scales))

    def _mean(self, yaws: Floats, tracks: Complexes) -> Heading:
        weights, total = self._weights, np.add.reduce
        yaw = float(total(weights * yaws))
        centre = complex(total(weights * tracks))
        off = tracks - centre
        x, y = off.real, off.imag
        weighted_x = weights * x
        return Heading(
            position=centre,
            yaw=yaw,
            yaw_variance=float(total(weights * (yaws - yaw) ** 2)),
            xx=float(total(weighted_x * x)),
            xy=float(total(weighted_x * y)),
            yy=float(total(weights * y * y)),
        )

    def _yaws(self, elapsed: float, turned: float) -> Floats:
        """Yaw (rad) to be added to the gyro's by each hypothesis, (H,)."""
        yaws: Floats = -(self._biases * elapsed + self._scales * turned)
        return yaws

    def _start(self, biases: Floats) -> None:
        """Hypotheses of these biases, (B,) and growing, with nothing learnt."""
        self._biases = np.repeat(biases, len(_SCALES))
        self._scales = np.tile(self._settings.scale_error * _SCALES, len(biases))
        self._log_mass = np.log(np.outer(np.gradient(biases), _SCALE_MASSES).ravel())
        count, room = len(self._biases), self._settings.knots
        self._tracks: Complexes = np.zeros(count, np.complex128)
        self._places: Complexes = np.zeros((count, room), np.complex128)
        self._inverse_factor: Floats = np.zeros((count, room, room))  # of the Cholesky factor of the covariance
        self._white: Floats = np.zeros((count, room))  # residuals, whitened
        self._log_likelihood: Floats = np.zeros(count)
        self._weigh()

    def _take_knot(self, variance: float) -> None:
        if len(self._knots) == self._settings.knots:
            self._since_knot += self._knots[-1].move
            self._rebuild(_thinned(self._knots))
        direction = cmath.phase(self._field_sum)
        if self._knots:
            last = self._knots[-1]
            variance = max(variance, last.variance)
            direction = last.direction + math.remainder(direction - last.direction, 2.0 * math.pi)
        knot = Knot(self._elapsed, self._turned, self._since_knot, direction, self._field_noise, variance, self._doubt)
        self._since_knot = 0j
        self._knots.append(knot)
        self._condition(len(self._knots) - 1)
        self._weigh()
        if len(self._knots) % _REFINE_EVERY == 0 and self._is_coarse():
            self._rebuild(self._knots)

    def _is_coarse(self) -> bool:
        by_bias = self._weights.reshape(-1, len(_SCALES)).sum(axis=1)
        return bool(1.0 / (by_bias**2).sum() < _TOO_FEW)

    def _rebuild(self, knots: list[Knot]) -> None:
        """Hypotheses where the weight is, with tracks from all knots again."""
        mean = self.bias
        spread = math.sqrt(float((self._weights * (self._biases - mean) ** 2).sum()))
        cell = float(np.diff(self._biases[:: len(_SCALES)]).min())
        half = min(5.0 * max(spread, cell), 2.0 * self._settings.largest_bias)
        self._start(np.linspace(mean - half, mean + half, self._settings.biases))
        self._knots = knots
        before = (0.0, 0.0)
        for row, knot in enumerate(knots):
            middle = 0.5 * (before[0] + knot.elapsed), 0.5 * (before[1] + knot.turned)
            self._tracks += np.exp(1j * self._yaws(*middle)) * knot.move
            self._condition(row)
            before = knot.elapsed, knot.turned
        self._tracks += np.exp(1j * self._yaws(self._elapsed, self._turned)) * self._since_knot
        self._weigh()

    def _condition(self, n: int) -> None:
        """Add the evidence of knot n given those before: one more row of the inverse Cholesky factor.

        The position's own uncertainty, u^2 per axis and growing along the walk, blurs the map: the mean of the kernel
        over it is l^2 / (l^2 + u^2) exp(-d^2 / 2 (l^2 + u^2)).
        """
        s, knot = self._settings, self._knots[n]
        self._places[:, n] = self._tracks
        residual = knot.direction - self._knots[0].direction + self._yaws(knot.elapsed, knot.turned)
        apart = np.abs(self._places[:, :n] - self._places[:, n : n + 1])
        wide = s.field_scale**2 + knot.variance - np.array([k.variance for k in self._knots[:n]])
        kernel = (s.field_error * s.field_scale) ** 2 / wide * np.exp(apart * apart / (-2.0 * wide))
        kernel += s.rough_error**2 * np.exp(apart / -s.rough_scale) + _CONSTANT
        if knot.doubt > 0.0:  # a turn that was wrong shifts all directions after it: those of both, up to the earlier
            kernel += np.array([k.doubt for k in self._knots[:n]])
        # einsum keeps to its own loops: the sums are the same on any number of threads
        factor = self._inverse_factor[:, :n, :n]
        row = np.einsum("hij,hj->hi", factor, kernel)
        own = s.field_error**2 + s.rough_error**2 + _CONSTANT + knot.noise**2 + knot.doubt
        deviation = np.sqrt(np.maximum(own - (row * row).sum(axis=1), knot.noise**2))
        self._inverse_factor[:, n, :n] = np.einsum("hi,hij->hj", row, factor) / -deviation[:, None]
        self._inverse_factor[:, n, n] = 1.0 / deviation
        white = (residual - (row * self._white[:, :n]).sum(axis=1)) / deviation
        self._white[:, n] = white
        self._log_likelihood -= 0.5 * white * white + np.log(deviation)

    def _weigh(self) -> None:
        spreads = self._spreads
        parts = np.exp(-0.5 * (self._biases[:, None] / spreads) ** 2) * (self._spread_share / spreads)
        log = np.log(parts.sum(axis=1) + 1e-300) + self._log_mass + self._log_likelihood
        weights = np.exp(log - log.max())
        self._weights = weights / weights.sum()


def _thinned(knots: list[Knot]) -> list[Knot]:
    """Every second knot from the first on, because walks end where they began; each with the way from the one kept.

    `knots` is even in number; the way to the last one, which is not kept, is the caller's to add.
    """
    kept = knots[:1]
    for first, second in zip(knots[1:-1:2], knots[2::2], strict=True):
        kept.append(second._replace(move=first.move + second.move))
    return kept
