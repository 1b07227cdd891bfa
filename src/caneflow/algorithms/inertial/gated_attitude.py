"""An attitude filter that single wild readings do not reach, and that real jumps reach in full.

A reading that jumps is held at the one before it (glitches). Whether it was wild shows only later: when readings
come back, it was; when they stay, a real motion was held for a few samples. The same for the first reading, and the
first one after a gap, which have none before them to be compared with. So while any reading is in doubt, the filter as
it was before the first such one is kept, and goes through the samples again once it is known what they should be.
"""

import copy
import math
from dataclasses import dataclass, field

from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.inertial.initial_attitude import (
    SHORTEST_VECTOR,
    AttitudeEstimate,
    AttitudeMethod,
    initial_attitude,
    required_start,
)
from caneflow.algorithms.rotations import Vector

# s, intervals between readings up to which a limit of GlitchSettings holds; for a slower sensor it grows in proportion.
# A turn rate changes steadily, a force by impacts, a field by half its strength while a body turns by 30 degrees.
QUICK = {"gyro": 0.01, "accel": 0.05, "mag": 0.25}
GAP = 2.5  # usual intervals
FOLLOWED = 0.1  # of an interval that differs, by which the usual one moves
MOST_IN_DOUBT = 8  # samples; what is not settled by then stays as it was taken


@dataclass
class _Taken:
    """One sample as the filter took it."""

    stamp_ns: int
    readings: dict[str, Vector | None]


@dataclass
class _Part:
    """One sensor: its last good reading, and those that may prove to be others than were taken."""

    limit: float
    quick: float  # s, see QUICK
    most_held: int
    shortest_gap: float  # s
    good: Vector | None = None
    steady: bool = True  # a reading has agreed with the last good one, or nothing has told yet
    last_ns: int = 0
    usual: float = 0.0  # s between readings
    held: list[tuple[_Taken, Vector]] = field(default_factory=list)  # with what was read
    fresh: list[_Taken] = field(default_factory=list)  # that no reading before them could be compared with

    @property
    def in_doubt(self) -> bool:
        """Whether a reading may still prove to be another than was taken."""
        return bool(self.held or self.fresh)

    def judge(self, name: str, taken: _Taken) -> bool:
        """Put the accepted reading into `taken`; true where samples before it prove to have been others than taken."""
        read = taken.readings[name]
        if read is None:
            return False
        interval, self.last_ns = (taken.stamp_ns - self.last_ns) * 1e-9, taken.stamp_ns
        if self.good is None:
            self.good, self.fresh = read, [taken]
            return False
        gap = self._is_gap(interval)
        limit = self.limit * max(self.usual / self.quick, 1.0)
        distance = math.dist(read, self.good)
        if gap:
            self.held, self.fresh = [], []
        if distance <= limit:  # what was fresh was good, what was held was wild; unless this one agrees with it as well
            real = bool(self.held) and math.dist(read, self.held[-1][1]) <= limit
            return self._accept(name, read, steady=True, real=real)
        if gap:
            before = self.good
            self._accept(name, read, steady=True)
            self.fresh = [taken]
            if distance > limit * interval / self.usual:  # not even in that time
                taken.readings[name] = before
                self.held = [(taken, read)]
            return False
        if self.fresh:
            return self._is_fresh_too(name, taken, read)
        if self.steady and len(self.held) < self.most_held:
            taken.readings[name] = self.good
            self.held.append((taken, read))
            return False
        return self._accept(name, read, steady=False, real=True)  # it lasts

    def _is_gap(self, interval: float) -> bool:
        usual = self.usual or interval
        gap = interval > max(GAP * usual, self.shortest_gap)
        # where no shorter ones come, this will be the usual interval
        self.usual = usual + FOLLOWED * (min(interval, GAP * usual) - usual)
        return gap

    def _accept(self, name: str, read: Vector, *, steady: bool, real: bool = False) -> bool:
        """Take `read` as it is; true where readings that were held prove to be `real`, and are put back."""
        held = self.held if real else []
        for each, was in held:
            each.readings[name] = was
        self.good, self.steady = read, steady
        self.held, self.fresh = [], []
        return bool(held)

    def _is_fresh_too(self, name: str, taken: _Taken, read: Vector) -> bool:
        """It or the one before is wild: take this one for both, until the next tells."""
        fresh = self.fresh
        self._accept(name, read, steady=False)
        useless = name == "accel" and not math.hypot(*read) > SHORTEST_VECTOR  # an attitude cannot begin with it
        if useless or len(fresh) > self.most_held:
            return False
        for each in fresh:
            each.readings[name] = read
        self.fresh = [*fresh, taken]
        return True


class GatedAttitude:
    """Takes raw readings; `held` names those of the last sample that were not believed."""

    def __init__(self, method: AttitudeMethod, settings: GlitchSettings, name: str) -> None:
        """`name` of the method, for errors."""
        self._name = name
        self._filter = method
        self._last_ns: int | None = None
        self._parts = {
            name: _Part(limit, QUICK[name], settings.most_held, settings.longest_gap)
            for name, limit in (("gyro", settings.turn_rate), ("accel", settings.acceleration), ("mag", settings.field))
        }
        self._before: AttitudeMethod | None = None  # the filter before the first of
        self._in_doubt: list[_Taken] = []
        self.held: tuple[str, ...] = ()

    def update(
        self, stamp_ns: int, gyro: Vector, accel: Vector | None, mag: Vector | None = None
    ) -> tuple[AttitudeEstimate, Vector | None]:
        """The estimate at `stamp_ns`, and the specific force that it takes for true; units as for AttitudeMethod.

        Raises ValueError, and changes nothing, when time does not go on, or for a first reading without a usable accel.
        """
        self._require_usable(stamp_ns, accel, mag)
        self._last_ns = stamp_ns
        taken = _Taken(stamp_ns, {"gyro": gyro, "accel": accel, "mag": mag})
        again = False
        for name, part in self._parts.items():
            again |= part.judge(name, taken)
        self.held = tuple(name for name, part in self._parts.items() if part.held and part.held[-1][0] is taken)
        if any(part.in_doubt for part in self._parts.values()) and self._before is None:
            self._before = copy.deepcopy(self._filter)
        estimate = self._gone_through_again(taken) if again else _told(self._filter, taken)
        self._keep(taken)
        return estimate, taken.readings["accel"]

    def _require_usable(self, stamp_ns: int, accel: Vector | None, mag: Vector | None) -> None:
        if self._last_ns is None:
            initial_attitude(required_start(accel, self._name), mag)
        elif stamp_ns <= self._last_ns:
            raise ValueError(f"imu: stamp {stamp_ns} ns is not after the one before, {self._last_ns} ns")

    def _gone_through_again(self, last: _Taken) -> AttitudeEstimate:
        assert self._before is not None
        self._filter = copy.deepcopy(self._before)
        for taken in self._in_doubt:
            _told(self._filter, taken)
        return _told(self._filter, last)

    def _keep(self, taken: _Taken) -> None:
        if self._before is None:
            return
        self._in_doubt.append(taken)
        settled = not any(part.in_doubt for part in self._parts.values())
        if settled or len(self._in_doubt) > MOST_IN_DOUBT:
            self._before, self._in_doubt = None, []
            for part in self._parts.values():
                part.held, part.fresh = [], []


def _told(method: AttitudeMethod, taken: _Taken) -> AttitudeEstimate:
    gyro = taken.readings["gyro"]
    assert gyro is not None
    return method.update(taken.stamp_ns, gyro, taken.readings["accel"], taken.readings["mag"])
