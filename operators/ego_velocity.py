"""Speed over ground from a radar's points with Doppler: what stands still in the whole room tells how it moves itself.

in   points : RadarPoints  one frame per sample
in   imu    : Imu          orientation and gyro; with accel a wild frame is told from a sudden move
out  speed  : GroundSpeed  one per frame: `velocity` in both components, `vertical`
"""

import math
from dataclasses import dataclass, field

import numpy as np

from caneflow.algorithms.glitches import GlitchGate, GlitchSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import require_later
from caneflow.algorithms.radar.ego_motion import (
    AntennaVelocity,
    EgoMotion,
    EgoMotionSettings,
    RadarMounting,
    level_mounting,
)
from caneflow.messages import GroundSpeed, Imu, MessageError, RadarPoints, Sample, bounds
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

UNOBSERVED = 1e6  # (m/s)^2 (wire.md)


@dataclass(frozen=True, kw_only=True)
class EgoVelocityOperatorSettings:
    """How points become a velocity, and how the IMU is guarded."""

    ego_motion: EgoMotionSettings = field(default_factory=EgoMotionSettings)
    glitches: GlitchSettings = field(default_factory=GlitchSettings)  # of the IMU


class EgoVelocityOperator(Operator):
    """Robust least squares over the points of each frame, turned into R0 by the attitude in its middle."""

    inputs = {"points": RadarPoints, "imu": Imu}
    outputs = {"speed": GroundSpeed}
    Settings = EgoVelocityOperatorSettings

    def __init__(self, settings: EgoVelocityOperatorSettings, context: Context) -> None:
        self._motion = EgoMotion(settings.ego_motion, mounting(context.rig))
        self._gate = GlitchGate(settings.glitches)
        self._seed = int(context.random.integers(2**63))
        self._imu_ns: int | None = None  # stamps of the last samples
        self._points_ns: int | None = None

    def handle(self, port: str, message: Sample) -> Emitted:
        """The velocity of a frame; an IMU sample only tells the attitude and what was felt."""
        if isinstance(message, RadarPoints):
            return (("speed", self._speed(message)),)
        if isinstance(message, Imu):
            self._take_attitude(message)
        return ()

    def _take_attitude(self, imu: Imu) -> None:
        if imu.orientation is None:
            raise Refused("the IMU sample has no orientation; put operators.attitude in front of ego_velocity")
        try:
            require_later(imu.stamp, self._imu_ns)
        except ValueError as error:
            raise Refused(str(error)) from error
        self._imu_ns = imu.stamp
        reading = self._gate.update(imu.stamp, ImuReading(imu.gyro, imu.accel, orientation=imu.orientation))
        if reading.orientation is not None:
            self._motion.imu(imu.stamp, reading.orientation, reading.gyro, reading.accel)

    def _speed(self, points: RadarPoints) -> GroundSpeed:
        if self._points_ns is not None and points.stamp <= self._points_ns:
            raise Refused(f"points at {points.stamp} ns are not newer than the last, {self._points_ns} ns")
        self._points_ns = points.stamp
        delay = 0.5 * points.frame_time
        found = self._motion.update(
            points.stamp - round(delay * 1e9),
            points.position,
            points.doppler,
            points.snr,
            doppler_step=points.doppler_step,
            doppler_limit=points.doppler_limit,
            # by the frame and not by the frames before it: a node that goes on after a restart draws the same
            random=np.random.default_rng((self._seed, points.stamp)),
        )
        return _said(points.stamp, delay, found)


def _said(stamp: int, delay: float, found: AntennaVelocity | None) -> GroundSpeed:
    if found is None or float(np.abs(found.velocity).max()) > bounds.SPEED:
        return GroundSpeed(
            stamp=stamp,
            speed=0.0,
            quality=math.inf,
            rays=0,
            valid=False,
            delay=delay,
            velocity=(0.0, 0.0),
            velocity_cov=(UNOBSERVED, 0.0, UNOBSERVED),
            velocity_delay=delay,
        )
    forward, left, up = found.velocity.tolist()
    (xx, xy, _), (_, yy, _), (_, _, zz) = found.covariance.tolist()
    return GroundSpeed(
        stamp=stamp,
        speed=forward,
        quality=min(math.sqrt(xx), bounds.SPREAD),
        rays=found.points,
        valid=True,
        delay=delay,
        velocity=(forward, left),
        velocity_cov=(xx, xy, yy),
        velocity_delay=delay,
        vertical=up,
        vertical_sd=min(math.sqrt(zz), bounds.SPREAD),
    )


def mounting(rig: Rig) -> RadarMounting:
    """Where the radar sits; raises MessageError where the rig leaves open how it is turned."""
    to_body = rig.radar_orientation
    if to_body is None:
        try:
            to_body = level_mounting(rig.boresight)
        except ValueError as error:
            raise MessageError(f"rig.radar_orientation is not known, and {error}; write it under rig:") from error
    return RadarMounting(to_body=to_body, boresight=rig.boresight, antenna=rig.antenna)


if __name__ == "__main__":
    run(EgoVelocityOperator)
