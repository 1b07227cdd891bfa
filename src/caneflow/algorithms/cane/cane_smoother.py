"""`smoothed`: the track of a whole walk in hindsight, for evaluation; the same models as `best`, run both ways.

Forward the filter of cane_filter.py. Then backward over its states (Rauch, Tung and Striebel, AIAA Journal 3(8), 1965),
and the whole track again with the heading that the walk's end has taught.
"""

import cmath
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.cane.cane_filter import CaneFilter, CaneFilterSettings, level_covariance
from caneflow.algorithms.cane.dead_reckoning import PoseEstimate
from caneflow.algorithms.cane.heading_hypotheses import Heading
from caneflow.algorithms.cane.walk_motion import Axes, WalkMotion, WalkMotionSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import Quaternion, Vector, from_yaw, multiply, normalized

Floats = NDArray[np.float64]

_KEPT: Final = 10  # states but for the marks, which are places of before
_JITTER: Final = 1e-15 * np.eye(_KEPT)  # the start is known exactly: its covariance has no inverse


class RecordedMotion(WalkMotion):
    """The filter, with all that the way back needs; its memory grows with the walk."""

    def __init__(self, settings: WalkMotionSettings) -> None:
        super().__init__(settings)
        self.corrected: list[tuple[Floats, Floats]] = []  # states and covariances, before each prediction
        self.predicted: list[tuple[Floats, Floats]] = []
        self.transitions: list[Floats] = []

    def predict(self, t: float, acceleration: complex, axes: Axes) -> complex:
        """As the filter's, and remembered."""
        self.corrected.append(self._now())
        gained = super().predict(t, acceleration, axes)
        self.predicted.append(self._now())
        self.transitions.append(self._f[:_KEPT, :_KEPT].copy())
        return gained

    def coast(self, t: float) -> None:
        """As the filter's; what is predicted over a gap is what is left after it."""
        super().coast(t)
        self.predicted[-1] = self._now()

    def _now(self) -> tuple[Floats, Floats]:
        return np.array(self._x[:_KEPT]), self._p[:_KEPT, :_KEPT].copy()

    def smoothed(self) -> tuple[Floats, Floats]:
        """States (n + 1, 10) and covariances (n + 1, 10, 10) at the start and after each of n predictions."""
        x, p = self._now()
        states, covariances = [x], [p]
        for index in range(len(self.transitions) - 1, -1, -1):
            x_then, p_then = self.corrected[index]
            x_next, p_next = self.predicted[index]
            gain = np.linalg.solve(p_next + _JITTER, self.transitions[index] @ p_then).T
            x = x_then + gain @ (x - x_next)
            p = p_then + gain @ (p - p_next) @ gain.T
            states.append(x)
            covariances.append(p)
        return np.array(states[::-1]), np.array(covariances[::-1])


class _Sample(NamedTuple):
    predictions: int  # made before it
    elapsed: float  # s
    turned: float  # rad, by the gyro
    offset: float  # rad, gyro's yaw less the chip's
    orientation: Quaternion  # the chip's
    estimate: PoseEstimate  # the filter's


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
        self._settings = settings
        self._motion = RecordedMotion(settings.motion)
        self._filter = CaneFilter(settings, boresight=boresight, pivot=pivot, antenna=antenna, motion=self._motion)
        self._samples: list[_Sample] = []
        # inputs go to the filter as they are
        self.speed = self._filter.speed
        self.velocity = self._filter.velocity
        self.spread = self._filter.spread

    def imu(self, stamp_ns: int, reading: ImuReading) -> None:
        """As `CaneFilter.imu`, but for the estimates, which come all together at the end."""
        estimate = self._filter.imu(stamp_ns, reading)
        assert reading.orientation is not None, "the filter refuses samples without"
        elapsed, turned = self._filter.heading.clock
        done, offset = len(self._motion.transitions), self._filter.yaw_offset
        self._samples.append(_Sample(done, elapsed, turned, offset, reading.orientation, estimate))

    def estimates(self) -> list[PoseEstimate]:
        """One per IMU sample so far, each with all samples before and after it; height is the filter's."""
        if not self._samples:
            return []
        states, covariances = self._motion.smoothed()
        rows = np.array([sample.predictions for sample in self._samples])
        states, covariances = states[rows], covariances[rows]
        times = np.array([(sample.elapsed, sample.turned) for sample in self._samples])
        places = states[:, 0] + 1j * states[:, 1]
        hindsight = self._filter.heading.hindsight(times[:, 0], times[:, 1], np.diff(places, prepend=places[:1]))
        return [
            _smoothed_estimate(sample, state, covariance, heading, self._settings)
            for sample, state, covariance, heading in zip(self._samples, states, covariances, hindsight, strict=True)
        ]


def _smoothed_estimate(
    sample: _Sample, state: Floats, covariance: Floats, heading: Heading, settings: CaneFilterSettings
) -> PoseEstimate:
    before = sample.estimate
    turn = cmath.rect(1.0, heading.yaw)
    velocity = turn * complex(state[2], state[3])
    filtered = before.covariance
    assert filtered is not None, "the filter gives one"
    smoothed = level_covariance(covariance[:4, :4], heading, turn, velocity, settings.speed_scale)
    smoothed[2, 2], smoothed[5, 5] = filtered[2, 2], filtered[5, 5]
    return PoseEstimate(
        position=(heading.position.real, heading.position.imag, before.position[2]),
        velocity=(velocity.real, velocity.imag, before.velocity[2]),
        orientation=multiply(from_yaw(sample.offset + heading.yaw), normalized(sample.orientation)),
        covariance=smoothed,
    )
