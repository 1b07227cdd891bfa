"""An extended Kalman filter of a person in a room: position, velocity, and what is slowly wrong with the sensors.

State, in this order, n = 6 + number of sensors:

    x, y    m, R0
    u, v    m/s, velocity in R0
    beta    rad, heading of travel less the IMU's yaw: the trunk is not quite along the way, north is not quite north
    gamma   dB per dB, how much slower than R^-4 the strength falls
    b_i     dB, what sensor i receives more than its k says: aspect, reflections, an imperfect calibration

Between echoes the velocity turns with the IMU's yaw, so that an abrupt turn costs nothing; across the heading it is
measured to be 0. Without an IMU it is a random walk. Where the person's own dead reckoning is known (a cane's), the
position goes its way and the velocity is its velocity, both turned by beta, which then is its error of yaw.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from caneflow.algorithms.quantities import (
    Angle,
    Decibels,
    DegreesOfFreedom,
    Density,
    Factor,
    Fraction,
    Length,
    Speed,
    Time,
    Zero,
)
from caneflow.algorithms.room.room_tracking import (
    DECIBEL,
    LEAST_DISTANCE,
    Echo,
    HeadingHistory,
    MotionWatch,
    RoomEstimate,
    RoomStart,
    StaticSensor,
    WayHistory,
    pattern_loss,
)

Array = NDArray[np.float64]
X, Y, U, V, BETA, GAMMA, BIASES = 0, 1, 2, 3, 4, 5, 6  # places in the state


@dataclass(frozen=True, kw_only=True)
class RoomEkfSettings:
    """Noise of the model and of the measurements; docs/methods/room.md says where each number comes from."""

    use_speed: bool = True
    use_strength: bool = True
    use_heading: bool = True
    use_steps: bool = True  # the IMU's steps tell standing from lost; false, or no accelerometer: the sensors must
    walk_noise: Density = 1.1  # m/s/sqrt(s), without an IMU, on each axis
    walk_time: Time = 2.0  # s, in which it comes back to 0
    along_noise: Density = 0.6  # m/s/sqrt(s), with an IMU, along the heading
    along_time: Time = 2.0  # s, in which it comes back to the usual speed
    usual_speed: Speed | Zero = 0.9  # m/s, of someone who walks
    across_noise: Density = 0.3  # m/s/sqrt(s), with an IMU, across it
    across_speed: Speed = 0.1  # m/s, sd of the speed across the heading
    yaw_error: Angle | Zero = math.radians(7.0)  # rad, sd of beta
    yaw_time: Time = 20.0  # s, correlation of beta
    speed_error: Speed = 0.12  # m/s
    speed_share: Fraction = 0.6  # of an echo that is new: windows overlap
    strength_error: Decibels = 4.0  # dB, fast fading
    strength_share: Fraction = 0.3
    bias_error: Decibels | Zero = 1.5  # dB, sd of b
    bias_time: Time = 5.0  # s, correlation of b
    gamma: Annotated[float, Ge(-10), Le(10)] = 0.0  # expected
    gamma_error: Fraction | Zero = 0.0
    reference_range: Length = 6.0  # m, where k is right whatever gamma
    range_error: Factor = 0.1  # m, of sensors that measure it
    edge_error: Length = 1.0  # m, sd of how far beyond the area's edge someone may be
    edge_share: Fraction | Zero = 0.05  # of what being beyond it says against a member of a bank, per echo
    degrees: DegreesOfFreedom = 4.0  # of freedom of the Student-t that all errors are taken to have
    gate: Annotated[float, Gt(1), Le(1000)] = 5.0  # sd beyond which a measurement is discarded
    way_noise: Density = 0.1  # m/sqrt(s), of dead reckoning
    way_turn_noise: Density = math.radians(2.0)  # rad/sqrt(s), of its yaw: iron in a room, or drift
    way_time: Time = 0.8  # s over which its velocity is averaged: a cane swings
    way_speed_error: Speed = 0.25  # m/s, sd of each component of that mean, in a bend above all
    hold_after: Time = 0.7  # s with hardly a valid echo, after which the position is held
    hold_decay: Time = 0.3  # s, the velocity's then
    hold_speed: Speed | Zero = 0.3  # m/s, sd of each component of the velocity then
    hold_noise: Density = 0.3  # m/sqrt(s), of the position then
    set_off_speed: Speed | Zero = 0.5  # m/s along the heading, with an IMU, of who begins to walk
    set_off_error: Speed = 0.4  # m/s, its sd
    start_speed: Speed = 0.7  # m/s, sd of each component before anything is known
    heading_timeout: Time = 0.5  # s, after which the IMU counts as silent


class RoomEkf:
    """Takes headings and echoes as they come; stands at the time of the last echo."""

    def __init__(
        self,
        settings: RoomEkfSettings,
        sensors: Mapping[str, StaticSensor],
        start: RoomStart,
    ) -> None:
        self._settings = settings
        self._sensors = dict(sensors)
        self._place = {name: BIASES + index for index, name in enumerate(self._sensors)}
        self._area = start.area
        self._headings = HeadingHistory()
        self._way = WayHistory()
        self._motion = MotionWatch(settings.hold_after, settings.heading_timeout)
        self._now_ns: int | None = None
        self._crossed_ns: int | None = None  # when the heading was last used
        self._held = False  # whether the person did not move, the last time
        self.discarded = 0
        self.log_likelihood = 0.0  # of all that was measured, up to a constant: what a bank weighs its members by
        size = BIASES + len(self._sensors)
        self.state = np.zeros(size)
        self.state[:2], error = start.moments()
        self.state[GAMMA] = settings.gamma
        spread = np.full(size, settings.bias_error)
        spread[:BIASES] = (
            *error,
            settings.start_speed,
            settings.start_speed,
            settings.yaw_error,
            settings.gamma_error,
        )
        self.covariance = np.diag(spread**2)

    @property
    def moving(self) -> bool:
        """Whether some sensor has seen something move not long before."""
        return self._now_ns is None or self._motion.moving(self._now_ns)

    def heading(self, stamp_ns: int, yaw: float, standing: bool | None = None) -> None:
        """Take the direction that the person faces, rad in R0, and whether they stand, where it is known."""
        if self._settings.use_heading:
            self._headings.add(stamp_ns, yaw)
            self._motion.steps(stamp_ns, standing if self._settings.use_steps else None)

    def walked(self, stamp_ns: int, place: tuple[float, float]) -> None:
        """Take where the person is by dead reckoning of their own, m, axes as R0, origin anywhere."""
        self._way.add(stamp_ns, place)

    def echo(self, sensor: str, echo: Echo) -> None:
        """Take what a sensor saw."""
        self.count(echo)
        if self.take_place(sensor, echo):
            self.take_speed(sensor, echo)

    def count(self, echo: Echo) -> None:
        """Take whether anything moves; members of a bank share what is known of it."""
        self._motion.echo(echo.stamp_ns, echo.valid)

    def take_place(self, sensor: str, echo: Echo) -> bool:
        """Go on to the time of an echo and take what it says of the place; whether it says anything of the speed."""
        self._advance(echo.stamp_ns)
        if not echo.valid:
            return False
        if echo.range is not None:
            self._take_range(self._sensors[sensor], echo.range)
        if self._motion.standing(echo.stamp_ns):  # a limb, a sway, or noise
            return False
        if self._settings.use_strength and echo.strength is not None:
            self._take_strength(sensor, echo.strength)
        return self._settings.use_speed

    def estimate(self, stamp_ns: int) -> RoomEstimate:
        """The state, predicted to `stamp_ns`."""
        state, covariance = self.state, self.covariance
        if self._now_ns is not None and stamp_ns > self._now_ns:
            state, covariance = self._predicted(stamp_ns, self._motion.moving(stamp_ns))
        return RoomEstimate(
            (float(state[X]), float(state[Y])), (float(state[U]), float(state[V])), covariance[:4, :4].copy()
        )

    def _advance(self, stamp_ns: int) -> None:
        if self._now_ns is None:
            self._now_ns = stamp_ns
            return
        if stamp_ns <= self._now_ns:
            return
        moving = self._motion.moving(stamp_ns)
        self.state, self.covariance = self._predicted(stamp_ns, moving)
        self._now_ns = stamp_ns
        if moving and self._heading_known(stamp_ns) and not self._way_known(stamp_ns):
            if self._held:
                self._set_off(stamp_ns)
            self._take_heading(stamp_ns)
        self._held = not moving
        self._stay_inside()

    def _heading_known(self, stamp_ns: int) -> bool:
        return self._headings.age(stamp_ns) < self._settings.heading_timeout

    def _way_known(self, stamp_ns: int) -> bool:
        return self._way.age(stamp_ns) < self._settings.heading_timeout

    def _predicted(self, stamp_ns: int, moving: bool) -> tuple[Array, Array]:
        assert self._now_ns is not None
        s = self._settings
        dt = (stamp_ns - self._now_ns) * 1e-9
        size = len(self.state)
        f, q, drift = np.eye(size), np.zeros((size, size)), np.zeros(size)
        if self._way_known(stamp_ns):
            self._go_the_way(stamp_ns, dt, f, q, drift)
        elif not moving:
            self._hold(dt, f, q)
        elif self._heading_known(stamp_ns):
            self._walk_along(stamp_ns, dt, f, q, drift)
        else:
            self._walk_anywhere(dt, f, q)
        if self._way_known(stamp_ns):
            q[BETA, BETA] = s.way_turn_noise**2 * dt
        else:
            f[BETA, BETA] = math.exp(-dt / s.yaw_time)
            q[BETA, BETA] = (1.0 - f[BETA, BETA] ** 2) * s.yaw_error**2
        keep = math.exp(-dt / s.bias_time)
        for place in self._place.values():
            f[place, place] = keep
            q[place, place] = (1.0 - keep**2) * s.bias_error**2
        return f @ self.state + drift, f @ self.covariance @ f.T + q

    def _hold(self, dt: float, f: Array, q: Array) -> None:
        """Nothing moves, or nobody sees it: the velocity dies away, the position may creep."""
        decay = math.exp(-dt / self._settings.hold_decay)
        f[U, U] = f[V, V] = decay
        f[X, U] = f[Y, V] = self._settings.hold_decay * (1.0 - decay)
        q[X, X] = q[Y, Y] = self._settings.hold_noise**2 * dt
        q[U, U] = q[V, V] = (1.0 - decay**2) * self._settings.hold_speed**2

    def _walk_anywhere(self, dt: float, f: Array, q: Array) -> None:
        """Without an IMU: a random walk of the velocity that comes back to 0."""
        s = self._settings
        decay = math.exp(-dt / s.walk_time)
        f[X, U] = f[Y, V] = s.walk_time * (1.0 - decay)
        f[U, U] = f[V, V] = decay
        q[U, U] = q[V, V] = s.walk_noise**2 * dt
        q[X, X] = q[Y, Y] = q[U, U] * dt * dt / 3.0

    def _walk_along(self, stamp_ns: int, dt: float, f: Array, q: Array, drift: Array) -> None:
        """With an IMU: the velocity turns with it, and comes back to the usual speed along the heading."""
        assert self._now_ns is not None
        s = self._settings
        travel = self._headings.travel(self._now_ns, stamp_ns)
        decay = math.exp(-dt / s.along_time)
        first = travel.yaw - travel.turned
        c, n = math.cos(first), math.sin(first)
        along, aside = c * travel.east + n * travel.north, c * travel.north - n * travel.east
        f[X, U], f[X, V], f[Y, U], f[Y, V] = along, -aside, aside, along
        c, n = decay * math.cos(travel.turned), decay * math.sin(travel.turned)
        f[U, U], f[U, V], f[V, U], f[V, V] = c, -n, n, c
        yaw = travel.yaw + float(self.state[BETA])
        c, n = math.cos(yaw), math.sin(yaw)
        gained = (1.0 - decay) * s.usual_speed
        drift[U], drift[V] = gained * (c + n * self.state[BETA]), gained * (n - c * self.state[BETA])
        f[U, BETA], f[V, BETA] = -gained * n, gained * c
        a, b = s.along_noise**2 * dt, s.across_noise**2 * dt
        q[U, U], q[V, V] = a * c * c + b * n * n, a * n * n + b * c * c
        q[U, V] = q[V, U] = (a - b) * c * n
        q[X, X], q[Y, Y] = q[U, U] * dt * dt / 3.0, q[V, V] * dt * dt / 3.0

    def _go_the_way(self, stamp_ns: int, dt: float, f: Array, q: Array, drift: Array) -> None:
        """With dead reckoning: its way and its velocity, turned by beta."""
        assert self._now_ns is not None
        s = self._settings
        beta = float(self.state[BETA])
        c, n = math.cos(beta), math.sin(beta)
        f[U, U] = f[V, V] = 0.0
        east, north = self._way.between(self._now_ns, stamp_ns)
        u, v = self._way.velocity(stamp_ns, round(s.way_time * 1e9))
        for place, (x, y) in ((X, (east, north)), (U, (u, v))):
            ahead, aside = c * x - n * y, n * x + c * y
            f[place, BETA], f[place + 1, BETA] = -aside, ahead
            drift[place], drift[place + 1] = ahead + aside * beta, aside - ahead * beta
        q[X, X] = q[Y, Y] = s.way_noise**2 * dt
        q[U, U] = q[V, V] = s.way_speed_error**2

    def _set_off(self, stamp_ns: int) -> None:
        """Whoever walks again walks ahead: what was left of the velocity says nothing, and its sign may be wrong."""
        s = self._settings
        yaw = self._headings.travel(stamp_ns, stamp_ns).yaw + float(self.state[BETA])
        c, n = math.cos(yaw), math.sin(yaw)
        self.state[U], self.state[V] = s.set_off_speed * c, s.set_off_speed * n
        a, b = s.set_off_error**2, s.across_speed**2
        self.covariance[[U, V], :] = self.covariance[:, [U, V]] = 0.0
        self.covariance[U, U], self.covariance[V, V] = a * c * c + b * n * n, a * n * n + b * c * c
        self.covariance[U, V] = self.covariance[V, U] = (a - b) * c * n

    def _take_heading(self, stamp_ns: int) -> None:
        """The velocity is along the heading: what it has across is 0, and what it has along is not negative."""
        dt = 0.05 if self._crossed_ns is None else (stamp_ns - self._crossed_ns) * 1e-9
        self._crossed_ns = stamp_ns
        yaw = self._headings.travel(stamp_ns, stamp_ns).yaw + float(self.state[BETA])
        c, n = math.cos(yaw), math.sin(yaw)
        u, v = float(self.state[U]), float(self.state[V])
        # one measurement of this error per 0.25 s, however often it is made
        noise = self._settings.across_speed**2 * 0.25 / max(dt, 1e-3)
        h = np.zeros(len(self.state))
        h[U], h[V], h[BETA] = -n, c, -(c * u + n * v)
        self._correct(h, n * u - c * v, noise)
        along = c * float(self.state[U]) + n * float(self.state[V])
        if along < 0.0:  # nobody walks backwards for long; and the sensors' mirror image is walked in just so
            h[U], h[V], h[BETA] = c, n, c * v - n * u
            self._correct(h, -along, noise)

    def _stay_inside(self) -> None:
        """Whoever is found outside of the area is drawn to its edge."""
        if self._area is None:
            return
        for place, low, high in ((X, self._area[0], self._area[1]), (Y, self._area[2], self._area[3])):
            at = float(self.state[place])
            beyond = min(at - low, 0.0) + max(at - high, 0.0)
            if beyond:
                variance = self._settings.edge_error**2 + float(self.covariance[place, place])
                self.log_likelihood -= self._settings.edge_share * 0.5 * beyond**2 / variance
                h = np.zeros(len(self.state))
                h[place] = 1.0
                self._correct(h, -beyond, self._settings.edge_error**2)

    def _sight(self, sensor: StaticSensor) -> tuple[float, float, float]:
        """Distance to the person, and the direction to them."""
        dx, dy = float(self.state[X]) - sensor.position[0], float(self.state[Y]) - sensor.position[1]
        distance = max(math.hypot(dx, dy), LEAST_DISTANCE)
        return distance, dx / distance, dy / distance

    def _take_range(self, sensor: StaticSensor, measured: float) -> None:
        distance, ex, ey = self._sight(sensor)
        h = np.zeros(len(self.state))
        h[X], h[Y] = ex, ey
        self._correct_robustly(h, measured - distance, self._settings.range_error**2)

    def _take_strength(self, name: str, measured: float) -> None:
        s = self._settings
        sensor = self._sensors[name]
        if sensor.k is None:
            return
        distance, ex, ey = self._sight(sensor)
        off = math.remainder(math.atan2(ey, ex) - sensor.azimuth, math.tau)
        gamma = float(self.state[GAMMA])
        ratio = DECIBEL * math.log(distance / s.reference_range)
        expected = (
            DECIBEL * math.log(sensor.k)
            - 4.0 * DECIBEL * math.log(distance)
            - pattern_loss(off)
            + gamma * ratio
            + float(self.state[self._place[name]])
        )
        slope = (gamma - 4.0) * DECIBEL / distance
        turn = -2.0 * DECIBEL * math.tan(min(max(off, -1.3), 1.3)) / distance
        h = np.zeros(len(self.state))
        h[X], h[Y] = slope * ex - turn * ey, slope * ey + turn * ex
        h[GAMMA] = ratio
        h[self._place[name]] = 1.0
        self._correct_robustly(h, measured - expected, s.strength_error**2 / s.strength_share)

    def take_speed(self, name: str, echo: Echo) -> None:
        """Take the radial speed that a sensor saw; of an unsigned one both signs as far as they are likely."""
        s, sensor = self._settings, self._sensors[name]
        distance, ex, ey = self._sight(sensor)
        u, v = float(self.state[U]), float(self.state[V])
        expected = u * ex + v * ey
        h = np.zeros(len(self.state))
        h[U], h[V] = ex, ey
        h[X], h[Y] = (u - expected * ex) / distance, (v - expected * ey) / distance
        noise = s.speed_error**2 / s.speed_share
        if echo.signed:
            self._correct_robustly(h, echo.range_rate - expected, noise)
            return
        variance = float(h @ self.covariance @ h) + noise
        away, towards = echo.range_rate - expected, -echo.range_rate - expected
        if min(abs(away), abs(towards)) > s.gate * math.sqrt(variance):  # their mean may fit where neither does
            self.discarded += 1
            return
        # how much likelier one sign is than the other; both are taken as far as they are likely
        odds = math.exp(min(max(0.5 * (away**2 - towards**2) / variance, -50.0), 50.0))
        share = 1.0 / (1.0 + odds)  # of `away`
        mean = share * away + (1.0 - share) * towards
        self._correct_robustly(h, mean, noise, spread=share * (1.0 - share) * (away - towards) ** 2)

    def _correct_robustly(self, h: Array, residual: float, noise: float, spread: float = 0.0) -> None:
        """Student-t: the larger the residual, the less it is believed; none at all beyond the gate."""
        variance = float(h @ self.covariance @ h) + noise
        normalized = residual / math.sqrt(variance)
        nu = self._settings.degrees
        if abs(normalized) > self._settings.gate:  # the same for all members of a bank, however wide
            self.log_likelihood -= 0.5 * (nu + 1.0) * math.log1p(self._settings.gate**2 / nu)
            self.discarded += 1
            return
        self.log_likelihood -= 0.5 * (math.log(variance) + (nu + 1.0) * math.log1p(normalized**2 / nu))
        noise *= max((nu + normalized**2) / (nu + 1.0), 1.0)
        self._correct(h, residual, noise, spread)

    def _correct(self, h: Array, residual: float, noise: float, spread: float = 0.0) -> None:
        ph = self.covariance @ h
        variance = float(h @ ph) + noise
        gain = ph / variance
        self.state = self.state + gain * residual
        # P - K S K' is symmetric by construction; `spread` is what the choice between two signs leaves open
        self.covariance = self.covariance - np.outer(gain, gain) * (variance - spread)
