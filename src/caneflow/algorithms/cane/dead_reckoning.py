"""What the paper's fusion methods share: their shape, the measured interval, a speed that finds its heading.

psi is the yaw of the boresight; (cos psi, sin psi) is kept instead of psi, since eq. 5 needs nothing else.
"""

from abc import ABC, abstractmethod
from collections import deque
from typing import ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import LONGEST_INTERVAL, heading_of
from caneflow.algorithms.rotations import Quaternion, Vector

HISTORY = 512  # IMU samples that a late speed may reach back: 5 s at 100 Hz

DelayCompensation: TypeAlias = Literal["none", "heading", "motion"]
_Instant: TypeAlias = tuple[int, float, float, float, float]


class PoseEstimate(NamedTuple):
    """Where the IMU's origin is, in R0, at the stamp of the IMU sample that asked."""

    position: Vector  # m
    velocity: Vector  # m/s
    orientation: Quaternion  # w x y z, body to world
    covariance: NDArray[np.float64] | None  # (6, 6) of position and velocity, m^2, m^2/s, m^2/s^2


class DeadReckoning(ABC):
    """The shape of every fusion method: ground speeds and IMU samples in, one estimate per IMU sample out.

    A method that derives from it need not say that it has no use for speeds or velocities.
    """

    has_gates: ClassVar[bool] = False  # wild readings are held in it, and it wants them as they come
    held: tuple[str, ...] = ()  # what it held back of the last sample, when it has gates

    @property
    @abstractmethod
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""

    def speed(  # noqa: B027 - some methods have no use for it, or for the one that follows
        self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None
    ) -> None:
        """Take a new ground speed: m/s, its quality in m/s, and the s by which it lags its stamp."""

    def velocity(  # noqa: B027
        self,
        stamp_ns: int,
        velocity: tuple[float, float],
        covariance: tuple[float, float, float],
        delay: float | None,
    ) -> None:
        """Take a velocity along the boresight's projection and to its left (m/s), with xx, xy, yy ((m/s)^2)."""

    def spread(self, stamp_ns: int, spread: float, delay: float | None) -> None:  # noqa: B027
        """Take the width of the Doppler as the speed to the side that it would come from, m/s."""

    @abstractmethod
    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`, from an IMU sample."""


class VelocityMeasurement(NamedTuple):
    """A ground speed turned into R0 (eq. 5); its vertical component is 0."""

    x: float  # m/s
    y: float  # m/s
    quality: float  # m/s, eq. 4


class GroundVelocity:
    """Turns ground speeds into velocities in R0 (eq. 5), each with the heading of its own time.

    The radar's value belongs to the middle of its window, `delay` before its stamp. `none` ignores that:
    heading at the stamp. `heading` takes the heading at stamp - delay. `motion` adds to that the velocity
    gained since, by the accelerometer. A speed waits until an IMU sample later than its stamp has come, so
    the result does not depend on which of two samples with one stamp is delivered first.
    """

    def __init__(self, boresight: Vector, *, compensate_delay: DelayCompensation) -> None:
        self._boresight = boresight
        self._compensate_delay = compensate_delay
        self._waiting: deque[tuple[int, float, float, float]] = deque(maxlen=16)
        # stamp, cos psi, sin psi, velocity gained since the start (x, y; only for `motion`)
        self._history: deque[_Instant] = deque(maxlen=HISTORY)
        self._gained_x = self._gained_y = 0.0  # m/s, R0

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Keep a valid speed until it is taken; one that is not valid says nothing."""
        if valid:
            self._waiting.append((stamp_ns, speed, quality, delay or 0.0))

    def imu(self, stamp_ns: int, orientation: Quaternion, acceleration: Vector, interval: float | None) -> None:
        """Remember heading and acceleration (R0, m/s^2) of an IMU sample."""
        # over a gap nobody knows the acceleration
        if self._compensate_delay == "motion" and interval is not None and interval <= LONGEST_INTERVAL:
            self._gained_x += interval * acceleration[0]
            self._gained_y += interval * acceleration[1]
        cos_psi, sin_psi = heading_of(orientation, self._boresight)
        self._history.append((stamp_ns, cos_psi, sin_psi, self._gained_x, self._gained_y))

    def take(self, before_ns: int) -> VelocityMeasurement | None:
        """The newest speed whose stamp lies before `before_ns`, as a velocity; None when none has come."""
        newest = None
        while self._waiting and self._waiting[0][0] < before_ns:
            newest = self._waiting.popleft()
        if newest is None or not self._history:
            return None
        stamp_ns, speed, quality, delay = newest
        if self._compensate_delay != "none":
            stamp_ns -= round(delay * 1e9)
        _, cos_psi, sin_psi, gained_x, gained_y = self._instant(stamp_ns)
        return VelocityMeasurement(
            speed * cos_psi + self._gained_x - gained_x, speed * sin_psi + self._gained_y - gained_y, quality
        )

    def _instant(self, stamp_ns: int) -> _Instant:
        """The last IMU sample at or before a time, the oldest kept when there is none."""
        for instant in reversed(self._history):
            if instant[0] <= stamp_ns:
                return instant
        return self._history[0]
