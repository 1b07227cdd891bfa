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
BELOW: Final = 6554  # 0.10 m, and half the band: less is not a drop
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
        slack = (rays.ranges * TWO_PERCENT) >> 16  # 1/4096 m
        ends = _placed(rays, rays.directions.T * rays.ranges, self.origin)
        band = FLOOR_BAND + (slack << 4)
        target = rays.says == TARGET
        floor: NDArray[np.bool_] = target & (np.abs(ends.height) <= band)
        self._take_occupied(rays, ends, slack, floor, target & (ends.height > band))
        self._take_missing_floor(rays, ends, floor, -BELOW - (band >> 1))
        return floor

    def forget(self) -> None:
        """Let every count go towards 0 by a sixteenth of it, rounded up."""
        for cells in (self.occupancy, self.floor_missing):
            left = np.frombuffer(cells.tobytes().translate(_FORGOTTEN), np.int8)
            cells[...] = left.reshape(cells.shape)

    # A reading touches a few hundred of 36864 cells, so they are listed, some of them many times. Each new value is
    # made of what was there before the reading: listed twice, a cell gets the same value twice.

    def _take_occupied(
        self, rays: Rays, ends: "_Points", slack: Integers, floor: NDArray[np.bool_], above: NDArray[np.bool_]
    ) -> None:
        settings, occupancy, top = self._settings, self.occupancy.reshape(-1), self.slices << 14
        free_end = np.where(rays.says == TARGET, rays.ranges - FREE_MARGIN - slack, 0)
        free_end[rays.says == NO_TARGET] = FREE_WITHOUT_TARGET
        passed = _points_up_to(rays, free_end, self.origin)[0]
        inside = passed.inside & (passed.height.view(np.uint32) < top)  # a negative height is a large number there
        bare = ends.cell[floor & ends.inside]  # of slice 0
        missed = np.concatenate([(((passed.height >> 14) << 12) | passed.cell)[inside], bare]).astype(np.intp)
        hit = (((ends.height >> 14) << 12) | ends.cell)[above & ends.inside & (ends.height < top)]
        after_hit = np.minimum(occupancy[hit] + np.int8(settings.hit), _MOST)
        occupancy[missed] = np.maximum(occupancy[missed] - np.int8(settings.miss), _LEAST)
        occupancy[hit] = after_hit

    def _take_missing_floor(self, rays: Rays, ends: "_Points", floor: NDArray[np.bool_], depth: Integers) -> None:
        settings, missing = self._settings, self.floor_missing.reshape(-1)
        absent, below = self._unanswered(rays, ends, floor), self._below_floor(rays, ends, depth)
        seen = ends.cell[floor & ends.inside]
        after_absent = np.minimum(missing[absent] + np.int8(settings.no_floor), _MOST)
        after_below = np.minimum(missing[below] + np.int8(settings.below_floor), _MOST)
        after_seen = np.maximum(missing[seen] - np.int8(settings.floor_seen), _LEAST)
        missing[absent] = after_absent
        missing[below] = after_below
        missing[seen] = after_seen

    def _unanswered(self, rays: Rays, ends: "_Points", floor: NDArray[np.bool_]) -> Integers:
        """Cells where a ray reaches the floor within where it has been answering, and it does not answer."""
        last = min(rays.floor_reach // STEP, STEPS)
        if last == 0:
            return _NO_CELLS
        silent = rays.says == NO_TARGET
        passed = (rays.says == TARGET) & (ends.height < 0) & ~floor
        down, height = rays.directions[:, 2], rays.origin[2]
        lowest = height + np.minimum((down * STEP) >> 10, (down * (last * STEP)) >> 10)
        zones = np.flatnonzero((silent | passed) & (lowest <= 0))
        if not len(zones):
            return _NO_CELLS
        few = _some(rays, zones)
        # The first point at or below the floor: the least k for which height + (down k STEP >> 10) <= 0.
        at = np.maximum(-((4 * height - 3) // np.minimum(few.directions[:, 2], -1)), 1) * STEP
        points = _placed(few, few.directions.T * at, self.origin)
        unanswered: Integers = points.cell[points.inside & (silent[zones] | (few.ranges > at + BEYOND_FLOOR))]
        return unanswered

    def _below_floor(self, rays: Rays, ends: "_Points", depth: Integers) -> Integers:
        """Cells over which a ray goes on below the floor."""
        zones = np.flatnonzero((rays.says == TARGET) & (ends.height < depth))
        if not len(zones):
            return _NO_CELLS
        few = _some(rays, zones)
        points, zone = _points_up_to(few, few.ranges, self.origin)
        deep = points.inside & (points.height < depth[zones[zone]])
        return np.concatenate([points.cell[deep], ends.cell[zones[ends.inside[zones]]]])


class _Points(NamedTuple):
    """n points on rays."""

    cell: Integers  # (n,) index into a plane of the torus
    inside: NDArray[np.bool_]  # (n,) the window
    height: Integers  # (n,) above the floor, 1/65536 m


_NO_CELLS: Final = np.zeros(0, np.int32)


def cell_of(metres: float) -> int:
    """The world cell of a horizontal coordinate."""
    return world_coordinate(metres) >> 16


def entering_lines(old: int, new: int) -> NDArray[np.intp]:
    """Lines of the torus that a window of CELLS from cell `new` has and one from cell `old` has not."""
    if abs(new - old) >= CELLS:
        return np.arange(CELLS)
    first = old + CELLS if new > old else new
    return np.arange(first, first + abs(new - old)) & _MASK


def _some(rays: Rays, zones: NDArray[np.intp]) -> Rays:
    return rays._replace(directions=rays.directions[zones], ranges=rays.ranges[zones], says=rays.says[zones])


def _points_up_to(rays: Rays, ends: Integers, window: tuple[int, int]) -> tuple[_Points, NDArray[np.intp]]:
    """The points at which each ray is looked at, up to `ends` (Z,) in 1/4096 m; and the ray of each point."""
    counts = np.minimum(np.maximum(ends, 0) // STEP, STEPS)
    zone = np.repeat(np.arange(len(counts)), counts)
    before = (np.cumsum(counts, dtype=np.int32) - counts).take(zone)  # points of the rays before
    at = (np.arange(1, len(zone) + 1, dtype=np.int32) - before) * STEP
    return _placed(rays, np.ascontiguousarray(rays.directions.T).take(zone, axis=1) * at, window), zone


def _placed(rays: Rays, moved: Integers, window: tuple[int, int]) -> _Points:
    """Points in the torus, `moved` (3, n) from the origin of the rays as direction by range."""
    moved >>= 10  # 1/65536 m
    lines = moved[:2] * CELLS_PER_METRE  # row and column, at first in 1/65536 from the window's low corner
    lines += np.array([[rays.origin[axis] - (window[axis] << 16)] for axis in (0, 1)], np.int32)
    lines >>= 16
    inside = ((lines[0] | lines[1]) & ~_MASK) == 0  # a negative one has high bits
    lines += np.array([[window[axis] & _MASK] for axis in (0, 1)], np.int32)
    lines &= _MASK
    return _Points((lines[0] << 6) | lines[1], inside, moved[2] + rays.origin[2])


def _coded(cells: Cells) -> NDArray[np.uint8]:
    return (cells.astype(np.int16) + 128).astype(np.uint8)


def _forgotten() -> bytes:
    """By count, as its byte, what is left of it after `forget`."""
    counts = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int16)
    left: Cells = (counts - np.sign(counts) * ((np.abs(counts) + 15) >> 4)).astype(np.int8)
    return left.tobytes()


_FORGOTTEN: Final = _forgotten()
