"""`method: best`: radar velocity, IMU and magnetic field into a track (docs/methods/best.md).

Velocity is estimated in the gyro's frame (walk_motion.py), the heading of that frame and the track by weighing many
gyro errors against the magnetic field (heading_hypotheses.py), height by itself (heave.py).
"""

import cmath
import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.cane.heading_hypotheses import Heading, HeadingHypotheses, HeadingSettings
from caneflow.algorithms.cane.sideways_spread import SidewaysSpread, SidewaysSpreadSettings
from caneflow.algorithms.cane.speed_gate import StatedVariance
from caneflow.algorithms.cane.swing_marks import SwingMarks
from caneflow.algorithms.cane.walk_motion import Axes, WalkMotion, WalkMotionSettings
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.gyro_yaw import GyroYaw
from caneflow.algorithms.inertial.heave import HeaveObserver, HeaveSettings
from caneflow.algorithms.inertial.imu_sample import (
    LONGEST_INTERVAL,
    SampleClock,
    heading_of,
    required_orientation,
    world_acceleration,
)
from caneflow.algorithms.inertial.standing import StandingDetector, StandingSettings
from caneflow.algorithms.quantities import Angle, Density, Factor, Fraction, Length, Offset, Speed, Time, TurnRate, Zero
from caneflow.algorithms.rotations import Quaternion, Vector, from_yaw, multiply, normalized, rotate


@dataclass(frozen=True, kw_only=True)
class CaneFilterSettings:
    """What the filter may be told; units on each line."""

    # s over which radar velocities err alike (their window, and the speckle they stand on): as white noise, those
    # that come more often are worth less each. Neighbours 50 ms apart correlate by 0.25 to 0.35, so each is worth half
    velocity_correlation: Time = 0.1
    # m/s, sd of a radar velocity at the least, whatever it states: the best of 20 walks was 0.02
    velocity_error: Speed = 0.015
    # of the sideways speed, sd of a radar velocity beside what it states: the beam's azimuths then close unlike, and
    # which of them are lit is chance
    sideways_share: Factor | Zero = 0.14
    hole: Time = 0.12  # s between IMU samples, from which on acceleration and turn rate are not interpolated
    hole_speed: Speed = 0.15  # m/s, sd of what the hand's velocity changes over a hole (estimators.md)
    hole_speed_time: Time = 0.3  # s in which it changes by that much; as a random walk, over other holes
    longest_hole: Time = 1.5  # s, from which on the velocity is as unknown as at the start
    hole_turn: TurnRate = math.radians(1.0)  # rad/s, sd of the rate at which the chip's yaw errs over a hole
    disagreement: Time = 1.0  # s of outliers alone, after which the radar is believed again
    speed_noise: Density = 0.5  # m/s, of the paper's speed, where it is all there is (kalman.md)
    speed_patience: Time = 0.5  # s without a velocity before the paper's speed is taken instead
    # m/s per sqrt(s), by which the velocity may go astray beside what the filter knows of the accelerometer, while no
    # radar tells it: the chip's tilt and what the last velocities before a silence had wrong
    unseen_drift: Speed = 0.1
    # m/s, sd of the hand's velocity across the way the cane points; with what the ways below say, chosen on walks of
    # another simulator
    sideways: Speed = 0.15
    sideways_interval: Time = 0.1  # s
    sideways_memory: Time = 1.0  # s over which swinging and turning are noticed
    sideways_per_turn: Length | Zero = 0.7  # m: (m/s) of doubt per (rad/s) of swinging or turning
    way_error: Length = 0.05  # m, sd of the hand's way across the mean direction of the cane over a full swing
    way_share: Factor | Zero = 0.15  # of that way, sd beside it
    way_per_turn: Length | Zero = 0.3  # m, sd per rad by which the body turned meanwhile
    swing_back: Angle = math.radians(4.0)  # rad that the cane goes back before it counts as having turned
    hand_ahead: Offset = 0.3  # m that the hand is carried ahead of the body: it goes sideways when the body turns
    standing_speed: Speed = 0.03  # m/s, sd of the sensors' while the bearer stands
    standing_inflation: Factor = 20.0  # samples that share one drift of the hand
    radar_standing: Speed = 0.2  # m/s, radar speed above which nobody stands, whatever the IMU says
    speed_scale: Fraction | Zero = 0.012  # sd of the radar's scale: 1 cm of height; only in the covariance
    heading_interval: Time = 0.1  # s between updates of the tracks
    # s in which the track follows a correction: a person does not jump by millimetres twenty times a second
    correction_time: Time = 0.3
    spread: SidewaysSpreadSettings = field(default_factory=SidewaysSpreadSettings)
    standing: StandingSettings = field(default_factory=StandingSettings)
    motion: WalkMotionSettings = field(default_factory=WalkMotionSettings)
    heading: HeadingSettings = field(default_factory=HeadingSettings)
    heave: HeaveSettings = field(default_factory=HeaveSettings)


