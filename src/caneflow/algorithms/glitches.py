"""Single wild readings of an inertial sensor: held at the value before, so that no filter ever sees them.

A bus that drops a bit gives one full-scale reading among good ones. No hand accelerates or turns the cane that much
from one sample to the next; what stays there for longer than a few samples is believed again (estimators.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Generic, TypeVar

from annotated_types import Ge, Le

from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.quantities import Acceleration, Angle, Time, TurnRate
from caneflow.algorithms.rotations import Quaternion, Vector
from caneflow.physics import GRAVITY

V = TypeVar("V")

_STILL: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class GlitchSettings:
    """How far a reading may be from the last good one; measured to cancel single wild ones and touch no walk."""

    acceleration: Acceleration = 10.0  # m/s^2
    turn_rate: TurnRate = math.radians(120.0)  # rad/s
    field: Annotated[float, Ge(1e-3), Le(1e5)] = 60.0  # uT
    rotation: Angle = math.radians(10.0)  # rad, between two attitudes
    most_held: Annotated[int, Ge(0), Le(1000)] = 3  # samples; what lasts longer is not a glitch
    longest_gap: Time = 0.05  # s; across a longer one a limit of `unseen` holds
    # times turn_rate, at the start and across a gap: 480 deg/s; nothing that a hand does to a cane goes beyond
    unseen: Annotated[float, Ge(1), Le(1000)] = 4.0


class JumpGate(Generic[V]):
    """One quantity that jumps from its last good value by more than `limit` is held there, for a few samples.

    A value that no other one has agreed with yet (the first, one after a gap, one that lasted) holds nothing up:
    were it the wild one, the good ones after it would be held. Where `unseen_limit` is given, a value that is farther
    than that from the last good one (before the first: from `start`) is held at the start and across gaps too.
    """

    def __init__(
        self,
        limit: float,
        distance: Callable[[V, V], float],
        *,
        most_held: int = 3,
        longest_gap: float = 0.05,
        start: V | None = None,
        unseen_limit: float = math.inf,
    ) -> None:
        """Limits in the unit of `distance`, which tells how far two values are apart; `longest_gap` in s."""
        self._limit, self._unseen_limit, self._distance = limit, unseen_limit, distance
        self._most_held, self._longest_gap_ns = most_held, round(longest_gap * 1e9)
        self._good: V | None = start
        self._confirmed = False
        self._last_ns: int | None = None  # stamp of the last value, good or held
        self._held = 0  # in a row
        self.holding = False  # the last value was held
        self.contradicted = False  # the last value is far from the one before it, and neither has been confirmed

    def update(self, stamp_ns: int, value: V) -> V:
        """`value`, or the last good one in its place."""
        good, near, confirmed = self._good, False, False
        last_ns, self._last_ns = self._last_ns, stamp_ns
        follows = last_ns is not None and stamp_ns - last_ns <= self._longest_gap_ns
        if good is not None:
            apart = self._distance(value, good)
            if follows:
                near, confirmed = apart <= self._limit, self._confirmed
                if near and confirmed and not self._held:  # nearly every sample; nothing else changes
                    self._good = value
                    return value
            if not near and (confirmed or apart > self._unseen_limit) and self._held < self._most_held:
                self._confirmed, self.holding, self.contradicted = confirmed, True, False
                self._held += 1
                return good
        self.contradicted = follows and not near and not confirmed and not self._held
        self._good, self._confirmed = value, near
        self._held, self.holding = 0, False
        return value


class GlitchGate:
    """A gate for each part of an IMU sample. `held`: which parts of the last sample were held."""

    def __init__(self, settings: GlitchSettings) -> None:
        s = settings

        def vectors(limit: float, start: Vector | None = None, unseen_limit: float = math.inf) -> JumpGate[Vector]:
            return JumpGate(
                limit,
                math.dist,
                most_held=s.most_held,
                longest_gap=s.longest_gap,
                start=start,
                unseen_limit=unseen_limit,
            )

        self._gyro = vectors(s.turn_rate, _STILL, s.unseen * s.turn_rate)
        self._mag = vectors(s.field)
        # three samples without acceleration cost nothing, so here the limit is the same at the start and across a gap
        self._accel = vectors(s.acceleration, (0.0, 0.0, GRAVITY), 2.0 * GRAVITY + s.acceleration)
        self._linear_accel = vectors(s.acceleration, _STILL, s.acceleration)
        self._orientation: JumpGate[Quaternion] = JumpGate(
            s.rotation, _angle, most_held=s.most_held, longest_gap=s.longest_gap
        )
        self.held: tuple[str, ...] = ()

    @property
    def contradicted(self) -> bool:
        """Some part of the last sample is far from the one before it, and nothing tells which of the two is wild."""
        gates = self._gyro, self._accel, self._mag, self._orientation, self._linear_accel
        return any(gate.contradicted for gate in gates)

    def update(self, stamp_ns: int, reading: ImuReading) -> ImuReading:
        """The reading, the last good one in the place of each that is wild."""
        gyro, accel, mag, orientation, linear = reading
        gyro = self._gyro.update(stamp_ns, gyro)
        held: tuple[str, ...] = ("gyro",) if self._gyro.holding else ()
        if accel is not None:
            accel = self._accel.update(stamp_ns, accel)
            if self._accel.holding:
                held += ("accel",)
        if mag is not None:
            mag = self._mag.update(stamp_ns, mag)
            if self._mag.holding:
                held += ("mag",)
        if orientation is not None:
            orientation = self._orientation.update(stamp_ns, orientation)
            if self._orientation.holding:
                held += ("orientation",)
        if linear is not None:
            linear = self._linear_accel.update(stamp_ns, linear)
            if self._linear_accel.holding:
                held += ("linear_accel",)
        self.held = held
        return ImuReading(gyro, accel, mag, orientation, linear) if held else reading


def _angle(a: Quaternion, b: Quaternion) -> float:
    """Of the rotation from one attitude to the other, rad."""
    w = abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])
    return 2.0 * math.acos(min(w, 1.0))
