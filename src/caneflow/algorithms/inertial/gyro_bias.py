"""What a gyro says when nothing turns, learnt at rest and, more slowly, from how an attitude must be corrected.

A bias error e (body) turns the estimated attitude by R e per second (R: body to world), and whatever corrects the
attitude turns it back. The rate of correction is -R e behind the low pass that the correction went through; with
what was taken off the gyro behind the same low pass, it measures H times the bias, H being R behind the low pass.
The bias is a random walk with a 3 x 3 covariance, corrected by such scalar measurements: what has not been seen
stays unknown, the part along gravity above all.

After VQF's (D. Laidig, T. Seel, Information Fusion 91, 2023), simplified.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

from caneflow.algorithms.quantities import Acceleration, Density, Factor, Time, TurnRate, Zero
from caneflow.algorithms.rotations import Quaternion, Vector
from caneflow.algorithms.scalar_update import Covariance, updated

# A row of H, and the turn rate (rad/s) about that axis of the world that was taken off as bias; both low-passed.
Row: TypeAlias = tuple[float, float, float, float]

NOTHING_SEEN: Row = (0.0, 0.0, 0.0, 0.0)

INTERVAL = 0.1  # s that are gathered for one correction


@dataclass(frozen=True, kw_only=True)
class GyroBiasSettings:
    """How large a bias may be, and what counts as rest."""

    largest: TurnRate = math.radians(2.0)  # rad/s per axis; a slower steady turn passes for rest
    initial: TurnRate = math.radians(0.5)  # rad/s, sd per axis before anything was seen
    walk: Density = math.radians(0.01)  # rad/s/sqrt(s): 0.1 deg/s in 100 s
    # sd of a measurement over 1 s:
    rest_noise: Density = math.radians(0.05)  # rad/s, at rest, beside what follows
    sway: Factor | Zero = 4.0  # times the gyro's own deviations at rest: a hand that is still is not quite
    tilt_noise: Density = math.radians(1.0)  # rad/s, of a correction by gravity
    heading_noise: Density = math.radians(2.0)  # rad/s, of a correction by magnetic north
    rest_gyro: TurnRate = math.radians(2.0)  # rad/s, largest deviation from the mean at rest
    rest_accel: Acceleration = 0.5  # m/s^2, likewise
    rest_time: Time = 1.5  # s that it must last
    rest_memory: Time = 0.5  # s, of that mean


class RestDetector:
    """Whether gyro and accelerometer have stayed near their own mean for long enough."""

    def __init__(self, settings: GyroBiasSettings) -> None:
        self._settings = settings
        self._gyro: Vector = (0.0, 0.0, 0.0)
        self._accel: Vector = (0.0, 0.0, 0.0)
        self._turning = 0.0  # rad^2/s^2, mean square of the gyro's deviations
        self._lasted = -math.inf  # s; before the first sample

    @property
    def at_rest(self) -> bool:
        """As of the last sample."""
        return self._lasted >= self._settings.rest_time

    @property
    def deviation(self) -> float:
        """rad/s, RMS per axis of what the gyro deviates from its mean."""
        return math.sqrt(self._turning / 3.0)

    def restart(self) -> None:
        """Forget what was: after a gap."""
        self._lasted = -math.inf

    def update(self, gyro: Vector, accel: Vector, interval: float) -> bool:
        """Whether it is at rest now; gyro in rad/s with its bias, accel in m/s^2, `interval` in s."""
        settings = self._settings
        if self._lasted < 0.0:
            self._gyro, self._accel, self._lasted = gyro, accel, 0.0
            return False
        share = interval / (settings.rest_memory + interval)
        self._gyro, turning = _followed(self._gyro, gyro, share)
        self._accel, shaking = _followed(self._accel, accel, share)
        self._turning += share * (turning - self._turning)
        x, y, z = self._gyro
        if (
            turning > settings.rest_gyro**2
            or shaking > settings.rest_accel**2
            or max(abs(x), abs(y), abs(z)) > settings.largest
        ):
            self._lasted = 0.0
        else:
            self._lasted += interval
        return self._lasted >= settings.rest_time


class GyroBias:
    """The bias and its covariance; told of every sample, it corrects itself every INTERVAL."""

    def __init__(self, settings: GyroBiasSettings) -> None:
        self._settings = settings
        self._bias: Vector = (0.0, 0.0, 0.0)
        variance = settings.initial**2
        self._p: Covariance = variance, 0.0, 0.0, variance, 0.0, variance
        self._gyro: Vector = (0.0, 0.0, 0.0)  # rad, at rest since the last correction
        self._rested = 0.0  # s
        self._tilt = (0.0, 0.0)  # rad, since the last correction
        self._turn = 0.0  # rad
        self._elapsed = self._tilted = self._turned = 0.0  # s

    @property
    def bias(self) -> Vector:
        """rad/s, body."""
        return self._bias

    @property
    def sd(self) -> Vector:
        """rad/s, standard deviation per axis of the body."""
        xx, _, _, yy, _, zz = self._p
        return math.sqrt(xx), math.sqrt(yy), math.sqrt(zz)

    def at_rest(self, gyro: Vector, deviation: float, interval: float) -> None:
        """A sample at rest: the gyro says its bias, and a sway of which `deviation` (rad/s) is the quick part."""
        self._gyro = (
            self._gyro[0] + interval * gyro[0],
            self._gyro[1] + interval * gyro[1],
            self._gyro[2] + interval * gyro[2],
        )
        self._rested += interval
        if self._rested >= INTERVAL:
            self._correct_at_rest(deviation)
            self._gyro, self._rested = (0.0, 0.0, 0.0), 0.0

    def corrected(
        self,
        tilt: tuple[float, float] | None,
        tilt_rows: tuple[Row, Row],
        turn: float | None,
        turn_row: Row,
        interval: float,
    ) -> None:
        """A sample of any kind: the attitude was corrected, about x and y by `tilt` and about z by `turn`, rad.

        The rows went through the low pass that the correction went through. None where nothing could be corrected.
        """
        self._elapsed += interval
        if tilt is not None:
            self._tilt = self._tilt[0] + tilt[0], self._tilt[1] + tilt[1]
            self._tilted += interval
        if turn is not None:
            self._turn += turn
            self._turned += interval
        if self._elapsed >= INTERVAL:
            self._grow(self._elapsed)
            if self._tilted > 0.0:
                for row, angle in zip(tilt_rows, self._tilt, strict=True):
                    self._correct_by(row, angle, self._tilted, self._settings.tilt_noise)
            if self._turned > 0.0:
                self._correct_by(turn_row, self._turn, self._turned, self._settings.heading_noise)
            self._tilt, self._turn = (0.0, 0.0), 0.0
            self._elapsed = self._tilted = self._turned = 0.0

    def _correct_at_rest(self, deviation: float) -> None:
        lasted, settings = self._rested, self._settings
        variance = (settings.rest_noise**2 + (settings.sway * deviation) ** 2) / lasted
        for axis, row in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
            self._correct(row, self._gyro[axis] / lasted - self._bias[axis], variance)

    def _correct_by(self, row: Row, angle: float, lasted: float, noise: float) -> None:
        a, b, c, taken_off = row
        x, y, z = self._bias
        residual = taken_off - angle / lasted - (a * x + b * y + c * z)
        self._correct((a, b, c), residual, noise**2 / lasted)

    def _grow(self, interval: float) -> None:
        """The random walk; nothing gets less known than it was at first."""
        added, limit = self._settings.walk**2 * interval, self._settings.initial**2
        xx, xy, xz, yy, yz, zz = self._p
        self._p = min(xx + added, limit), xy, xz, min(yy + added, limit), yz, min(zz + added, limit)

    def _correct(self, row: Vector, residual: float, variance: float) -> None:
        """The Kalman filter's update by residual = row . (true bias - bias) + noise, rad/s."""
        a, b, c = row
        xx, xy, xz, yy, yz, zz = self._p
        px, py, pz = xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c
        (gain_x, gain_y, gain_z), self._p = updated(self._p, (px, py, pz), a * px + b * py + c * pz + variance)
        largest = self._settings.largest
        residual = max(-largest, min(largest, residual))
        x, y, z = self._bias
        self._bias = (
            max(-largest, min(largest, x + gain_x * residual)),
            max(-largest, min(largest, y + gain_y * residual)),
            max(-largest, min(largest, z + gain_z * residual)),
        )