Floats = NDArray[np.float64]


class _Instant(NamedTuple):
    """What a velocity that comes late is compared with; horizontal vectors are x + jy in the gyro's frame."""

    stamp_ns: int
    facing: complex  # unit vector, the boresight's projection
    gained: complex  # m/s, by the accelerometer since the start
    lever: complex  # m/s, of the antenna about the IMU


class _Measured(NamedTuple):
    stamp_ns: int
    delay: float  # s
    forward: float  # m/s
    left: float  # m/s
    xx: float  # (m/s)^2
    yy: float  # (m/s)^2

    @property
    def of_ns(self) -> int:
        """The time that it belongs to."""
        return self.stamp_ns - round(self.delay * 1e9)


class _Spread(NamedTuple):
    stamp_ns: int
    of_ns: int  # the time that it belongs to
    spread: float  # m/s


_HISTORY: Final = 64  # IMU samples that a velocity may come late
_LARGEST_SPREAD: Final = 2.0  # m/s; what is wider is not ground
_LONGEST_SPREAD: Final = 0.6  # s by which it may lag: as far as the history reaches
_VERTICAL: Final = 1e-6  # horizontal part of a unit vector, below which it has no direction
_UNOBSERVED: Final = 1e5  # (m/s)^2, from which on a component says nothing
_POINTING_TIME: Final = 0.2  # s
_SHORTEST_GROWTH: Final = 0.5  # s


