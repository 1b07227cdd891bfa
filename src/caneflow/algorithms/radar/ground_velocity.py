"""Speed over ground along the boresight's projection from the pulse pair in every range cell, all cells at once.

Letters: R range, g grazing angle (sin g = height / R), f carrier, T scan period, c speed of light, x analytic scans.
Ground at azimuth phi off the boresight closes at cos(g) (v_f cos phi + v_l sin phi) - v_z sin(g). Over the beam sin phi
averages to nothing and cos phi to `beam_factor`. So the phase of x(t) conj(x(t - T)), in sum over the window and one
cell, is 4 pi f T / c times cos(g) beam v_f - sin(g) v_z: linear, and the same two unknowns in all cells (cane.md,
"Pulse pair"). v_z comes from the accelerometer, which knows it to a centimetre per second; the height, which nobody
knows to a centimetre, is a third unknown that a whole walk determines.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Annotated, Final, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.inertial.attitude_history import LONGEST_STEP_NS, AttitudeHistory
from caneflow.algorithms.inertial.heave import HeaveObserver, HeaveSettings
from caneflow.algorithms.inertial.imu_sample import LONGEST_INTERVAL
from caneflow.algorithms.quantities import (
    Density,
    Elevation,
    Factor,
    Fraction,
    Length,
    OpenFraction,
    Speed,
    Time,
    TurnRate,
    Zero,
)
from caneflow.algorithms.radar.doppler_spread import doppler_spread
from caneflow.algorithms.radar.effective_range import EffectiveRanges
from caneflow.algorithms.radar.footprint import CaneGeometry, antenna_height, pitch
from caneflow.algorithms.radar.matched_velocity import Doubts, lag_sums, matched_speed
from caneflow.algorithms.radar.moving_returns import MovingReturns
from caneflow.algorithms.radar.pulse_pairs import PulsePairWindow
from caneflow.algorithms.radar.rest import ground_stands
from caneflow.algorithms.rotations import Quaternion, Vector, rotate
from caneflow.physics import GRAVITY, SPEED_OF_LIGHT

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]

UNOBSERVED: Final = 1e6  # (m/s)^2, variance of a component that is not observed (wire.md)
_LOWEST_SPEED, _SPEED_STEP, _SPEEDS = -2.0, 0.4, 16  # m/s to begin with; so near that the nearest is the best
_MOST_COHERENT: Final = 0.96  # squared coherence above which noise is not what limits a cell
_FAINT: Final = 1e-30  # power of nothing
LOOKED_PAIRS: Final = 5  # of scans, for which `looks` are stated
ONE_BIN: Final = 1e-9  # m, less than any bin
MANY_PAIRS: Final = 25  # in a window, from which on scans are weighed together and not cell by cell
_HEAVES: Final = 64  # IMU samples that a window's middle may lie back


@dataclass(frozen=True, kw_only=True)
class GroundVelocitySettings:
    """What the pulse pair may be told."""

    window: Annotated[float, Ge(1e-3), Le(2)] = 0.05  # s of pairs of scans in a sum
    every: Annotated[float, Ge(0), Le(2)] = 0.05  # s from one estimate to the next: windows that overlap err alike
    cell: Length = 0.075  # m of range in a sum: the pulse is 0.09 m long
    # rms length of the pulse's power over c / 2 bandwidth: a Gaussian cut off at -10 dB, 3.65 cm of range at 1.7 GHz
    pulse_spread: Factor | Zero = 0.414
    shallowest: Elevation = math.radians(16)  # rad, grazing angle
    steepest: Elevation = math.radians(75)  # rad
    beam_share: Factor = 0.7  # of the aperture, to either side of the boresight, that is looked at
    fewest_cells: Annotated[int, Ge(3), Le(1000)] = 5
    looks: Factor = 2.75  # independent ones per cell and 5 pairs of scans: their 40 samples share one speckle
    outlier: Speed = 0.3  # rad of phase, from which on a cell loses its weight: walls, people
    least_fit: OpenFraction = 0.3  # coherence of all cells with the fit that counts as ground seen
    alias_share: Fraction = 0.9  # of the unambiguous radial speed up to which a fit counts
    vertical_speed: Speed = 0.12  # m/s, sd without an accelerometer: a bob of 12 mm at 1.1 Hz
    heave_error: Speed = 0.02  # m/s, sd of the vertical speed with one
    height_error: Length = 0.03  # m, sd of a person's hand about the rig's height
    height_walk: Density | Zero = 0.002  # m / sqrt(s)
    height_time: Time = 0.5  # s that tell the height as much as one estimate would by itself
    spread_window: Time | Zero = 0.25  # s of scans whose Doppler's width is looked at, once in as long
    spread_lag: Time = 0.03  # s between scans that are compared with neighbours
    rest_turn_rate: TurnRate = math.radians(5.0)  # rad/s, mean norm, below which standing ground is rest
    rest_speed: Speed = 0.03  # m/s, sd of the antenna's then: drift and tremor of a hand
    rest_standing: Factor = 0.05  # of a scan's noise, power of the ground that stands then
    least_significance: Factor = 6.0  # of the sum of pairs over its noise, with many scans in a window
    speckle: Fraction = 0.02  # of the speed, sd that no window helps against: which scatterers are lit the most
    least_error: Speed = 0.01  # m/s, sd below which no velocity of many scans is claimed
    heave: HeaveSettings = field(default_factory=HeaveSettings)

    def __post_init__(self) -> None:
        if self.shallowest >= self.steepest:
            raise ValueError(f"shallowest is {self.shallowest:.3g} rad; it is less than steepest, {self.steepest:.3g}")


@dataclass(frozen=True, kw_only=True)
class VelocityEstimate:
    """Velocity of the antenna over ground: along the boresight's horizontal projection, and to its left."""

    velocity: tuple[float, float]  # m/s; 0 where not observed
    covariance: Triple  # xx, xy, yy, (m/s)^2; UNOBSERVED where not observed
    delay: float  # s from the window's middle, where the estimate belongs, to the newest scan
    valid: bool  # some component is observed
    spread: float | None = None  # m/s, the speed to the side that would make the Doppler as wide as it is
    spread_delay: float | None = None  # s, from where it belongs to the newest scan


