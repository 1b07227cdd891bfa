"""The nearest of each sector and level in the grid, told of after a second look and held over a few without."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Length, Zero
from caneflow.algorithms.surroundings.occupancy_grid import CELL, LEAST, MOST, SLICE, OccupancyGrid

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
        end = self.history[-1][0]
        times = [(stamp - end) * 1e-9 for stamp, _ in self.history]
        middle = sum(times) / len(times)
        mean = sum(distance for _, distance in self.history) / len(times)
        above = sum((t - middle) * (d - mean) for t, (_, d) in zip(times, self.history, strict=True))
        return -above / sum((t - middle) ** 2 for t in times)


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
        x = (grid.world_lines(0) + 0.5) * CELL - view.x
        y = (grid.world_lines(1) + 0.5) * CELL - view.y
        ahead = np.add.outer(view.cos * x, view.sin * y).reshape(-1)
        aside = np.add.outer(-view.sin * x, view.cos * y).reshape(-1)
        weights, known = self._weights(grid), _known(grid, self._slices)
        needed = np.array([2 * settings.support] * 3 + [settings.support_drop])
        for sector, unordered in enumerate(self._sectors(ahead, aside)):
            cells = unordered[np.argsort(ahead[unordered], kind="stable")]
            self.known[sector] = np.count_nonzero(known[:, cells], axis=1) / max(len(cells), 1)
            here = weights[:, cells]
            if sector == AHEAD:
                here[:, np.abs(aside[cells]) > self._half - settings.edge] = 0
            chosen = _nearest(ahead[cells], here, needed, settings.depth)
            for level, first in enumerate(chosen):
                found = None
                if first >= 0:
                    at = int(cells[first])
                    row, column = divmod(at, len(x))
                    found = Found(float(ahead[at]), float(aside[at]), float(x[row]) + view.x, float(y[column]) + view.y)
                self.entries[sector][level].update(stamp_ns, middle_ns, found, settings)

    def _sectors(self, ahead: Table, aside: Table) -> Iterator[NDArray[np.intp]]:
        """The cells of each sector, left, ahead, right, by their places in the user's frame."""
        settings = self._settings
        cells = np.flatnonzero((ahead >= settings.nearest) & (ahead <= max(settings.ahead, settings.beside)))
        ahead, aside = ahead[cells], aside[cells]
        near, outer = ahead <= settings.beside, np.abs(aside) <= settings.aside
        yield cells[near & outer & (aside > self._half)]
        yield cells[(ahead <= settings.ahead) & (np.abs(aside) <= self._half)]
        yield cells[near & outer & (aside < -self._half)]

    def _weights(self, grid: OccupancyGrid) -> NDArray[np.uint8]:
        """How much stands in each cell at each level, (4, cells): two for an occupied slice, one for a likely one."""
        settings = self._settings
        occupied = (grid.occupancy >= settings.occupied).view(np.uint8)
        likely = (grid.occupancy >= settings.likely).view(np.uint8)
        weights = (occupied + likely).reshape(grid.slices, -1)
        missing = (grid.floor_missing >= settings.missing).view(np.uint8).reshape(-1)
        return np.stack(
            [*(np.add.reduce(weights[first:last], dtype=np.uint8) for first, last in self._slices), missing]
        )


def _known(grid: OccupancyGrid, slices: Sequence[tuple[int, int]]) -> NDArray[np.bool_]:
    """Whether anything is known of each cell at each level, (4, cells)."""
    looked_at = (grid.occupancy != 0).reshape(grid.slices, -1)
    levels = [np.logical_or.reduce(looked_at[first:last]) for first, last in slices]
    return np.stack([*levels, grid.floor_missing.reshape(-1) != 0])


def _nearest(ahead: Table, weights: NDArray[np.uint8], needed: NDArray[np.int64], depth: float) -> list[int]:
    """By level the nearest cell from which on a weight of `needed` lies within `depth`, m; -1 when there is none.

    `ahead` (n,) m, in order; `weights` (levels, n).
    """
    if not weights.any():
        return [-1] * len(weights)
    upto = np.zeros((len(weights), len(ahead) + 1), np.int64)
    np.cumsum(weights, axis=1, out=upto[:, 1:])
    gathered = upto[:, np.searchsorted(ahead, ahead + depth, side="right")] - upto[:, :-1]
    enough = (gathered >= needed[:, None]) & (weights > 0)
    first = np.where(enough.any(axis=1), enough.argmax(axis=1), -1)
    return [int(each) for each in first]