class CaneFilter(DeadReckoning):
    """Ground velocities, magnetic field and IMU samples in, one estimate per IMU sample out."""

    def __init__(
        self,
        settings: CaneFilterSettings,
        *,
        boresight: Vector,
        pivot: Vector = (0.0, -0.3, 0.0),
        antenna: Vector = (0.0, 0.0, 0.0),
        motion: WalkMotion | None = None,
    ) -> None:
        """For a rig: `boresight`, `pivot` (m, IMU to hand) and `antenna` (m, from the IMU), all in the body frame.

        `motion` takes the place of the filter's own, for who wants to look into it (cane_smoother.py).
        """
        self._settings = settings
        self._boresight, self._pivot, self._antenna = boresight, pivot, antenna
        self._clock = SampleClock()
        self._yaw = GyroYaw()
        self._standing = StandingDetector(settings.standing)
        self._pointing = _Pointing(settings.sideways_memory)
        self._swing = SwingMarks(settings.swing_back)
        self._motion = motion or WalkMotion(settings.motion)
        self.heading = HeadingHypotheses(settings.heading)
        self._heave = HeaveObserver(settings.heave)
        self._start_height: float | None = None  # m, None before the first sample
        self._waiting: deque[_Measured] = deque(maxlen=16)
        self._waiting_spreads: deque[_Spread] = deque(maxlen=4)
        self._spread = SidewaysSpread(settings.spread)
        self._history: deque[_Instant] = deque(maxlen=_HISTORY)
        self._gained = 0j  # m/s since the start
        self._acceleration = 0j  # m/s^2 in the gyro's frame, of the last sample
        self._last_velocity_ns: int | None = None
        self._disagree_ns: int | None = None  # stamp of the first of the outliers that the last velocities were
        self._facing = 1.0 + 0j  # the boresight's projection in the gyro's frame, as of the last sample
        self._arm = self._arm_speed = 0j  # m, m/s in the gyro's frame: from the IMU to the hand, as of the last sample
        self._turns = _TurnDoubt()
        self._lonely = False  # the last velocity came after a silence
        self._forward_variance = StatedVariance(settings.speed_noise**2)
        self._left_variance = StatedVariance(math.inf)
        self._radar_speed = 0.0  # m/s, the last
        self._since_heading = self._since_sideways = 0.0  # s
        self._correction = 0j  # m in the gyro's frame, by which the track has yet to move
        self._local = 0j  # m, the track that never leaps
        self._local_covariance: Floats = np.zeros((2, 2))  # m^2, of it at the last mark; grows as the way's does
        self._local_growth: Floats = np.zeros((2, 2))  # m^2/s, since then
        self._since_mark = 0.0  # s
        self._local_yaw = 0.0  # rad, its frame's to be added to the gyro's
        self._chip: Quaternion = (1.0, 0.0, 0.0, 0.0)  # orientation of the last sample

    @property
    def gaps(self) -> int:
        """How many intervals between IMU samples were longer than LONGEST_INTERVAL."""
        return self._clock.gaps

    @property
    def gyro_bias(self) -> float:
        """Bias of the gyro about the vertical as the filter has it, rad/s."""
        return self.heading.bias

    @property
    def yaw_offset(self) -> float:
        """The gyro's yaw less the chip's, rad."""
        return self._yaw.offset

    def speed(self, stamp_ns: int, speed: float, quality: float, valid: bool, delay: float | None) -> None:
        """Take the paper's speed (m/s), which counts only where no velocity comes."""
        last_ns = self._last_velocity_ns
        if not valid or (last_ns is not None and stamp_ns - last_ns < self._settings.speed_patience * 1e9):
            return
        self._waiting.append(_Measured(stamp_ns, delay or 0.0, speed, 0.0, self._settings.speed_noise**2, math.inf))

    def velocity(
        self,
        stamp_ns: int,
        velocity: tuple[float, float],
        covariance: tuple[float, float, float],
        delay: float | None,
    ) -> None:
        """Take a velocity along the boresight's projection and to its left (m/s), with xx, xy, yy ((m/s)^2)."""
        (forward, left), (xx, _, yy) = velocity, covariance
        if min(xx, yy) < _UNOBSERVED:
            if velocity != (0.0, 0.0):  # at rest every component is seen, and as well as ever
                xx, yy = self._forward_variance.believed(xx), self._left_variance.believed(yy)
            least = self._settings.velocity_error**2
            xx, yy = max(xx, least), max(yy, least)
            last_ns, self._last_velocity_ns = self._last_velocity_ns, stamp_ns
            since = (stamp_ns - last_ns) * 1e-9 if last_ns is not None else math.inf
            share = min(since / self._settings.velocity_correlation, 1.0)
            # the first after a silence may be a wild one, which the next will show; at rest that does no harm
            was_lonely = self._lonely
            self._lonely = lonely = since > self._settings.speed_patience and velocity != (0.0, 0.0)
            if share > 0.0 and (was_lonely or not lonely):
                self._waiting.append(_Measured(stamp_ns, delay or 0.0, forward, left, xx / share, yy / share))

    def spread(self, stamp_ns: int, spread: float, delay: float | None) -> None:
        """Take the width of the Doppler as the sideways speed that it would come from, m/s; one of a hand."""
        if 0.0 <= spread <= _LARGEST_SPREAD and (delay or 0.0) <= _LONGEST_SPREAD:
            self._waiting_spreads.append(_Spread(stamp_ns, stamp_ns - round((delay or 0.0) * 1e9), spread))

    def imu(self, stamp_ns: int, reading: ImuReading) -> PoseEstimate:
        """The estimate at `stamp_ns`.

        Raises ValueError without an orientation, without any acceleration, or when time does not go on.
        """
        gyro = reading.gyro
        orientation = normalized(required_orientation(reading.orientation, "best"))
        in_chips_frame = world_acceleration(orientation, reading, "best")
        elapsed = self._clock.interval(stamp_ns) or 0.0
        interval = elapsed if elapsed <= min(self._settings.hole, LONGEST_INTERVAL) else 0.0
        stands = self._standing.update(stamp_ns, gyro, in_chips_frame)
        self._lift(elapsed, interval, in_chips_frame[2], orientation)

        chip_cos, chip_sin = heading_of(orientation, self._boresight)
        if elapsed > interval:
            self._yaw.bridge(elapsed)
        self._yaw.update(interval, orientation, gyro, chip_cos, chip_sin)
        turn = cmath.rect(1.0, self._yaw.offset)  # from the chip's frame to the gyro's
        facing = turn * complex(chip_cos, chip_sin)
        before = complex(*self._motion.position)
        acceleration = turn * complex(*in_chips_frame[:2])
        arm = turn * _horizontal(rotate(orientation, self._pivot))
        arm_speed = turn * _horizontal(rotate(orientation, _cross(gyro, self._pivot)))
        if elapsed > interval:
            self._bridge(stamp_ns, elapsed, arm, arm_speed)
        else:
            self._predict(interval, acceleration, _level_axes(turn, orientation))
        self._acceleration, self._arm, self._arm_speed = acceleration, arm, arm_speed
        self._facing = facing
        moved = complex(*self._motion.position) - before
        turned = self._pointing.update(interval, cmath.phase(facing))
        self._remember(stamp_ns, turn, facing, orientation, gyro)
        self._take_velocities(stamp_ns)
        self._take_spreads(stamp_ns)
        self._open_while_unseen(stamp_ns, interval)
        self._use_gait(interval, stands, turn, orientation, gyro)
        if self._swing.update(elapsed, turned):
            self._use_way()
        self._correction += complex(*self._motion.position) - before - moved
        shown = self._correction * min(elapsed / self._settings.correction_time, 1.0)
        self._correction -= shown

        self.heading.move(elapsed, turned, moved.real + shown.real, moved.imag + shown.imag)
        self._follow_local(elapsed, turned, moved + shown, orientation)
        if self._turns.variance > 0.0:
            self._turns.move(moved + shown)
        self._see_field(orientation, reading.mag)
        self._since_heading += elapsed
        if self._since_heading >= self._settings.heading_interval:
            self._follow_heading()
        return self._estimate(orientation)

    def local(self) -> PoseEstimate:
        """The pose as of the last sample in a frame that is never laid again: for a map of the last seconds.

        What is learnt of the gyro turns what comes, and not what was. The frame drifts away from R0 as the gyro does.
        The growth of the position's covariance between two poses is that of the way between them, over 1 to 5 s, in
        the heading of the first; the velocity's is that of the velocity, and what they share is not told.
        """
        turn = cmath.rect(1.0, self._local_yaw)
        velocity = turn * complex(*self._motion.velocity)
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = self._local_covariance + self._since_mark * self._local_growth
        covariance[3:5, 3:5] = _turned(self._motion.covariance[2:4, 2:4], turn)
        covariance[2, 2], covariance[5, 5] = self._heave.height_variance, self._heave.rate_variance
        return PoseEstimate(
            position=(self._local.real, self._local.imag, self._heave.height - (self._start_height or 0.0)),
            velocity=(velocity.real, velocity.imag, self._heave.rate),
            orientation=multiply(from_yaw(self._yaw.offset + self._local_yaw), self._chip),
            covariance=covariance,
        )

    def _follow_local(self, elapsed: float, turned: float, moved: complex, orientation: Quaternion) -> None:
        """Go on by what the cane `turned` (rad) and `moved` (m) in the gyro's frame."""
        bias, scale = self.heading.drift
        self._local_yaw -= bias * elapsed + scale * turned
        self._local += cmath.rect(1.0, self._local_yaw) * moved
        self._since_mark += elapsed
        self._chip = orientation

    def _grow_local(self, elapsed: float | None) -> None:
        """From now on the local covariance grows as that of the way in the last `elapsed` s did.

        Where nobody knows, as if the velocity were wrong by its own sd for a second.
        """
        self._local_covariance = self._local_covariance + self._since_mark * self._local_growth
        self._since_mark = 0.0
        if elapsed is None:
            growth = self._motion.covariance[2:4, 2:4]
        else:
            growth = self._motion.way_covariance / max(elapsed, _SHORTEST_GROWTH)
        self._local_growth = _turned(growth, cmath.rect(1.0, self._local_yaw))

    def _lift(self, elapsed: float, interval: float, acceleration: float, orientation: Quaternion) -> None:
        """Up and down; the hand's height is the zero, because only changes of height are given out."""
        height = -rotate(orientation, self._pivot)[2]
        if elapsed > interval:
            self._heave.bridge(elapsed)
        self._heave.update(interval, acceleration, height)
        if self._start_height is None:
            self._start_height = height

    def _predict(self, interval: float, acceleration: complex, axes: Axes) -> None:
        mean = 0.5 * (acceleration + self._acceleration)
        if interval > 0.0:
            self._gained += self._motion.predict(interval, mean, axes)

    def _bridge(self, stamp_ns: int, elapsed: float, arm: complex, arm_speed: complex) -> None:
        """Over a hole in the samples the hand goes on at its velocity, and the sensors turn about it."""
        s = self._settings
        speed_error = s.hole_speed * math.sqrt(elapsed / s.hole_speed_time)
        gained = self._arm_speed - arm_speed
        moved = elapsed * self._arm_speed + self._arm - arm
        if elapsed <= s.longest_hole:
            self._motion.bridge(elapsed, moved, gained, speed_error)
        else:
            self._motion.coast(elapsed)
            self._swing.forget()
            self._grow_local(None)
        self._gained += gained
        variance = (s.hole_turn * elapsed) ** 2
        self.heading.doubt(variance)
        self._turns.variance += variance
        # what the radar measured in the hole belongs to an attitude that nobody knows
        began_ns = stamp_ns - round(elapsed * 1e9)
        self._waiting = deque((each for each in self._waiting if each.of_ns <= began_ns), self._waiting.maxlen)

    def _remember(self, stamp_ns: int, turn: complex, facing: complex, orientation: Quaternion, gyro: Vector) -> None:
        lever = turn * _horizontal(rotate(orientation, _cross(gyro, self._antenna)))
        self._history.append(_Instant(stamp_ns, facing, self._gained, lever))

    def _take_velocities(self, before_ns: int) -> None:
        """Correct by what waits with a stamp before this sample's: so the order of delivery does not matter."""
        while self._waiting and self._waiting[0].stamp_ns < before_ns:
            measured = self._waiting.popleft()
            then = self._instant(measured.of_ns)
            since = self._gained - then.gained - then.lever  # from the antenna's velocity then to the IMU's now
            if not abs(then.facing) > _VERTICAL:
                continue  # a boresight that points straight up or down tells no direction
            facing = then.facing / abs(then.facing)
            sideways = ((complex(*self._motion.velocity) - since) / (facing * 1j)).real
            doubt = (self._settings.sideways_share * sideways) ** 2
            sides = ((facing, measured.forward, measured.xx + doubt), (facing * 1j, measured.left, measured.yy))
            for direction, value, variance in sides:
                if variance < _UNOBSERVED:
                    self._observe(measured.stamp_ns, direction, value + (since * direction.conjugate()).real, variance)
            self._radar_speed = measured.forward

    def _take_spreads(self, before_ns: int) -> None:
        """Correct the sideways speed by the Doppler's width, which has no sign: the filter's."""
        while self._waiting_spreads and self._waiting_spreads[0].stamp_ns < before_ns:
            measured = self._waiting_spreads.popleft()
            then = self._instant(measured.of_ns)
            if not abs(then.facing) > _VERTICAL:
                continue
            left = then.facing / abs(then.facing) * 1j
            since = self._gained - then.gained - then.lever
            velocity = (complex(*self._motion.velocity) - since) / left
            found = self._spread.update(measured.of_ns, measured.spread, -velocity.imag, velocity.real)
            if found is not None:
                value = found.speed + (since * left.conjugate()).real
                self._motion.observe_velocity((left.real, left.imag), value, found.variance)

    def _observe(self, stamp_ns: int, direction: complex, value: float, variance: float) -> None:
        """Correct by the radar. When the filter has called all it says an outlier for long, the filter is wrong."""
        along = direction.real, direction.imag
        if self._motion.observe_velocity(along, value, variance) < self._settings.motion.outlier:
            self._disagree_ns = None
            return
        if self._disagree_ns is None:
            self._disagree_ns = stamp_ns
        lasting = (stamp_ns - self._disagree_ns) * 1e-9
        if lasting > self._settings.disagreement:
            vx, vy = self._motion.velocity
            self._motion.doubt(abs(value - along[0] * vx - along[1] * vy), lasting)
            self._motion.observe_velocity(along, value, variance)
            self._disagree_ns = None

    def _instant(self, stamp_ns: int) -> _Instant:
        """Between the samples about a time; the oldest kept when that is not as old."""
        newer = self._history[-1]
        for older in reversed(self._history):
            if older.stamp_ns <= stamp_ns:
                if newer.stamp_ns == older.stamp_ns:
                    return older
                share = (stamp_ns - older.stamp_ns) / (newer.stamp_ns - older.stamp_ns)
                return _Instant(
                    stamp_ns,
                    older.facing + share * (newer.facing - older.facing),
                    older.gained + share * (newer.gained - older.gained),
                    older.lever + share * (newer.lever - older.lever),
                )
            newer = older
        return newer

    def _open_while_unseen(self, stamp_ns: int, interval: float) -> None:
        """Trust the velocity less and less while no radar tells it."""
        last_ns, patience = self._last_velocity_ns, self._settings.speed_patience
        if last_ns is not None and stamp_ns - last_ns > patience * 1e9 and interval > 0.0:
            self._motion.doubt(self._settings.unseen_drift * math.sqrt(interval), 0.0)

    def _use_gait(self, interval: float, stands: bool, turn: complex, orientation: Quaternion, gyro: Vector) -> None:
        """A bearer who stands does not move; one who walks does not move his hand sideways."""
        settings, motion = self._settings, self._motion
        self._since_sideways += interval
        if stands and abs(self._radar_speed) < settings.radar_standing:
            variance = settings.standing_speed**2 * settings.standing_inflation
            motion.observe_velocity((1.0, 0.0), 0.0, variance)
            motion.observe_velocity((0.0, 1.0), 0.0, variance)
        elif self._since_sideways >= settings.sideways_interval:
            self._since_sideways = 0.0
            ahead = cmath.rect(1.0, self._pointing.yaw + motion.pointing)
            left = ahead * 1j
            lever = turn * _horizontal(rotate(orientation, _cross(gyro, self._pivot)))
            hand = complex(*motion.velocity) + lever
            speed = (hand * ahead.conjugate()).real
            # the hand's velocity to the left of the way is what a turning body gives it; linear in beta about now
            value = settings.hand_ahead * self._pointing.rate
            value -= (lever * left.conjugate()).real + speed * motion.pointing
            variance = settings.sideways**2 + settings.sideways_per_turn**2 * self._pointing.turning
            motion.observe_velocity((left.real, left.imag), value, variance, per_pointing=-speed)

    def _use_way(self) -> None:
        """Over a full swing the hand goes where the cane pointed on average, but for what a turning body adds."""
        settings, motion, swing = self._settings, self._motion, self._swing
        since = swing.full(cmath.phase(self._facing), self._arm)
        if since is not None:
            ahead = cmath.rect(1.0, since.yaw + motion.pointing)
            left = ahead * 1j
            way = motion.way + since.arm
            along = (way * ahead.conjugate()).real
            value = settings.hand_ahead * 2.0 * math.sin(0.5 * since.turned)
            value -= (since.arm * left.conjugate()).real + along * motion.pointing
            variance = settings.way_error**2 + (settings.way_share * abs(way)) ** 2
            variance += (settings.way_per_turn * since.turned) ** 2
            motion.observe_way((left.real, left.imag), value, variance, per_pointing=-along)
        self._grow_local(None if since is None else since.elapsed)
        motion.mark()

    def _see_field(self, orientation: Quaternion, mag: Vector | None) -> None:
        """Direction of the field in the gyro's frame; without a magnetometer, of what the chip takes for north."""
        if mag is None:
            self.heading.field(self._yaw.offset, from_chip=True)
            return
        x, y, _ = rotate(orientation, mag)
        self.heading.field(math.atan2(y, x) + self._yaw.offset, from_chip=False)

    def _follow_heading(self) -> None:
        self._since_heading = 0.0
        biases = self._yaw.level_biases()
        if biases is not None:
            self.heading.level_biases(*biases)
        p = self._motion.covariance
        self.heading.advance(0.5 * float(p[0, 0] + p[1, 1]))

    def _estimate(self, orientation: Quaternion) -> PoseEstimate:
        heading = self.heading.heading()
        turn = cmath.rect(1.0, heading.yaw)
        velocity = turn * complex(*self._motion.velocity)
        rise = self._heave.height - (self._start_height or 0.0)
        settings = self._settings
        covariance = level_covariance(self._motion.covariance, heading, turn, velocity, settings.speed_scale)
        if self._turns.variance > 0.0:
            covariance += self._turns.covariance(turn, velocity)
        covariance[2, 2], covariance[5, 5] = self._heave.height_variance, self._heave.rate_variance
        return PoseEstimate(
            position=(heading.position.real, heading.position.imag, rise),
            velocity=(velocity.real, velocity.imag, self._heave.rate),
            orientation=multiply(from_yaw(self._yaw.offset + heading.yaw), orientation),
            covariance=covariance,
        )


