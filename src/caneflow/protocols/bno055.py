"""Registers of the Bosch BNO055: blocks of bytes in, quantities in SI units out, and back.

Addresses, scales and defaults: data sheet BST-BNO055-DS000-14 (DS). All registers used are on page 0. How the
bytes travel is in bno055_link, what to write in which order in bno055_chip.
"""

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Self, TypeAlias

from caneflow.physics import GRAVITY
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mounting import mounting

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Levels: TypeAlias = tuple[int, int, int, int]
Counts3: TypeAlias = tuple[int, int, int]


class Register(IntEnum):
    """Addresses on page 0 (DS 4.2.1)."""

    CHIP_ID = 0x00
    PAGE_ID = 0x07
    ACCEL = 0x08  # the first of the measurements
    GYRO = 0x14
    CALIBRATION = 0x35  # the last of the measurements
    SELF_TEST = 0x36
    CLOCK_STATUS = 0x38
    STATUS = 0x39
    ERROR = 0x3A
    UNITS = 0x3B
    MODE = 0x3D
    POWER = 0x3E
    TRIGGER = 0x3F
    AXIS_MAP = 0x41
    AXIS_SIGN = 0x42
    PROFILE = 0x55  # offsets and radii, 22 bytes; written in CONFIG mode only


class Mode(IntEnum):
    """Operation modes (DS table 3-5); the register's upper half is not defined."""

    CONFIG = 0x00
    IMU = 0x08  # fusion of accelerometer and gyro
    NDOF = 0x0C  # fusion with the magnetometer


MODE_BITS = 0x0F
CHIP_ID = 0xA0
UNITS_SI = 0x80  # the chip's default: m/s^2, deg/s, degC
POWER_NORMAL = 0x00
TRIGGER_RESET = 0x20
TRIGGER_EXTERNAL_CRYSTAL = 0x80
SELF_TEST_PASSED = 0x0F
STATUS_ERROR = 1
STATUS_NAMES = {
    0: "idle",
    1: "error",
    2: "initialising peripherals",
    3: "initialising",
    4: "self-test",
    5: "fusion runs",
    6: "runs without fusion",
}
ERROR_NAMES = {
    0: "none",
    1: "peripheral initialisation",
    2: "system initialisation",
    3: "self-test failed",
    4: "register value out of range",
    5: "register address out of range",
    6: "register write",
    7: "low power mode not available",
    8: "accelerometer power mode not available",
    9: "fusion configuration",
    10: "sensor configuration",
}

# Seconds that the chip takes (DS tables 0-1 and 3-6).
TO_CONFIG = 0.019
FROM_CONFIG = 0.007
START_UP = 0.4  # from power on
RESET = 0.65
RATE = 100.0  # Hz of all outputs in the fusion modes but the magnetometer's, 20 Hz (DS table 3-14)

ACCEL_STEP = 0.01  # m/s^2 (DS p. 30)
MAG_STEP = 1.0 / 16.0  # uT (DS p. 30)
GYRO_STEP = math.radians(1.0) / 16.0  # rad/s (DS table 3-22)
QUATERNION_STEP = 2.0**-14  # (DS p. 36)
UNIT_TOLERANCE = 1e-3  # how far an orientation's norm may be from 1: that of the wire; rounding makes 6e-5

# What the chip can measure in the fusion modes, whose ranges its firmware sets (DS 3.5), with a twentieth of margin
# for the offsets that it takes off; without gravity an axis has one g more. It works from -40 to 85 degC.
MARGIN = 1.05
MOST_ACCEL = MARGIN * 4.0 * GRAVITY  # m/s^2, 4 g
MOST_LINEAR_ACCEL = MARGIN * 5.0 * GRAVITY
MOST_GRAVITY = MARGIN * GRAVITY
MOST_GYRO = math.radians(2000.0)  # rad/s; the register ends at 2048 deg/s, so there is no room for a margin
MOST_MAG = (MARGIN * 1300.0, MARGIN * 1300.0, MARGIN * 2500.0)  # uT along x, y, z of the chip
TEMPERATURES = (-45, 90)  # degC


class Measurement(NamedTuple):
    """What the measurement registers say, body axes as remapped."""

    gyro: Vector  # rad/s
    orientation: Quaternion  # w x y z; of norm 0 until the fusion has started
    linear_accel: Vector  # m/s^2
    gravity: Vector  # m/s^2
    temperature: int  # degC
    calibration: Levels  # sys, gyro, accel, mag, 0..3
    accel: Vector | None = None  # m/s^2; None when the block begins behind it
    mag: Vector | None = None  # uT


class Block(NamedTuple):
    """A stretch of measurement registers that is read at once."""

    first: Register
    layout: struct.Struct

    @property
    def length(self) -> int:
        """Bytes."""
        return self.layout.size


WHOLE = Block(Register.ACCEL, struct.Struct("<3h3h3h3h4h3h3hbB"))  # ends with CALIBRATION, as does the other
WITHOUT_ACCEL_AND_MAG = Block(Register.GYRO, struct.Struct("<3h3h4h3h3hbB"))
VALUES_END = -2  # temperature and calibration follow, which say nothing of whether the values are new


