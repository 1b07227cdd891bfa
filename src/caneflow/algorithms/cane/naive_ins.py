"""Naive inertial navigation: the chip's linear acceleration, turned into R0, integrated twice (cane.md row 14)."""

from dataclasses import dataclass

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import SampleClock, required_orientation, world_acceleration
from caneflow.algorithms.rotations import Vector


@dataclass(frozen=True, kw_only=True)
class NaiveInsSettings:
    """Nothing to set: that is what makes it naive."""


class NaiveIns(DeadReckoning):
    """Velocity and position by the trapezium rule; the radar is not used. The reference that drifts (Table I)."""

    def __init__(self, settings: NaiveInsSettings) -> None:
        self._clock = SampleClock()
        self._acceleration: Vector = (0.0, 0.0, 0.0)
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL; integrated like any other."""
        return self._clock.gaps

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`; starts at rest in the origin; no covariance.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        orientation = required_orientation(reading.orientation, "naive_ins")
        acceleration = world_acceleration(orientation, reading, "naive_ins")
        interval = self._clock.interval(stamp_ns)
        if interval is not None:
            velocity = _trapezium(self._velocity, self._acceleration, acceleration, interval)
            self._position = _trapezium(self._position, self._velocity, velocity, interval)
            self._velocity = velocity
        self._acceleration = acceleration
        return PoseEstimate(self._position, self._velocity, orientation, None)


def _trapezium(integral: Vector, before: Vector, now: Vector, interval: float) -> Vector:
    half = 0.5 * interval
    return (
        integral[0] + half * (before[0] + now[0]),
        integral[1] + half * (before[1] + now[1]),
        integral[2] + half * (before[2] + now[2]),
    )
