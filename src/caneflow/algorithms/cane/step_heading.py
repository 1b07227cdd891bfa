"""Step and heading, adapted to the white cane as in section VI of the paper (cane.md row 13).

The cane is swung once per step. Between two swings it stands still for an instant, a stationary point. So does a phone
in a hand; one in a pocket may swing once per stride, which its vertical acceleration tells (step_bob.py).
"""

import math
from dataclasses import dataclass

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.cane.step_bob import StepBob
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import (
    LONGEST_INTERVAL,
    SampleClock,
    heading_of,
    required_orientation,
    world_acceleration,
)
from caneflow.algorithms.quantities import Time, TurnRate
from caneflow.algorithms.rotations import Vector


@dataclass(frozen=True, kw_only=True)
class StepHeadingSettings:
    """When the cane stands still, and what is a swing."""

    stationary_rate: TurnRate = math.radians(25.0)  # rad/s: a stationary point lies below
    swing_rate: TurnRate = math.radians(40.0)  # rad/s: the peak of a swing lies above
    shortest_swing: Time = 0.45  # s between stationary points

    def __post_init__(self) -> None:
        if not self.swing_rate > self.stationary_rate:
            raise ValueError(
                f"swing_rate is {self.swing_rate} rad/s; it must be above stationary_rate, {self.stationary_rate} rad/s"
            )


class StepHeading(DeadReckoning):
    """One step of fixed length for each swing, along the mean yaw of the boresight during it.

    A stationary point is a local minimum of the gyro's norm below `stationary_rate`, at least `shortest_swing`
    after the one before. It is known one sample late. Position moves on at the end of a step, not during it.
    """

    def __init__(self, settings: StepHeadingSettings, *, boresight: Vector, step_length: float) -> None:
        self._settings = settings
        self._boresight = boresight
        self._step_length = step_length  # m
        self._clock = SampleClock()
        self._norms = (math.inf, math.inf)  # rad/s, of the two samples before
        self._since = 0.0  # s since the last stationary point
        self._peak = 0.0  # rad/s, since then
        self._heading_sum = (0.0, 0.0)  # of (cos psi, sin psi), since then
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)
        self._bob = StepBob()
        self.steps = 0

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._clock.gaps

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`; height stays 0; velocity is the last step's mean; no covariance.

        Raises ValueError without an orientation or when time does not go on.
        """
        orientation = required_orientation(reading.orientation, "shs")
        interval = self._clock.interval(stamp_ns)
        gyro = reading.gyro
        norm = math.sqrt(gyro[0] ** 2 + gyro[1] ** 2 + gyro[2] ** 2)
        cos_psi, sin_psi = heading_of(orientation, self._boresight)
        self._since += interval or 0.0
        accelerates = reading.accel is not None or reading.linear_accel is not None
        if interval is not None and interval <= LONGEST_INTERVAL and accelerates:
            self._bob.update(interval, world_acceleration(orientation, reading, "shs")[2])
        self._peak = max(self._peak, norm)
        self._heading_sum = self._heading_sum[0] + cos_psi, self._heading_sum[1] + sin_psi
        if self._since >= self._settings.shortest_swing and self._stationary(norm):
            self._end_swing()
        self._norms = self._norms[1], norm
        return PoseEstimate(self._position, self._velocity, orientation, None)

    def _stationary(self, norm: float) -> bool:
        """Whether the sample before this one was a local minimum below the limit."""
        before, middle = self._norms
        return middle < self._settings.stationary_rate and middle <= before and middle < norm

    def _end_swing(self) -> None:
        if self._peak > self._settings.swing_rate:
            x, y = self._heading_sum
            length = math.hypot(x, y) or 1.0
            steps = 2 if self._bob.is_stride else 1
            walked = steps * self._step_length
            step_x, step_y = walked * x / length, walked * y / length
            self._position = self._position[0] + step_x, self._position[1] + step_y, 0.0
            self._velocity = step_x / self._since, step_y / self._since, 0.0
            self.steps += steps
            self._bob.end_swing()
        else:
            self._velocity = (0.0, 0.0, 0.0)
        self._since, self._peak, self._heading_sum = 0.0, 0.0, (0.0, 0.0)
