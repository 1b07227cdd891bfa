"""The grid of integers: the same in every cell as a slow, obvious version of it, wherever its window has moved."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from caneflow.algorithms.surroundings.occupancy_grid import (
    CELLS,
    LEAST,
    MOST,
    NO_TARGET,
    NOTHING,
    TARGET,
    GridSettings,
    OccupancyGrid,
    Rays,
    cell_of,
    world_coordinate,
)

SETTINGS = GridSettings()
FLOOR_REACH = 1.9  # m


class SlowGrid:
    """Cells by their place in the world, one ray after the other: the docstring of the grid, word by word."""

    def __init__(self, slices: int) -> None:
        self.slices = slices
        self.low = (0, 0)
        self.occupied: dict[tuple[int, int, int], int] = {}
        self.missing: dict[tuple[int, int], int] = {}

    def centre_on(self, x: float, y: float) -> None:
        self.low = (cell_of(x) - CELLS // 2, cell_of(y) - CELLS // 2)
        self.occupied = {key: value for key, value in self.occupied.items() if self.is_inside(key[1:])}
        self.missing = {key: value for key, value in self.missing.items() if self.is_inside(key)}

    def is_inside(self, cell: tuple[int, ...]) -> bool:
        return all(0 <= cell[axis] - self.low[axis] < CELLS for axis in (0, 1))

    def take(self, rays: Rays) -> None:
        hits, misses, floors, below, absent = set(), set(), set(), set(), set()
        for direction, distance, says in zip(rays.directions.tolist(), rays.ranges.tolist(), rays.says, strict=True):

            def at(t: int, d: list[int] = direction) -> tuple[int, int, int]:
                x, y = (rays.origin[axis] + 10 * ((d[axis] * t) >> 10) for axis in (0, 1))
                return x >> 16, y >> 16, rays.origin[2] + ((d[2] * t) >> 10)

            slack = (distance * 1311) >> 16
            band = 3932 + 16 * slack
            free = {TARGET: distance - 328 - slack, NO_TARGET: 4915, NOTHING: 0}[int(says)]
            depth = -6554 - (band >> 1)
            crossed = None
            for t in range(256, 65 * 256, 256):
                i, j, z = at(t)
                if t <= free and 0 <= z < self.slices << 14:
                    misses.add((z >> 14, i, j))
                if z <= 0 and crossed is None:
                    crossed = (t, i, j)
                if says == TARGET and t <= distance and z < depth:
                    below.add((i, j))
            i, j, z = at(distance)
            on_floor = says == TARGET and abs(z) <= band
            if says == TARGET and on_floor:
                floors.add((i, j))
                misses.add((0, i, j))
            elif says == TARGET and z > band and z >> 14 < self.slices:
                hits.add((z >> 14, i, j))
            elif says == TARGET and z < depth:
                below.add((i, j))
            if crossed is not None and crossed[0] <= rays.floor_reach and not on_floor:
                beyond = says == TARGET and z < 0 and distance > crossed[0] + 1434
                if says == NO_TARGET or beyond:
                    absent.add(crossed[1:])
        for key in hits | misses:
            self.add(self.occupied, key, 27 if key in hits else -9, key[1:])
        for cell in floors | below | absent:
            self.add(self.missing, cell, -16 if cell in floors else 16 if cell in below else 10, cell)

    def add(self, cells: dict[Any, int], key: tuple[int, ...], change: int, place: tuple[int, ...]) -> None:
        if self.is_inside(place):
            cells[key] = min(max(cells.get(key, 0) + change, LEAST), MOST)

    def forget(self) -> None:
        planes: tuple[dict[Any, int], ...] = (self.occupied, self.missing)
        for cells in planes:
            for key, value in cells.items():
                left = abs(value) - math.ceil(abs(value) / 16)
                cells[key] = left if value > 0 else -left

    def arrays(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        occupied = np.full((self.slices, CELLS, CELLS), 128, np.uint8)
        missing = np.full((CELLS, CELLS), 128, np.uint8)
        for (s, i, j), value in self.occupied.items():
            occupied[s, i - self.low[0], j - self.low[1]] = 128 + value
        for (i, j), value in self.missing.items():
            missing[i - self.low[0], j - self.low[1]] = 128 + value
        return occupied, missing


def directions_of(vectors: NDArray[np.float64]) -> NDArray[np.int32]:
    unit: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.rint(unit * 16384).astype(np.int32)


def readings(seed: int, count: int) -> Iterator[tuple[float, float, Rays]]:
    """A walk in no particular direction, with rays in all directions: floor, things, holes, nothing."""
    dice = np.random.default_rng(seed)
    x, y = dice.uniform(-500, 500, 2)
    for _ in range(count):
        x, y = x + dice.normal(0, 0.4), y + dice.normal(0, 0.4)
        height = dice.uniform(0.3, 1.2)
        pointing = directions_of(dice.normal(0, 1, (24, 3)) - np.array([0.0, 0.0, 0.5]))
        to_floor = height / np.maximum(-pointing[:, 2] / 16384, 0.05)
        distance = np.where(dice.random(24) < 0.5, to_floor * dice.normal(1, 0.1, 24), dice.uniform(0.05, 6, 24))
        yield (
            x,
            y,
            Rays(
                origin=(world_coordinate(x + 0.2), world_coordinate(y - 0.1), round(height * 65536)),
                directions=pointing,
                ranges=np.rint(np.clip(distance, 0.02, 16) * 4096).astype(np.int32),
                says=dice.integers(0, 3, 24).astype(np.uint8),
                floor_reach=round(dice.choice([0.0, FLOOR_REACH, 3.5]) * 4096),
            ),
        )


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32))
def test_every_cell_is_that_of_the_slow_version(seed: int) -> None:
    fast, slow = OccupancyGrid(SETTINGS, 8), SlowGrid(8)
    for number, (x, y, rays) in enumerate(readings(seed, 12)):
        for grid in (fast, slow):
            grid.centre_on(x, y)
            grid.take(rays)
            if number % 3 == 2:
                grid.forget()
    for found, expected in zip(fast.unrolled(), slow.arrays(), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert np.ptp(fast.unrolled()[0]) > 0


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("way", [-0.73, 0.73, 20.0])
def test_a_cell_stays_where_it_is_in_the_world_until_it_leaves_the_window(axis: int, way: float) -> None:
    grid = OccupancyGrid(SETTINGS, 8)
    grid.centre_on(-3.0, 5.0)
    post = Rays(
        (world_coordinate(-3.0), world_coordinate(5.0), 65536),
        directions_of(np.array([[1.0, 0.5, 0.0]])),
        np.array([4096], np.int32),
        np.array([TARGET], np.uint8),
        0,
    )
    grid.take(post)
    s, i, j = (int(each[0]) for each in np.nonzero(grid.unrolled()[0] == 128 + SETTINGS.hit))
    x, y = -3.0 + math.cos(math.atan(0.5)), 5.0 + math.sin(math.atan(0.5))
    assert (s, i + grid.origin[0], j + grid.origin[1]) == (4, cell_of(x), cell_of(y))

    moved = (-3.0 + way, 5.0) if axis == 0 else (-3.0, 5.0 + way)
    grid.centre_on(*moved)

    found = np.argwhere(grid.unrolled()[0] == 128 + SETTINGS.hit)
    if abs(way) > 6.4:
        assert len(found) == 0
    else:
        assert (found + np.array([0, *grid.origin])).tolist() == [[4, cell_of(x), cell_of(y)]]


def test_a_hit_beats_a_miss_and_a_cell_changes_once_a_reading() -> None:
    grid = OccupancyGrid(SETTINGS, 8)
    ray = directions_of(np.array([[1.0, 0.0, 0.0]] * 3))
    ranges = np.array([1.0 * 4096, 1.0 * 4096, 2.0 * 4096], np.int32)  # two that end where the third goes through
    rays = Rays((0, 0, 65536), ray, ranges, np.full(3, TARGET, np.uint8), 0)
    grid.take(rays)
    occupancy = grid.unrolled()[0]
    row = occupancy[4, -grid.origin[0] :, -grid.origin[1]]
    assert row[10] == 128 + 27
    assert row[5] == 128 - 9
    assert row[20] == 128 + 27


@pytest.mark.parametrize("level", [-48, -1, 0, 1, 96])
def test_forgetting_halves_in_under_three_seconds_and_ends_at_unknown(level: int) -> None:
    grid = OccupancyGrid(SETTINGS, 1)
    grid.occupancy[:] = level
    times = 0
    while abs(int(grid.occupancy[0, 0, 0])) > abs(level) / 2:
        grid.forget()
        times += 1
    assert times <= 11
    for _ in range(64):
        grid.forget()
    assert not grid.occupancy.any()


def test_saturation_keeps_to_its_ends() -> None:
    grid = OccupancyGrid(SETTINGS, 8)
    ray = directions_of(np.array([[1.0, 0.0, 0.0]]))
    for _ in range(20):
        grid.take(Rays((0, 0, 65536), ray, np.array([6000], np.int32), np.array([TARGET], np.uint8), 0))
    occupancy = grid.unrolled()[0].astype(int) - 128
    assert (occupancy.min(), occupancy.max()) == (LEAST, MOST)


def test_no_target_says_nothing_beyond_what_black_cloth_would_hide() -> None:
    grid = OccupancyGrid(SETTINGS, 8)
    ray = directions_of(np.array([[1.0, 0.0, 0.0]]))
    grid.take(Rays((0, 0, 65536), ray, np.array([0], np.int32), np.array([NO_TARGET], np.uint8), 0))
    free = np.flatnonzero(grid.unrolled()[0][4, -grid.origin[0] :, -grid.origin[1]] < 128)
    assert free.max() == 11  # 1.2 m


@pytest.mark.parametrize(
    ("depth", "says"), [(0.05, "floor"), (0.12, "neither"), (0.25, "drop")], ids=["floor", "neither", "drop"]
)
def test_a_floor_that_lies_lower_is_a_drop_only_beyond_its_band(depth: float, says: str) -> None:
    grid = OccupancyGrid(SETTINGS, 8)
    height = 1.0
    ray = directions_of(np.array([[1.0, 0.0, -1.0]]))
    distance = (height + depth) * math.sqrt(2.0)
    for _ in range(2):
        grid.take(Rays((0, 0, 65536), ray, np.array([round(distance * 4096)], np.int32), np.array([1], np.uint8), 0))
    missing = grid.unrolled()[1].astype(int) - 128
    assert {"floor": missing.min() == -32, "neither": not missing.any(), "drop": missing.max() == 32}[says]
