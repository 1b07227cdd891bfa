"""Courses in a room: within the area, at a walker's speeds, without a jump."""

import numpy as np
import pytest
from numpy.random import default_rng

from caneflow.simulation.attitude import DEGREE
from caneflow.simulation.room_course import (
    FASTEST,
    RATE,
    REVOLUTIONS,
    SHAPES,
    SLOWEST,
    CourseSettings,
    RoomShape,
    Trajectory,
    back_and_forth,
    course_legs,
    standing,
    trajectory,
)

AREA = (0.0, 8.0, 0.0, 8.0)


def walked(shape: RoomShape, seed: int, stops: int | None = None) -> Trajectory:
    settings = CourseSettings(shape=shape, stops=stops)
    return trajectory(course_legs(AREA, settings, default_rng(seed)), settings, default_rng(seed + 100))


def speed_of(way: Trajectory) -> np.ndarray:
    return np.hypot(way.velocity[:, 0], way.velocity[:, 1])


@pytest.mark.parametrize("shape", SHAPES)
def test_a_course_stays_in_the_area_at_a_walkers_speed(shape: RoomShape) -> None:
    for seed in range(3):
        way = walked(shape, seed)
        speed = speed_of(way)
        assert way.position.min() > 0.2
        assert way.position.max() < 7.8
        assert speed.max() < FASTEST
        # slower than the slowest only within 0.8 s of standing still
        still = np.convolve(speed < 0.01, np.ones(2 * round(0.85 * RATE) + 1), "same") > 0
        assert speed[~still].min() > SLOWEST
        assert 60.0 < way.time[-1] < 300.0
        assert speed[~still].std() > 0.05  # "not at constant speed"


@pytest.mark.parametrize("shape", SHAPES)
def test_a_person_neither_jumps_nor_spins_and_faces_where_they_go(shape: RoomShape) -> None:
    way = walked(shape, 7)
    acceleration = np.linalg.norm(np.diff(way.position, 2, axis=0), axis=1) * RATE**2
    assert acceleration.max() < 6.0  # m/s^2: to stop from 1.5 m/s in 0.8 s takes 3.5 at the peak
    assert np.abs(np.diff(way.heading)).max() * RATE < 330.0 * DEGREE
    moving = speed_of(way) > 0.2
    course = np.arctan2(way.velocity[moving, 1], way.velocity[moving, 0])
    assert np.abs(np.angle(np.exp(1j * (course - way.heading[moving])))).max() < 1.0 * DEGREE
    assert np.abs(np.diff(way.distance) - np.linalg.norm(np.diff(way.position, axis=0), axis=1)).max() < 1e-4


def test_the_circle_has_ten_revolutions_and_turns_about() -> None:
    directions = set()
    for seed in range(6):
        way = walked("circle", seed)
        angle = np.unwrap(np.arctan2(way.position[:, 1] - 4.0, way.position[:, 0] - 4.0))
        assert np.abs(np.diff(angle)).sum() == pytest.approx(REVOLUTIONS * 2.0 * np.pi, rel=1e-3)
        radius = np.linalg.norm(way.position - 4.0, axis=1)
        assert np.ptp(radius) < 0.02
        sense = np.sign(np.diff(angle)[np.abs(np.diff(angle)) > 1e-4])
        assert 2 <= np.count_nonzero(np.diff(sense)) <= 3
        directions.add(float(sense[0]))
    assert directions == {-1.0, 1.0}


def test_the_square_has_corners_and_the_eight_turns_both_ways() -> None:
    square = walked("square", 1, stops=0)
    turned = np.abs(np.diff(square.heading)) * RATE > 60.0 * DEGREE
    assert np.count_nonzero(np.diff(turned.astype(int)) == 1) == 16
    eight = walked("figure_eight", 1)
    rate = np.diff(eight.heading) * RATE
    assert rate.max() > 0.3
    assert rate.min() < -0.3
    assert np.ptp(eight.heading) < 2.0 * np.pi


@pytest.mark.parametrize("stops", [0, 1, 3])
def test_a_person_stops_as_often_as_asked(stops: int) -> None:
    way = walked("figure_eight", 2, stops)
    still = np.diff((np.diff(way.distance) == 0.0).astype(int), prepend=0, append=0)
    lasts = (np.flatnonzero(still == -1) - np.flatnonzero(still == 1)) / RATE
    assert len(lasts) == 2 + stops  # it begins and ends at rest
    assert all(2.0 <= s <= 5.1 for s in lasts[1:-1])


def test_back_and_forth_returns_along_its_line() -> None:
    settings = CourseSettings()
    start, end = np.array([0.5, 4.0]), np.array([7.5, 4.0])
    way = trajectory(back_and_forth(start, end, 4, settings, default_rng(1)), settings, default_rng(2))
    assert way.position[:, 0].min() == pytest.approx(0.5, abs=0.03)
    assert way.position[:, 0].max() == pytest.approx(7.5, abs=0.03)
    assert np.abs(way.position[:, 1] - 4.0).max() < 0.4
    assert way.position[-1] == pytest.approx([0.5, 4.0], abs=0.4)
    about = np.abs(way.heading[-1] - way.heading[0])
    assert about % np.pi == pytest.approx(0.0, abs=0.3) or about % np.pi == pytest.approx(np.pi, abs=0.3)


def test_lengths_are_whole_blocks_and_seeds_reproduce() -> None:
    one, again, other = walked("random", 3), walked("random", 3), walked("random", 4)
    assert len(one.time) % 10 == 0
    assert np.array_equal(one.position, again.position)
    assert not np.array_equal(one.position[:100], other.position[:100])
    still = standing(np.array([1.0, 2.0]), 0.5, 3.0)
    assert len(still.time) == 3 * RATE
    assert not still.velocity.any()
