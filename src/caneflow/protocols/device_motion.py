"""DeviceMotion and DeviceOrientation of a browser as Imu samples. No I/O here.

W3C Device Orientation and Motion: x to the right of the screen, y up along it, z out of it: right-handed, and at rest
on a table accelerationIncludingGravity is +9.81 on z, as ours. Rates: deg/s about x (beta), y (gamma) and z (alpha).
Orientation: intrinsic turns about z by alpha, x by beta, y by gamma, from the earth (x east, y north, z up).
"""

import math
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

Milliseconds: TypeAlias = Annotated[float, Meta(ge=-1e14, le=1e14)]
Three: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]  # w x y z


class Reading(msgspec.Struct, frozen=True, kw_only=True):
    """One event of the page."""

    t: Milliseconds  # of the phone's clock
    rate: Three  # deg/s about x, y, z
    accel: Three | None = None  # m/s^2, gravity included
    linear: Three | None = None  # m/s^2, without
    angles: Three | None = None  # deg: alpha, beta, gamma


class Batch(msgspec.Struct, frozen=True, kw_only=True):
    """What the page sends at once."""

    readings: Annotated[list[Reading], Meta(max_length=500)]
    offset: Milliseconds  # of this machine's clock less the phone's, by the shortest of the last round trips
    delay: Annotated[float, Meta(ge=0, le=1e7)] = 0.0  # ms of that round trip: the offset is right to half of it
    lost: Annotated[int, Meta(ge=0)] = 0  # readings that the page had to throw away so far


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """A reading in SI units, on this machine's clock."""

    stamp: int  # ns
    gyro: Three  # rad/s
    accel: Three | None  # m/s^2, specific force
    linear_accel: Three | None  # m/s^2
    orientation: Quaternion | None  # body to world, x east and z up where the browser knows the north


def motion_of(reading: Reading, offset: float) -> Motion:
    """The reading in our units; `offset`: ms that this machine's clock is ahead of the phone's."""
    x, y, z = (math.radians(rate) for rate in reading.rate)
    return Motion(
        stamp=round((reading.t + offset) * 1e6),
        gyro=(x, y, z),
        accel=reading.accel,
        linear_accel=reading.linear,
        orientation=None if reading.angles is None else orientation_of(*reading.angles),
    )


def orientation_of(alpha: float, beta: float, gamma: float) -> Quaternion:
    """Body to world of the angles (deg) of a DeviceOrientation event; W3C Device Orientation Event, worked example."""
    z, x, y = (math.radians(angle) / 2 for angle in (alpha, beta, gamma))
    cx, cy, cz, sx, sy, sz = math.cos(x), math.cos(y), math.cos(z), math.sin(x), math.sin(y), math.sin(z)
    return (
        cx * cy * cz - sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz + sx * sy * cz,
    )
