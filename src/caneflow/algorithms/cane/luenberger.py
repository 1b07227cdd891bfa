"""The paper's observer (eq. 9): radar speed and IMU acceleration into velocity, position by integration.

Per axis of R0: state x = (a, v), m/s^2 and m/s; A = [[1, 0], [T, 1]]; C = I; L the 2 x 2 gain; p the position, m.
"""

import cmath
from dataclasses import dataclass
from typing import Annotated, TypeAlias

from annotated_types import Ge, Gt, Le, Lt

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, DelayCompensation, GroundVelocity, PoseEstimate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import (
    LONGEST_INTERVAL,
    SampleClock,
    required_orientation,
    world_acceleration,
)
from caneflow.algorithms.quantities import Time
from caneflow.algorithms.rotations import Vector

Pole: TypeAlias = Annotated[float, Gt(-1), Lt(1)]
GainElement: TypeAlias = Annotated[float, Ge(-1e4), Le(1e4)]  # of an observer that converges: a few 1 / interval
Gain: TypeAlias = tuple[tuple[GainElement, GainElement], tuple[GainElement, GainElement]]


@dataclass(frozen=True, kw_only=True)
class LuenbergerSettings:
    """What may be set; raises ValueError for an observer that does not converge."""

    pole_acceleration: Pole = 0.5  # per sample, magnitude below 1
    pole_velocity: Pole = 0.95  # per sample, magnitude below 1; 0.98 and above lags visibly
    gain: Gain | None = None  # L itself instead of poles; rows a, v; columns innovation of a, of v
    interval: Time = 0.01  # s, nominal; only for checking `gain`
    compensate_delay: DelayCompensation = "none"

    def __post_init__(self) -> None:
        for name in ("pole_acceleration", "pole_velocity"):
            pole = getattr(self, name)
            if not abs(pole) < 1.0:  # written so that NaN is refused
                raise ValueError(f"{name} is {pole}; its magnitude must be below 1 (1: never corrected)")
        if self.gain is not None:
            eigenvalues = observer_eigenvalues(self.gain, self.interval)
            if not all(abs(value) < 1.0 for value in eigenvalues):
                listed = ", ".join(f"{value:.4g}" for value in eigenvalues)
                raise ValueError(
                    f"gain: A - L C has eigenvalues {listed} at {self.interval} s; all must lie inside the unit circle"
                )


def placed_gain(interval: float, pole_acceleration: float, pole_velocity: float) -> Gain:
    """L = A - diag(poles): with C = I this makes the poles the eigenvalues of A - L C (cane.md row 10)."""
    return (1.0 - pole_acceleration, 0.0), (interval, 1.0 - pole_velocity)


def observer_eigenvalues(gain: Gain, interval: float) -> tuple[complex, complex]:
    """Both eigenvalues of A - L C for A = [[1, 0], [interval, 1]], C = I."""
    (l_aa, l_av), (l_va, l_vv) = gain
    trace = (1.0 - l_aa) + (1.0 - l_vv)
    determinant = (1.0 - l_aa) * (1.0 - l_vv) + l_av * (interval - l_va)
    root = cmath.sqrt(0.25 * trace * trace - determinant)
    return 0.5 * trace + root, 0.5 * trace - root


class LuenbergerObserver(DeadReckoning):
    """One state (a, v) per axis of R0, advanced from IMU sample to IMU sample.

    x(k+1) = A x(k) + L (y(k) - C x(k)), p(k+1) = p(k) + T v(k+1), with T the measured interval (row 11).
    L is computed again from each T, so the poles stay where they are set; an explicit `gain` is used as given.
    Where no valid speed has come since the last sample, the velocity row is A's alone (row 10).
    Over a gap (more than LONGEST_INTERVAL) the last velocity holds: a constant acceleration would be an invention.
    """

    def __init__(self, settings: LuenbergerSettings, *, boresight: Vector) -> None:
        self._settings = settings
        self._clock = SampleClock()
        self._ground = GroundVelocity(boresight, compensate_delay=settings.compensate_delay)
        self._measured: Vector = (0.0, 0.0, 0.0)  # y_a of the last sample
        self._acceleration: Vector = (0.0, 0.0, 0.0)
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._clock.gaps

    @property
    def acceleration(self) -> Vector:
        """The acceleration part of the state, m/s^2, R0."""
        return self._acceleration

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Take a new ground speed (m/s); the observer has no use for its quality (m/s)."""
        self._ground.speed(stamp_ns, speed, quality, valid, delay)

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`; no covariance, an observer has none.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        orientation = required_orientation(reading.orientation, "luenberger")
        acceleration = world_acceleration(orientation, reading, "luenberger")
        interval = self._clock.interval(stamp_ns)
        if interval is not None:
            self._advance(stamp_ns, interval)
        self._ground.imu(stamp_ns, orientation, acceleration, interval)
        self._measured = acceleration
        return PoseEstimate(self._position, self._velocity, orientation, None)

    def _advance(self, stamp_ns: int, interval: float) -> None:
        step = interval if interval <= LONGEST_INTERVAL else 0.0  # T in A
        measurement = self._ground.take(stamp_ns)
        gain = self._settings.gain or placed_gain(step, self._settings.pole_acceleration, self._settings.pole_velocity)
        ax, ay, az = self._acceleration
        vx, vy, vz = self._velocity
        px, py, pz = self._position
        measured_x, measured_y, measured_z = self._measured
        ground_x = ground_y = ground_z = None
        if measurement is not None:
            ground_x, ground_y, ground_z = measurement.x, measurement.y, 0.0
        ax, vx = _advance_axis(ax, vx, measured_x, ground_x, step, gain)
        ay, vy = _advance_axis(ay, vy, measured_y, ground_y, step, gain)
        az, vz = _advance_axis(az, vz, measured_z, ground_z, step, gain)
        self._acceleration = ax, ay, az
        self._velocity = vx, vy, vz
        self._position = px + interval * vx, py + interval * vy, pz + interval * vz


def _advance_axis(
    a: float, v: float, measured_a: float, measured_v: float | None, step: float, gain: Gain
) -> tuple[float, float]:
    """(a, v) of one axis a sample later: A x + L (y - x), the velocity row without L where v is not measured."""
    (l_aa, l_av), (l_va, l_vv) = gain
    innovation_a = measured_a - a
    if measured_v is None:
        return a + l_aa * innovation_a, v + step * a
    innovation_v = measured_v - v
    return (
        a + l_aa * innovation_a + l_av * innovation_v,
        v + step * a + l_va * innovation_a + l_vv * innovation_v,
    )
