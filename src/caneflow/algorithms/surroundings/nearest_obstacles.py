"""The nearest of each sector and level in the grid, told of after a second look and held over a few without."""

from dataclasses import dataclass, field
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Length, Zero
from caneflow.algorithms.surroundings.occupancy_grid import CELL, CELLS, LEAST, MOST, SLICE, OccupancyGrid

LEFT, AHEAD, RIGHT = 0, 1, 2
LOW, WAIST, HEAD, DROP = 0, 1, 2, 3
LEVEL_TOPS: Final = (0.5, 1.25)  # m: of low and of waist; head ends at the user's height

Table = NDArray[np.float64]
Count: TypeAlias = Annotated[int, Ge(1), Le(100)]
Threshold: TypeAlias = Annotated[int, Ge(LEAST), Le(MOST)]


@dataclass(frozen=True, kw_only=True)
class NearestSettings:
    """When a cell counts, how many make an obstacle, how often it has to be seen."""

    occupied: Threshold = 40  # counts: two hits
    likely: Threshold = 20  # counts: one hit; as good as half a cell, for what moves leaves no cell the time for two
    missing: Threshold = 28  # counts, of the floor
    support: Count = 2  # cells within `depth`
    support_drop: Count = 5
    depth: Length = 0.35  # m
    edge: Length | Zero = 0.05  # m at either side of the way ahead in which nothing counts: the map is no better
    confirm: Count = 2  # updates in a row with support
    hold: Count = 4  # updates without, after which it is not told of any more
    nearest: Length = 0.15  # m ahead of the hand, where the sectors begin
    ahead: Length = 3.0  # m, where they end
    beside: Length = 1.5
    aside: Length = 1.1  # m to the left and right, where those beside end


class View(NamedTuple):
    """From where and which way the user looks; `heading` in rad, the place in m, R0."""

    x: float  # of the origin: the hand, moved to the body's middle
    y: float
    cos: float  # of the heading
    sin: float


class Found(NamedTuple):
    """The nearest obstacle of a sector and level in one update."""

    distance: float  # m ahead of the hand
    aside: float  # m to the left
    x: float  # m, R0, of the cell
    y: float


@dataclass
class Entry:
    """One sector and level over time."""

    found: Found | None = None  # what is told of
    since_ns: int = 0  # exposure's middle of the first reading of the run that confirmed it
    run: int = 0  # updates in a row with support
    run_ns: int = 0  # exposure's middle of the first of them
    without: int = 0  # updates in a row without
    history: list[tuple[int, float]] = field(default_factory=list)  # stamp (ns) and distance (m), while told of

    def update(self, stamp_ns: int, middle_ns: int, found: Found | None, settings: NearestSettings) -> None:
        """Take what one update found."""
        if found is None:
            self.run = 0
            self.without += 1
            if self.without >= settings.hold:
                self.found = None
                self.history.clear()
            return
        self.without = 0
        self.run += 1
        if self.run == 1:
            self.run_ns = middle_ns
        if self.found is None and self.run < settings.confirm:
            return
        if self.found is None:
            self.since_ns = self.run_ns
        self.found = found
        self.history.append((stamp_ns, found.distance))
        while self.history[0][0] < stamp_ns - CLOSING_NS:
            del self.history[0]

    def closing(self) -> float:
        """Speed (m/s) at which it comes nearer, the slope of a straight line through the last moment; 0: unknown."""
        if len(self.history) < 4 or self.history[-1][0] - self.history[0][0] < CLOSING_NS // 2:
            return 0.0
        end, count = self.history[-1][0], len(self.history)
        sum_t = sum_d = sum_tt = sum_td = 0.0
        for stamp, distance in self.history:
            time = (stamp - end) * 1e-9
            sum_t += time
            sum_d += distance
            sum_tt += time * time
            sum_td += time * distance
        return -(count * sum_td - sum_t * sum_d) / (count * sum_tt - sum_t * sum_t)


CLOSING_NS: Final = 800_000_000  # ns of distances of which a closing speed is made


