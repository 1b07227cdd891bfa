"""Speed over ground along the boresight's projection from the pulse pair in every range cell, all cells at once.

Letters: R range, g grazing angle (sin g = height / R), f carrier, T scan period, c speed of light, x analytic scans.
Ground at azimuth phi off the boresight closes at cos(g) (v_f cos phi + v_l sin phi) - v_z sin(g); over the beam sin phi
averages to nothing and cos phi to I1/I0 of kappa (see `beam_factor`). So the phase of x(t) conj(x(t - T)), in sum over
the window and over one cell, is 4 pi f T / c times cos(g) I1/I0 v_f - sin(g) v_z: linear in two unknowns, which all
cells share (cane.md, "Pulse pair").
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from numpy.typing import NDArray

from caneflow.algorithms.attitude_history import AttitudeHistory
from caneflow.algorithms.footprint import CaneGeometry, antenna_height, pitch
from caneflow.algorithms.moving_returns import MovingReturns, RadarParameters
from caneflow.algorithms.range_doppler import SPEED_OF_LIGHT

Floats = NDArray[np.float64]
UNOBSERVED: Final = 1e6  # (m/s)^2, variance of a component that is not observed (wire.md)


@dataclass(frozen=True, kw_only=True)
class GroundVelocitySettings:
    """What the pulse pair may be told."""

    enabled: bool = True
    window: Annotated[int, Ge(2)] = 5  # pairs of scans in a sum
    cell: Annotated[float, Gt(0)] = 0.075  # m of range in a sum: the pulse is 0.09 m long
    shallowest: Annotated[float, Gt(0)] = math.radians(16)  # rad, grazing angle
    steepest: Annotated[float, Lt(math.pi / 2)] = math.radians(75)  # rad
    beam_share: Annotated[float, Gt(0)] = 0.7  # of the aperture, off the boresight, that is looked at
    least_coherence: Annotated[float, Gt(0), Lt(1)] = 0.4  # of a cell that counts
    fewest_cells: Annotated[int, Ge(3)] = 5
    outlier: Annotated[float, Gt(0)] = 0.3  # rad of phase, at which a cell's weight has fallen to a half
    vertical_speed: Annotated[float, Gt(0)] = 0.12  # m/s, sd of the hand's: bob of 12 mm at 1.1 steps per second
    alias_share: Annotated[float, Gt(0), Le(1)] = 0.9  # of the unambiguous radial speed up to which a fit counts
    rest_coherence: Annotated[float, Ge(0), Lt(1)] = 0.25  # of all ground below which nothing moves
    rest_turn_rate: Annotated[float, Gt(0)] = math.radians(5.0)  # rad/s, mean norm over the window
    rest_speed: Annotated[float, Gt(0)] = 0.02  # m/s, sd of the antenna's at rest: drift and tremor of a hand


@dataclass(frozen=True, kw_only=True)
class VelocityEstimate:
    """Velocity of the antenna over ground: along the boresight's horizontal projection, and to its left."""

    velocity: tuple[float, float]  # m/s; 0 where not observed
    covariance: tuple[float, float, float]  # xx, xy, yy, (m/s)^2; UNOBSERVED where not observed
    delay: float  # s from the window's middle, where the estimate belongs, to the newest scan
    valid: bool  # some component is observed


@dataclass(frozen=True, kw_only=True, eq=False)
class PulsePairs:
    """Sums over the window and over one range cell each, for K cells."""

    pairs: NDArray[np.complex128]  # shape (K,), sums of x(t) conj(x(t - T))
    power: Floats  # shape (K,), sums of |x(t)|^2 and |x(t - T)|^2, the mean of both
    ranges: Floats  # shape (K,) m, of the cells' middles

    def coherence(self) -> Floats:
        """How alike neighbouring scans are, 0..1, shape (K,)."""
        coherence: Floats = np.abs(self.pairs) / (self.power + 1e-30)
        return np.minimum(coherence, 1.0)


