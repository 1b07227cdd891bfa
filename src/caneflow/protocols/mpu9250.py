"""Registers of the TDK InvenSense MPU-9250: blocks of bytes in, quantities in SI units out, and back.

Two dies in one case: gyro and accelerometer (addresses and scales: register map RM-MPU-9250A-00, RM, and product
specification PS-MPU-9250A-01, PS), and Asahi Kasei's AK8963 magnetometer (AK, its own data sheet), whose axes lie
otherwise (PS 9.1). The first reads the second by itself and keeps what it said beside its own values, so that one
burst has all. What to write in which order is in mpu9250_chip.
"""

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from caneflow.physics import GRAVITY
from caneflow.protocols.errors import ProtocolError

Vector: TypeAlias = tuple[float, float, float]

MAGNETOMETER_ADDRESS = 0x0C
WITH_MAGNETOMETER = {0x71: "MPU-9250", 0x73: "MPU-9255"}  # by WHO_AM_I
WITHOUT_MAGNETOMETER = {0x70: "MPU-6500"}  # often sold as an MPU-9250
MAGNETOMETER_ID = 0x48


class Register(IntEnum):
    """Addresses of the gyro's and accelerometer's die (RM 3)."""

    RATE_DIVIDER = 0x19  # the first of the five that say how it measures
    CONFIG = 0x1A  # gyro's filter
    GYRO_CONFIG = 0x1B
    ACCEL_CONFIG = 0x1C
    ACCEL_CONFIG_2 = 0x1D  # accelerometer's filter
    MASTER_CONTROL = 0x24
    SLAVE_ADDRESS = 0x25
    SLAVE_REGISTER = 0x26
    SLAVE_CONTROL = 0x27
    PIN_CONFIG = 0x37  # the first of the burst
    INTERRUPT_ENABLE = 0x38
    ACCEL = 0x3B
    EXTERNAL = 0x49  # what the magnetometer said
    USER_CONTROL = 0x6A
    POWER = 0x6B
    WHO_AM_I = 0x75


class MagRegister(IntEnum):
    """Addresses of the AK8963 (AK 8.2)."""

    ID = 0x00
    STATUS_1 = 0x02
    FIELD = 0x03
    STATUS_2 = 0x09
    CONTROL_1 = 0x0A
    CONTROL_2 = 0x0B
    ADJUSTMENT = 0x10  # 3 bytes, readable in FUSE_ROM only


POWER_RESET = 0x80
POWER_BEST_CLOCK = 0x01  # the gyro's, when it is ready
PIN_BYPASS = 0x02  # the magnetometer is on the host's bus
INTERRUPT_DATA_READY = 0x01  # no wire is needed; it tells a chip that was set up from one that was reset
MASTER_400_KHZ = 0x4D  # and data are ready when the magnetometer's are
USER_MASTER = 0x20
SLAVE_READ = 0x80
SLAVE_ENABLED = 0x80
MAG_POWER_DOWN, MAG_FUSE_ROM, MAG_100_HZ_16_BITS = 0x00, 0x0F, 0x16
MAG_RESET = 0x01
MAG_OVERFLOW, MAG_16_BITS = 0x08, 0x10  # of STATUS_2

# Seconds that the chip takes (PS 3: start-up of registers, gyro; AK 7.3: between modes).
RESET = 0.1
GYRO_START = 0.035
MAG_CHANGE = 0.001

INTERNAL_RATE = 1000.0  # Hz, with the filters used here
GYRO_RANGES = {250: 0, 500: 1, 1000: 2, 2000: 3}  # deg/s
ACCEL_RANGES = {2: 0, 4: 1, 8: 2, 16: 3}  # g
# Bandwidth (Hz) of the filter -> its setting, and the delay of the gyro, s (RM 4.4). The accelerometer's are alike.
FILTERS = {184: (1, 2.9e-3), 92: (2, 3.9e-3), 41: (3, 5.9e-3), 20: (4, 9.9e-3), 10: (5, 17.85e-3), 5: (6, 33.48e-3)}
MAG_STEP = 0.15  # uT, 16 bits (AK 5.3.4)
TEMPERATURE_STEP, TEMPERATURE_ZERO = 1.0 / 333.87, 21.0  # degC, and at 0 (PS 3.4.2)

