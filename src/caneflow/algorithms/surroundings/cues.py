"""The one thing to tell the user now: of all levels ahead, the nearest by weight; it keeps its level for a while."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from caneflow.algorithms.quantities import Factor, Length, OpenFraction
from caneflow.algorithms.surroundings.nearest_obstacles import Entry

LEVELS: Final = ("low", "waist", "head", "drop")
SLOWEST_TO_CLOSE: Final = 0.1  # m/s, below which no time to contact is said
LONGEST_TIME: Final = 1e5  # s


@dataclass(frozen=True, kw_only=True)
class CueSettings:
    """What matters more, and how easily the cue changes."""

    low: Factor = 1.0
    waist: Factor = 1.0
    head: Factor = 1.3  # the cane itself does not find it
    drop: Factor = 1.6
    keep: OpenFraction = 0.8  # another level takes over when it is nearer than this part of the distance by weight
    far: Length = 3.0  # m, where the urgency is 0

    @property
    def weights(self) -> tuple[float, float, float, float]:
        """By level."""
        return self.low, self.waist, self.head, self.drop


class Told(NamedTuple):
    """What to tell of an obstacle or a drop."""

    level: int
    distance: float  # m ahead of the hand
    azimuth: float  # rad from the walking direction, left positive
    urgency: float  # 0..1
    time: float | None  # s to contact
    since_ns: int


class CueChoice:
    """Chooses among the levels ahead."""

    def __init__(self, settings: CueSettings) -> None:
        self._settings = settings
        self._level: int | None = None

    def choose(self, ahead: list[Entry]) -> Told | None:
        """What to tell of the four levels ahead; None: nothing."""
        weighed = {
            level: entry.found.distance / weight
            for level, (entry, weight) in enumerate(zip(ahead, self._settings.weights, strict=True))
            if entry.found is not None
        }
        if not weighed:
            self._level = None
            return None
        best = min(weighed, key=lambda level: (weighed[level], level))
        held = self._level
        if held is None or held not in weighed or weighed[best] < self._settings.keep * weighed[held]:
            self._level = held = best
        entry = ahead[held]
        assert entry.found is not None
        distance, closing = entry.found.distance, entry.closing()
        return Told(
            level=held,
            distance=distance,
            azimuth=math.atan2(entry.found.aside, distance),
            urgency=min(max(1.0 - weighed[held] / self._settings.far, 0.0), 1.0),
            time=min(distance / closing, LONGEST_TIME) if closing > SLOWEST_TO_CLOSE else None,
            since_ns=entry.since_ns,
        )