class Fit(NamedTuple):
    """Solution of the weighted least squares: forward and vertical speed (m/s), error of the height (m)."""

    forward: float
    vertical: float
    height: float
    forward_variance: float
    height_variance: float
    residual: Floats  # rad, (K,)


class _Cells(NamedTuple):
    """The lit cells of one window: K of them."""

    pairs: NDArray[np.complex128]
    power: Floats
    per_forward: Floats  # rad per m/s
    per_vertical: Floats  # rad per m/s
    per_height: Floats  # rad per m/s and m
    cosine: Floats  # of the grazing angle
    per_speed: float  # rad per m/s of radial speed
    first: int  # number of the first of them in the window


def beam_factor(cos_grazing: Floats, axis: float, aperture: float) -> Floats:
    """Mean of cos(phi) over the beam's two-way power, at each grazing angle; `axis` (alpha0) and `aperture` in rad.

    The power of a Gaussian beam is exp(-8 ln2 (theta / delta)^2), theta^2 is nearly 2 - 2 cos(theta), and cos(theta) =
    cos(g) cos(axis) cos(phi) + sin(g) sin(axis): a von Mises density in phi, kappa = 16 ln2 cos(g) cos(axis) / delta^2,
    whose mean cosine is I1(kappa) / I0(kappa), here by its series for large kappa.
    """
    inverse = aperture**2 / (16.0 * math.log(2.0) * math.cos(axis)) / cos_grazing
    factor: Floats = 1.0 - inverse * (0.5 + inverse * (0.125 + 0.125 * inverse))
    return factor


