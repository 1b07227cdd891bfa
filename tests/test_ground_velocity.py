"""The two-component front end: its model against integrals, its fit against made-up ground, walls and rest."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.radar.background import Background
from caneflow.algorithms.radar.footprint import CaneGeometry
from caneflow.algorithms.radar.ground_velocity import (
    UNOBSERVED,
    Fit,
    GroundVelocityEstimator,
    GroundVelocitySettings,
    VelocityEstimate,
    beam_factor,
)
from caneflow.algorithms.radar.moving_returns import MovingReturns, RadarParameters, StandingPicture
from caneflow.algorithms.rotations import Quaternion, from_rotation_vector
from caneflow.physics import SPEED_OF_LIGHT

Scans = NDArray[np.complex64]
PARAMETERS = RadarParameters(scan_period=0.01, range_start=0.3, range_step=0.00915, carrier=4.3e9, bandwidth=1.7e9)
GEOMETRY = CaneGeometry(hand_height=0.95, aperture=math.radians(50), pivot=(0.0, -0.3, 0.0))
PITCH = math.radians(42)
HELD: Quaternion = from_rotation_vector((-PITCH, 0.0, 0.0))  # boresight y, 42 deg below the horizontal
HEIGHT = 0.95 - 0.3 * math.sin(PITCH)
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 10_000_000
BINS = 288
RANGES = PARAMETERS.range_start + PARAMETERS.range_step * np.arange(BINS)


def returns_of(scan: Scans, index: int, background: Background) -> MovingReturns:
    """As a filter whose background is `background` makes them of what moves, `scan`."""
    return MovingReturns(
        scans=scan[None],
        stamps_ns=(START_NS + index * PERIOD_NS,),
        stand_ins=(),
        parameters=PARAMETERS,
        restarted=index == 0,
        standing=StandingPicture(background, None),
    )


def standing(picture: Scans) -> Background:
    """A background in which `picture` has stood for a second."""
    background = Background(0.5)
    for _ in range(100):
        background.remove(picture.copy(), 0.01)
    return background


def ground(forward: float, *, scans: int, noise: float = 0.0, height: float = HEIGHT, up: float = 0.0) -> Scans:
    """Speckle that turns as ground does under a beam without width in azimuth, plus noise; one echo per bin."""
    rng = np.random.default_rng(1)
    speckle = rng.normal(size=BINS) + 1j * rng.normal(size=BINS)
    sine = np.minimum(height / RANGES, 1.0)
    grazing = np.arcsin(sine)
    closing = np.cos(grazing) * beam_factor(np.cos(grazing).clip(0.1), PITCH, GEOMETRY.aperture) * forward - up * sine
    phase = 4 * math.pi * PARAMETERS.carrier / SPEED_OF_LIGHT * closing * 0.01
    made = speckle * np.exp(1j * phase * np.arange(scans)[:, None])
    made += noise * (rng.normal(size=made.shape) + 1j * rng.normal(size=made.shape))
    scans_made: Scans = made.astype(np.complex64)
    return scans_made


def run(
    scans: Scans,
    *,
    settings: GroundVelocitySettings | None = None,
    turn_rate: float = 0.0,
    rise: float | None = None,
    stands: float = 0.0,
) -> tuple[GroundVelocityEstimator, list[VelocityEstimate]]:
    """Estimates for each of `scans`; with `rise` an accelerometer that saw the start of a lift at that speed.

    `stands`: rms amplitude of the ground in the background.
    """
    speckle = np.random.default_rng(7).normal(size=(2, BINS)) / math.sqrt(2.0)
    background = standing((stands * (speckle[0] + 1j * speckle[1])).astype(np.complex64))
    estimator = GroundVelocityEstimator(settings or GroundVelocitySettings(every=0.01), GEOMETRY)
    attitudes = AttitudeHistory()
    estimates = []
    for index, scan in enumerate(scans):
        stamp_ns = START_NS + index * PERIOD_NS
        attitudes.add(stamp_ns, HELD, (0.0, 0.0, turn_rate))
        if rise is not None:
            jolt = rise / 0.01 if index == 1 else 0.0
            up = 9.80665 + jolt
            estimator.imu(stamp_ns, HELD, (0.0, -up * math.sin(PITCH), up * math.cos(PITCH)))
        estimate = estimator.update(returns_of(scan, index, background), attitudes)
        if estimate is not None:
            estimates.append(estimate)
    return estimator, estimates


@pytest.mark.parametrize("pitch", [30, 42, 55])
@pytest.mark.parametrize("grazing", [25, 40, 60])
@pytest.mark.parametrize("aperture", [35, 50])
def test_the_beam_factor_is_the_mean_cosine_over_the_two_way_power(pitch: int, grazing: int, aperture: int) -> None:
    axis, g, delta = math.radians(pitch), math.radians(grazing), math.radians(aperture)
    phi = np.linspace(-math.pi / 2, math.pi / 2, 4001)
    theta = np.arccos(np.cos(g) * math.cos(axis) * np.cos(phi) + math.sin(g) * math.sin(axis))
    power = np.exp(-8 * math.log(2) * (theta / delta) ** 2)
    expected = (power * np.cos(phi)).sum() / power.sum()
    assert beam_factor(np.array([math.cos(g)]), axis, delta)[0] == pytest.approx(expected, abs=0.015)


@pytest.mark.parametrize("forward", [0.45, 1.2, 0.1, -0.3])
def test_finds_the_speed_of_noise_free_ground_exactly_and_its_sign(forward: float) -> None:
    _, estimates = run(ground(forward, scans=8))
    assert [estimate.valid for estimate in estimates] == [False] * 5 + [True] * 3
    assert estimates[-1].velocity[0] == pytest.approx(forward, rel=0.01)
    assert estimates[-1].velocity[1] == 0.0
    assert estimates[-1].covariance[2] == UNOBSERVED
    assert estimates[-1].delay == pytest.approx(0.025)


def test_a_wall_that_fills_a_fifth_of_the_ranges_costs_little() -> None:
    scans = ground(0.45, scans=10, noise=0.1)
    scans[:, 180:215] = 3.0 * np.exp(1j * 1.4 * np.arange(10)[:, None])  # closes at 0.78 m/s
    _, estimates = run(scans)
    assert estimates[-1].velocity[0] == pytest.approx(0.45, abs=0.03)


def noise(scans: int = 60) -> Scans:
    rng = np.random.default_rng(2)
    made: Scans = (rng.normal(size=(scans, BINS)) + 1j * rng.normal(size=(scans, BINS))).astype(np.complex64)
    return made


@pytest.mark.parametrize("stands", [1.0, 10.0])
def test_ground_that_stands_is_rest_for_a_still_cane_and_nothing_for_a_turning_one(stands: float) -> None:
    """In noise of power 2: at -3 and at 17 dB."""
    _, still = run(noise(), stands=stands)
    resting = [e for e in still if e.valid]
    assert len(resting) == 55
    assert all((e.velocity, e.covariance) == ((0.0, 0.0), (0.03**2, 0.0, 0.03**2)) for e in resting)
    _, turning = run(noise(), turn_rate=1.0, stands=stands)
    assert not any(e.valid and e.covariance[2] < UNOBSERVED for e in turning)


@pytest.mark.parametrize("stands", [0.0, 0.1])
def test_noise_alone_is_no_rest(stands: float) -> None:
    """Nothing is seen: no velocity, and no rest."""
    _, still = run(noise(), stands=stands)
    assert {(e.velocity, e.covariance, e.valid) for e in still} == {((0.0, 0.0), (UNOBSERVED, 0.0, UNOBSERVED), False)}


def test_a_radar_without_any_noise_is_none() -> None:
    _, still = run(np.zeros((60, BINS), np.complex64), stands=10.0)
    assert not any(e.valid for e in still)


def test_refuses_what_is_near_the_limit_of_unambiguous_doppler() -> None:
    """The limit is c / (4 f T) = 1.74 m/s of radial speed: 2.6 m/s over ground at the flattest cell seen."""
    _, estimates = run(ground(2.5, scans=10))
    assert not estimates[-1].valid


def test_the_accelerometer_tells_a_lift_from_a_walk() -> None:
    """With five cells' worth of angles a lift looks much like a walk; the accelerometer knows better."""
    lifted = ground(0.4, scans=12, noise=0.3, up=0.15)
    _, without = run(lifted)
    _, with_accelerometer = run(lifted, rise=0.15)
    assert abs(with_accelerometer[-1].velocity[0] - 0.4) < 0.02
    assert abs(without[-1].velocity[0] - 0.4) > 2 * abs(with_accelerometer[-1].velocity[0] - 0.4)


