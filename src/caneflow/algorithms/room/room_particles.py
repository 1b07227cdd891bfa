"""Particle filters of a person in a room: the paper's Algorithm 1, and one that walks along the IMU's heading.

Algorithm 1 (Ferrand et al., ICCHP 2020): every particle is a position and a velocity; it goes on at constant velocity;
radial speeds, distances by strength and the IMU's orientation weigh it; a static target is identified and inconsistent
measurements are discarded; small particles are removed, the others resampled; the estimate is the weighted mean.
The choices where the paper is silent are room.md's, rows 11 to 16 and 18.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import Angle, Decibels, Density, Factor, Fraction, Probability, Speed, Time, Zero
from caneflow.algorithms.room.particle_filter import (
    Narrow,
    Particles,
    ParticleSettings,
    noise,
    normal_with_outliers,
    student_t,
    weighted_covariance,
)
from caneflow.algorithms.room.room_tracking import (
    DECIBEL,
    LEAST_COSINE,
    LEAST_DISTANCE,
    PATTERN_EXPONENT,
    Echo,
    HeadingHistory,
    MotionWatch,
    RoomEstimate,
    RoomStart,
    StaticSensor,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RoomParticleSettings:
    """What both filters may be told; the numbers are room.md's."""

    use_speed: bool = True
    use_strength: bool = True
    use_heading: bool = True
    particles: ParticleSettings = field(default_factory=ParticleSettings)
    walk_noise: Density = 0.5  # m/s/sqrt(s), on each axis: a bend and a change of pace
    along_noise: Density = 0.6  # m/s/sqrt(s), of the speed along the heading
    fastest: Speed = 2.0  # m/s
    start_speed: Speed | Zero = 0.7  # m/s, sd of each component
    speed_error: Speed = 0.12  # m/s
    speed_outliers: Probability = 0.1
    speed_share: Fraction = 0.5  # of an echo that is new: windows overlap
    strength_error: Decibels = 5.0  # dB
    strength_share: Fraction = 0.2
    degrees: Annotated[float, Ge(0.1), Le(1000)] = 4.0  # of freedom of the strength's Student-t
    range_error: Fraction = 0.1  # m, of sensors that measure it
    heading_error: Angle = math.radians(7.0)  # rad
    heading_share: Fraction = 0.025  # its error lasts for seconds, an update for 50 ms
    heading_time: Time = 20.0  # s, correlation of the yaw's error
    turn_noise: Density = 1.0  # rad/sqrt(s), of a heading that nobody measures
    edge_share: Factor | Zero = 0.5  # 1/m^2: how fast it becomes unlikely to be outside of the area
    consistent: Factor = 3.0  # sd: a measurement farther from every particle is discarded
    roughening: Factor | Zero = 0.05  # m, after resampling
    hold_after: Time = 0.7  # s with hardly a valid echo, after which the position is held
    hold_decay: Time = 0.3  # s, the velocity's then
    hold_noise: Density = 0.3  # m/sqrt(s), of the position then
    heading_timeout: Time = 0.5  # s, after which the IMU counts as silent


