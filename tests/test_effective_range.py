"""Where a cell's power comes from: against the slow mean over echoes, and the speed of ground whose power falls."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.radar.background import Background
from caneflow.algorithms.radar.effective_range import EffectiveRanges
from caneflow.algorithms.radar.footprint import CaneGeometry
from caneflow.algorithms.radar.ground_velocity import GroundVelocityEstimator, GroundVelocitySettings, beam_factor
from caneflow.algorithms.radar.moving_returns import MovingReturns, RadarParameters, StandingPicture
from caneflow.algorithms.rotations import from_rotation_vector
from caneflow.physics import SPEED_OF_LIGHT

Floats = NDArray[np.float64]
PARAMETERS = RadarParameters(scan_period=0.01, range_start=0.3, range_step=0.00915, carrier=4.3e9, bandwidth=1.7e9)
BINS, CELL = 288, 8
RANGES = PARAMETERS.range_start + PARAMETERS.range_step * np.arange(BINS)
SPREAD = 0.0365  # m, of the pulse's power
PITCH = math.radians(42)
GEOMETRY = CaneGeometry(hand_height=0.95, aperture=math.radians(50), pivot=(0.0, -0.3, 0.0))
HEIGHT = 0.95 - 0.3 * math.sin(PITCH)


def pulses(ranges: Floats) -> Floats:
    """Amplitude in each bin (BINS, n) of echoes at n `ranges` (m)."""
    return np.exp(-((RANGES[:, None] - ranges) ** 2) / (4.0 * SPREAD**2))


def learnt(power: Floats, spread: float = 0.414) -> EffectiveRanges:
    """After one scan of this power in every bin."""
    effective = EffectiveRanges(spread)
    effective.start(BINS, CELL, PARAMETERS)
    effective.learn(np.sqrt(power).astype(np.complex64), 0.05)
    return effective


@pytest.mark.parametrize("fall", [-6.0, 0.0, 4.0])
def test_it_is_the_mean_range_of_the_echoes_that_reach_the_cell(fall: float) -> None:
    """Echoes everywhere, their power as R to the `fall`; the slow way adds up what each gives to each cell."""
    ranges = np.linspace(0.1, 3.4, 6000)
    each = pulses(ranges) ** 2 * ranges**fall
    found = learnt(each.sum(axis=1)).of_cells(5, 20)
    in_cells = each[5 * CELL : 25 * CELL].reshape(20, CELL, -1).sum(axis=1)
    expected = in_cells @ ranges / in_cells.sum(axis=1)
    middles = RANGES[: BINS // CELL * CELL].reshape(-1, CELL).mean(axis=1)[5:25]
    assert found == pytest.approx(expected, abs=2e-4)
    if fall:  # by what is at stake: a centimetre where it is near
        assert abs(expected[0] - middles[0]) > 0.006


def test_the_power_is_a_mean_over_a_second() -> None:
    """Each scan for exp(-age / 1 s): as the sum says that nobody runs."""
    scans = np.random.default_rng(3).random((40, BINS))
    effective = EffectiveRanges(0.414)
    effective.start(BINS, CELL, PARAMETERS)
    for power in scans:
        effective.learn(np.sqrt(power).astype(np.complex64), 0.05)
        effective.start(BINS, CELL, PARAMETERS)  # a gap in the same scans forgets nothing
    mean = (scans * np.exp(-0.05 * np.arange(39, -1, -1.0))[:, None]).sum(axis=0)
    assert effective.of_cells(0, 36) == pytest.approx(learnt(mean).of_cells(0, 36), abs=1e-6)


@pytest.mark.parametrize("power", [np.zeros(BINS), np.eye(1, BINS, 100)[0]])
def test_where_there_is_no_power_the_range_is_near_the_middle(power: Floats) -> None:
    middles = RANGES.reshape(-1, CELL).mean(axis=1)
    found = learnt(power).of_cells(0, BINS // CELL)
    assert np.abs(found - middles).max() <= SPREAD + 1e-3
    assert np.isfinite(found).all()


def walked(settings: GroundVelocitySettings, forward: float) -> tuple[float, float]:
    """Mean speed (m/s) and learnt height (m) on ground of many echoes whose power falls with range."""
    rng = np.random.default_rng(5)
    ranges = rng.uniform(0.6, 3.2, 600)
    sine = HEIGHT / np.maximum(ranges, HEIGHT)
    cosine = np.sqrt(1.0 - sine**2)
    closing = np.where(cosine > 0.05, cosine * beam_factor(cosine.clip(0.1), PITCH, GEOMETRY.aperture), 0.0) * forward
    phase = 4 * math.pi * PARAMETERS.carrier / SPEED_OF_LIGHT * closing * 0.01
    shape = pulses(ranges) * ranges**-4.0
    estimator = GroundVelocityEstimator(settings, GEOMETRY)
    attitudes, background = AttitudeHistory(), Background(0.5)
    held = from_rotation_vector((-PITCH, 0.0, 0.0))
    background.remove(np.zeros(BINS, np.complex64), 0.01)
    speeds = []
    for index in range(800):
        if index % 25 == 0:  # as walking does: other echoes
            echoes = rng.normal(size=len(ranges)) + 1j * rng.normal(size=len(ranges))
        echoes *= np.exp(1j * phase)
        stamp_ns = 10_000_000 * (index + 1)
        attitudes.add(stamp_ns, held, (0.0, 0.0, 0.0))
        up = 9.80665
        estimator.imu(stamp_ns, held, (0.0, -up * math.sin(PITCH), up * math.cos(PITCH)))
        scan = (shape @ echoes).astype(np.complex64)
        standing = StandingPicture(background, None)
        returns = MovingReturns(scan[None], (stamp_ns,), (), PARAMETERS, index == 0, standing)
        estimate = estimator.update(returns, attitudes)
        if estimate is not None and estimate.valid and index > 200:
            speeds.append(estimate.velocity[0])
    return float(np.mean(speeds)), estimator.height_error


def test_ground_whose_power_falls_is_no_higher_than_it_is() -> None:
    """With cells at their middles the echoes seem farther than they are, and so the hand higher."""
    speed, height = walked(GroundVelocitySettings(), 0.5)
    _, high = walked(GroundVelocitySettings(pulse_spread=0.0), 0.5)
    assert high > 0.012
    assert abs(height) < 0.4 * high
    assert speed == pytest.approx(0.5, abs=0.005)