def test_learns_that_the_hand_is_lower_than_the_rig_says() -> None:
    estimator, estimates = run(ground(0.45, scans=3000, noise=0.1, height=HEIGHT - 0.03), rise=0.0)
    assert estimator.height_error == pytest.approx(-0.03, abs=0.01)
    assert estimates[-1].velocity[0] == pytest.approx(0.45, abs=0.02)


def test_without_an_attitude_there_is_nothing() -> None:
    estimator = GroundVelocityEstimator(GroundVelocitySettings(every=0.01), GEOMETRY)
    scans = ground(0.45, scans=8)
    estimates = [
        estimator.update(returns_of(scan, i, standing(scan)), AttitudeHistory()) for i, scan in enumerate(scans)
    ]
    assert not any(estimate is None or estimate.valid for estimate in estimates)


@pytest.mark.parametrize("every", [1, 3, 5])
def test_an_estimate_every_few_frames_is_the_one_of_every_frame(every: int) -> None:
    scans = ground(0.45, scans=30, noise=0.2)
    _, each = run(scans)
    estimator = GroundVelocityEstimator(GroundVelocitySettings(every=0.01 * every), GEOMETRY)
    attitudes = AttitudeHistory()
    for index, scan in enumerate(scans):
        attitudes.add(START_NS + index * PERIOD_NS, HELD, (0.0, 0.0, 0.0))
        estimate = estimator.update(returns_of(scan, index, standing(scan)), attitudes)
        assert (estimate is not None) == ((index + 1) % every == 0)
        if estimate is not None and estimate.valid:
            # the height's error has been learnt from fewer frames
            assert estimate.velocity[0] == pytest.approx(each[index].velocity[0], abs=0.002)


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match=r"shallowest is 1\.2 rad"):
        GroundVelocitySettings(shallowest=1.2, steepest=1.0)


