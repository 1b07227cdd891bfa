"""`smoothed`: the track of a whole walk in hindsight, for evaluation; the same models as `best`, run both ways.

Forward the filter of cane_filter.py. Then backward over its states (Rauch, Tung and Striebel, AIAA Journal 3(8), 1965),
and the whole track anew with the heading that the walk's end has taught.
"""

import math

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.cane_filter import CaneFilter, CaneFilterSettings
from caneflow.algorithms.dead_reckoning import PoseEstimate
from caneflow.algorithms.rotations import Quaternion, Vector, from_yaw, multiply
from caneflow.algorithms.walk_motion import WalkMotion, WalkMotionSettings

Floats = NDArray[np.float64]


class RecordedMotion(WalkMotion):
    """The filter, with all that the way back needs; its memory grows with the walk."""

    def __init__(self, settings: WalkMotionSettings) -> None:
        super().__init__(settings)
        self.corrected: list[tuple[Floats, Floats]] = []  # states and covariances, before each prediction
        self.predicted: list[tuple[Floats, Floats]] = []
        self.transitions: list[Floats] = []

    def predict(
        self, t: float, acceleration: tuple[float, float], cos_yaw: float, sin_yaw: float
    ) -> complex:
        """As the filter's, and remembered."""
        self.corrected.append((np.array(self._x), self._p.copy()))
        gained = super().predict(t, acceleration, cos_yaw, sin_yaw)
        self.predicted.append((np.array(self._x), self._p.copy()))
        self.transitions.append(self._f.copy())
        return gained

    def smoothed(self) -> tuple[Floats, Floats]:
        """States (n + 1, 7) and covariances (n + 1, 7, 7) at the start and after each of n predictions."""
        x, p = np.array(self._x), self._p.copy()
        states, covariances = [x], [p]
        for index in range(len(self.transitions) - 1, -1, -1):
            x_then, p_then = self.corrected[index]
            x_next, p_next = self.predicted[index]
            # the transition is that of the accelerometer's biases; what was gained is in the predicted state
            gain = np.linalg.solve(p_next + _JITTER, self.transitions[index] @ p_then).T
            x = x_then + gain @ (x - x_next)
            p = p_then + gain @ (p - p_next) @ gain.T
            states.append(x)
            covariances.append(p)
        return np.array(states[::-1]), np.array(covariances[::-1])


_JITTER = 1e-15 * np.eye(7)


class CaneSmoother:
    """Takes what `CaneFilter` takes, and gives all estimates at the end."""

    def __init__(
        self,
        settings: CaneFilterSettings,
        *,
        boresight: Vector,
        pivot: Vector = (0.0, -0.3, 0.0),
        antenna: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """As for `CaneFilter`."""
        self._filter = CaneFilter(settings, boresight=boresight, pivot=pivot, antenna=antenna)
        self._motion = RecordedMotion(settings.motion)
        self._filter.replace_motion(self._motion)
        self._samples: list[_Sample] = []

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """As `CaneFilter.speed`."""
        self._filter.speed(stamp_ns, speed, quality, valid, delay)

    def velocity(
        self,
        stamp_ns: int,
        velocity: tuple[float, float],
        covariance: tuple[float, float, float],
        delay: float | None,
    ) -> None:
        """As `CaneFilter.velocity`."""
        self._filter.velocity(stamp_ns, velocity, covariance, delay)

    def magnetic_field(self, mag: Vector) -> None:
        """As `CaneFilter.magnetic_field`."""
        self._filter.magnetic_field(mag)

    def imu(
        self,
        stamp_ns: int,
        gyro: Vector,
        accel: Vector | None,
        orientation: Quaternion | None,
        linear_accel: Vector | None,
    ) -> None:
        """As `CaneFilter.imu`, but for the estimate, which comes with `estimates`."""
        estimate = self._filter.imu(stamp_ns, gyro, accel, orientation, linear_accel)
        assert orientation is not None, "the filter refuses samples without"
        self._samples.append(
            _Sample(len(self._motion.transitions), self._filter.gyro_turn, orientation, self._filter.drift, estimate)
        )

    def estimates(self) -> list[PoseEstimate]:
        """One per IMU sample; the orientation at the start is the filter's."""
        raise NotImplementedError
