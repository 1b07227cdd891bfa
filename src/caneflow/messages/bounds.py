"""What no sensor, person or flow can say: the bounds of every number in a message, each with its reason.

A bound is not a gate. It lies well beyond what the best sensor of its kind measures, so that no reading of a working
device breaks it, and far below where arithmetic overflows. A wild reading inside it is the estimators' business.
"""

import math
from collections.abc import Sequence
from typing import Annotated, TypeAlias

import numpy as np
from msgspec import Meta

from caneflow.messages.arrays import Array

# rad/s: the BNO055's numbers end at 36, the fastest gyros at 20 000 deg/s = 349 (ADXRS649).
# So wide a margin lets programs that try a flow out count samples in this field, as they do; a wild turn is for the
# gates.
TURN_RATE = 1e6
# m/s^2: accelerometers for impacts end at 400 g = 3923 m/s^2 (H3LIS331DL), the BNO055's numbers at 328.
ACCELERATION = 4000.0
LINEAR_ACCELERATION = ACCELERATION + 10.0  # m/s^2: the same less gravity, in any attitude
# uT: the widest compass ends at 4912 (AK8963 in the MPU9250); the earth's field has 25 to 65.
MAGNETIC_FIELD = 1e4
UNIT_TOLERANCE = 1e-3  # how far a quaternion's norm may be from 1

SPEED = 100.0  # m/s over ground: 360 km/h; what carries the sensors is a person or a vehicle
SPREAD = 1000.0  # m/s, standard deviation of a speed: what is not observed has the variance 1e6 m^2/s^2
SPEED_VARIANCE = 1e12  # m^2/s^2: 1e6 times that of what is not observed
RAYS = 10**6  # more than a scan has range bins
DELAY = 60.0  # s: a window or filter that lags more is of no use to anybody who walks

POSITION = 4.1e7  # m: once round the earth is 4.0e7
VELOCITY = 1000.0  # m/s of a pose: more than any vehicle; dead reckoning from an IMU alone drifts for hours until then
COVARIANCE = 1e16  # m^2, m^2/s^2: the square of more than twice round the earth

# Elements of radar scans that are not integers: integers of 32 bits are written as floats as well; twice their range.
SCAN = 2.0**32
SCAN_PERIOD = (1e-6, 60.0)  # s: pulses of a fast radar; one scan a minute follows nothing that moves
RANGE_START = (-1e6, 1e6)  # m: as far as the numbers of a P440 go (32 bits of ps are 322 km), with margin
RANGE_STEP = (1e-5, 1000.0)  # m: far finer than any wavelength; far coarser than any person
CARRIER = (1e6, 1e12)  # Hz: radio; radars for people use 0.4 to 140 GHz
BANDWIDTH = (1.0, 1e12)  # Hz: no wider than the carrier; 1 Hz is 150 000 km of resolution

# Elements of sound that are not integers: full scale is 1, but some write the counts of 16 bits; three times those.
SOUND = 1e5
AMPLITUDE = 1e6  # of a line in such sound, with margin for an I and a Q
SAMPLE_RATE = (10.0, 1e6)  # Hz: no Doppler below; faster than any converter behind a Doppler module (sound: 384 kHz)
RANGE_RATE = 1000.0  # m/s: three times the speed of sound
SNR = 400.0  # dB: more than the largest float32 over the last bit of 24
TARGET_RANGE = 1e6  # m: as RANGE_START

POINT = 1e4  # m from a radar to a point: as RANGE
FRAME_TIME = 60.0  # s: as SCAN_PERIOD
DOPPLER_STEP = (1e-6, RANGE_RATE)  # m/s: a frame of a minute at 77 GHz has 3e-5

RANGE = 1e4  # m along a ray: the farthest laser range finders in the hand end at 10 km
LIGHT = 1e9  # of a range sensor's signal and ambient light, in its units: counts of 30 bits
LOG_ODDS = (1e-6, 100.0)  # nat per count: a thousand counts to see a difference; one count that settles everything
CELL_SIZE = (1e-3, 100.0)  # m: finer than any range sensor; coarser than any room
HEIGHT = 1e4  # m above the floor: no sensor looks farther
CELL_INDEX = 2**40  # cells of a millimetre, 27 times round the earth
BEARING = 100.0  # rad: sixteen turns; a walking direction may be unwrapped
AZIMUTH = 1.5708  # rad: a quarter turn to either side, rounded up
CONTACT = 1e5  # s: the farthest range at the slowest approach


def _within(least: float, most: float) -> Meta:
    """The bounds as a JSON Schema says them; `require_within` and its like check them, in words of their own."""
    return Meta(extra_json_schema={"minimum": least, "maximum": most})


