"""`smoothed`: a method for whole recordings only, beside those that the estimator offers.

It needs every sample before it says anything, so no operator can be it; what it takes is what `best` takes.
"""

from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import Any

from caneflow.algorithms.cane.cane_filter import CaneFilterSettings
from caneflow.algorithms.cane.cane_smoother import CaneSmoother
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.messages import GroundSpeed, Imu, Pose, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime.program import Sink

SMOOTHED = "smoothed"
HINDSIGHT_OF = "best"  # the method whose settings it takes


def smoothed_poses(
    readings: Sequence[Imu], speeds: Sequence[GroundSpeed], settings: CaneFilterSettings, rig: Rig
) -> Iterator[Pose]:
    """A pose for each of a recording's IMU samples, in hindsight; both sequences in the order of their stamps.

    Raises ValueError for samples that the filter cannot use, MessageError for a rig without a pivot.
    """
    smoother = CaneSmoother(settings, boresight=rig.boresight, pivot=rig.need("pivot"), antenna=rig.antenna)
    coming = iter(speeds)
    speed = next(coming, None)
    for imu in readings:
        while speed is not None and speed.stamp < imu.stamp:
            if speed.velocity is not None and speed.velocity_cov is not None:
                smoother.velocity(speed.stamp, speed.velocity, speed.velocity_cov, speed.velocity_delay)
            if speed.spread is not None:
                smoother.spread(speed.stamp, speed.spread, speed.spread_delay)
            smoother.speed(speed.stamp, speed.speed, speed.quality, speed.valid, speed.delay)
            speed = next(coming, None)
        reading = ImuReading(
            gyro=imu.gyro, accel=imu.accel, mag=imu.mag, orientation=imu.orientation, linear_accel=imu.linear_accel
        )
        smoother.imu(imu.stamp, reading)
    for imu, estimate in zip(readings, smoother.estimates(), strict=True):
        yield Pose(
            stamp=imu.stamp,
            position=estimate.position,
            velocity=estimate.velocity,
            orientation=estimate.orientation,
            covariance=estimate.covariance,
            method=SMOOTHED,
        )


def smoother(settings: CaneFilterSettings, poses: list[Pose]) -> type[Sink]:
    """A sink that keeps what the estimator reads, and puts the smoothed poses into `poses` at the end."""

    class Smoother(Sink):
        """Made for one run, as a program's settings are plain values."""

        def __init__(self, settings: Any, context: Any) -> None:
            self._rig: Rig = context.rig
            self._readings: list[Imu] = []
            self._speeds: list[GroundSpeed] = []

        def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
            """Keep a sample: streams come to a sink as they please, and are put in order at the end."""
            if isinstance(message, Imu):
                self._readings.append(message)
            elif isinstance(message, GroundSpeed):
                self._speeds.append(message)

        def idle(self, time: int) -> None:
            """Nothing to do."""

        def finish(self) -> None:
            """All samples are there."""
            by_stamp = attrgetter("stamp")
            readings, speeds = sorted(self._readings, key=by_stamp), sorted(self._speeds, key=by_stamp)
            poses.extend(smoothed_poses(readings, speeds, settings, self._rig))

    return Smoother