def horizontal_rows(orientation: Quaternion, bias: Vector) -> tuple[Row, Row]:
    """The rows x and y of the rotation, body to world, with the turn rates (rad/s) that `bias` takes off."""
    w, x, y, z = orientation
    bx, by, bz = bias
    xx, xy, xz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    yx, yy, yz = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    return (xx, xy, xz, xx * bx + xy * by + xz * bz), (yx, yy, yz, yx * bx + yy * by + yz * bz)


def vertical_row(orientation: Quaternion, bias: Vector) -> Row:
    """The row z of the rotation, likewise."""
    w, x, y, z = orientation
    a, b, c = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    return a, b, c, a * bias[0] + b * bias[1] + c * bias[2]


def followed_row(row: Row, target: Row, share: float) -> Row:
    """A first-order low pass: `row` moved towards `target` by `share`."""
    a, b, c, d = row
    return (
        a + share * (target[0] - a),
        b + share * (target[1] - b),
        c + share * (target[2] - c),
        d + share * (target[3] - d),
    )


def _followed(mean: Vector, value: Vector, share: float) -> tuple[Vector, float]:
    """The mean, moved towards `value` by `share`, and the squared distance that was between them."""
    dx, dy, dz = value[0] - mean[0], value[1] - mean[1], value[2] - mean[2]
    moved = mean[0] + share * dx, mean[1] + share * dy, mean[2] + share * dz
    return moved, dx * dx + dy * dy + dz * dz
