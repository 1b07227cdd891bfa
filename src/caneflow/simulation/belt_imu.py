"""An MPU9250 class IMU on a belt: raw rates, specific force and field of a walking person at 100 Hz.

Data sheet: InvenSense PS-MPU-9250A-01. Body frame: x ahead, y to the left, z up, as the belt holds it. The belt sits
on the pelvis, so it has the pelvis's rotations in every stride; it is put on by hand, so it is not quite straight.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator

from caneflow.physics import LOCAL_GRAVITY
from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.imu import SAMPLE_RATE, ImuSettings, magnetic_field
from caneflow.simulation.room_course import RATE
from caneflow.simulation.room_walk import Gait

NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, kw_only=True)
class BeltImuSettings:
    """Errors of the chip, of how it is worn, and of the field in the room."""

    gyro_noise: NotNegative = 0.01 * DEGREE  # rad/s/sqrt(Hz) (data sheet table 1)
    # What a factory calibration leaves of the +-5 deg/s of the data sheet (chosen), and what changes at each start
    gyro_bias: NotNegative = 0.5 * DEGREE  # rad/s, sd per axis
    gyro_start: NotNegative = 0.1 * DEGREE  # rad/s, sd per axis and recording (chosen)
    gyro_scale: NotNegative = 0.01  # sd per axis (data sheet: +-3 %)
    accel_noise: NotNegative = 300e-6 * LOCAL_GRAVITY  # m/s^2/sqrt(Hz) (data sheet table 2)
    accel_bias: NotNegative = 0.15  # m/s^2, sd per axis (data sheet: +-60 mg, +-80 mg for z)
    mag_noise: NotNegative = 0.5  # uT, sd per axis (chosen: what an AK8963 shows at 100 Hz)
    hard_iron: NotNegative = 2.0  # uT, sd per axis: what a calibration before use leaves, plus a buckle (chosen)
    belt_turn: NotNegative = 4.0 * DEGREE  # rad, sd of the belt about the vertical (see room_walk.py, trunk_wander)
    belt_tilt: NotNegative = 3.0 * DEGREE  # rad, sd about each horizontal axis (chosen)
    north: float = 0.5 * np.pi  # rad from x0, of magnetic north: along y0 (room.md, row 3: an offset is a setting)
    # rad, sd of the field's direction: with it such a device is right within the "about 3-5 deg" of the paper's
    field_error: NotNegative = 6.0 * DEGREE
    field_scale: Annotated[float, Gt(0)] = 2.0  # m over which it errs (as cane.md)


class Belt(NamedTuple):
    """One chip on one belt."""

    turned: Floats  # (4,) the chip's axes in those of the pelvis, a quaternion
    gyro_bias: Floats  # (3,) rad/s
    gyro_scale: Floats  # (3,)
    accel_bias: Floats  # (3,) m/s^2
    hard_iron: Floats  # (3,) uT


class BeltSamples(NamedTuple):
    """Raw readings, m samples at 100 Hz, body frame, on the chip's grid of values."""

    gyro: Floats  # (m, 3) rad/s
    accel: Floats  # (m, 3) m/s^2
    mag: Floats  # (m, 3) uT


GYRO_STEP = DEGREE / 65.5  # rad/s, range of 500 deg/s (data sheet table 1)
ACCEL_STEP = LOCAL_GRAVITY / 8192.0  # m/s^2, range of 4 g (data sheet table 2)
MAG_STEP = 0.15  # uT, AK8963 with 16 bit (data sheet)
_GYRO_RANGE, _ACCEL_RANGE = 500.0 * DEGREE, 4.0 * LOCAL_GRAVITY
_EVERY = RATE // SAMPLE_RATE


