"""Every sample that crosses a process, as docs/messages.md fixes it: SI units, radians, stamps in ns.

A sample checks itself when it is made, so a bad one is refused on the way in and on the way out alike.
"""

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta

from caneflow.messages.arrays import Array

Vector2: TypeAlias = tuple[float, float]
Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]
Count: TypeAlias = Annotated[int, Meta(ge=0)]
Stamp: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 2)]  # one more says that a stream has ended

UNNUMBERED = -1  # a sample that no host has published yet
UNIT_TOLERANCE = 1e-3  # how far a quaternion's norm may be from 1


class Sample(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """What every sample has."""

    schema: ClassVar[str] = ""  # e.g. "caneflow.Imu/1", in the Zenoh encoding and in recordings

    stamp: Annotated[
        Stamp, Meta(description="ns, Unix epoch: when the sensor measured; strictly increasing per stream")
    ]
    seq: Annotated[int, Meta(description="0, 1, 2 ... per stream and run; a gap is a loss")] = UNNUMBERED


class Imu(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """One reading of an inertial measurement unit, body frame."""

    schema = "caneflow.Imu/1"

    gyro: Annotated[Vector3, Meta(description="rad/s, body")]
    accel: Annotated[Vector3 | None, Meta(description="m/s^2, specific force, body (rest: +9.81 on z)")] = None
    mag: Annotated[Vector3 | None, Meta(description="uT, body")] = None
    orientation: Annotated[Quaternion | None, Meta(description="w x y z, body to world, the chip's own fusion")] = None
    linear_accel: Annotated[Vector3 | None, Meta(description="m/s^2, body, gravity removed")] = None
    calibration: Annotated[
        tuple[Count, Count, Count, Count] | None,
        Meta(description="BNO055 levels sys, gyro, accel, mag, 0..3"),
    ] = None

    def __post_init__(self) -> None:
        require_finite("gyro", self.gyro)
        if self.accel is not None:
            require_finite("accel", self.accel)
        if self.mag is not None:
            require_finite("mag", self.mag)
        if self.linear_accel is not None:
            require_finite("linear_accel", self.linear_accel)
        if self.orientation is not None:
            require_unit("orientation", self.orientation)
        if self.calibration is not None and max(self.calibration) > 3:
            raise ValueError(f"calibration is {self.calibration}; levels are 0..3")


class RadarFrame(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Scans of a pulse-Doppler radar: slow time x range."""

    schema = "caneflow.RadarFrame/1"

    scans: Annotated[
        Array,
        Meta(description="(N, M) int16, int32, float32 or complex64: N scans, oldest first, of M range bins"),
    ]
    scan_period: Annotated[Positive, Meta(description="s between scans")]
    range_start: Annotated[float, Meta(description="m, range of bin 0, antenna delay taken off")]
    range_step: Annotated[Positive, Meta(description="m between bins")]
    carrier: Annotated[Positive, Meta(description="Hz")]
    bandwidth: Annotated[Positive, Meta(description="Hz")]

    def __post_init__(self) -> None:
        require_array("scans", self.scans, "hifF", dimensions=2)
        require_finite(
            "range_start, scan_period, range_step, carrier, bandwidth",
            (self.range_start, self.scan_period, self.range_step, self.carrier, self.bandwidth),
        )


class GroundSpeed(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Speed over ground of the radar."""

    schema = "caneflow.GroundSpeed/1"

    speed: Annotated[float, Meta(description="m/s (paper eq. 3); 0 when not valid")]
    quality: Annotated[
        float, Meta(description="m/s (paper eq. 4), spread over the rays, smaller is better; +inf: none")
    ]
    rays: Annotated[Count, Meta(description="K used")]
    valid: Annotated[bool, Meta(description="false when too few rays agree")]
    delay: Annotated[float | None, Meta(description="s by which speed lags the stamp")] = None
    velocity: Annotated[
        Vector2 | None, Meta(description="m/s horizontal: along the boresight's projection, to its left")
    ] = None
    velocity_cov: Annotated[Vector3 | None, Meta(description="xx, xy, yy of velocity, m^2/s^2; 1e6: not observed")] = (
        None
    )
    velocity_delay: Annotated[float | None, Meta(description="s by which velocity lags the stamp")] = None

    def __post_init__(self) -> None:
        require_finite("speed, delay, velocity_delay", (self.speed, self.delay or 0.0, self.velocity_delay or 0.0))
        if not self.quality >= 0:  # also refuses NaN; +inf is allowed
            raise ValueError(f"quality is {self.quality}; it is 0 or more, or +inf")
        if self.velocity is not None:
            require_finite("velocity", self.velocity)
        if self.velocity_cov is not None:
            require_finite("velocity_cov", self.velocity_cov)
            if self.velocity_cov[0] < 0 or self.velocity_cov[2] < 0:
                raise ValueError(f"velocity_cov is {self.velocity_cov}; variances are 0 or more")


class Pose(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """Where the IMU's origin (room: the person on the floor) is, in R0."""

    schema = "caneflow.Pose/1"

    position: Annotated[Vector3, Meta(description="m, R0")]
    velocity: Annotated[Vector3, Meta(description="m/s, R0")]
    orientation: Annotated[Quaternion, Meta(description="w x y z, body to world")]
    method: Annotated[str, Meta(description="the estimator's name")]
    covariance: Annotated[Array | None, Meta(description="(6, 6) float64 of position and velocity")] = None
    status: Annotated[
        str | None,
        Meta(
            description="on what the estimate rests, in words: static_or_lost, without:south ...; absent: all is well"
        ),
    ] = None

    def __post_init__(self) -> None:
        require_finite("position", self.position)
        require_finite("velocity", self.velocity)
        require_unit("orientation", self.orientation)
        if self.covariance is not None:
            require_array("covariance", self.covariance, "fd", dimensions=2)
            if self.covariance.shape != (6, 6):
                raise ValueError(f"covariance has shape {self.covariance.shape}, not (6, 6)")


class DopplerBlock(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """A block of a continuous-wave Doppler module's output; the stamp is that of its last sample."""

    schema = "caneflow.DopplerBlock/1"

    samples: Annotated[Array, Meta(description="(n,) int16, float32 or complex64 (I + jQ)")]
    sample_rate: Annotated[Positive, Meta(description="Hz")]
    carrier: Annotated[Positive, Meta(description="Hz")]

    def __post_init__(self) -> None:
        require_array("samples", self.samples, "hfF", dimensions=1)
        require_finite("sample_rate, carrier", (self.sample_rate, self.carrier))


class DopplerTarget(Sample, frozen=True, kw_only=True, omit_defaults=True, gc=False):
    """The predominant moving target that one Doppler module sees."""

    schema = "caneflow.DopplerTarget/1"

    range_rate: Annotated[float, Meta(description="m/s, positive away from the sensor; magnitude when not signed")]
    signed: Annotated[bool, Meta(description="false: one mixer, the sign is unknown")]
    amplitude: Annotated[float, Meta(ge=0, description="of the predominant line, full scale = 1 (int16: 32768)")]
    snr: Annotated[float, Meta(description="dB")]
    valid: Annotated[bool, Meta(description="false: no line above the threshold")]
    range: Annotated[float | None, Meta(description="m, from the received strength")] = None
    delay: Annotated[float | None, Meta(description="s by which the value lags its stamp")] = None

    def __post_init__(self) -> None:
        require_finite("range_rate", (self.range_rate,))
        require_finite("amplitude, snr", (self.amplitude, self.snr))
        require_finite("range, delay", (self.range or 0.0, self.delay or 0.0))


SAMPLES: dict[str, type[Sample]] = {
    kind.schema: kind for kind in (Imu, RadarFrame, GroundSpeed, Pose, DopplerBlock, DopplerTarget)
}


def require_finite(name: str, values: Sequence[float]) -> None:
    """Raise ValueError unless every value is a finite number."""
    # One that is not leaves no sum finite; a sum may be infinite without any.
    if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
        raise ValueError(f"{name} is {values}; NaN and infinity are not allowed")


def require_unit(name: str, quaternion: Quaternion) -> None:
    """Raise ValueError unless the quaternion has norm 1 within UNIT_TOLERANCE."""
    w, x, y, z = quaternion
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1) <= UNIT_TOLERANCE:  # written so that NaN is refused
        raise ValueError(f"{name} has norm {norm:.6g}; a rotation has 1")


def require_array(name: str, array: Array, letters: str, *, dimensions: int) -> None:
    """Raise ValueError unless dtype, number of dimensions and (for floats) finiteness fit."""
    if array.dtype.char not in letters:
        allowed = ", ".join(str(np.dtype(letter)) for letter in letters)
        raise ValueError(f"{name} is of dtype {array.dtype}; allowed are {allowed}")
    if array.ndim != dimensions or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; it takes {dimensions} dimensions, none of them empty")
    if array.dtype.kind in "fc" and not np.isfinite(array).all():
        raise ValueError(f"{name} has elements that are NaN or infinite")
