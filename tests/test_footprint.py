"""Rays on the ground against plane geometry."""

import math

import numpy as np
import pytest

from caneflow.algorithms.radar.footprint import NO_RAYS, CaneGeometry, Fan, RayCaster, antenna_height, pitch
from caneflow.algorithms.rotations import Quaternion, from_rotation_vector, from_yaw, multiply

STEP = 0.00915  # m
FAN = Fan(rays=16, half_width=math.radians(20), shallowest=math.radians(18), steepest=math.radians(80))
GEOMETRY = CaneGeometry(hand_height=0.95, aperture=math.radians(50), pivot=(0.0, -0.3, 0.0))


def held(down: float, yaw: float = 0.7) -> Quaternion:
    """The cane's y axis `down` rad below the horizontal."""
    return multiply(from_yaw(yaw), from_rotation_vector((-down, 0.0, 0.0)))


def caster(bins: int = 288, range_start: float = 0.3) -> RayCaster:
    return RayCaster(FAN, bins=bins, range_start=range_start, range_step=STEP)


@pytest.mark.parametrize("down", [0.0, 0.5, 0.73, 1.2])
def test_the_antenna_hangs_below_the_hand(down: float) -> None:
    assert pitch(GEOMETRY, held(down)) == pytest.approx(down)
    assert antenna_height(GEOMETRY, held(down)) == pytest.approx(0.95 - 0.3 * math.sin(down))


def test_an_antenna_off_the_imu_counts() -> None:
    above = CaneGeometry(hand_height=1.0, aperture=0.9, pivot=(0, -0.3, 0), antenna=(0.0, 0.1, 0.05))
    down = 0.7
    expected = 1.0 - 0.4 * math.sin(down) + 0.05 * math.cos(down)
    assert antenna_height(above, held(down)) == pytest.approx(expected)


@pytest.mark.parametrize("axis", [math.radians(38), math.radians(42), math.radians(58)])
def test_rays_meet_the_ground_at_their_angle(axis: float) -> None:
    height = 0.75
    rays = caster().cast(height=height, axis=axis)
    assert rays.rows.shape == (18,)
    assert len(rays.cosines) == 16
    angles = np.arccos(rays.cosines)
    ranges = 0.3 + rays.rows * STEP
    assert height / np.sin(angles) == pytest.approx(ranges[1:-1])
    # All of the fan, evenly in range, to within a bin.
    assert ranges[0] == pytest.approx(height / math.sin(axis + FAN.half_width), abs=STEP)
    assert ranges[-1] == pytest.approx(height / math.sin(axis - FAN.half_width), abs=STEP)
    assert np.ptp(np.diff(rays.rows)) <= 1


@pytest.mark.parametrize(("axis", "low", "high"), [(0.5, 18, 48.6), (1.3, 54.5, 80)])
def test_the_fan_is_narrowed_to_sensible_angles(axis: float, low: float, high: float) -> None:
    rays = caster(bins=2000, range_start=0.0).cast(height=0.75, axis=axis)
    angles = np.degrees(np.arccos(rays.cosines))
    assert len(np.unique(rays.rows)) == 18, "distinct rays"
    assert high >= angles.max() > high - 5
    assert low <= angles.min() < low + 1.5


@pytest.mark.parametrize("axis", [-0.3, 0.0, -math.pi / 2])
def test_a_beam_above_the_ground_has_no_rays(axis: float) -> None:
    assert caster().cast(height=0.75, axis=axis) is NO_RAYS


@pytest.mark.parametrize("height", [0.0, -0.4])
def test_an_antenna_in_the_ground_has_no_rays(height: float) -> None:
    assert caster().cast(height=height, axis=0.73) is NO_RAYS


def test_rays_stay_inside_the_recorded_ranges_or_are_not_there() -> None:
    most = caster(bins=150).cast(height=0.75, axis=0.73)  # to 1.66 m of 2.0 m
    assert most.rows.max() <= 149
    assert most.rows.min() >= 0
    assert caster(bins=100).cast(height=0.75, axis=0.73) is NO_RAYS  # to 1.2 m: less than half