class _RoomParticles(ABC):
    """What both filters share; a subclass says what a state is and how it goes on."""

    _feels_steps = False  # whether it listens to the IMU for steps; the paper's identifies who stands by the sensors

    def __init__(
        self,
        settings: RoomParticleSettings,
        sensors: Mapping[str, StaticSensor],
        start: RoomStart,
        random: np.random.Generator,
    ) -> None:
        self._settings = settings
        self._sensors = dict(sensors)
        self._area = start.area
        self._random = random
        self._headings = HeadingHistory()
        self._motion = MotionWatch(settings.hold_after, settings.heading_timeout)
        self._now_ns: int | None = None
        self.discarded = 0
        self._particles = Particles(self._drawn(start, settings.particles.count), settings.particles)

    @property
    def moving(self) -> bool:
        """Whether some sensor has seen something move not long before."""
        return self._now_ns is None or self._motion.moving(self._now_ns)

    def heading(self, stamp_ns: int, yaw: float, standing: bool | None = None) -> None:
        """Take the direction that the person faces, rad in R0, and whether they stand, where it is known."""
        if self._settings.use_heading:
            self._headings.add(stamp_ns, yaw)
            self._motion.steps(stamp_ns, standing if self._feels_steps else None)

    def echo(self, sensor: str, echo: Echo) -> None:
        """Take what a sensor saw: one pass of Algorithm 1's loop."""
        self._motion.echo(echo.stamp_ns, echo.valid)
        self._advance(echo.stamp_ns)
        if echo.valid and (echo.range is not None or not self._motion.standing(echo.stamp_ns)):
            self._weigh(self._sensors[sensor], echo)

    @abstractmethod
    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The weighted mean, predicted to `stamp_ns`."""

    @abstractmethod
    def _drawn(self, start: RoomStart, count: int) -> Array:
        """States at the start, shape (D, count); the first two are the position."""

    @abstractmethod
    def _velocities(self) -> Narrow:
        """Of each particle at the time it stands at, shape (2, N), m/s."""

    @abstractmethod
    def _move(self, stamp_ns: int, dt: float) -> None:
        """Predict all particles to `stamp_ns`."""

    @abstractmethod
    def _hold(self, dt: float) -> None:
        """Let velocities decay: nothing moves, or nobody sees it."""

    def _heading_known(self, stamp_ns: int) -> bool:
        return self._headings.age(stamp_ns) < self._settings.heading_timeout

    def _advance(self, stamp_ns: int) -> None:
        if self._now_ns is None:
            self._now_ns = stamp_ns
        if stamp_ns <= self._now_ns:
            return
        if self._particles.renew(self._random):  # once all that was seen at one time has been weighed
            self._roughen()
        dt = (stamp_ns - self._now_ns) * 1e-9
        if self._motion.moving(stamp_ns):
            self._move(stamp_ns, dt)
        else:
            self._hold(dt)
            spread = self._settings.hold_noise * math.sqrt(dt)
            self._particles.states[:2] += spread * noise(self._random, 2, self._particles.states.shape[1])
        self._now_ns = stamp_ns

    def _weigh(self, sensor: StaticSensor, echo: Echo) -> None:
        s = self._settings
        x, y = self._particles.states[0] - sensor.position[0], self._particles.states[1] - sensor.position[1]
        distance = np.maximum(np.sqrt(x * x + y * y), LEAST_DISTANCE)
        weight = np.zeros(len(distance), dtype=np.float32)
        if echo.range is not None and self._consistent(echo.range - distance, s.range_error):
            weight += normal_with_outliers(echo.range - distance, s.range_error, s.speed_outliers, 3.0)
        if s.use_strength and echo.strength is not None and sensor.k is not None:
            residual = echo.strength - expected_strength(sensor, sensor.k, x, y, distance)
            if self._consistent(residual, s.strength_error):
                weight += s.strength_share * student_t(residual, s.strength_error, s.degrees)
        if s.use_speed:
            u, v = self._velocities()
            rate = (x * u + y * v) / distance
            residual = echo.range_rate - (rate if echo.signed else np.abs(rate))
            if self._consistent(residual, s.speed_error):
                weight += s.speed_share * normal_with_outliers(
                    residual, s.speed_error, s.speed_outliers, 2.0 * s.fastest
                )
        if self._area is not None:
            west, east, south, north = self._area
            px, py = self._particles.states[0], self._particles.states[1]
            beyond = np.maximum(np.maximum(west - px, px - east), np.maximum(south - py, py - north))
            weight -= s.edge_share * np.maximum(beyond, 0.0) ** 2
        self._particles.weigh(weight)

    def _consistent(self, residuals: Narrow, error: float) -> bool:
        """Whether any particle could have been measured so; counts what none could."""
        fits = bool((np.abs(residuals) < self._settings.consistent * error).any())
        self.discarded += not fits
        return fits

    def _roughen(self) -> None:
        states = self._particles.states
        states[:2] += self._settings.roughening * noise(self._random, 2, states.shape[1])


class ParticleTracker(_RoomParticles):
    """Algorithm 1 as printed: states x, y, u, v."""

    def _drawn(self, start: RoomStart, count: int) -> Array:
        velocities = self._settings.start_speed * self._random.standard_normal((2, count))
        return np.concatenate([start.drawn(count, self._random), velocities])

    def _velocities(self) -> Narrow:
        return self._particles.states[2:]

    def _move(self, stamp_ns: int, dt: float) -> None:
        s, states = self._settings, self._particles.states
        states[2:] += s.walk_noise * math.sqrt(dt) * noise(self._random, 2, states.shape[1])
        speed = np.maximum(np.sqrt(states[2] ** 2 + states[3] ** 2), 1e-9)
        if speed.max() > s.fastest:
            states[2:] *= np.minimum(1.0, s.fastest / speed)
            speed = np.minimum(speed, s.fastest)
        states[:2] += dt * states[2:]
        if self._heading_known(stamp_ns):
            # von Mises: as a Gaussian of the angle where the angle is small, and no arctangent
            yaw = self._headings.travel(stamp_ns, stamp_ns).yaw
            along = math.cos(yaw) * states[2] + math.sin(yaw) * states[3]
            self._particles.weigh((s.heading_share / s.heading_error**2) * (along / speed))

    def _hold(self, dt: float) -> None:
        self._particles.states[2:] *= math.exp(-dt / self._settings.hold_decay)

    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The weighted mean; what lies between the last echo and `stamp_ns` at constant velocity."""
        particles = self._particles
        x, y, u, v = particles.mean().tolist()
        covariance = weighted_covariance(particles.states, particles.weights)
        dt = (stamp_ns - self._now_ns) * 1e-9 if self._now_ns is not None and self.moving else 0.0
        forward = np.eye(4)
        forward[0, 2] = forward[1, 3] = dt
        walked = self._settings.walk_noise**2 * dt  # m^2/s^2, what the velocity may have changed by since
        spread = np.kron(np.array([[dt * dt / 3.0, dt / 2.0], [dt / 2.0, 1.0]]), walked * np.eye(2))
        return RoomEstimate((x + dt * u, y + dt * v), (u, v), forward @ covariance @ forward.T + spread)