TurnRate: TypeAlias = Annotated[float, _within(-TURN_RATE, TURN_RATE)]
Acceleration: TypeAlias = Annotated[float, _within(-ACCELERATION, ACCELERATION)]
LinearAcceleration: TypeAlias = Annotated[float, _within(-LINEAR_ACCELERATION, LINEAR_ACCELERATION)]
MagneticField: TypeAlias = Annotated[float, _within(-MAGNETIC_FIELD, MAGNETIC_FIELD)]
Cosine: TypeAlias = Annotated[float, _within(-1.0 - UNIT_TOLERANCE, 1.0 + UNIT_TOLERANCE)]
Level: TypeAlias = Annotated[int, _within(0, 3)]
Speed: TypeAlias = Annotated[float, _within(-SPEED, SPEED)]
Spread: TypeAlias = Annotated[float, Meta(extra_json_schema={"minimum": 0.0})]
Deviation: TypeAlias = Annotated[float, _within(0.0, SPREAD)]
SpeedVariance: TypeAlias = Annotated[float, _within(-SPEED_VARIANCE, SPEED_VARIANCE)]
Rays: TypeAlias = Annotated[int, _within(0, RAYS)]
Delay: TypeAlias = Annotated[float, _within(0.0, DELAY)]
Position: TypeAlias = Annotated[float, _within(-POSITION, POSITION)]
Velocity: TypeAlias = Annotated[float, _within(-VELOCITY, VELOCITY)]
ScanPeriod: TypeAlias = Annotated[float, _within(*SCAN_PERIOD)]
RangeStart: TypeAlias = Annotated[float, _within(*RANGE_START)]
RangeStep: TypeAlias = Annotated[float, _within(*RANGE_STEP)]
Carrier: TypeAlias = Annotated[float, _within(*CARRIER)]
Bandwidth: TypeAlias = Annotated[float, _within(*BANDWIDTH)]
SampleRate: TypeAlias = Annotated[float, _within(*SAMPLE_RATE)]
Amplitude: TypeAlias = Annotated[float, _within(0.0, AMPLITUDE)]
RangeRate: TypeAlias = Annotated[float, _within(-RANGE_RATE, RANGE_RATE)]
Snr: TypeAlias = Annotated[float, _within(-SNR, SNR)]
FrameTime: TypeAlias = Annotated[float, _within(0.0, FRAME_TIME)]
DopplerStep: TypeAlias = Annotated[float, _within(*DOPPLER_STEP)]
TargetRange: TypeAlias = Annotated[float, _within(0.0, TARGET_RANGE)]
LogOdds: TypeAlias = Annotated[float, _within(*LOG_ODDS)]
CellSize: TypeAlias = Annotated[float, _within(*CELL_SIZE)]
Height: TypeAlias = Annotated[float, _within(-HEIGHT, HEIGHT)]
CellIndex: TypeAlias = Annotated[int, _within(-CELL_INDEX, CELL_INDEX)]
Bearing: TypeAlias = Annotated[float, _within(-BEARING, BEARING)]
Azimuth: TypeAlias = Annotated[float, _within(-AZIMUTH, AZIMUTH)]
Distance: TypeAlias = Annotated[float, _within(0.0, RANGE)]
Share: TypeAlias = Annotated[float, _within(0.0, 1.0)]
Contact: TypeAlias = Annotated[float, _within(0.0, CONTACT)]


def require_within(name: str, value: float, least: float, most: float, unit: str = "") -> None:
    """Raise ValueError unless `least` <= value <= `most`; NaN and infinity never are."""
    if not least <= value <= most:  # written so that NaN is refused
        raise ValueError(_outside(name, value, least, most, unit))


def require_vector(name: str, vector: tuple[float, float, float], most: float, unit: str) -> None:
    """Raise ValueError unless each of three components lies within -`most` to `most`."""
    x, y, z = vector
    if not (-most <= x <= most and -most <= y <= most and -most <= z <= most):
        raise ValueError(_outside(name, vector, -most, most, unit))


def require_pair(name: str, pair: tuple[float, float], most: float, unit: str) -> None:
    """Raise ValueError unless each of two components lies within -`most` to `most`."""
    x, y = pair
    if not (-most <= x <= most and -most <= y <= most):
        raise ValueError(_outside(name, pair, -most, most, unit))


def require_unit(name: str, quaternion: tuple[float, float, float, float]) -> None:
    """Raise ValueError unless the quaternion has norm 1 within UNIT_TOLERANCE."""
    w, x, y, z = quaternion
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1) <= UNIT_TOLERANCE:  # written so that NaN is refused
        raise ValueError(f"{name} has norm {norm:.6g}; a rotation has 1")


def require_covariance(name: str, covariance: tuple[float, float, float]) -> None:
    """Raise ValueError unless xx, xy, yy are the covariance of something, bounded by SPEED_VARIANCE."""
    xx, xy, yy = covariance
    require_vector(name, covariance, SPEED_VARIANCE, "m^2/s^2")
    if xx < 0 or yy < 0:
        raise ValueError(f"{name} is {covariance}; variances are 0 or more")
    if xy * xy > xx * yy * (1 + 1e-6):  # a little more than 1 by rounding is not a correlation beyond 1
        raise ValueError(f"{name} is {covariance}; expected xy^2 to be at most xx times yy")


def require_array(
    name: str, array: Array, letters: str, *, dimensions: int, most: float, may_be_empty: bool = False
) -> None:
    """Raise ValueError unless dtype and number of dimensions fit, and every part of a float within `most`."""
    if array.dtype.char not in letters:
        allowed = ", ".join(str(np.dtype(letter)) for letter in letters)
        raise ValueError(f"{name} is of dtype {array.dtype}; allowed are {allowed}")
    if may_be_empty and array.ndim == dimensions and array.size == 0:
        return
    if array.ndim != dimensions or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; it takes {dimensions} dimensions, none of them empty")
    if array.dtype.kind in "fc":
        largest = np.abs(_parts(array)).max().item()
        if not math.isfinite(largest):
            raise ValueError(f"{name} has elements that are NaN or infinite")
        if largest > most:
            raise ValueError(f"{name} has an element of {largest:g}; expected {-most:g} to {most:g}")


def _parts(array: Array) -> Array:
    """The elements, of complex ones both parts."""
    if array.dtype.kind != "c":
        return array
    return np.ascontiguousarray(array).view(array.real.dtype)


def _outside(name: str, found: float | Sequence[float], least: float, most: float, unit: str) -> str:
    values = found if isinstance(found, Sequence) else (found,)
    if not all(map(math.isfinite, values)):
        return f"{name} is {found}; NaN and infinity are not allowed"
    return f"{name} is {found}; expected {least:g} to {most:g}{unit and ' ' + unit}"