def test_what_is_stated_says_how_many_independent_looks_a_cell_has() -> None:
    """Four times as many: a quarter of the variance. The same frames, the same speed within a few of its deviations."""
    scans = ground(0.45, scans=10, noise=0.5)
    found = {}
    for looks in (1.0, 4.0):
        # a height and a rise that are known leave the looks alone to say how sure the speed is
        settings = GroundVelocitySettings(every=0.01, looks=looks, height_error=1e-3)
        _, estimates = run(scans, settings=settings, rise=0.0)
        found[looks] = estimates[-1]
    assert found[1.0].covariance[0] / found[4.0].covariance[0] == pytest.approx(4.0, rel=0.1)


def test_frames_that_share_their_ground_say_the_height_once() -> None:
    """What each frame says with a deviation of 1 cm is known to 1 cm after `height_time`, not to 1 mm."""
    settings = GroundVelocitySettings(height_error=0.03, height_walk=0.0)
    estimator: Any = GroundVelocityEstimator(settings, GEOMETRY)
    prior, said, period = settings.height_error**2, 0.01**2, 0.05
    for _ in range(round(settings.height_time / period)):
        before = estimator._height_variance
        mean = -0.02 - estimator.height_error
        variance = 1.0 / (1.0 / before + 1.0 / said)
        estimator._learn_height(Fit(0.0, 0.0, mean * variance / said, 0.0, variance, np.zeros(1)), period)
    assert estimator._height_variance == pytest.approx(1.0 / (1.0 / prior + 1.0 / said), rel=0.1)
    assert estimator.height_error == pytest.approx(-0.02 * prior / (prior + said), rel=0.1)