class PulsePairWindow:
    """Pulse pairs of the newest scans; its state is the last scan and one row of sums per pair."""

    def __init__(self, *, window: int, cell: float) -> None:
        """For sums over `window` pairs of scans and over cells of `cell` m."""
        self._window, self._cell = window, cell
        self._stamps_ns: deque[int] = deque(maxlen=window + 1)
        self._bins = 0  # of a cell
        self._ranges: Floats = np.zeros(0)
        self._last = np.zeros(0, np.complex64)
        self._last_power: Floats = np.zeros(0)
        self._pairs = np.zeros((window, 0), np.complex128)
        self._power = np.zeros((window, 0))
        self._next = 0

    def push(self, returns: MovingReturns) -> None:
        """Take the scans of one more frame."""
        if returns.restarted:
            self._start_anew(returns.scans.shape[1], returns.parameters)
        for scan, stamp_ns in zip(returns.scans, returns.stamps_ns, strict=True):
            self._push(scan, stamp_ns)

    def interval_ns(self) -> tuple[int, int] | None:
        """Stamps of the oldest and the newest scan in the sums; None while there are too few."""
        if len(self._stamps_ns) <= self._window:
            return None
        return self._stamps_ns[0], self._stamps_ns[-1]

    def sums(self) -> PulsePairs:
        """The sums over the whole window."""
        return PulsePairs(pairs=self._pairs.sum(axis=0), power=self._power.sum(axis=0), ranges=self._ranges)

    def _push(self, scan: NDArray[np.complex64], stamp_ns: int) -> None:
        power = self._in_cells((scan * scan.conj()).real).astype(np.float64)
        if self._stamps_ns:
            self._pairs[self._next] = self._in_cells(scan * self._last.conj())
            self._power[self._next] = 0.5 * (power + self._last_power)
            self._next = (self._next + 1) % self._window
        self._last, self._last_power = scan, power
        self._stamps_ns.append(stamp_ns)

    def _in_cells(self, values: NDArray[np.inexact]) -> NDArray[np.inexact]:
        count = len(self._ranges)
        summed: NDArray[np.inexact] = values[: count * self._bins].reshape(count, self._bins).sum(axis=1)
        return summed

    def _start_anew(self, bins: int, parameters: RadarParameters) -> None:
        self._bins = max(1, min(bins, round(self._cell / parameters.range_step)))
        count = bins // self._bins
        middles = self._bins * np.arange(count) + 0.5 * (self._bins - 1)
        self._ranges = parameters.range_start + parameters.range_step * middles
        self._pairs = np.zeros((self._window, count), np.complex128)
        self._power = np.zeros((self._window, count))
        self._next = 0
        self._stamps_ns.clear()


def beam_factor(grazing: Floats, axis: float, aperture: float) -> Floats:
    """Mean of cos(phi) over the beam's power at each grazing angle; angles and `aperture` (delta) in rad.

    The two-way power of a Gaussian beam is exp(-8 ln2 (theta / delta)^2), and theta^2 is nearly 2 - 2 cos(theta), with
    cos(theta) = cos(g) cos(axis) cos(phi) + sin(g) sin(axis): a von Mises density in phi of
    kappa = 16 ln2 cos(g) cos(axis) / delta^2, whose mean cosine is I1 / I0, here by its series for large kappa.
    """
    kappa = np.maximum(16.0 * math.log(2.0) * np.cos(grazing) * math.cos(axis) / aperture**2, 1.0)
    factor: Floats = 1.0 - (0.5 + (0.125 + 0.125 / kappa) / kappa) / kappa
    return factor