def belt(settings: BeltImuSettings, rng: Generator) -> Belt:
    """A belt as someone puts it on."""
    angles = rng.normal(0.0, 1.0, 3) * [settings.belt_tilt, settings.belt_tilt, settings.belt_turn]
    return Belt(
        turned=attitude.from_rotation_vector(angles[None])[0],
        gyro_bias=rng.normal(0.0, 1.0, 3) * settings.gyro_bias,
        gyro_scale=1.0 + rng.normal(0.0, 1.0, 3) * settings.gyro_scale,
        accel_bias=rng.normal(0.0, 1.0, 3) * settings.accel_bias,
        hard_iron=rng.normal(0.0, 1.0, 3) * settings.hard_iron,
    )


def measure(walk: Gait, worn: Belt, settings: BeltImuSettings, rng: Generator, field_rng: Generator) -> BeltSamples:
    """Readings at every second sample of a walk; `field_rng` makes the room's field, and only that."""
    gyro_rng, accel_rng, mag_rng = rng.spawn(3)
    orientation = attitude.multiply(pelvis_orientation(walk), worn.turned[None])
    # central differences over one sample of motion to each side; the ends stand still
    turned = attitude.multiply(attitude.conjugate(orientation[:-2]), orientation[2:])
    rate = np.zeros_like(walk.centre)
    rate[1:-1] = 0.5 * RATE * attitude.to_rotation_vector(turned)
    acceleration = np.zeros_like(walk.centre)
    acceleration[1:-1] = RATE**2 * np.diff(walk.centre, 2, axis=0)
    to_body = attitude.conjugate(orientation)
    force = attitude.rotate(to_body, acceleration + np.array([0.0, 0.0, LOCAL_GRAVITY]))
    field = attitude.rotate(to_body[::_EVERY], room_field(walk.centre[::_EVERY], settings, field_rng))

    rate, force = rate[::_EVERY], force[::_EVERY]
    count, root_band = len(rate), np.sqrt(0.5 * SAMPLE_RATE)
    bias = worn.gyro_bias + gyro_rng.normal(0.0, 1.0, 3) * settings.gyro_start
    gyro = rate * worn.gyro_scale + bias + gyro_rng.normal(0.0, 1.0, (count, 3)) * settings.gyro_noise * root_band
    accel = force + worn.accel_bias + accel_rng.normal(0.0, 1.0, (count, 3)) * settings.accel_noise * root_band
    mag = field + worn.hard_iron + mag_rng.normal(0.0, 1.0, (count, 3)) * settings.mag_noise
    return BeltSamples(
        gyro=_stepped(np.clip(gyro, -_GYRO_RANGE, _GYRO_RANGE), GYRO_STEP),
        accel=_stepped(np.clip(accel, -_ACCEL_RANGE, _ACCEL_RANGE), ACCEL_STEP),
        mag=_stepped(mag, MAG_STEP),
    )


def pelvis_orientation(walk: Gait) -> Floats:
    """Quaternions (n, 4) of the pelvis: x ahead, y to the left, z up."""
    yaw, pitch, roll = walk.pelvis.T
    zero = np.zeros_like(yaw)
    about_z = attitude.from_rotation_vector(np.column_stack([zero, zero, yaw]))
    about_y = attitude.from_rotation_vector(np.column_stack([zero, pitch, zero]))
    about_x = attitude.from_rotation_vector(np.column_stack([roll, zero, zero]))
    return attitude.multiply(attitude.multiply(about_z, about_y), about_x)


def room_field(position: Floats, settings: BeltImuSettings, rng: Generator) -> Floats:
    """Field (n, 3), uT, in the room's frame at `position` (n, 3), m: that of the cane's world, turned to `north`."""
    turn = settings.north - 0.5 * np.pi
    field = ImuSettings(field_error=settings.field_error, field_scale=settings.field_scale)
    return _about_z(magnetic_field(_about_z(position, -turn), field, rng), turn)


def _about_z(vector: Floats, angle: float) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vector.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])


def _stepped(value: Floats, step: float) -> Floats:
    return np.asarray(np.rint(value / step) * step, dtype=np.float64)
