"""Speed over ground from radar frames, the cane's attitude telling where the beam meets the ground.

in   frame : RadarFrame   one scan per 10 ms
in   imu   : Imu          orientation and gyro
out  speed : GroundSpeed  one per frame; `velocity` in every fifth (ground_velocity.every)
"""

import math
from dataclasses import dataclass, field, fields
from operator import attrgetter

from caneflow.algorithms.glitches import GlitchGate, GlitchSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.inertial.imu_sample import require_later
from caneflow.algorithms.radar.footprint import CaneGeometry
from caneflow.algorithms.radar.ground_velocity import GroundVelocityEstimator, GroundVelocitySettings
from caneflow.algorithms.radar.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.radar.paper_speed import PaperSpeed, PaperSpeedSettings, SpeedEstimate
from caneflow.messages import GroundSpeed, Imu, RadarFrame, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

PARAMETERS = tuple(each.name for each in fields(RadarParameters))  # a frame calls them the same
DESCRIPTION = attrgetter(*PARAMETERS)
NO_SPEED = SpeedEstimate(speed=0.0, quality=math.inf, rays=0, valid=False, delay=0.0)  # the paper's front end is off


@dataclass(frozen=True, kw_only=True)
class GroundSpeedSettings:
    """What is common to all front ends, and what each may be told."""

    moving_returns: MovingReturnsSettings = field(default_factory=MovingReturnsSettings)
    with_speed: bool = True  # fill `speed` and `quality`, by the paper's front end
    with_velocity: bool = True  # fill `velocity` and `velocity_cov`, by the pulse pair
    paper: PaperSpeedSettings = field(default_factory=PaperSpeedSettings)
    ground_velocity: GroundVelocitySettings = field(default_factory=GroundVelocitySettings)
    glitches: GlitchSettings = field(default_factory=GlitchSettings)  # of the IMU

    def __post_init__(self) -> None:
        if not (self.with_speed or self.with_velocity):
            raise ValueError("with_speed and with_velocity are both false; there would be nothing to say")


class GroundSpeedOperator(Operator):
    """The paper's front end (eq. 1-4) on a sliding window, and the pulse pair beside it, on the same moving returns."""

    inputs = {"frame": RadarFrame, "imu": Imu}
    outputs = {"speed": GroundSpeed}
    Settings = GroundSpeedSettings

    def __init__(self, settings: GroundSpeedSettings, context: Context) -> None:
        self._moving_returns = MovingReturnsFilter(settings.moving_returns)
        rig = geometry(context.rig)
        self._paper = PaperSpeed(settings.paper, rig) if settings.with_speed else None
        self._velocity = GroundVelocityEstimator(settings.ground_velocity, rig) if settings.with_velocity else None
        self._gate = GlitchGate(settings.glitches)
        self._last_ns: int | None = None  # stamp of the last IMU sample
        self._attitudes = AttitudeHistory()
        self._described: tuple[float, ...] = ()  # what the frame before said of its scans
        self._parameters: RadarParameters | None = None  # the same by name

    def handle(self, port: str, message: Sample) -> Emitted:
        """The speed at a frame's stamp; an IMU sample only tells the attitude."""
        if isinstance(message, RadarFrame):
            return (("speed", self._speed(message)),)
        if isinstance(message, Imu):
            self._take_attitude(message)
        return ()

    def _take_attitude(self, imu: Imu) -> None:
        if imu.orientation is None:
            raise Refused("the IMU sample has no orientation; put operators.attitude in front of ground_speed")
        try:
            require_later(imu.stamp, self._last_ns)
        except ValueError as error:
            raise Refused(str(error)) from error
        self._last_ns = imu.stamp
        reading = self._gate.update(imu.stamp, ImuReading(imu.gyro, imu.accel, orientation=imu.orientation))
        if reading.orientation is not None:
            self._attitudes.add(imu.stamp, reading.orientation, reading.gyro)
            if self._velocity is not None:
                self._velocity.imu(imu.stamp, reading.orientation, reading.accel)

    def _speed(self, frame: RadarFrame) -> GroundSpeed:
        described = DESCRIPTION(frame)
        parameters = self._parameters
        if parameters is None or described != self._described:
            parameters = RadarParameters(**dict(zip(PARAMETERS, described, strict=True)))
        try:
            returns = self._moving_returns.update(frame.stamp, frame.scans, parameters)
        except ValueError as error:
            raise Refused(str(error)) from error
        self._described, self._parameters = described, parameters
        speed = self._paper.update(returns, self._attitudes) if self._paper is not None else NO_SPEED
        velocity = self._velocity.update(returns, self._attitudes) if self._velocity is not None else None
        return GroundSpeed(
            stamp=frame.stamp,
            speed=speed.speed,
            quality=speed.quality,
            rays=speed.rays,
            valid=speed.valid,
            delay=speed.delay,
            velocity=velocity.velocity if velocity is not None else None,
            velocity_cov=velocity.covariance if velocity is not None else None,
            velocity_delay=velocity.delay if velocity is not None else None,
            spread=velocity.spread if velocity is not None else None,
            spread_delay=velocity.spread_delay if velocity is not None else None,
        )


def geometry(rig: Rig) -> CaneGeometry:
    """What the front ends need of the rig; raises MessageError for what is not known."""
    return CaneGeometry(
        hand_height=rig.need("hand_height"),
        aperture=rig.need("aperture"),
        pivot=rig.need("pivot"),
        boresight=rig.boresight,
        antenna=rig.antenna,
        aperture_across=rig.aperture_across,
    )


if __name__ == "__main__":
    run(GroundSpeedOperator)