# From PIN_CONFIG on: pin, interrupt, DMP status, status; acceleration, temperature, gyro. Behind it, the
# magnetometer: STATUS_1, field, STATUS_2, in its own order of bytes.
_INERTIAL = struct.Struct(">4B3hh3h")
_FIELD = struct.Struct("<B3hB")
_ADJUSTMENT = struct.Struct("3B")
BURST = _INERTIAL.size + _FIELD.size  # bytes
VALUES = slice(4, _INERTIAL.size)  # of a burst: what noise alone changes from sample to sample
SET_UP = bytes([0, INTERRUPT_DATA_READY])  # how a burst of a chip begins that was set up


@dataclass(frozen=True, kw_only=True)
class Scales:
    """What one count is."""

    gyro: float  # rad/s
    accel: float  # m/s^2
    mag: Vector  # uT along the magnetometer's own axes, as it was adjusted in the factory

    @classmethod
    def of(cls, gyro_range: int, accel_range: int, adjustment: bytes) -> "Scales":
        """Scales for ranges in deg/s and g and the magnetometer's 3 bytes of adjustment (AK 8.3.11)."""
        if len(adjustment) != _ADJUSTMENT.size:
            raise ProtocolError(f"{len(adjustment)} bytes of adjustment; the magnetometer has 3")
        x, y, z = (MAG_STEP * (1.0 + (byte - 128) / 256.0) for byte in adjustment)
        return cls(
            gyro=math.radians(gyro_range) / 2**15,  # 131.07 LSB for 1 deg/s at 250, 131 in the data sheet
            accel=accel_range * GRAVITY / 2**15,
            mag=(x, y, z),
        )


class Measurement(NamedTuple):
    """What a burst says, in the axes of gyro and accelerometer."""

    gyro: Vector  # rad/s
    accel: Vector  # m/s^2
    temperature: float  # degC
    mag: Vector | None  # uT; None when it overflowed or has not begun
    was_reset: bool  # the chip does not work as it was set up
    magnetometer_works: bool
    saturated: str = (
        ""  # which of gyro and accel is at the end of its range on some axis, so that it is more; else empty
    )


def measurement(data: bytes, scales: Scales) -> Measurement:
    """What `data`, a burst from PIN_CONFIG on, says; raises ProtocolError when it is not as long as one."""
    if len(data) != BURST:
        raise ProtocolError(f"a burst of {len(data)} bytes; it has {BURST}")
    values = _INERTIAL.unpack_from(data)
    _, x, y, z, status = _FIELD.unpack_from(data, _INERTIAL.size)
    works = bool(status & MAG_16_BITS)
    field = (x * scales.mag[0], y * scales.mag[1], z * scales.mag[2])
    return Measurement(
        gyro=_scaled(values[8:11], scales.gyro),
        accel=_scaled(values[4:7], scales.accel),
        temperature=values[7] * TEMPERATURE_STEP + TEMPERATURE_ZERO,
        mag=aligned(field) if works and not status & MAG_OVERFLOW else None,
        was_reset=data[: len(SET_UP)] != SET_UP,
        magnetometer_works=works,
        saturated=" and ".join(name for name, at in (("gyro", 8), ("accel", 4)) if not _within(values[at : at + 3])),
    )


def aligned(field: Vector) -> Vector:
    """`field` along the magnetometer's axes, along those of gyro and accelerometer; the same turns it back (PS 9.1)."""
    x, y, z = field
    return y, x, -z


def burst(said: Measurement, scales: Scales) -> bytes:
    """The burst of a chip that measures `said`: the inverse of `measurement`."""
    head = bytes(4) if said.was_reset else SET_UP + bytes([0, 1])
    inertial = _INERTIAL.pack(
        *head,
        *_counts(said.accel, (scales.accel,) * 3),
        *_counts((said.temperature - TEMPERATURE_ZERO,), (TEMPERATURE_STEP,)),
        *_counts(said.gyro, (scales.gyro,) * 3),
    )
    if not said.magnetometer_works:
        return inertial + bytes(_FIELD.size)
    field = aligned(said.mag) if said.mag is not None else (0.0, 0.0, 0.0)
    status = MAG_16_BITS | (MAG_OVERFLOW if said.mag is None else 0)
    return inertial + _FIELD.pack(1, *_counts(field, scales.mag), status)


def _within(counts: tuple[int, ...]) -> bool:
    """Whether none is the first or the last that 16 bits hold."""
    return min(counts) > -(2**15) and max(counts) < 2**15 - 1


def _scaled(counts: tuple[int, int, int], step: float) -> Vector:
    x, y, z = counts
    return x * step, y * step, z * step


def _counts(values: tuple[float, ...], steps: tuple[float, ...]) -> list[int]:
    """The nearest counts that 16 bits hold."""
    return [min(max(round(v / step), -(2**15)), 2**15 - 1) for v, step in zip(values, steps, strict=True)]