class GroundVelocityEstimator:
    """Takes IMU samples and moving returns as they come; its state is the window, the heave and the height's error."""

    def __init__(self, settings: GroundVelocitySettings, geometry: CaneGeometry) -> None:
        self._settings = settings
        self._geometry = geometry
        self._pairs, self._period = 2, 0.0  # of scans in a window; s between scans
        self._window = PulsePairWindow(window=self._pairs, cell=settings.cell)
        self._long_scans = 0  # in the window of the Doppler's width, 0: it is not looked at
        self._since_spread = 0.0  # s
        self._ranges = EffectiveRanges(settings.pulse_spread)
        self._last_ns: int | None = None  # when an estimate was due last
        self._heave = HeaveObserver(settings.heave)
        self._heaves: deque[tuple[int, float, float]] = deque(maxlen=_HEAVES)  # stamp, height, rate
        self._height_error = 0.0  # m, to be added to the rig's
        self._height_variance = settings.height_error**2

    @property
    def height_error(self) -> float:
        """By how much (m) the antenna is higher than the rig says, as the radar has it."""
        return self._height_error

    def imu(self, stamp_ns: int, orientation: Quaternion, accel: Vector | None) -> None:
        """Follow the antenna up and down: attitude, and specific force in the body frame (m/s^2) where known."""
        if accel is None:
            return
        elapsed = (stamp_ns - self._heaves[-1][0]) * 1e-9 if self._heaves else 0.0
        if not 0.0 <= elapsed <= LONGEST_INTERVAL:
            self._heave = HeaveObserver(self._settings.heave)
            elapsed = 0.0
        if elapsed > LONGEST_STEP_NS * 1e-9:  # a hole: what the accelerometer said before and after says nothing of it
            self._heave.bridge(elapsed)
            elapsed = 0.0
        rise = rotate(orientation, accel)[2] - GRAVITY
        self._heave.update(elapsed, rise, antenna_height(self._geometry, orientation))
        self._heaves.append((stamp_ns, self._heave.height, self._heave.rate))

    def update(self, returns: MovingReturns, attitudes: AttitudeHistory) -> VelocityEstimate | None:
        """The estimate after one more frame; None where none is due.

        Not valid while the window is not full, without an attitude in its middle, where the beam shows too little
        ground or ground that does not move as one, and near the limit of unambiguous Doppler.
        """
        settings = self._settings
        if returns.restarted:
            self._begin(returns)
        self._window.push(returns)
        if returns.restarted:
            self._ranges.start(returns.scans.shape[1], self._window.cell_bins, returns.parameters)
        elapsed = self._due(returns)
        if elapsed is None:
            return None
        if self._pairs < MANY_PAIRS:
            self._ranges.learn(returns.scans[-1], elapsed)
        interval = self._window.interval_ns()
        if interval is None:
            return _nothing(0.5 * self._pairs * returns.parameters.scan_period)
        oldest_ns, newest_ns = interval
        delay = (newest_ns - oldest_ns) * 0.5e-9
        middle_ns = (oldest_ns + newest_ns) // 2
        orientation = attitudes.near(middle_ns)
        if orientation is None:
            return _nothing(delay)
        height, rise, rise_error = self._vertical(middle_ns, orientation)
        per_speed = 4 * math.pi * returns.parameters.carrier * (2 * delay / self._pairs) / SPEED_OF_LIGHT
        axis = pitch(self._geometry, orientation)
        if self._pairs >= MANY_PAIRS:
            turn_rate = attitudes.mean_turn_rate(oldest_ns, newest_ns)
            still = turn_rate is not None and turn_rate < settings.rest_turn_rate
            return self._matched(returns, (height, rise, rise_error), axis, per_speed, delay, still=still)
        cells = self._lit(height + self._height_error, axis, per_speed)
        if cells is None:
            return _nothing(delay)
        fit = self._fit(cells, rise, rise_error)
        total = float(np.add.reduce(cells.power))
        self._since_spread += elapsed
        coherence = float(np.add.reduce(np.abs(cells.pairs) * np.cos(fit.residual))) / total if total > 0 else 0.0
        if coherence < settings.least_fit:
            turn_rate = attitudes.mean_turn_rate(oldest_ns, newest_ns)
            still = turn_rate is not None and turn_rate < settings.rest_turn_rate
            if still and self._ground_stands(returns, cells):
                return _rest(delay, settings.rest_speed)
            return _nothing(delay)
        if float(np.maximum.reduce(cells.per_forward)) * abs(fit.forward) > settings.alias_share * math.pi:
            return _nothing(delay)
        self._learn_height(fit, elapsed)
        spread = self._spread(cells, returns.parameters.scan_period, axis)
        return VelocityEstimate(
            velocity=(fit.forward, 0.0),
            covariance=(fit.forward_variance, 0.0, UNOBSERVED),
            delay=delay,
            valid=True,
            spread=spread,
            spread_delay=None if spread is None else 0.5 * (self._long_scans - 1) * returns.parameters.scan_period,
        )

    def _spread(self, cells: _Cells, period: float, axis: float) -> float | None:
        """Width of the Doppler over the long window, m/s to the side; None where none is due, or to be had."""
        settings = self._settings
        if not self._long_scans or not self._window.is_filled:
            return None
        if self._since_spread < settings.spread_window - 0.5 * settings.every:
            return None
        self._since_spread = 0.0
        aperture = self._geometry.aperture_across or self._geometry.aperture
        per_sideways = cells.cosine * (cells.per_speed**2 * aperture**2 / (16.0 * math.log(2.0) * math.cos(axis)))
        scans = self._window.long_scans(cells.first, len(cells.power))
        lag = _lag(settings, period)
        return doppler_spread(scans, self._window.cell_bins, lag, per_sideways, least_fit=settings.least_fit)

    def _begin(self, returns: MovingReturns) -> None:
        """Make the window for scans of another period; all that was in it is forgotten anyway."""
        period = returns.parameters.scan_period
        pairs = max(round(self._settings.window / period), 2)
        if (pairs, period) != (self._pairs, self._period):
            self._pairs, self._period = pairs, period
            # weak scans are not added up before they are compared: phases of neighbouring bins need not be alike
            cell = ONE_BIN if pairs >= MANY_PAIRS else self._settings.cell
            settings, self._long_scans = self._settings, 0
            if settings.spread_window and pairs < MANY_PAIRS:
                self._long_scans = round(settings.spread_window / period) + _lag(settings, period)
            self._window = PulsePairWindow(window=pairs, cell=cell, kept=self._long_scans)

    def _due(self, returns: MovingReturns) -> float | None:
        """Seconds since the last estimate was due, if one is now: to the nearest frame."""
        now = returns.stamps_ns[-1]
        frame = len(returns.scans) * returns.parameters.scan_period
        if self._last_ns is None or self._last_ns > now:
            self._last_ns = now - round(frame * 1e9)
        elapsed = (now - self._last_ns) * 1e-9
        if elapsed < self._settings.every - 0.5 * min(frame, self._settings.every):
            return None
        self._last_ns = now
        return elapsed

    def _matched(
        self, returns: MovingReturns, vertical: Triple, axis: float, per_speed: float, delay: float, *, still: bool
    ) -> VelocityEstimate:
        """The estimate of a window of many scans: weak as they are, together they tell."""
        settings, (height, rise, rise_error) = self._settings, vertical
        between = self._lit_ranges(height, axis)
        if between is None:
            return _nothing(delay)
        scans, ranges, first = self._window.scans(*between)
        if not len(ranges):
            return _nothing(delay)
        along, across, per_height = self._slopes(ranges, height, axis, per_speed)
        sums = lag_sums(scans)
        doubts = Doubts(rise=rise_error, least=settings.least_error, speckle=settings.speckle)
        found = matched_speed(sums, along, across, per_height, rise, doubts)
        if found is None or found.significance < settings.least_significance:
            standing = self._window.power(returns.standing.scan(), first, len(ranges))
            rest = float(sums.power.mean())
            share = returns.standing.noise_share
            if still and ground_stands(standing, rest, share, settings.rest_standing):
                return _rest(delay, settings.rest_speed)
            return _nothing(delay)
        if float(along.max()) * abs(found.forward) > settings.alias_share * math.pi:
            return _nothing(delay)
        variance = found.variance + (found.per_height * settings.height_error) ** 2
        return VelocityEstimate(
            velocity=(found.forward, 0.0), covariance=(variance, 0.0, UNOBSERVED), delay=delay, valid=True
        )

    def _vertical(self, stamp_ns: int, orientation: Quaternion) -> Triple:
        """Height (m) and vertical speed (m/s) of the antenna at a stamp, and the speed's sd."""
        for stamp, height, rate in reversed(self._heaves):
            if stamp <= stamp_ns:
                return height, rate, self._settings.heave_error
        return antenna_height(self._geometry, orientation), 0.0, self._settings.vertical_speed

    def _lit(self, height: float, axis: float, per_speed: float) -> _Cells | None:
        """The cells that the beam lights, with the derivatives of their phase; None when there are too few."""
        settings = self._settings
        between = self._lit_ranges(height, axis)
        if between is None:
            return None
        sums = self._window.sums(*between)
        if len(sums.ranges) < settings.fewest_cells:
            return None
        ranges = sums.ranges
        if settings.pulse_spread:
            ranges = self._ranges.of_cells(sums.first, len(ranges))
            np.maximum(ranges, between[0], out=ranges)  # nothing is lit more steeply
        along, sine, per_height = self._slopes(ranges, height, axis, per_speed)
        return _Cells(
            pairs=sums.pairs,
            power=sums.power,
            per_forward=along,
            per_vertical=sine,
            per_height=per_height,
            cosine=np.sqrt(1.0 - (height / ranges) ** 2),
            per_speed=per_speed,
            first=sums.first,
        )

    def _lit_ranges(self, height: float, axis: float) -> tuple[float, float] | None:
        """From where to where (m) the beam lights the ground; None where it does not."""
        settings = self._settings
        half = settings.beam_share * self._geometry.aperture
        low, high = max(axis - half, settings.shallowest), min(axis + half, settings.steepest)
        if low >= high or height <= 0.0:
            return None
        return height / math.sin(high), height / math.sin(low)

    def _slopes(self, ranges: Floats, height: float, axis: float, per_speed: float) -> tuple[Floats, Floats, Floats]:
        """How a cell's phase from scan to scan depends on forward and vertical speed, and per speed on the height."""
        sine = height / ranges
        cosine = np.sqrt(1.0 - sine * sine)
        along = beam_factor(cosine, axis, self._geometry.aperture_across or self._geometry.aperture)
        along *= cosine
        along *= per_speed
        sine *= -per_speed
        return along, sine, along * (-height / (cosine * ranges) ** 2)

    def _ground_stands(self, returns: MovingReturns, cells: _Cells) -> bool:
        """Whether the lit cells show ground that stands still."""
        settings = self._settings
        standing = self._window.power(returns.standing.scan(), cells.first, len(cells.power))
        rest = float(np.add.reduce(cells.power)) / (len(cells.power) * self._pairs)
        return ground_stands(standing, rest, returns.standing.noise_share, settings.rest_standing)

    def _fit(self, cells: _Cells, rise: float, rise_error: float) -> Fit:
        """Weighted least squares about the best of a few speeds, reweighted for outliers.

        The speeds to begin with reach beyond the limit of unambiguous Doppler: ranges see the speed under different
        angles, so that a speed that has come round fits worse than the true one, and can be refused for what it is.
        """
        settings = self._settings
        # over the power: a strong wall has no more to say than faint ground
        pairs = cells.pairs * np.exp(cells.per_vertical * (-1j * rise)) / (cells.power + _FAINT)
        square = pairs.real**2 + pairs.imag**2
        np.minimum(square, _MOST_COHERENT, out=square)
        weight = square / (1.0 - square)
        weight *= 2.0 * settings.looks * max(self._pairs / LOOKED_PAIRS, 1.0)
        # the pairs turned back by each of the speeds to begin with, one more step for every row
        turned = np.empty((_SPEEDS, len(pairs)), np.complex128)
        turned[0] = pairs * np.exp(cells.per_forward * (-1j * _LOWEST_SPEED))
        turned[1:] = np.exp(cells.per_forward * (-1j * _SPEED_STEP))
        np.multiply.accumulate(turned, out=turned)
        forward = _LOWEST_SPEED + _SPEED_STEP * int(np.add.reduce(turned.real, axis=1).argmax())
        off = pairs * np.exp(cells.per_forward * (-1j * forward))
        expected = cells.per_forward * forward
        phase = np.arctan2(off.imag, off.real) + expected
        vertical = height = 0.0
        residual = phase - expected
        columns = np.empty((4, len(pairs)))  # of the three unknowns, and what they explain
        columns[0], columns[1], columns[3] = cells.per_forward, cells.per_vertical, phase
        for _ in range(3):
            doubt = residual * (1.0 / settings.outlier)
            doubt *= doubt
            doubt += 1.0
            columns[2] = cells.per_height * forward
            weighted = columns[:3] * (weight / (doubt * doubt))
            normal = np.einsum("ik,jk->ij", weighted, columns).tolist()
            normal[0][0] += 1.0 / UNOBSERVED
            normal[1][1] += 1.0 / rise_error**2
            normal[2][2] += 1.0 / self._height_variance
            (forward, vertical, height), (variance, height_variance) = _solved(normal)
            residual = phase - cells.per_forward * forward - cells.per_vertical * vertical - columns[2] * height
        return Fit(forward, rise + vertical, height, variance, height_variance, residual)

    def _learn_height(self, fit: Fit, elapsed: float) -> None:
        """One frame's word on the height; frames that share their ground count for little each."""
        settings, before = self._settings, self._height_variance
        information = max(1.0 / fit.height_variance - 1.0 / before, 0.0)
        if information * before < 1e-9:
            return
        seen = fit.height * (1.0 + 1.0 / (information * before))  # what the frame alone would say
        before += settings.height_walk**2 * elapsed
        looks = max(settings.height_time / elapsed, 1.0)
        gain = before * information / (looks + before * information)
        self._height_error += gain * seen
        self._height_variance = before * (1.0 - gain)


def _solved(normal: list[list[float]]) -> tuple[Triple, tuple[float, float]]:
    """Solution of three equations, (3, 4) with their right sides, and the inverse's first and last diagonal element.

    The matrix is symmetric; by cofactors.
    """
    (a, b, c, p), (_, d, e, q), (_, _, f, r) = normal
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * ab + c * ac
    solution = (
        (aa * p + ab * q + ac * r) / determinant,
        (ab * p + bb * q + bc * r) / determinant,
        (ac * p + bc * q + cc * r) / determinant,
    )
    return solution, (aa / determinant, cc / determinant)


def _lag(settings: GroundVelocitySettings, period: float) -> int:
    """Scans between those that are compared with neighbours."""
    return max(round(settings.spread_lag / period), 2)


def _rest(delay: float, speed: float) -> VelocityEstimate:
    return VelocityEstimate(
        velocity=(0.0, 0.0), covariance=(speed * speed, 0.0, speed * speed), delay=delay, valid=True
    )


def _nothing(delay: float) -> VelocityEstimate:
    return VelocityEstimate(velocity=(0.0, 0.0), covariance=(UNOBSERVED, 0.0, UNOBSERVED), delay=delay, valid=False)