class GroundVelocityEstimator:
    """Takes moving returns frame by frame; its state is the window of pulse pairs."""

    def __init__(self, settings: GroundVelocitySettings, geometry: CaneGeometry) -> None:
        self._settings = settings
        self._geometry = geometry
        self._window = PulsePairWindow(window=settings.window, cell=settings.cell)
        self.debug = None
        self.dh = 0.0
        self.Ph = 0.03**2
        self.usevz = True
        self.useh = True
        self.sdz = 0.02
        self.corr = 50.0

    def update(self, returns: MovingReturns, attitudes: AttitudeHistory) -> VelocityEstimate:
        settings = self._settings
        self._window.push(returns)
        interval = self._window.interval_ns()
        delay = 0.5 * settings.window * returns.parameters.scan_period
        self.debug = None
        if interval is None:
            return _nothing(delay)
        oldest_ns, newest_ns = interval
        delay = (newest_ns - oldest_ns) * 0.5e-9
        period = 2 * delay / settings.window
        orientation = attitudes.at((oldest_ns + newest_ns) // 2)
        before, after = attitudes.at(oldest_ns), attitudes.at(newest_ns)
        if orientation is None or before is None or after is None:
            return _nothing(delay)
        geometry = self._geometry
        height = antenna_height(geometry, orientation)
        axis = pitch(geometry, orientation)
        hz, hv = self.heave.at((oldest_ns + newest_ns) // 2)
        rise = hv if self.usevz else (antenna_height(geometry, after) - antenna_height(geometry, before)) / (2 * delay)
        if self.usevz:
            height = hz
        height += self.dh
        sums = self._window.sums()
        sine = height / sums.ranges
        seen = (sine > math.sin(settings.shallowest)) & (sine < math.sin(settings.steepest))
        grazing = np.arcsin(np.minimum(sine, 1.0))
        seen &= np.abs(grazing - axis) < settings.beam_share * geometry.aperture
        pairs, power = sums.pairs[seen], sums.power[seen]
        if len(pairs) < settings.fewest_cells:
            return _nothing(delay)
        grazing, sine = grazing[seen], sine[seen]
        total = float(power.sum()) + 1e-30
        coherence_all = float(np.abs(pairs).sum()) / total
        coherence = np.minimum(np.abs(pairs) / (power + 1e-30), 0.999)
        rate = attitudes.mean_turn_rate(oldest_ns, newest_ns)
        per_speed = 4 * math.pi * returns.parameters.carrier * period / SPEED_OF_LIGHT
        forward = per_speed * np.cos(grazing) * beam_factor(grazing, axis, geometry.aperture)
        vertical = -per_speed * sine
        phase = np.angle(pairs * np.exp(-1j * vertical * rise))
        weight = np.where(coherence > settings.least_coherence, coherence**2 / (1 - coherence**2), 0.0)
        weight = np.minimum(weight, 30)
        self.debug = dict(coh=coherence_all, rate=rate, n=int((weight > 0).sum()), tot=total / len(pairs))
        if (weight > 0).sum() < settings.fewest_cells:
            return _nothing(delay)
        # start: weighted median of per-cell speeds
        v = phase / forward
        o = np.argsort(v)
        cw = np.cumsum((weight * forward**2)[o])
        vf = v[o][np.searchsorted(cw, 0.5 * cw[-1])]
        vz = dh = 0.0
        pz = 1.0 / self.sdz**2
        ph = 1.0 / self.Ph
        slope = per_speed * -np.tan(grazing) * sine / height
        slope = slope * beam_factor(grazing, axis, geometry.aperture)
        for _ in range(4):
            cols = np.stack([forward, vertical, slope * vf])
            r = phase - vf * forward - vz * vertical - 0 * dh * slope * vf
            w = weight / (1 + (r / settings.outlier) ** 2) ** 2 * 2
            N = np.einsum("ik,k,jk->ij", cols, w, cols)
            y = np.einsum("ik,k,k->i", cols, w, phase)
            N[1, 1] += pz
            N[2, 2] += ph
            vf, vz, dh = np.linalg.solve(N, y).tolist()
            if not self.useh:
                dh = 0.0
        C = np.linalg.inv(N)
        r = phase - forward * vf - vertical * vz - slope * vf * dh
        s2 = float((w * r * r).sum() / max(w.sum(), 1e-9))
        var = float(C[0, 0])
        if self.useh:
            info = max(1 / C[2, 2] - ph, 0) / self.corr
            self.Ph += 0.002**2 * period
            K = info and self.Ph * info / (1 + self.Ph * info)
            # dh is the posterior mean with prior 0 of sd Ph; data-only value
            data = dh * (1 / C[2, 2]) / max(1 / C[2, 2] - ph, 1e-9) if info else 0.0
            self.dh += K * data
            self.Ph *= 1 - K
        fit = float((np.abs(pairs) * np.cos(r)).sum()) / total
        self.debug.update(coh2=fit, vz=vz + rise, s2=s2, var=var, W=float(w.sum()), dh=self.dh)
        return VelocityEstimate(velocity=(vf, 0.0), covariance=(var, 0.0, UNOBSERVED), delay=delay, valid=True)


def _nothing(delay: float) -> VelocityEstimate:
    return VelocityEstimate(velocity=(0.0, 0.0), covariance=(UNOBSERVED, 0.0, UNOBSERVED), delay=delay, valid=False)
