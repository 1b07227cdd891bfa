"""A grid of integers around the user: what is occupied, slice by slice of height, and where the floor is missing.

Additive log-odds with saturation (Moravec and Elfes 1985; Elfes 1989), one count being 1/32 nat. The window is a torus
that lies still in the world: a cell keeps its place in memory while the window moves over it, and nothing is resampled.
Every number is an integer and every operation exact, so that numpy, mcu/grid.c and a snapshot agree in every cell:
horizontal coordinates in 1/65536 cell, heights in 1/65536 m, ranges in 1/4096 m, directions in 1/16384.
"""

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

CELLS: Final = 64  # along each side
CELLS_PER_METRE: Final = 10
CELL: Final = 1.0 / CELLS_PER_METRE  # m
SLICE: Final = 0.25  # m of height, 1/4 so that a shift finds it
UNIT: Final = 1.0 / 32.0  # nat per count
LEAST: Final = -48  # counts
MOST: Final = 96
_LEAST, _MOST = np.int8(LEAST), np.int8(MOST)
PLANE: Final = CELLS * CELLS

COORDINATE: Final = 65536  # of a cell (x, y) or a metre (z)
RANGE: Final = 4096  # of a metre, along a ray
STEP: Final = RANGE // 16  # along a ray, between the points that are looked at
STEPS: Final = 64  # of them: 4 m
_MASK: Final = CELLS - 1
_AT: Final = (np.arange(1, STEPS + 1, dtype=np.int32) * STEP)[None, :]  # where the points are, in 1/4096 m
TWO_PERCENT: Final = 1311  # of 65536

NOTHING, TARGET, NO_TARGET = 0, 1, 2  # what a ray says

LARGEST: Final = 31
Counts: TypeAlias = Annotated[int, Ge(1), Le(LARGEST)]
Integers = NDArray[np.int32]
Cells = NDArray[np.int8]


@dataclass(frozen=True, kw_only=True)
class GridSettings:
    """What one reading is worth, in counts of 1/32 nat."""

    hit: Counts = 27  # a target in the cell
    miss: Counts = 9  # a ray that went through it
    floor_seen: Counts = 16  # taken off the missing floor
    below_floor: Counts = 16  # a ray that goes on below where the floor should be
    no_floor: Counts = 10  # no answer, or one from beyond, where the floor has been answering


class Rays(NamedTuple):
    """One reading: Z rays from one place."""

    origin: tuple[int, int, int]  # x, y in 1/65536 cell of the world, height above the floor in 1/65536 m
    directions: Integers  # (Z, 3) in 1/16384, world
    ranges: Integers  # (Z,) in 1/4096 m, where `says` is TARGET
    says: NDArray[np.uint8]  # (Z,) NOTHING, TARGET, NO_TARGET
    floor_reach: int  # 1/4096 m up to which the floor has been answering


FREE_MARGIN: Final = 328  # 0.08 m, and two per cent: how far before its end a ray stops to free
FREE_WITHOUT_TARGET: Final = 4915  # 1.2 m: "no target" may be black cloth, glass or sunlight
FLOOR_BAND: Final = 3932  # 0.06 m, and two per cent of the range
BELOW: Final = 6554  # 0.10 m, and half the band: less is no drop
BEYOND_FLOOR: Final = 1434  # 0.35 m


def world_coordinate(metres: float) -> int:
    """A horizontal coordinate in 1/65536 of a cell."""
    return round(metres * (CELLS_PER_METRE * COORDINATE))


