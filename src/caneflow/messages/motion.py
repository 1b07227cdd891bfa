"""Motion: what an IMU measures, the speed over ground, and where one is. SI units, radians, stamps in ns."""

import math
from typing import Annotated, TypeAlias

from msgspec import Meta

from caneflow.messages import bounds
from caneflow.messages.arrays import Array
from caneflow.messages.bounds import (
    require_array,
    require_covariance,
    require_pair,
    require_unit,
    require_vector,
    require_within,
)
from caneflow.messages.sample import Sample

Vector3: TypeAlias = tuple[float, float, float]
TurnRates: TypeAlias = tuple[bounds.TurnRate, bounds.TurnRate, bounds.TurnRate]
Accelerations: TypeAlias = tuple[bounds.Acceleration, bounds.Acceleration, bounds.Acceleration]
LinearAccelerations: TypeAlias = tuple[bounds.LinearAcceleration, bounds.LinearAcceleration, bounds.LinearAcceleration]
MagneticFields: TypeAlias = tuple[bounds.MagneticField, bounds.MagneticField, bounds.MagneticField]
Quaternion: TypeAlias = tuple[bounds.Cosine, bounds.Cosine, bounds.Cosine, bounds.Cosine]
Levels: TypeAlias = tuple[bounds.Level, bounds.Level, bounds.Level, bounds.Level]
Speeds: TypeAlias = tuple[bounds.Speed, bounds.Speed]
SpeedVariances: TypeAlias = tuple[bounds.SpeedVariance, bounds.SpeedVariance, bounds.SpeedVariance]
Positions: TypeAlias = tuple[bounds.Position, bounds.Position, bounds.Position]
Velocities: TypeAlias = tuple[bounds.Velocity, bounds.Velocity, bounds.Velocity]


class Imu(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """One reading of an inertial measurement unit, body frame."""

    schema = "caneflow.Imu/1"

    gyro: Annotated[TurnRates, Meta(description="rad/s, body")]
    accel: Annotated[Accelerations | None, Meta(description="m/s^2, specific force, body (rest: +9.81 on z)")] = None
    mag: Annotated[MagneticFields | None, Meta(description="uT, body")] = None
    orientation: Annotated[Quaternion | None, Meta(description="w x y z, body to world, the chip's own fusion")] = None
    linear_accel: Annotated[LinearAccelerations | None, Meta(description="m/s^2, body, gravity removed")] = None
    calibration: Annotated[Levels | None, Meta(description="BNO055 levels sys, gyro, accel, mag")] = None

    def __post_init__(self) -> None:
        require_vector("gyro", self.gyro, bounds.TURN_RATE, "rad/s")
        if self.accel is not None:
            require_vector("accel", self.accel, bounds.ACCELERATION, "m/s^2")
        if self.mag is not None:
            require_vector("mag", self.mag, bounds.MAGNETIC_FIELD, "uT")
        if self.linear_accel is not None:
            require_vector("linear_accel", self.linear_accel, bounds.LINEAR_ACCELERATION, "m/s^2")
        if self.orientation is not None:
            require_unit("orientation", self.orientation)
        if self.calibration is not None and not (min(self.calibration) >= 0 and max(self.calibration) <= 3):
            raise ValueError(f"calibration is {self.calibration}; levels are 0..3")


class GroundSpeed(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Speed over ground of the radar."""

    schema = "caneflow.GroundSpeed/1"

    speed: Annotated[bounds.Speed, Meta(description="m/s (paper eq. 3); 0 when not valid")]
    quality: Annotated[
        bounds.Spread,
        Meta(description="m/s (paper eq. 4), spread over the rays, smaller is better; at most 1000, or +inf: none"),
    ]
    rays: Annotated[bounds.Rays, Meta(description="K used")]
    valid: Annotated[bool, Meta(description="false when too few rays agree")]
    delay: Annotated[bounds.Delay | None, Meta(description="s by which speed lags the stamp")] = None
    velocity: Annotated[
        Speeds | None, Meta(description="m/s horizontal: along the boresight's projection, to its left")
    ] = None
    velocity_cov: Annotated[
        SpeedVariances | None, Meta(description="xx, xy, yy of velocity, m^2/s^2; 1e6: not observed")
    ] = None
    velocity_delay: Annotated[bounds.Delay | None, Meta(description="s by which velocity lags the stamp")] = None
    vertical: Annotated[bounds.Speed | None, Meta(description="m/s, upward speed of the radar; lags as velocity")] = (
        None
    )
    vertical_sd: Annotated[bounds.Deviation | None, Meta(description="m/s, its standard deviation")] = None
    spread: Annotated[
        bounds.Deviation | None, Meta(description="m/s, the speed to the side that would widen the Doppler as much")
    ] = None
    spread_delay: Annotated[bounds.Delay | None, Meta(description="s by which spread lags the stamp")] = None

    def __post_init__(self) -> None:
        require_within("speed", self.speed, -bounds.SPEED, bounds.SPEED, "m/s")
        if not (0 <= self.quality <= bounds.SPREAD or self.quality == math.inf):  # also refuses NaN
            raise ValueError(f"quality is {self.quality}; it is 0 to {bounds.SPREAD:g} m/s, or +inf")
        require_within("rays", self.rays, 0, bounds.RAYS)
        if self.delay is not None:
            require_within("delay", self.delay, 0.0, bounds.DELAY, "s")
        if self.velocity is not None:
            require_pair("velocity", self.velocity, bounds.SPEED, "m/s")
        if self.velocity_cov is not None:
            require_covariance("velocity_cov", self.velocity_cov)
        if self.velocity_delay is not None:
            require_within("velocity_delay", self.velocity_delay, 0.0, bounds.DELAY, "s")
        if self.vertical is not None:
            require_within("vertical", self.vertical, -bounds.SPEED, bounds.SPEED, "m/s")
        if self.vertical_sd is not None:
            require_within("vertical_sd", self.vertical_sd, 0.0, bounds.SPREAD, "m/s")
        if self.spread is not None:
            require_within("spread", self.spread, 0.0, bounds.SPREAD, "m/s")
        if self.spread_delay is not None:
            require_within("spread_delay", self.spread_delay, 0.0, bounds.DELAY, "s")


class Pose(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Where the IMU's origin (room: the person on the floor) is, in R0."""

    schema = "caneflow.Pose/1"

    position: Annotated[Positions, Meta(description="m, R0")]
    velocity: Annotated[Velocities, Meta(description="m/s, R0")]
    orientation: Annotated[Quaternion, Meta(description="w x y z, body to world")]
    method: Annotated[str, Meta(description="the estimator's name")]
    covariance: Annotated[
        Array | None, Meta(description="(6, 6) float64 of position and velocity, elements within 1e16")
    ] = None
    status: Annotated[
        str | None,
        Meta(
            description="on what the estimate rests, in words: static_or_lost, without:south ...; absent: all is well"
        ),
    ] = None

    def __post_init__(self) -> None:
        require_vector("position", self.position, bounds.POSITION, "m")
        require_vector("velocity", self.velocity, bounds.VELOCITY, "m/s")
        require_unit("orientation", self.orientation)
        if self.covariance is not None:
            require_array("covariance", self.covariance, "fd", dimensions=2, most=bounds.COVARIANCE)
            if self.covariance.shape != (6, 6):
                raise ValueError(f"covariance has shape {self.covariance.shape}, not (6, 6)")
            variances = self.covariance.diagonal().tolist()
            if min(variances) < 0:
                raise ValueError(f"covariance has the diagonal {variances}; variances are 0 or more")
