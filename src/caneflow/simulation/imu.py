"""A BNO055 class IMU in fusion mode: what the chip reports of a motion at 100 Hz, with its errors and its steps.

Data sheet: Bosch BST-BNO055-DS000-14. The rows marked cane.md are what is left after the chip's own calibration.
"""

from dataclasses import dataclass
from itertools import accumulate
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from caneflow.physics import LOCAL_GRAVITY
from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.smooth_noise import slow
from caneflow.simulation.walk import RATE, Motion

NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, kw_only=True)
class ImuSettings:
    """Errors of the chip and of the field around it."""

    gyro_noise: NotNegative = 0.014 * DEGREE  # rad/s/sqrt(Hz) (cane.md; data sheet table 0-2)
    gyro_bias: NotNegative = 0.05 * DEGREE  # rad/s, sd per axis (cane.md)
    gyro_scale: NotNegative = 0.007  # sd per axis (cane.md)
    accel_noise: NotNegative = 190e-6 * LOCAL_GRAVITY  # m/s^2/sqrt(Hz) (cane.md; data sheet table 0-2)
    accel_bias: NotNegative = 0.07  # m/s^2, sd per axis (cane.md)
    mag_noise: NotNegative = 0.3  # uT, sd per axis: the data sheet's resolution of the magnetometer
    tilt_error: NotNegative = 0.26 * DEGREE  # rad, sd about each horizontal axis (cane.md)
    tilt_time: Annotated[float, Gt(0)] = 8.0  # s (cane.md)
    heading_time: Annotated[float, Gt(0)] = 5.0  # s in which the heading is pulled to the field (cane.md)
    field_error: NotNegative = 10.0 * DEGREE  # rad, sd of the field's direction indoors (cane.md)
    field_scale: Annotated[float, Gt(0)] = 2.0  # m over which it errs (cane.md)
    # A field that changes in time, as by lifts, doors, trains and what is carried: chosen, nobody has measured it
    field_turn: NotNegative = 0.0  # rad by which it turns once, either way, at a time within FIELD_TURNS
    field_wander: NotNegative = 0.0  # rad, sd of its direction
    wander_time: Annotated[float, Gt(0)] = 40.0  # s over which that wanders


class ImuSamples(NamedTuple):
    """What the chip's registers hold, n samples, body frame, on the chip's grid of values."""

    gyro: Floats  # (n, 3) rad/s
    accel: Floats  # (n, 3) m/s^2
    mag: Floats  # (n, 3) uT
    orientation: Floats  # (n, 4), unit within the chip's rounding
    linear_accel: Floats  # (n, 3) m/s^2
    calibration: NDArray[np.int64]  # (n, 4) sys, gyro, accel, mag, 0..3


SAMPLE_RATE = 100  # Hz of the fusion's outputs (data sheet table 3-14)
_EVERY = RATE // SAMPLE_RATE

GYRO_STEP = DEGREE / 16.0  # rad/s, default units (data sheet table 3-22)
ACCEL_STEP = 0.01  # m/s^2 (data sheet p. 30)
MAG_STEP = 1.0 / 16.0  # uT (data sheet p. 30)
QUATERNION_STEP = 2.0**-14  # (data sheet p. 36)
_ACCEL_RANGE = 4.0 * LOCAL_GRAVITY  # m/s^2, fusion modes (data sheet table 3-4)
_GYRO_BAND, _ACCEL_BAND = 32.0, 62.5  # Hz, -3 dB, fusion modes (data sheet table 3-4)
_MAG_EVERY = 5  # samples: 20 Hz in NDOF (data sheet table 3-14)

# Grenoble, where the paper's walks were made: 22.5 uT to the north (here +y0), 41.5 uT down (IGRF, rounded)
EARTH_FIELD = np.array([0.0, 22.5, -41.5])  # uT
_WAVES = 64  # of which the anomaly is made


