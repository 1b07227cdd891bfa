"""Yaw by the magnetic field, believed as far as its strength and dip are those of the undisturbed field.

The yaw that a gyro integrates is off by an offset that wanders. A scalar Kalman filter follows the offset; its
variance is counted in units of the wander's per second, so it is a time: `time_constant` in the steady state, and
longer the longer the field was not believed. A disturbed field has `distrust` times the noise.
"""

import math
from dataclasses import dataclass, field

from caneflow.algorithms.inertial.attitude_recovery import LEAST_LEVEL, UndisturbedField
from caneflow.algorithms.inertial.gyro_bias import NOTHING_SEEN, Row, followed_row
from caneflow.algorithms.inertial.initial_attitude import NORTH_YAW
from caneflow.algorithms.quantities import Angle, Factor, Time
from caneflow.algorithms.rotations import Vector, wrapped

SMOOTHING = 0.1  # s, of strength and dip: the magnetometer's noise is not a disturbance
TURNING = math.radians(20.0)  # rad/s; a field that is steady while the body turns is not a magnet that it carries
LARGEST_DISTRUST = 1000.0
FAR = 10.0  # deviations; one that is further is distrusted no more, and its fourth power may be no number
SETTLED = 1.5  # times the steady variance, below which corrections are of now, not of what was
# rad/s; a gyro's scale errors make the offset wander, and at this turn rate as fast as everything else does
WANDERING = math.radians(100.0)
LEVELLING_MEMORY = 1.0  # s of readings that count before the attitude is level


@dataclass(frozen=True, kw_only=True)
class MagneticHeadingSettings:
    """How fast the magnetometer corrects yaw, and when it does not."""

    time_constant: Time = 20.0  # s
    strength_tolerance: Factor = 0.1  # relative
    dip_tolerance: Angle = math.radians(10.0)  # rad
    reference_time: Time = 20.0  # s, over which the undisturbed field is averaged
    acceptance_time: Time = 20.0  # s of steadiness in turning that make another field the one


@dataclass
class FieldShape:
    """What of a magnetic field does not depend on yaw."""

    strength: float  # the magnetometer's unit
    dip: float  # rad, positive down

    def follow(self, strength: float, dip: float, share: float) -> None:
        """Move towards another by `share`."""
        self.strength += share * (strength - self.strength)
        self.dip += share * (dip - self.dip)


@dataclass
class _Candidate:
    shape: FieldShape
    steady: float = 0.0  # s


@dataclass
class FieldReference:
    """The undisturbed field, as it seems; says how far off a reading is."""

    settings: MagneticHeadingSettings
    shape: FieldShape | None = None
    _smooth: FieldShape | None = None
    _seen: float = 0.0  # s
    _candidate: _Candidate | None = field(default=None, repr=False)

    def deviation(self, strength: float, dip: float, turn_rate: float, interval: float) -> float:
        """How far a reading is from the undisturbed field, 1 at the tolerance; moves the reference along.

        Another field becomes the reference when it stays the same for long enough while the body turns.
        """
        if self.shape is None or self._smooth is None:
            self.shape, self._smooth = FieldShape(strength, dip), FieldShape(strength, dip)
        if interval <= 0.0:
            return 0.0
        smooth = self._smooth
        smooth.follow(strength, dip, interval / (SMOOTHING + interval))
        deviation = self._between(smooth, self.shape)
        if deviation < 1.0:
            self._candidate = None
            self._seen = min(self._seen + interval, self.settings.reference_time)
            self.shape.follow(smooth.strength, smooth.dip, interval / (self._seen + interval))
        else:
            self._consider(smooth, turn_rate, interval)
        return deviation

    def _consider(self, smooth: FieldShape, turn_rate: float, interval: float) -> None:
        candidate = self._candidate
        if candidate is None or self._between(smooth, candidate.shape) > 1.0:
            self._candidate = _Candidate(FieldShape(smooth.strength, smooth.dip))
            return
        if turn_rate < TURNING:
            return
        candidate.steady += interval
        candidate.shape.follow(smooth.strength, smooth.dip, interval / (candidate.steady + interval))
        if candidate.steady >= self.settings.acceptance_time:
            self.shape, self._candidate = candidate.shape, None

    def _between(self, one: FieldShape, other: FieldShape) -> float:
        strength = abs(one.strength - other.strength) / (self.settings.strength_tolerance * other.strength)
        return max(strength, abs(one.dip - other.dip) / self.settings.dip_tolerance)


