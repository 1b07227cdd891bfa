"""The paper's speed over ground: superior edges of Doppler spectra along the rays of the beam (paper IV, eq. 1-4).

One estimate per frame, over the newest `window` scans; it belongs to the window's middle. Rows are cane.md's.
"""

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, field
from operator import mul
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.quantities import Elevation, Factor, Fraction, OpenFraction, Speed, Zero
from caneflow.algorithms.radar.edges import EDGE_BEYOND_SPEED, superior_edges
from caneflow.algorithms.radar.footprint import NO_RAYS, CaneGeometry, Fan, RayCaster, Rays, antenna_height, pitch
from caneflow.algorithms.radar.moving_returns import MovingReturns, RadarParameters
from caneflow.algorithms.radar.range_doppler import SlowTimeWindow, hann, speed_per_bin
from caneflow.algorithms.radar.rest import RestSettings, ground_stands, is_at_rest, median, peaks_and_floor
from caneflow.algorithms.rotations import Quaternion

RECEDING_SHARE = 0.25  # of the approaching peak: with a beam of 50 deg, walking and swinging stay below it

Average: TypeAlias = Literal["mean", "median", "weighted"]


@dataclass(frozen=True, kw_only=True)
class PaperSpeedSettings:
    """What the paper leaves open, and our choice."""

    window: Annotated[int, Ge(8), Le(8192)] = 64  # scans, N (row 4)
    transform: Annotated[int, Ge(16), Le(65536)] = 256  # Doppler bins, zero-padded from the window
    rays: Annotated[int, Ge(2), Le(1024)] = 16  # K (row 5)
    aperture_share: Fraction = 0.8  # of the rig's aperture, that the rays span
    shallowest: Elevation = math.radians(18)  # rad, of a ray to the ground
    steepest: Elevation = math.radians(80)  # rad
    compensate_edge: bool = True  # take off what the edge lies beyond the speed (row 6)
    edge_beyond_speed: Speed | Zero = EDGE_BEYOND_SPEED  # resolution cells of the window
    average: Average = "mean"  # f and g of eq. 3, 4 (row 7); weighted: by the height of a ray's fall
    agreement: Speed = 0.25  # m/s, from the rays' median, within which a ray agrees
    fewest_rays: Annotated[int, Ge(1), Le(1024)] = 8  # that must agree
    least_peak: Factor = 6.0  # of a ray's Doppler power, in noise floors
    alias_share: Fraction = 0.9  # of the radial speed limit, up to which an edge counts
    most_lost: OpenFraction | Zero = 0.25  # share of a window's scans that may be missing
    rest: RestSettings = field(default_factory=RestSettings)


class SpeedEstimate(NamedTuple):
    """Speed of the antenna over ground along the boresight's projection, and how far to trust it."""

    speed: float  # m/s, eq. 3; 0 when not valid
    quality: float  # m/s, eq. 4, spread over the rays: smaller is better; inf when not valid
    rays: int  # that showed an edge and were averaged
    valid: bool
    delay: float  # s from the window's middle, where the estimate belongs, to the newest scan