def measure(motion: Motion, settings: ImuSettings, rng: Generator) -> ImuSamples:
    """The chip's outputs at every tenth sample of a motion at 1 kHz.

    The sensors' low-pass filters are symmetric, so that a sample's stamp is the middle of what it measures. The
    samples of a shorter motion are the beginning of those of the longer one, but for the filters' last 10 ms.
    """
    gyro_rng, accel_rng, mag_rng, field_rng, fusion_rng, time_rng = rng.spawn(6)
    orientation, position = motion.orientation[::_EVERY], motion.position[::_EVERY]
    count = len(orientation)
    rate = _low_passed(motion.rate, _GYRO_BAND)[::_EVERY]
    gyro = _gyro(rate, settings, gyro_rng)
    force = attitude.rotate(
        attitude.conjugate(motion.orientation), motion.acceleration + np.array([0.0, 0.0, LOCAL_GRAVITY])
    )
    accel = _accel(_low_passed(force, _ACCEL_BAND)[::_EVERY], settings, accel_rng)
    field = _changed(magnetic_field(position, settings, field_rng), motion.time[::_EVERY], settings, time_rng)
    to_body = attitude.conjugate(orientation)
    mag = attitude.rotate(to_body, field) + mag_rng.normal(0.0, 1.0, (count, 3)) * settings.mag_noise
    mag = mag[np.arange(count) // _MAG_EVERY * _MAG_EVERY]

    turning_error = attitude.rotate(orientation, gyro - rate)[:, 2]
    chip = _fusion(orientation, field, turning_error, settings, fusion_rng)
    gravity = attitude.rotate(attitude.conjugate(chip), np.array([0.0, 0.0, LOCAL_GRAVITY]))
    return ImuSamples(
        gyro=_stepped(gyro, GYRO_STEP),
        accel=_stepped(np.clip(accel, -_ACCEL_RANGE, _ACCEL_RANGE), ACCEL_STEP),
        mag=_stepped(mag, MAG_STEP),
        orientation=_stepped(chip, QUATERNION_STEP),
        linear_accel=_stepped(accel - gravity, ACCEL_STEP),
        calibration=_calibration(field),
    )


def magnetic_field(position: Floats, settings: ImuSettings, rng: Generator) -> Floats:
    """Field (n, 3), uT, in R0 at `position` (n, 3), m: the Earth's and what steel below the floor adds.

    The anomaly is a sum of waves of a potential that fades upwards, so it has neither curl nor divergence, as a
    field outside its sources must. Its horizontal part has a correlation length of `field_scale`, and turns the
    direction of the whole by `field_error`.
    """
    waves = rng.normal(0.0, 1.0 / settings.field_scale, (_WAVES, 2))  # rad/m
    phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    number = np.linalg.norm(waves, axis=1)
    # amplitude per wave: half of the horizontal variance goes to each axis, half of that is the mean of sin^2
    size = np.tan(settings.field_error) * EARTH_FIELD[1] * 2.0 / np.sqrt(_WAVES)
    angle = position[:, :2] @ waves.T + phases
    fading = size * np.exp(-number * (position[:, 2:] - _FIELD_HEIGHT))
    horizontal = (fading * np.sin(angle)) @ (waves / number[:, None])
    vertical = np.sum(fading * np.cos(angle), axis=1, keepdims=True)
    return np.asarray(EARTH_FIELD + np.hstack([horizontal, vertical]), dtype=np.float64)


def _changed(field: Floats, time: Floats, settings: ImuSettings, rng: Generator) -> Floats:
    """The field (n, 3), uT, turned about the vertical by what changes in `time`, (n,) s."""
    if not (settings.field_turn or settings.field_wander):
        return field
    begins, side = rng.uniform(*FIELD_TURNS), 1.0 if rng.random() < 0.5 else -1.0
    turned = side * settings.field_turn * np.clip((time - begins) / FIELD_TURN_TIME, 0.0, 1.0)
    turned = turned + slow(rng, settings.field_wander, settings.wander_time)(time)
    about = np.column_stack([np.zeros((len(time), 2)), turned])
    return attitude.rotate(attitude.from_rotation_vector(about), field)


FIELD_TURNS = (10.0, 40.0)  # s after the beginning
FIELD_TURN_TIME = 1.0  # s
_FIELD_HEIGHT = 0.75  # m at which the anomaly has the strength that is asked for: the sensors' height


def _gyro(rate: Floats, settings: ImuSettings, rng: Generator) -> Floats:
    """Angular rate as measured, before rounding."""
    bias = rng.normal(0.0, 1.0, 3) * settings.gyro_bias
    scale = 1.0 + rng.normal(0.0, 1.0, 3) * settings.gyro_scale
    return rate * scale + bias + _white(len(rate), settings.gyro_noise, rng)


def _accel(force: Floats, settings: ImuSettings, rng: Generator) -> Floats:
    """Specific force as measured, before rounding."""
    bias = rng.normal(0.0, 1.0, 3) * settings.accel_bias
    return force + bias + _white(len(force), settings.accel_noise, rng)


def _fusion(orientation: Floats, field: Floats, turning_error: Floats, settings: ImuSettings, rng: Generator) -> Floats:
    """Orientation as the chip's fusion has it, before rounding, (n, 4).

    Heading: the gyro's turning, error and all, pulled towards the compass. The field's direction is taken for
    north, so a field turned to the left makes a heading that errs to the right. The chip has been on for long.
    """
    compass_error = np.arctan2(field[:, 0], field[:, 1])
    kept = np.exp(-1.0 / SAMPLE_RATE / settings.heading_time)
    pushed = (1.0 - kept) * compass_error + turning_error / SAMPLE_RATE
    heading_error = _leaky_sum(pushed, kept, compass_error[0])

    kept = np.exp(-1.0 / SAMPLE_RATE / settings.tilt_time)
    pushes = settings.tilt_error * rng.normal(0.0, 1.0, (len(orientation) + 1, 2))
    steps = pushes[1:] * np.sqrt(1.0 - kept**2)
    tilt_errors = [_leaky_sum(steps[:, axis], kept, pushes[0, axis]) for axis in (0, 1)]
    error = np.column_stack([*tilt_errors, heading_error])
    # small angles about the world's axes: their order changes them by less than 0.05 deg
    return attitude.multiply(attitude.from_rotation_vector(error), orientation)


def _leaky_sum(steps: Floats, kept: float, begin: float) -> Floats:
    """x[k] = kept x[k-1] + steps[k], from x[-1] = begin; (n,), as scipy.signal, which takes a second to import."""
    sums = accumulate(steps.tolist(), lambda before, step: kept * before + step, initial=float(begin))
    return np.array(list(sums)[1:])


def _calibration(field: Floats) -> NDArray[np.int64]:
    """Levels 0..3. Bosch does not say how; here the magnetometer's falls where the field's strength is unusual."""
    strength = np.linalg.norm(field, axis=1) / np.linalg.norm(EARTH_FIELD)
    mag = 3 - np.searchsorted([0.1, 0.2, 0.4], np.abs(strength - 1.0))
    full = np.full_like(mag, 3)
    return np.column_stack([mag, full, full, mag])


def _white(count: int, density: float, rng: Generator) -> Floats:
    """Noise (count, 3) of a one-sided spectral `density`, unit per sqrt(Hz), up to half of the sample rate."""
    noise: Floats = rng.normal(0.0, 1.0, (count, 3)) * density * np.sqrt(0.5 * SAMPLE_RATE)
    return noise


def _low_passed(signal: Floats, band: float) -> Floats:
    """A signal at RATE through a Gaussian filter that is down by 3 dB at `band`, Hz."""
    spread = np.sqrt(np.log(2.0)) / (2.0 * np.pi * band) * RATE  # samples
    return np.asarray(gaussian_filter1d(signal, spread, axis=0, mode="nearest"), dtype=np.float64)


def _stepped(value: Floats, step: float) -> Floats:
    """The nearest value on the chip's grid."""
    return np.asarray(np.rint(value / step) * step, dtype=np.float64)
