"""Orientation from a raw IMU: for sensors whose chip has no fusion of its own, and recordings of them.

in   imu : Imu   gyro, accelerometer and, where there is one, magnetometer
out  imu : Imu   the same sample with `orientation` and `linear_accel` filled in

Single wild readings do not reach the filter, and `linear_accel` follows from what was taken in their place. `gyro`,
`accel` and `mag` go out as they came: what a sensor said stays on record, and every estimator has a gate of its own.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

import msgspec
from annotated_types import Ge, Le

from caneflow.algorithms.glitches import GlitchSettings
from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.gated_attitude import GatedAttitude
from caneflow.algorithms.inertial.initial_attitude import NORTH_YAW, AttitudeMethod
from caneflow.algorithms.inertial.madgwick import Madgwick, MadgwickSettings
from caneflow.algorithms.rotations import Quaternion, Vector, conjugate, from_yaw, multiply, normalized, rotate
from caneflow.messages import Imu, Sample
from caneflow.physics import GRAVITY
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

Method: TypeAlias = Literal["attitude_filter", "madgwick"]


@dataclass(frozen=True, kw_only=True)
class AttitudeSettings:
    """Which filter, what each may be told, and what of the sample it may use."""

    method: Method = "attitude_filter"
    magnetometer: bool = True  # false: yaw by the gyro alone, from 0
    magnetic_north: Annotated[float, Ge(-2.0 * math.pi), Le(2.0 * math.pi)] = NORTH_YAW  # rad, its yaw in R0
    attitude_filter: AttitudeFilterSettings = field(default_factory=AttitudeFilterSettings)
    madgwick: MadgwickSettings = field(default_factory=MadgwickSettings)
    glitches: GlitchSettings = field(default_factory=GlitchSettings)  # its `rotation` is not used here


class Attitude(Operator):
    """One filter; every sample that comes goes out again with the attitude at its stamp."""

    inputs = {"imu": Imu}
    outputs = {"imu": Imu}
    Settings = AttitudeSettings

    def __init__(self, settings: AttitudeSettings, context: Context) -> None:
        self._filter = GatedAttitude(attitude_method(settings), settings.glitches, settings.method)
        self._uses_magnetometer = settings.magnetometer
        self._to_rig = from_yaw(settings.magnetic_north - NORTH_YAW) if settings.magnetometer else from_yaw(0.0)

    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield the sample with its attitude; an orientation that it has already is replaced."""
        assert isinstance(message, Imu)
        mag = message.mag if self._uses_magnetometer else None
        try:
            estimate, accel = self._filter.update(message.stamp, message.gyro, message.accel, mag)
        except ValueError as error:
            raise Refused(str(error)) from error
        orientation = normalized(multiply(self._to_rig, estimate.orientation))
        linear = linear_acceleration(orientation, accel)
        yield "imu", msgspec.structs.replace(message, orientation=orientation, linear_accel=linear)


def attitude_method(settings: AttitudeSettings) -> AttitudeMethod:
    """The filter that `method` names."""
    match settings.method:
        case "attitude_filter":
            return AttitudeFilter(settings.attitude_filter)
        case "madgwick":
            return Madgwick(settings.madgwick)


def linear_acceleration(orientation: Quaternion, accel: Vector | None) -> Vector | None:
    """Specific force less gravity, m/s^2, in the body; None where there is no specific force."""
    if accel is None:
        return None
    x, y, z = rotate(conjugate(orientation), (0.0, 0.0, GRAVITY))
    return accel[0] - x, accel[1] - y, accel[2] - z


if __name__ == "__main__":
    run(Attitude)