def measurement(block: Block, data: bytes) -> Measurement:
    """What `data`, read from `block`, says; raises ProtocolError when it is not as long as the block."""
    if len(data) != block.length:
        raise ProtocolError(f"{len(data)} bytes of measurements; the block has {block.length}")
    values = block.layout.unpack(data)
    accel = mag = None
    if block.first == Register.ACCEL:
        accel, mag = _scaled(values[0:3], ACCEL_STEP), _scaled(values[3:6], MAG_STEP)
        values = values[6:]
    w, x, y, z = values[6:10]  # before them: Euler angles
    levels = values[17]
    return Measurement(
        gyro=_scaled(values[0:3], GYRO_STEP),
        orientation=(w * QUATERNION_STEP, x * QUATERNION_STEP, y * QUATERNION_STEP, z * QUATERNION_STEP),
        linear_accel=_scaled(values[10:13], ACCEL_STEP),
        gravity=_scaled(values[13:16], ACCEL_STEP),
        temperature=values[16],
        calibration=(levels >> 6 & 3, levels >> 4 & 3, levels >> 2 & 3, levels & 3),
        accel=accel,
        mag=mag,
    )


def registers(said: Measurement) -> bytes:
    """The WHOLE block of a chip that measures `said`: the inverse of `measurement`, the Euler angles being 0."""
    sys, gyro, accel, mag = said.calibration
    return WHOLE.layout.pack(
        *_steps(said.accel or (0.0, 0.0, 0.0), ACCEL_STEP),
        *_steps(said.mag or (0.0, 0.0, 0.0), MAG_STEP),
        *_steps(said.gyro, GYRO_STEP),
        *(0, 0, 0),
        *_steps(said.orientation, QUATERNION_STEP),
        *_steps(said.linear_accel, ACCEL_STEP),
        *_steps(said.gravity, ACCEL_STEP),
        said.temperature,
        sys << 6 | gyro << 4 | accel << 2 | mag,
    )


def is_rotation(orientation: Quaternion) -> bool:
    """Whether `orientation` is one: the chip says 0 0 0 0 until its fusion has started, and after a reset."""
    w, x, y, z = orientation
    return abs(math.sqrt(w * w + x * x + y * y + z * z) - 1.0) <= UNIT_TOLERANCE


def _largest(vector: Vector) -> float:
    return max(map(abs, vector))


def _scaled(counts: Counts3, step: float) -> Vector:
    x, y, z = counts
    return x * step, y * step, z * step


def _steps(values: tuple[float, ...], step: float) -> list[int]:
    """The nearest counts that 16 bits hold."""
    return [min(max(round(value / step), -(2**15)), 2**15 - 1) for value in values]


_PROFILE = struct.Struct("<3h3h3h2h")


@dataclass(frozen=True, kw_only=True)
class CalibrationProfile:
    """What the chip has learnt of its sensors, in its own counts (DS 3.6.4); to be given back after a reset."""

    accel_offset: Counts3
    mag_offset: Counts3
    gyro_offset: Counts3
    accel_radius: int
    mag_radius: int

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The profile in the registers from PROFILE on; raises ProtocolError unless these are 22 bytes."""
        if len(data) != _PROFILE.size:
            raise ProtocolError(f"a calibration profile of {len(data)} bytes; it has {_PROFILE.size}")
        counts = _PROFILE.unpack(data)
        return cls(
            accel_offset=counts[0:3],
            mag_offset=counts[3:6],
            gyro_offset=counts[6:9],
            accel_radius=counts[9],
            mag_radius=counts[10],
        )

    def to_bytes(self) -> bytes:
        """The registers; raises ProtocolError for a count that 16 bits do not hold."""
        counts = (*self.accel_offset, *self.mag_offset, *self.gyro_offset, self.accel_radius, self.mag_radius)
        try:
            return _PROFILE.pack(*counts)
        except struct.error as error:
            raise ProtocolError(f"a calibration profile of {counts}: {error}") from error


PROFILE_BYTES = _PROFILE.size


@dataclass(frozen=True, kw_only=True)
class Axes:
    """How the chip turns its own axes into those of the body before it uses them."""

    map: int = 0x24  # AXIS_MAP
    sign: int = 0x00  # AXIS_SIGN


def impossible(said: Measurement, axes: Axes) -> str:
    """What in a measurement the chip cannot have measured, e.g. "accel beyond 4 g"; empty when it can have all.

    `axes`: as it was told to turn its own. A bit that is lost on the way to the host makes such values, and a register
    that is read while it changes.
    """
    most_mag = [MOST_MAG[axes.map >> 2 * axis & 3] for axis in range(3)]
    low, high = TEMPERATURES
    beyond = {
        "gyro beyond 2000 deg/s": _largest(said.gyro) > MOST_GYRO + 0.5 * GYRO_STEP,
        "accel beyond 4 g": said.accel is not None and _largest(said.accel) > MOST_ACCEL,
        "linear_accel beyond 5 g": _largest(said.linear_accel) > MOST_LINEAR_ACCEL,
        "gravity beyond 1 g": _largest(said.gravity) > MOST_GRAVITY,
        "mag beyond 1300 uT": said.mag is not None and any(abs(b) > m for b, m in zip(said.mag, most_mag, strict=True)),
        "temperature beyond -40..85 degC": not low <= said.temperature <= high,
    }
    return next((what for what, found in beyond.items() if found), "")


def axes(text: str) -> Axes:
    """The remap that `text` describes: which of the chip's axes are the body's x, y and z, e.g. "-y+x+z".

    Raises:
        ProtocolError: no such triple, or a left-handed one.
    """
    (x, y, z), (sx, sy, sz) = mounting(text)
    return Axes(map=z << 4 | y << 2 | x, sign=(sx < 0) << 2 | (sy < 0) << 1 | (sz < 0))