class PaperSpeed:
    """Takes moving returns frame by frame; its state is the sliding window."""

    def __init__(self, settings: PaperSpeedSettings, geometry: CaneGeometry) -> None:
        """Raises ValueError for settings that contradict each other."""
        if settings.transform < settings.window:
            raise ValueError(f"transform is {settings.transform}; it is at least window, {settings.window}")
        if settings.shallowest >= settings.steepest:
            raise ValueError(
                f"shallowest is {settings.shallowest:.3g} rad; it is less than steepest, {settings.steepest:.3g}"
            )
        self._settings = settings
        self._geometry = geometry
        self._fan = Fan(
            rays=settings.rays,
            half_width=0.5 * settings.aperture_share * geometry.aperture,
            shallowest=settings.shallowest,
            steepest=settings.steepest,
        )
        self._cell = settings.transform / settings.window  # Doppler bins per resolution cell
        self._beyond = settings.edge_beyond_speed * self._cell if settings.compensate_edge else 0.0  # Doppler bins
        count = settings.rays + 2  # rows: one more than rays at either end
        # of each scan's samples, real and imaginary parts in turn: multiplied by what has their shape, without casts
        self._weights = np.repeat(hann(settings.window)[:, None], 2 * count, axis=1)
        # Slow-time rows to transform; what lies behind the window stays 0. numpy takes four rows at a time: any that
        # are left over cost as much as all four.
        self._padded = np.zeros((math.ceil(count / 4) * 4, settings.transform), np.complex64)
        self._rows = self._padded[:count, : settings.window].T
        # Room for what is worked out again for every scan: to allot it costs as much as to fill it.
        self._transformed = np.zeros_like(self._padded)
        self._spectra = self._transformed[:count]
        self._row_power = np.zeros(self._spectra.shape, np.float32)
        self._ray_power = np.zeros((settings.rays, settings.transform), np.float32)
        self._window = SlowTimeWindow(length=settings.window, bins=0)
        self._caster: RayCaster | None = None
        self._stamps_ns: deque[int] = deque(maxlen=settings.window)
        self._stand_ins: deque[int] = deque()  # stamps of the window's scans that were lost

    def update(self, returns: MovingReturns, attitudes: AttitudeHistory) -> SpeedEstimate:
        """The estimate after one more frame.

        Not valid while the window is not full or too much of it was lost, without an attitude for its middle,
        where too few rays meet the ground or agree, where the ground recedes, near the limit of Doppler, and where
        nothing moves but no ground is seen to stand.
        """
        self._push(returns)
        settings = self._settings
        if len(self._stamps_ns) < settings.window:
            return _nothing((settings.window - 1) / 2 * returns.parameters.scan_period)
        oldest_ns, newest_ns = self._stamps_ns[0], self._stamps_ns[-1]
        delay = (newest_ns - oldest_ns) * 0.5e-9
        orientation = attitudes.at((oldest_ns + newest_ns) // 2)
        if orientation is None or len(self._stand_ins) > settings.most_lost * settings.window:
            return _nothing(delay)
        rays = self._rays(orientation)
        if rays is NO_RAYS:
            return _nothing(delay)
        power = self._power(rays)
        spectrum: NDArray[np.float32] = np.add.reduce(power)
        approaching, receding, floor = peaks_and_floor(spectrum, self._cell)
        turn_rate = attitudes.mean_turn_rate(oldest_ns, newest_ns)
        if turn_rate is not None and is_at_rest(max(approaching, receding), floor, turn_rate, settings.rest):
            if not self._ground_stands(returns, rays):
                return _nothing(delay)
            return SpeedEstimate(speed=0.0, quality=0.0, rays=settings.rays, valid=True, delay=delay)
        if self._has_come_round(spectrum, approaching, receding, floor):
            return _nothing(delay)
        per_bin = speed_per_bin(
            scan_period=2 * delay / (settings.window - 1),  # measured, not nominal
            carrier=returns.parameters.carrier,
            transform=settings.transform,
        )
        speeds, falls = self._ray_speeds(power, floor / settings.rays, per_bin, rays.cosines)
        return self._average(speeds, falls, delay)

    def _push(self, returns: MovingReturns) -> None:
        if returns.restarted:
            self._start_anew(returns.scans.shape[1], returns.parameters)
        for scan in returns.scans:
            self._window.push(scan)
        self._stamps_ns.extend(returns.stamps_ns)
        self._stand_ins.extend(returns.stand_ins)
        while self._stand_ins and self._stand_ins[0] < self._stamps_ns[0]:
            self._stand_ins.popleft()

    def _start_anew(self, bins: int, parameters: RadarParameters) -> None:
        self._window = SlowTimeWindow(length=self._settings.window, bins=bins)
        self._caster = RayCaster(
            self._fan, bins=bins, range_start=parameters.range_start, range_step=parameters.range_step
        )
        self._stamps_ns.clear()
        self._stand_ins.clear()

    def _rays(self, orientation: Quaternion) -> Rays:
        assert self._caster is not None, "the first frame restarts"
        height = antenna_height(self._geometry, orientation)
        return self._caster.cast(height=height, axis=pitch(self._geometry, orientation))

    def _power(self, rays: Rays) -> NDArray[np.float32]:
        """Doppler power along each ray, in sum with its neighbours'; shape (K, transform), FFT order, for one scan.

        One range bin's spectrum is speckle, its steepest fall often that of a chance gap below the fastest ground.
        In sum over three bins, most of a range cell apart, the edge lies where the expected spectrum has it.
        """
        scans = self._window.of(rays.rows)
        parts = scans.view(np.float32)
        parts *= self._weights
        self._rows[:] = scans
        # Power is compared with power only. Without a factor (norm="backward") numpy would go over to double.
        np.fft.fft(self._padded, norm="forward", out=self._transformed)  # type: ignore[arg-type]  # stubs know double only
        power, summed = self._row_power, self._ray_power
        np.abs(self._spectra, out=power)
        power *= power
        np.add(power[:-2], power[1:-1], out=summed)
        summed += power[2:]
        return summed

    def _ground_stands(self, returns: MovingReturns, rays: Rays) -> bool:
        """Whether the rays meet ground that stands still."""
        standing = returns.standing.scan().take(rays.rows, mode="clip")
        moving = self._window.of(rays.rows)
        per_scan = np.add.reduce(moving.real**2 + moving.imag**2, axis=1) / len(rays.rows)
        return ground_stands(
            standing.real**2 + standing.imag**2,
            median(per_scan),  # not the mean: in the last of them the cane may have set off
            returns.standing.noise_share,
            self._settings.rest.least_standing,
        )

    def _has_come_round(self, spectrum: NDArray[np.float32], approaching: float, receding: float, floor: float) -> bool:
        """Whether ground recedes, or approaches so fast that some of its Doppler shows on the other side."""
        if receding > self._settings.least_peak * floor and receding > RECEDING_SHARE * approaching:
            return True
        half = len(spectrum) // 2
        return bool(np.add.reduce(spectrum[half:]) > np.add.reduce(spectrum[:half]))

    def _ray_speeds(
        self, power: NDArray[np.float32], floor: float, per_bin: float, cosines: list[float]
    ) -> tuple[list[float], list[float]]:
        """Speed over ground (m/s, eq. 2) of the rays that show one, and the heights of their edges.

        A ray shows one if its Doppler stands out of the noise `floor`. None counts if the edges of many come near
        the limit of unambiguous Doppler: the rest of them would tell of the slow part of the ground only.
        """
        settings = self._settings
        half = settings.transform // 2
        magnitudes = np.sqrt(power[:, : half + 1])
        edges, falls = superior_edges(magnitudes)
        peaks = np.maximum.reduce(magnitudes, axis=1)
        least_peak = math.sqrt(settings.least_peak * floor)
        last_edge, beyond = settings.alias_share * half, self._beyond
        speeds, heights, ambiguous = [], [], 0
        # Plain Python from here on: for a handful of numbers, numpy's calls cost more.
        for edge, fall, peak, cosine in zip(edges, falls, peaks.tolist(), cosines, strict=True):
            if peak <= least_peak:
                continue
            if edge > last_edge:
                ambiguous += 1
            else:
                speeds.append((edge - beyond) * per_bin / cosine if edge > beyond else 0.0)
                heights.append(fall)
        return ([], []) if 4 * ambiguous > settings.rays else (speeds, heights)

    def _average(self, speeds: list[float], falls: list[float], delay: float) -> SpeedEstimate:
        """Eq. 3 and 4, if enough rays agree."""
        settings, count = self._settings, len(speeds)
        if count < settings.fewest_rays:
            return _nothing(delay)
        ordered = sorted(speeds)
        middle = 0.5 * (ordered[count // 2] + ordered[(count - 1) // 2])
        low, high = middle - settings.agreement, middle + settings.agreement
        agreeing = bisect_right(ordered, high) - bisect_left(ordered, low)
        if agreeing < settings.fewest_rays:
            return _nothing(delay)
        if settings.average == "weighted":
            total = sum(falls)
            centre = sum(map(mul, falls, speeds)) / total
            spread = math.sqrt(sum(map(mul, falls, [(speed - centre) ** 2 for speed in speeds])) / total)
        else:
            centre = middle if settings.average == "median" else sum(speeds) / count
            spread = math.sqrt(sum([(off := speed - centre) * off for speed in speeds]) / count)
        return SpeedEstimate(speed=centre, quality=spread, rays=count, valid=True, delay=delay)


def _nothing(delay: float) -> SpeedEstimate:
    return SpeedEstimate(speed=0.0, quality=math.inf, rays=0, valid=False, delay=delay)
