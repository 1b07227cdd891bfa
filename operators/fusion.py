"""Position by dead reckoning: the radar's speed over ground along the IMU's heading, by the method of choice.

in   imu   : Imu          orientation, linear acceleration, gyro, 100 Hz
in   speed : GroundSpeed  one per radar frame, 100 Hz
out  pose  : Pose         one per IMU sample
"""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from caneflow.algorithms.cane_filter import CaneFilter, CaneFilterSettings
from caneflow.algorithms.dead_reckoning import DeadReckoning
from caneflow.algorithms.kalman import KalmanFilter, KalmanSettings
from caneflow.algorithms.luenberger import LuenbergerObserver, LuenbergerSettings
from caneflow.algorithms.luenberger_fixed import FixedLuenbergerObserver, observer_constants
from caneflow.algorithms.naive_ins import NaiveIns, NaiveInsSettings
from caneflow.algorithms.step_heading import StepHeading, StepHeadingSettings
from caneflow.messages import GroundSpeed, Imu, Pose, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

Method: TypeAlias = Literal["luenberger", "luenberger_fixed", "kalman", "shs", "naive_ins", "best"]


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """Which estimator, and what each may be told."""

    method: Method = "luenberger"
    luenberger: LuenbergerSettings = field(default_factory=LuenbergerSettings)  # also in fixed point
    kalman: KalmanSettings = field(default_factory=KalmanSettings)
    shs: StepHeadingSettings = field(default_factory=StepHeadingSettings)
    naive_ins: NaiveInsSettings = field(default_factory=NaiveInsSettings)
    best: CaneFilterSettings = field(default_factory=CaneFilterSettings)

    def __post_init__(self) -> None:
        if self.method == "luenberger_fixed":  # raises for what fixed point does not have
            observer_constants(self.luenberger, (0.0, 1.0, 0.0))


class Fusion(Operator):
    """One estimator, told of every speed and asked at every IMU sample."""

    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose}
    Settings = FusionSettings

    def __init__(self, settings: FusionSettings, context: Context) -> None:
        self._method = settings.method
        self._estimator = estimator(settings, context.rig)
        # The paper's methods know one speed; this one knows a velocity and the magnetic field as well.
        self._cane_filter = self._estimator if isinstance(self._estimator, CaneFilter) else None

    def handle(self, port: str, message: Sample) -> Emitted:
        """The pose at an IMU sample's stamp; a speed only informs the estimator."""
        if isinstance(message, Imu):
            return (("pose", self._pose(message)),)
        if isinstance(message, GroundSpeed):
            self._take_speed(message)
        return ()

    def _take_speed(self, ground: GroundSpeed) -> None:
        if self._cane_filter is not None and ground.velocity is not None and ground.velocity_cov is not None:
            self._cane_filter.velocity(ground.stamp, ground.velocity, ground.velocity_cov, ground.velocity_delay)
        self._estimator.speed(ground.stamp, ground.speed, ground.quality, ground.valid, ground.delay)

    def _pose(self, imu: Imu) -> Pose:
        if self._cane_filter is not None and imu.mag is not None:
            self._cane_filter.magnetic_field(imu.mag)
        try:
            estimate = self._estimator.imu(imu.stamp, imu.gyro, imu.accel, imu.orientation, imu.linear_accel)
        except ValueError as error:
            raise Refused(str(error)) from error
        return Pose(
            stamp=imu.stamp,
            position=estimate.position,
            velocity=estimate.velocity,
            orientation=estimate.orientation,
            covariance=estimate.covariance,
            method=self._method,
        )


def estimator(settings: FusionSettings, rig: Rig) -> DeadReckoning:
    """The estimator that `method` names."""
    match settings.method:
        case "luenberger":
            return LuenbergerObserver(settings.luenberger, boresight=rig.boresight)
        case "luenberger_fixed":
            return FixedLuenbergerObserver(settings.luenberger, boresight=rig.boresight)
        case "kalman":
            return KalmanFilter(settings.kalman, boresight=rig.boresight)
        case "shs":
            return StepHeading(settings.shs, boresight=rig.boresight, step_length=rig.need("step_length"))
        case "naive_ins":
            return NaiveIns(settings.naive_ins)
        case "best":
            return CaneFilter(
                settings.best,
                boresight=rig.boresight,
                pivot=rig.need("pivot"),
                antenna=rig.antenna,
            )


if __name__ == "__main__":
    run(Fusion)