class OccupancyGrid:
    """`slices` planes of CELLS x CELLS counts, and one plane of missing floor."""

    def __init__(self, settings: GridSettings, slices: int) -> None:
        self._settings = settings
        self.slices = slices
        self.origin = (0, 0)  # world cell of the window's low corner
        self.occupancy: Cells = np.zeros((slices, CELLS, CELLS), np.int8)  # in the torus's own order
        self.floor_missing: Cells = np.zeros((CELLS, CELLS), np.int8)

    def clear(self) -> None:
        """Forget everything."""
        self.occupancy[:] = 0
        self.floor_missing[:] = 0

    def centre_on(self, x: float, y: float) -> None:
        """Move the window so that (x, y), m, is in its middle; what enters is unknown."""
        new = (cell_of(x) - CELLS // 2, cell_of(y) - CELLS // 2)
        for axis in (0, 1):
            entering = entering_lines(self.origin[axis], new[axis])
            if len(entering):
                if axis == 0:
                    self.occupancy[:, entering, :] = 0
                    self.floor_missing[entering, :] = 0
                else:
                    self.occupancy[:, :, entering] = 0
                    self.floor_missing[:, entering] = 0
        self.origin = new

    def world_lines(self, axis: int) -> NDArray[np.int64]:
        """World cell of each line of the torus along `axis`, in the order of memory."""
        first = self.origin[axis]
        lines = np.arange(CELLS, dtype=np.int64)
        return first + ((lines - first) & _MASK)

    def unrolled(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Occupancy (S, H, W) and missing floor (H, W) from the window's low corner on, as 128 + counts."""
        rows, columns = ((self.origin[axis] + np.arange(CELLS)) & _MASK for axis in (0, 1))
        occupancy = self.occupancy[:, rows[:, None], columns[None, :]]
        missing = self.floor_missing[rows[:, None], columns[None, :]]
        return _coded(occupancy), _coded(missing)

    def take(self, rays: Rays) -> NDArray[np.bool_]:
        """Add one reading; which of its rays (Z,) hit the floor. Each cell changes once, and a hit beats a miss."""
        target = rays.says == TARGET
        slack = (rays.ranges * TWO_PERCENT) >> 16  # 1/4096 m
        free_end = np.where(target, rays.ranges - FREE_MARGIN - slack, 0)
        free_end[rays.says == NO_TARGET] = FREE_WITHOUT_TARGET
        # Points that nothing is said of are not looked at.
        farthest = max(int(rays.ranges[target].max(initial=0)), FREE_WITHOUT_TARGET, rays.floor_reach)
        points = _points(rays, self.origin, min(farthest // STEP + 1, STEPS))
        ends = _ends(rays, self.origin)
        band = FLOOR_BAND + (slack << 4)
        floor: NDArray[np.bool_] = target & (np.abs(ends.height) <= band)
        self._take_occupied(points, ends, free_end, floor, target & (ends.height > band))
        self._take_missing_floor(rays, points, ends, floor, -BELOW - (band >> 1))
        return floor

    def forget(self) -> None:
        """Let every count go towards 0 by a sixteenth of it, rounded up."""
        for cells in (self.occupancy, self.floor_missing):
            cells[...] = _FORGOTTEN[cells.view(np.uint8)]

    def _take_occupied(
        self,
        points: "_Points",
        ends: "_Points",
        free_end: Integers,
        floor: NDArray[np.bool_],
        above: NDArray[np.bool_],
    ) -> None:
        nowhere = self.slices * PLANE  # one more cell, for all that is not to be changed
        change = np.zeros(nowhere + 1, np.int8)
        steps = points.cell.shape[1]
        passed = (
            points.inside & (free_end[:, None] >= _AT[:, :steps]) & (points.height.view(np.uint32) < self.slices << 14)
        )
        change[np.where(passed, ((points.height >> 14) << 12) | points.cell, nowhere)] = -self._settings.miss
        change[ends.cell[floor & ends.inside]] = -self._settings.miss  # there the floor is bare
        hit = np.flatnonzero(above & ends.inside & (ends.height < self.slices << 14))
        change[((ends.height[hit] >> 14) << 12) | ends.cell[hit]] = self._settings.hit
        _add(self.occupancy, change[:nowhere])

    def _take_missing_floor(
        self, rays: Rays, points: "_Points", ends: "_Points", floor: NDArray[np.bool_], depth: Integers
    ) -> None:
        settings = self._settings
        change = np.zeros(PLANE, np.int8)
        target, silent = rays.says == TARGET, rays.says == NO_TARGET
        # The first point at or below the floor: a ray that goes down has all later ones below it.
        zones = np.flatnonzero((silent & (points.height[:, -1] <= 0)) | (target & (ends.height < 0) & ~floor))
        if len(zones):
            crossing = np.count_nonzero(points.height[zones] > 0, axis=1)
            at = (crossing + 1) * STEP
            crossing = np.minimum(crossing, points.cell.shape[1] - 1)
            unanswered = silent[zones] | (rays.ranges[zones] > at + BEYOND_FLOOR)
            chosen = unanswered & (at <= rays.floor_reach) & points.inside[zones, crossing]
            change[points.cell[zones[chosen], crossing[chosen]]] = settings.no_floor
        zones = np.flatnonzero(target & (ends.height < depth))
        if len(zones):
            reached = rays.ranges[zones, None] >= _AT[:, : points.cell.shape[1]]
            below = points.inside[zones] & (points.height[zones] < depth[zones, None]) & reached
            change[points.cell[zones][below]] = settings.below_floor
            change[ends.cell[zones[ends.inside[zones]]]] = settings.below_floor
        change[ends.cell[floor & ends.inside]] = -settings.floor_seen
        _add(self.floor_missing, change)


class _Points(NamedTuple):
    """Points on rays: one or many on each."""

    cell: Integers  # index into a plane of the torus
    inside: NDArray[np.bool_]  # the window
    height: Integers  # above the floor, 1/65536 m


def cell_of(metres: float) -> int:
    """The world cell of a horizontal coordinate."""
    return world_coordinate(metres) >> 16


def entering_lines(old: int, new: int) -> NDArray[np.intp]:
    """Lines of the torus that a window of CELLS from cell `new` has and one from cell `old` has not."""
    if abs(new - old) >= CELLS:
        return np.arange(CELLS)
    first = old + CELLS if new > old else new
    return np.arange(first, first + abs(new - old)) & _MASK


def _points(rays: Rays, window: tuple[int, int], steps: int) -> _Points:
    """The points at which each ray is looked at: (Z, steps)."""
    return _placed(rays, (rays.directions[:, :, None] * _AT[:, :steps]) >> 10, window)


def _ends(rays: Rays, window: tuple[int, int]) -> _Points:
    """The points that the ranges say: (Z,)."""
    return _placed(rays, (rays.directions * rays.ranges[:, None]) >> 10, window)


def _placed(rays: Rays, moved: Integers, window: tuple[int, int]) -> _Points:
    """Points `moved` (Z, 3, ...) from the origin of the rays, 1/65536 m, in the torus."""
    row = (rays.origin[0] - (window[0] << 16) + moved[:, 0] * CELLS_PER_METRE) >> 16
    column = (rays.origin[1] - (window[1] << 16) + moved[:, 1] * CELLS_PER_METRE) >> 16
    inside = ((row | column) & ~_MASK) == 0  # a negative one has high bits
    cell = (((row + (window[0] & _MASK)) & _MASK) << 6) | ((column + (window[1] & _MASK)) & _MASK)
    return _Points(cell, inside, rays.origin[2] + moved[:, 2])


def _add(cells: Cells, change: Cells) -> None:
    """Add with saturation; within a byte, as MOST + LARGEST is 127."""
    flat = cells.reshape(-1)
    flat += change
    np.maximum(flat, _LEAST, out=flat)
    np.minimum(flat, _MOST, out=flat)


def _coded(cells: Cells) -> NDArray[np.uint8]:
    return (cells.astype(np.int16) + 128).astype(np.uint8)


def _forgotten() -> Cells:
    """By count, as its byte, what is left of it after `forget`."""
    counts = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int16)
    left: Cells = (counts - np.sign(counts) * ((np.abs(counts) + 15) >> 4)).astype(np.int8)
    return left


_FORGOTTEN: Final = _forgotten()