class MagneticHeading:
    """The offset between the yaw that the gyro integrates and that of magnetic north (world: y)."""

    def __init__(self, settings: MagneticHeadingSettings) -> None:
        self._settings = settings
        self._reference = FieldReference(settings)
        self._deviation = 0.0
        self.offset = 0.0  # rad; the world's yaw less the gyro's
        self.forget()

    @property
    def disturbed(self) -> bool:
        """Whether the last reading was out of tolerance."""
        return self._deviation >= 1.0

    def forget(self) -> None:
        """Take the next reading's yaw as it is."""
        self._variance = math.inf  # s, see above
        self.row: Row = NOTHING_SEEN  # what the corrections tell of the gyro's bias

    def open(self, times: float) -> float:
        """Yaw may be off by `times` the error of a reading that stands for 1 s; by how much (s) it is opened."""
        opened = (times * self._settings.time_constant) ** 2
        self._variance += opened
        return opened

    def close(self, opened: float) -> None:
        """Take an opening back, as far as it is still there: yaw is known after all."""
        if not math.isinf(opened):
            self._variance = max(self._variance - opened, self._settings.time_constant)

    def averaged(self, elapsed: float) -> None:
        """`elapsed` s of readings have been averaged elsewhere."""
        reading = self._settings.time_constant**2
        if not math.isinf(self._variance):
            self._variance *= reading / (reading + self._variance * elapsed)
        elif elapsed > 0.0:
            self._variance = reading / elapsed

    def undisturbed(self) -> UndisturbedField | None:
        """The field as it was before the last reading, in the gyro's world; None where it cannot be trusted."""
        shape = self._reference.shape
        if shape is None or self.disturbed or math.isinf(self._variance):
            return None
        level, yaw = math.cos(shape.dip), NORTH_YAW - self.offset
        direction = level * math.cos(yaw), level * math.sin(yaw), -math.sin(shape.dip)
        return UndisturbedField(
            direction=direction, strength=shape.strength, tolerance=self._settings.strength_tolerance
        )

    def update(
        self, magnetic: Vector, row: Row, gyro: Vector, interval: float, *, levelled: bool = True
    ) -> float | None:
        """Correct the offset by a field, turned level by the gyro's attitude, `interval` s after the one before.

        Args:
            magnetic: any unit.
            row: the vertical one of the attitude, see gyro_bias.
            gyro: rad/s.
            interval: s since the reading before.
            levelled: false while the attitude's inclination may be wrong, and with it the yaw of a dipping field.

        Returns:
            The correction in rad, where it tells of the gyro's bias: not at the start, nor near a disturbance.
        """
        east, north, up = magnetic
        level = math.sqrt(east * east + north * north)
        strength = math.sqrt(level * level + up * up)
        if not level > LEAST_LEVEL * strength:
            self._variance += interval
            return None
        turn_rate = math.sqrt(gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2])
        self._deviation = self._reference.deviation(strength, math.atan2(-up, level), turn_rate, interval)
        distrust = min(1.0 + 10.0 * min(self._deviation, FAR) ** 4, LARGEST_DISTRUST)
        noise = distrust * self._settings.time_constant**2
        gain = self._gain(noise, interval, 1.0 + (turn_rate / WANDERING) ** 2)
        if not levelled:
            self._variance = max(self._variance, noise / LEVELLING_MEMORY)
        turn = gain * wrapped(NORTH_YAW - math.atan2(north, east) - self.offset)
        self.offset = wrapped(self.offset + turn)
        self.row = followed_row(self.row, row, gain)
        settled = self._variance < SETTLED * self._settings.time_constant and not self.disturbed
        return turn if settled else None

    def _gain(self, noise: float, interval: float, wander: float) -> float:
        """The Kalman gain; `noise` in s^2, the variance of a reading that stands for 1 s; `wander` times the usual."""
        if math.isinf(self._variance):
            if interval > 0.0:
                self._variance = noise / interval
            return 1.0
        self._variance += wander * interval
        gain = self._variance * interval / (self._variance * interval + noise)
        self._variance *= 1.0 - gain
        return gain