class _Pointing:
    """Where the cane points but for its swing: two poles, and how much it swings or turns."""

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self._started = False
        self._last = 0.0
        self.yaw = 0.0  # rad, unwrapped
        self.rate = 0.0  # rad/s
        self.turning = 0.04  # (rad/s)^2, mean square

    def update(self, interval: float, yaw: float) -> float:
        """Take the boresight's yaw (rad) `interval` s later; returns how far it turned."""
        if not self._started:
            self.yaw, self._started = yaw, True
            self._last = yaw
        turned = math.remainder(yaw - self._last, 2.0 * math.pi)
        self._last = yaw
        if interval > 0.0:
            pole = 1.0 / _POINTING_TIME
            off = math.remainder(yaw - self.yaw, 2.0 * math.pi)
            self.rate += interval * pole * (pole * off - 2.0 * self.rate)
            self.yaw += interval * self.rate
            share = min(interval / self._memory, 1.0)
            self.turning += share * ((turned / interval) ** 2 - self.turning)
        return turned


class _TurnDoubt:
    """What unknown turns of the gyro's frame (over holes) do to all that comes after them."""

    def __init__(self) -> None:
        self.variance = 0.0  # rad^2, of their sum
        self._mean = 0j  # m rad, covariance of the position with that sum, in the gyro's frame
        self._xx = self._xy = self._yy = 0.0  # m^2, of the position

    def move(self, moved: complex) -> None:
        """Go on by so much (m, x + jy, in the gyro's frame): a turn moves the end of it across."""
        across, before = moved * 1j, self._mean
        self._mean = after = before + self.variance * across
        both = before + after
        self._xx += across.real * both.real
        self._yy += across.imag * both.imag
        self._xy += 0.5 * (across.real * both.imag + across.imag * both.real)

    def covariance(self, turn: complex, velocity: complex) -> Floats:
        """Of position and velocity (6, 6), turned by `turn`; `velocity` (m/s) is in R0 already."""
        rotation = np.array(((turn.real, -turn.imag), (turn.imag, turn.real)))
        across, mean = velocity * 1j, self._mean * turn
        v = np.array((across.real, across.imag))
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = rotation @ np.array(((self._xx, self._xy), (self._xy, self._yy))) @ rotation.T
        covariance[3:5, 3:5] = self.variance * np.outer(v, v)
        covariance[:2, 3:5] = np.outer((mean.real, mean.imag), v)
        covariance[3:5, :2] = covariance[:2, 3:5].T
        return covariance


