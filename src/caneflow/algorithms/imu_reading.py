"""One sample of an inertial measurement unit as every estimator takes it.

A tuple with names rather than a data class: it is built several times a sample in replays, in a third of the time.
"""

from typing import NamedTuple

from caneflow.algorithms.rotations import Quaternion, Vector


class ImuReading(NamedTuple):
    """Body frame; None: the sensor does not have it, or who reads has no use for it. Give its parts by name."""

    gyro: Vector  # rad/s
    accel: Vector | None = None  # m/s^2, specific force
    mag: Vector | None = None  # uT
    orientation: Quaternion | None = None  # w x y z, body to world
    linear_accel: Vector | None = None  # m/s^2, gravity removed
