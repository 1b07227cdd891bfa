"""What every estimator takes from one IMU sample."""

import math

from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import Quaternion, Vector, rotate
from caneflow.physics import GRAVITY

LONGEST_INTERVAL = 0.5  # s between two IMU samples; a longer one is a gap (cane.md row 11)


class SampleClock:
    """The measured interval between IMU samples; counts what is too long to be one."""

    def __init__(self) -> None:
        self.gaps = 0
        self._last_ns: int | None = None

    def interval(self, stamp_ns: int) -> float | None:
        """Seconds since the sample before, None at the first; raises ValueError when time does not go on."""
        require_later(stamp_ns, self._last_ns)
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is None:
            return None
        interval = (stamp_ns - last_ns) * 1e-9
        if interval > LONGEST_INTERVAL:
            self.gaps += 1
        return interval


def require_later(stamp_ns: int, last_ns: int | None) -> None:
    """Raise ValueError unless an IMU sample's stamp is after that of the sample before, `last_ns`, if there is one."""
    if last_ns is not None and stamp_ns <= last_ns:
        raise ValueError(f"imu: stamp {stamp_ns} ns is not after the one before, {last_ns} ns")


def required_orientation(orientation: Quaternion | None, method: str) -> Quaternion:
    """The orientation, or a ValueError that says what is missing and who can supply it."""
    if orientation is None:
        raise ValueError(
            f"{method}: the imu sample has no orientation; it needs an IMU whose chip fuses one "
            "(BNO055 class) or an attitude filter in front"
        )
    return orientation


def required_force(accel: Vector | None, method: str) -> Vector:
    """The specific force (m/s^2, body), or a ValueError that says that it is missing."""
    if accel is None:
        raise ValueError(f"{method}: the imu sample has no accel; it needs the raw specific force")
    return accel


def required_acceleration(reading: ImuReading, method: str) -> Vector:
    """The one without gravity (m/s^2, body) where there is one, else the other; ValueError when there is neither."""
    if reading.linear_accel is not None:
        return reading.linear_accel
    if reading.accel is None:
        raise ValueError(f"{method}: the imu sample has neither linear_accel nor accel; it needs one of them")
    return reading.accel


def world_acceleration(orientation: Quaternion, reading: ImuReading, method: str) -> Vector:
    """Acceleration in R0, m/s^2, gravity removed: by the chip where it does, else by the attitude `orientation`.

    Raises ValueError when there is neither `linear_accel` nor `accel`.
    """
    x, y, z = rotate(orientation, required_acceleration(reading, method))
    return (x, y, z) if reading.linear_accel is not None else (x, y, z - GRAVITY)


def heading_of(orientation: Quaternion, boresight: Vector) -> tuple[float, float]:
    """(cos psi, sin psi) of the boresight's yaw; (1, 0) for a boresight that points straight up or down."""
    x, y, _ = rotate(orientation, boresight)
    norm = math.sqrt(x * x + y * y)
    return (x / norm, y / norm) if norm > 1e-9 else (1.0, 0.0)