def level_covariance(motion: Floats, heading: Heading, turn: complex, velocity: complex, speed_scale: float) -> Floats:
    """Of position and velocity (6, 6), nothing vertical, given out after a `turn` (cos + j sin) by the heading.

    The filter's `motion` (4, 4), what the headings add, and the radar's scale, of sd `speed_scale`: the heading's
    error turns the `velocity` (m/s, x + jy), the scale stretches the track.
    """
    turned = np.zeros((6, 4))
    turned[0, 0] = turned[1, 1] = turned[3, 2] = turned[4, 3] = turn.real
    turned[1, 0] = turned[4, 2] = turn.imag
    turned[0, 1] = turned[3, 3] = -turn.imag
    x, y = heading.position.real, heading.position.imag
    scale, yaw = speed_scale**2, heading.yaw_variance
    covariance = np.zeros((6, 6))
    covariance[0, 0] = heading.xx + scale * x * x
    covariance[1, 1] = heading.yy + scale * y * y
    covariance[0, 1] = covariance[1, 0] = heading.xy + scale * x * y
    covariance[3, 3] = yaw * velocity.imag**2
    covariance[4, 4] = yaw * velocity.real**2
    covariance[3, 4] = covariance[4, 3] = -yaw * velocity.real * velocity.imag
    covariance += turned @ motion @ turned.T
    return covariance


def _turned(covariance: Floats, turn: complex) -> Floats:
    """A covariance (2, 2) turned by `turn`."""
    rotation = np.array(((turn.real, -turn.imag), (turn.imag, turn.real)))
    found: Floats = rotation @ covariance @ rotation.T
    return found


def _level_axes(turn: complex, orientation: Quaternion) -> Axes:
    """Horizontal parts of the body's axes, turned by `turn`: the first two rows of the rotation's matrix."""
    w, x, y, z = orientation
    return (
        turn * complex(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)),
        turn * complex(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z)),
        turn * complex(2.0 * (x * z + w * y), 2.0 * (y * z - w * x)),
    )


def _horizontal(vector: Vector) -> complex:
    return complex(vector[0], vector[1])


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