class HeadingParticleTracker(_RoomParticles):
    """States x, y, speed (m/s), and the heading of travel less the IMU's yaw (rad); without an IMU, all of it."""

    _feels_steps = True

    def _drawn(self, start: RoomStart, count: int) -> Array:
        s = self._settings
        speed = np.abs(math.sqrt(2.0) * s.start_speed * self._random.standard_normal(count))
        return np.concatenate(
            [start.drawn(count, self._random), speed[None], s.heading_error * self._random.standard_normal((1, count))]
        )

    def _velocities(self) -> Narrow:
        yaw = self._yaw() + self._particles.states[3]
        speed = self._particles.states[2]
        return np.stack([speed * np.cos(yaw), speed * np.sin(yaw)])

    def _yaw(self) -> float:
        if not self._headings or self._now_ns is None:
            return 0.0
        return self._headings.travel(self._now_ns, self._now_ns).yaw

    def _move(self, stamp_ns: int, dt: float) -> None:
        s, states = self._settings, self._particles.states
        assert self._now_ns is not None
        shape = states.shape[1]
        if self._heading_known(stamp_ns):
            travel = self._headings.travel(self._now_ns, stamp_ns)
            cosine, sine = np.cos(states[3]), np.sin(states[3])
            states[0] += states[2] * (cosine * travel.east - sine * travel.north)
            states[1] += states[2] * (sine * travel.east + cosine * travel.north)
            keep = math.exp(-dt / s.heading_time)
            states[3] *= keep
            states[3] += s.heading_error * math.sqrt(1.0 - keep * keep) * noise(self._random, shape)
        else:
            states[:2] += dt * self._velocities()
            states[3] += s.turn_noise * math.sqrt(dt) * noise(self._random, shape)
        states[2] += s.along_noise * math.sqrt(dt) * noise(self._random, shape)
        np.abs(states[2], out=states[2])
        np.minimum(states[2], s.fastest, out=states[2])

    def _hold(self, dt: float) -> None:
        self._particles.states[2] *= math.exp(-dt / self._settings.hold_decay)

    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The weighted mean, walked on along the headings since the last echo."""
        particles = self._particles
        velocities = self._velocities()
        positions, forward = particles.states[:2], velocities
        if self._now_ns is not None and stamp_ns > self._now_ns and self.moving:
            dt = (stamp_ns - self._now_ns) * 1e-9
            ahead = np.stack([dt * velocities[0], dt * velocities[1]])
            if self._heading_known(stamp_ns):
                travel = self._headings.travel(self._now_ns, stamp_ns)
                bias, speed = particles.states[3], particles.states[2]
                cosine, sine = np.cos(bias), np.sin(bias)
                ahead = speed * np.stack(
                    [cosine * travel.east - sine * travel.north, sine * travel.east + cosine * travel.north]
                )
                yaw = travel.yaw + bias
                forward = np.stack([speed * np.cos(yaw), speed * np.sin(yaw)])
            positions = positions + ahead
        values = np.concatenate([positions, forward])
        x, y, u, v = (values @ particles.weights).tolist()
        return RoomEstimate((x, y), (u, v), weighted_covariance(values, particles.weights))


def expected_strength(sensor: StaticSensor, k: float, x: Narrow, y: Narrow, distance: Narrow) -> Narrow:
    """dB, of an echo from (x, y) m off the sensor, `distance` away: k / R^4 and the antenna's pattern; shape (N,)."""
    # cosine of the angle off the boresight, without an arctangent
    cosine = (x * math.cos(sensor.azimuth) + y * math.sin(sensor.azimuth)) / distance
    log_pattern = PATTERN_EXPONENT * np.log(np.maximum(cosine, LEAST_COSINE))
    return np.asarray(DECIBEL * (math.log(k) + log_pattern - 4.0 * np.log(distance)), dtype=np.float32)