class NearestObstacles:
    """What is told of in three sectors and four levels."""

    def __init__(self, settings: NearestSettings, shoulder: float, slices: int) -> None:
        self._settings = settings
        self._half = shoulder - 0.5 * CELL  # of the way ahead, for a cell's centre
        low, waist = (round(top / SLICE) for top in LEVEL_TOPS)
        self._slices = ((0, low), (low, waist), (waist, slices))  # of each level, first and beyond the last
        self.entries = [[Entry() for _ in range(4)] for _ in range(3)]
        self.known: Table = np.zeros((3, 4))

    def clear(self) -> None:
        """Forget all that was told of: the map begins again."""
        self.entries = [[Entry() for _ in range(4)] for _ in range(3)]

    def update(self, stamp_ns: int, middle_ns: int, grid: OccupancyGrid, view: View) -> None:
        """Look at the grid once; `middle_ns` is the middle of the exposure of the reading that asks."""
        settings = self._settings
        x = (grid.world_lines(0).astype(np.float64) + 0.5) * CELL - view.x
        y = (grid.world_lines(1).astype(np.float64) + 0.5) * CELL - view.y
        cells, ahead, aside = self._cells_in_sectors(x, y, view)
        weights, known = self._levels(grid, cells)
        sectors = self._sectors(ahead, aside)
        share = sectors.astype(np.float64) @ known.T.astype(np.float64)  # whole numbers: exact in any order
        self.known = share / np.maximum(np.count_nonzero(sectors, axis=1), 1)[:, None]
        sectors[AHEAD] &= np.abs(aside) <= self._half - settings.edge
        here = (weights * sectors[:, None, :]).reshape(12, -1)  # a row for each level of each sector
        needed = np.array([2 * settings.support] * 3 + [settings.support_drop])
        chosen = _nearest(ahead, here, np.tile(needed, 3), settings.depth)
        for number, first in enumerate(chosen):
            found = None
            if first >= 0:
                i, j = divmod(int(cells[first]), CELLS)
                found = Found(float(ahead[first]), float(aside[first]), float(x[i]) + view.x, float(y[j]) + view.y)
            self.entries[number // 4][number % 4].update(stamp_ns, middle_ns, found, settings)

    def _cells_in_sectors(self, x: Table, y: Table, view: View) -> tuple[NDArray[np.intp], Table, Table]:
        """Cells that any sector can have, the nearest ahead first, and where they are ahead and to the left, m."""
        settings = self._settings
        ahead = np.add.outer(view.cos * x, view.sin * y).reshape(-1)
        cells = np.flatnonzero((ahead >= settings.nearest) & (ahead <= max(settings.ahead, settings.beside)))
        aside = np.add.outer(-view.sin * x, view.cos * y).reshape(-1).take(cells)
        near = np.abs(aside) <= max(settings.aside, self._half)
        cells, aside = cells[near], aside[near]
        order = ahead.take(cells).argsort(kind="stable")
        cells = cells.take(order)
        return cells, ahead.take(cells), aside.take(order)

    def _sectors(self, ahead: Table, aside: Table) -> NDArray[np.bool_]:
        """Whether each cell belongs to each sector, (3, cells): left, ahead, right."""
        settings = self._settings
        beside = (ahead <= settings.beside) & (np.abs(aside) <= settings.aside)
        return np.stack(
            [
                beside & (aside > self._half),
                (ahead <= settings.ahead) & (np.abs(aside) <= self._half),
                beside & (aside < -self._half),
            ]
        )

    def _levels(self, grid: OccupancyGrid, cells: NDArray[np.intp]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """How much stands in each cell at each level, and whether anything is known of it there: both (4, cells).

        An occupied slice weighs two, a likely one one; where the floor is missing it is one.
        """
        settings = self._settings
        counts = grid.occupancy.reshape(grid.slices, -1).take(cells, axis=1)
        floor = grid.floor_missing.reshape(-1).take(cells)
        weights = (counts >= settings.occupied).view(np.uint8) + (counts >= settings.likely).view(np.uint8)
        looked_at = counts != 0
        standing = [np.add.reduce(weights[first:last], dtype=np.uint8) for first, last in self._slices]
        known = [np.logical_or.reduce(looked_at[first:last]) for first, last in self._slices]
        missing = (floor >= settings.missing).view(np.uint8)
        return np.stack([*standing, missing]), np.stack([*known, floor != 0])


def _nearest(ahead: Table, weights: NDArray[np.uint8], needed: NDArray[np.int64], depth: float) -> list[int]:
    """By row the nearest cell from which on a weight of `needed` lies within `depth`, m; -1 when there is none.

    `ahead` (n,) m, in order; `weights` (rows, n), `needed` (rows,).
    """
    chosen = [-1] * len(weights)
    rows = np.flatnonzero(weights.any(axis=1))
    if not len(rows):
        return chosen
    weights = weights.take(rows, axis=0)
    upto = np.zeros((len(rows), len(ahead) + 1), np.int32)
    np.cumsum(weights, axis=1, dtype=np.int32, out=upto[:, 1:])
    gathered = upto.take(np.searchsorted(ahead, ahead + depth, side="right"), axis=1) - upto[:, :-1]
    enough = (gathered >= needed[rows, None]) & (weights > 0)
    for place, row in enumerate(rows.tolist()):
        first = int(enough[place].argmax())
        if enough[place, first]:
            chosen[row] = first
    return chosen
