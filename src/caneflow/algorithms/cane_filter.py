"""`method: best`: radar velocity, IMU and magnetic field into a track, one estimate per IMU sample (docs/methods/best.md).

Velocity is estimated in the gyro's frame (walk_motion.py), the heading of that frame and the track by weighing many
gyro errors against the magnetic field (heading_hypotheses.py), height by itself (heave.py).
"""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt

from caneflow.algorithms.dead_reckoning import (
    LONGEST_INTERVAL,
    PoseEstimate,
    SampleClock,
    heading_of,
    required_orientation,
    world_acceleration,
)
from caneflow.algorithms.gyro_yaw import GyroYaw
from caneflow.algorithms.heading_hypotheses import HeadingHypotheses, HeadingSettings
from caneflow.algorithms.heave import HeaveObserver, HeaveSettings
from caneflow.algorithms.rotations import Quaternion, Vector, from_yaw, multiply, normalized, rotate
from caneflow.algorithms.standing import StandingDetector, StandingSettings
from caneflow.algorithms.walk_motion import WalkMotion, WalkMotionSettings


@dataclass(frozen=True, kw_only=True)
class CaneFilterSettings:
    """What the filter may be told; units on each line."""

    # a radar velocity errs alike for 0.1 s (its window, and the speckle it stands on): as white noise, so much more
    velocity_inflation: Annotated[float, Gt(0)] = 10.0
    speed_noise: Annotated[float, Gt(0)] = 0.5  # m/s, of the paper's speed, where it is all there is (kalman.md)
    speed_patience: Annotated[float, Gt(0)] = 0.5  # s without a velocity before the paper's speed is taken instead
    sideways: Annotated[float, Gt(0)] = 0.15  # m/s, sd of the hand's velocity across the way the cane points (cane.md)
    sideways_interval: Annotated[float, Gt(0)] = 0.1  # s
    sideways_memory: Annotated[float, Gt(0)] = 1.0  # s over which swinging and turning are noticed
    sideways_per_turn: Annotated[float, Ge(0)] = 0.4  # m: (m/s) of doubt per (rad/s) of swinging or turning
    hand_ahead: float = 0.3  # m that the hand is carried ahead of the body: it goes sideways when the body turns
    standing_speed: Annotated[float, Gt(0)] = 0.03  # m/s, sd of the sensors' while the bearer stands
    standing_inflation: Annotated[float, Gt(0)] = 20.0  # samples that share one drift of the hand
    radar_standing: Annotated[float, Gt(0)] = 0.2  # m/s, radar speed above which nobody stands, whatever the IMU says
    speed_scale: Annotated[float, Ge(0)] = 0.012  # sd of the radar's scale: 1 cm of height; only in the covariance
    heading_interval: Annotated[float, Gt(0)] = 0.1  # s between updates of the tracks
    standing: StandingSettings = field(default_factory=StandingSettings)
    motion: WalkMotionSettings = field(default_factory=WalkMotionSettings)
    heading: HeadingSettings = field(default_factory=HeadingSettings)
    heave: HeaveSettings = field(default_factory=HeaveSettings)


class _Instant(NamedTuple):
    """What a velocity that comes late is compared with."""

    stamp_ns: int
    cos_yaw: float  # of the boresight, in the gyro's frame
    sin_yaw: float
    gained_x: float  # m/s since the start
    gained_y: float
    lever_x: float  # m/s, of the antenna about the IMU
    lever_y: float


class _Measured(NamedTuple):
    stamp_ns: int  # when it was true
    forward: float  # m/s
    left: float
    xx: float  # (m/s)^2
    yy: float


_HISTORY = 64  # IMU samples that a velocity may come late
_UNOBSERVED = 1e5  # (m/s)^2, variance from which on a component says nothing


class CaneFilter:
    """Ground velocities, magnetic field and IMU samples in, one estimate per IMU sample out."""

    def __init__(
        self,
        settings: CaneFilterSettings,
        *,
        boresight: Vector,
        pivot: Vector = (0.0, -0.3, 0.0),
        antenna: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """For a rig: `boresight`, `pivot` (m, IMU to hand) and `antenna` (m, from the IMU), all in the body frame."""
        self._settings = settings
        self._boresight, self._pivot, self._antenna = boresight, pivot, antenna
        self._clock = SampleClock()
        self._yaw = GyroYaw()
        self._standing = StandingDetector(settings.standing)
        self._motion = WalkMotion(settings.motion)
        self._heading = HeadingHypotheses(settings.heading)
        self._heave = HeaveObserver(settings.heave)
        self._start_height: float | None = None
        self._start_yaw = 0.0
        self._waiting: deque[tuple[int, _Measured]] = deque(maxlen=16)
        self._history: deque[_Instant] = deque(maxlen=_HISTORY)
        self._gained_x = self._gained_y = 0.0
        self._acceleration = (0.0, 0.0)
        self._boresight_yaw = 0.0
        self._turning = 0.1  # (rad/s)^2, mean square of the boresight's turn rate
        self._last_velocity_ns: int | None = None
        self._radar_speed = 0.0
        self._field: float | None = None
        self._since_heading = self._since_sideways = 0.0

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._clock.gaps

    @property
    def gyro_bias(self) -> float:
        """Bias of the gyro about the vertical as the filter has it, rad/s."""
        return self._heading.bias

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Take the paper's speed (m/s), which counts only where no velocity comes."""
        last_ns = self._last_velocity_ns
        if not valid or (last_ns is not None and stamp_ns - last_ns < self._settings.speed_patience * 1e9):
            return
        variance = self._settings.speed_noise**2 / self._settings.velocity_inflation
        self._wait(stamp_ns, (speed, 0.0), variance, math.inf, delay)

    def velocity(
        self,
        stamp_ns: int,
        velocity: tuple[float, float],
        covariance: tuple[float, float, float],
        delay: float | None,
    ) -> None:
        """Take a velocity along the boresight's projection and to its left (m/s), with xx, xy, yy ((m/s)^2)."""
        if covariance[0] < _UNOBSERVED or covariance[2] < _UNOBSERVED:
            self._last_velocity_ns = stamp_ns
            self._wait(stamp_ns, velocity, covariance[0], covariance[2], delay)

    def magnetic_field(self, stamp_ns: int, mag: Vector) -> None:
        """Take the field (uT, body frame) of the IMU sample that comes next."""
        self._field = None if mag == (0.0, 0.0, 0.0) else 0.0
        self._mag = mag

    def imu(
        self,
        stamp_ns: int,
        gyro: Vector,
        accel: Vector | None,
        orientation: Quaternion | None,
        linear_accel: Vector | None,
    ) -> PoseEstimate:
        """The estimate at `stamp_ns`.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        orientation = normalized(required_orientation(orientation, "best"))
        acceleration = world_acceleration(orientation, accel, linear_accel, "best")
        interval = self._clock.interval(stamp_ns)
        raise NotImplementedError
