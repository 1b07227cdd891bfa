"""Where a person is in a room, from static Doppler modules and, if they wear one, an IMU.

in   <sensor> : DopplerTarget   any number; the port's name is the sensor's in the rig
in   imu      : Imu             its orientation tells which way the person faces, its acceleration whether they walk;
                                may be left out
in   cane     : Pose            the person's own dead reckoning, whose drift the sensors bound; may be left out
out  pose     : Pose            one per 50 ms, at the first sample of any input that is due

`status` of a pose says on what it rests: `static_or_lost` when no sensor sees anything move or the person is felt to
stand, `without:west` when the sensor `west` has fallen silent, `outlier:west` when something that `west` measured since
the last pose does not fit to where the person can be and was left out, `held:gyro` (or `orientation`, `linear_accel`,
`cane`) when a single wild reading was held at the one before; it is absent when all is well.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from caneflow.algorithms.glitches import GlitchGate, GlitchSettings, JumpGate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import heading_of
from caneflow.algorithms.inertial.standing import StandingDetector, StandingSettings
from caneflow.algorithms.quantities import Component, Length, Time, Zero
from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_particles import HeadingParticleTracker, ParticleTracker, RoomParticleSettings
from caneflow.algorithms.room.room_sign_bank import RoomSignBank, SignBankSettings
from caneflow.algorithms.room.room_tracking import Echo, RoomStart, RoomTracker, StaticSensor, Vector2
from caneflow.algorithms.rotations import Quaternion, from_yaw, rotate
from caneflow.messages import DopplerTarget, Imu, MessageError, Pose, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime import ANY_PORT, Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

Method: TypeAlias = Literal["particle", "heading_particle", "ekf", "best"]

IMU, CANE = "imu", "cane"
SLOWEST_TO_FACE = 0.2  # m/s; without an IMU a slower velocity does not tell which way the person faces
LEAP = 0.5  # m from one sample of the cane to the next, more than which is held for a few of them
NATURE_CHANGE = 0.025  # s of a sensor's delay, which does not change
FLOOR_VARIANCE = 1e-6  # m^2 and m^2/s^2, of the height: the person is on the floor


def plain() -> RoomEkfSettings:
    """The filter that takes the strength at its word: no state for what is slowly wrong with it."""
    return RoomEkfSettings(bias_error=0.0)


def worn_on_a_belt() -> StandingSettings:
    """A belt swings by 0.3 m/s^2 or more as soon as its wearer walks; who turns on the spot stands."""
    return StandingSettings(window=0.5, largest_turn_rate=math.tau, largest_acceleration=0.2)


@dataclass(frozen=True, kw_only=True)
class RoomTrackerSettings:
    """Which method, what each may be told, and how the IMU is worn."""

    __pydantic_config__ = {"extra": "forbid"}

    method: Method = "best"
    period: Time = 0.05  # s between poses
    forward: tuple[Component, Component, Component] = (1.0, 0.0, 0.0)  # the way the person faces, in the IMU's axes
    standing: StandingSettings = field(default_factory=worn_on_a_belt)
    cane_ahead: Length | Zero = 0.55  # m, of the cane's sensors in front of the person
    longest_delay: Time = 2.0  # s; what a sensor saw longer ago is of no use
    glitches: GlitchSettings = field(default_factory=GlitchSettings)  # of the IMU
    silent_after: Time = 0.5  # s without a sample, after which a sensor counts as silent
    particle: RoomParticleSettings = field(default_factory=RoomParticleSettings)
    heading_particle: RoomParticleSettings = field(default_factory=RoomParticleSettings)
    ekf: RoomEkfSettings = field(default_factory=plain)
    best: RoomEkfSettings = field(default_factory=RoomEkfSettings)
    signs: SignBankSettings = field(default_factory=SignBankSettings)  # of `best`, where a sensor tells none


class RoomTrackerOperator(Operator):
    """One tracker, told of every target and every heading, and asked once per period."""

    inputs = {ANY_PORT: DopplerTarget, IMU: Imu, CANE: Pose}
    outputs = {"pose": Pose}
    optional_inputs = frozenset({IMU, CANE})
    Settings = RoomTrackerSettings

    def __init__(self, settings: RoomTrackerSettings, context: Context) -> None:
        names = [port for port in context.ports if port not in (IMU, CANE)]
        self._settings = settings
        self._boresight = context.rig.boresight  # of the cane
        self._tracker = tracker(settings, context, names)
        if CANE in context.ports and not isinstance(self._tracker, RoomEkf | RoomSignBank):
            raise MessageError(f"room_tracker: {settings.method} cannot use the cane; ekf and best can")
        self._heard_ns: dict[str, int | None] = dict.fromkeys(names)
        self._begin_ns: int | None = None  # stamp of the first sample
        self._due_ns = 0
        self._facing: Quaternion | None = None  # by the IMU
        self._course = 0.0  # rad, by the velocity
        self._steps = StandingDetector(settings.standing)
        self._last_ns: dict[str, int] = {}  # stamp of the last sample of each port
        self._imu_gate = GlitchGate(settings.glitches)
        self._cane_gate: JumpGate[Vector2] = JumpGate(LEAP, math.dist, longest_gap=settings.silent_after)
        self._natures: dict[str, JumpGate[Vector2]] = {
            name: JumpGate(1.0, math.dist, longest_gap=settings.silent_after) for name in names
        }
        self._news: dict[str, None] = {}  # words for the next pose, in order

    def handle(self, port: str, message: Sample) -> Emitted:
        """Take the sample; yield a pose when one is due."""
        self._require_usable(port, message)
        self._last_ns[port] = message.stamp
        if self._begin_ns is None:
            self._begin_ns = message.stamp
        match message:
            case DopplerTarget():
                self._take_target(port, message)
            case Imu():
                self._take_heading(message)
            case Pose():
                self._take_cane(message)
        if message.stamp >= self._due_ns:
            self._due_ns = message.stamp + round(self._settings.period * 1e9)
            yield "pose", self._pose(message.stamp)

    def _require_usable(self, port: str, message: Sample) -> None:
        """Raise Refused before anything has changed."""
        last = self._last_ns.get(port)
        if last is not None and message.stamp <= last:
            raise Refused(f"{port}: stamp {message.stamp} ns is not after the one before, {last} ns")
        if isinstance(message, Imu) and message.orientation is None:
            raise Refused("the IMU sample has no orientation; put operators.attitude in front of room_tracker")

    def _take_target(self, sensor: str, target: DopplerTarget) -> None:
        self._heard_ns[sensor] = target.stamp
        echo = self._echo_of(sensor, target)
        discarded = self._tracker.discarded
        if echo is not None:
            self._tracker.echo(sensor, echo)
        if echo is None or self._tracker.discarded > discarded:
            self._news[f"outlier:{sensor}"] = None

    def _echo_of(self, sensor: str, target: DopplerTarget) -> Echo | None:
        """A target at the time that its value belongs to; None when that is too long ago.

        Delay, and whether the sensor tells the direction, are its nature: a single sample that says otherwise is not
        believed. While it is not known whether the direction is told, a speed counts as without one.
        """
        nature = self._natures[sensor]
        delay, signed = nature.update(target.stamp, ((target.delay or 0.0) / NATURE_CHANGE, 2.0 * target.signed))
        delay *= NATURE_CHANGE
        if nature.holding:
            self._news[f"held:{sensor}"] = None
        if delay > self._settings.longest_delay:
            return None
        signs = target.signed and signed > 1.0
        return Echo(
            stamp_ns=target.stamp - round(delay * 1e9),
            valid=target.valid,
            range_rate=target.range_rate if signs else abs(target.range_rate),
            signed=signs,
            strength=20.0 * math.log10(target.amplitude) if target.amplitude > 0.0 else None,
        )

    def _take_heading(self, imu: Imu) -> None:
        assert imu.orientation is not None
        read = self._imu_gate.update(
            imu.stamp, ImuReading(imu.gyro, orientation=imu.orientation, linear_accel=imu.linear_accel)
        )
        self._news.update(dict.fromkeys(f"held:{part}" for part in self._imu_gate.held))
        assert read.orientation is not None
        self._facing = read.orientation
        cosine, sine = heading_of(read.orientation, self._settings.forward)
        self._tracker.heading(imu.stamp, math.atan2(sine, cosine), self._stands(imu.stamp, read))

    def _take_cane(self, pose: Pose) -> None:
        """The cane is ahead of the person, in the direction in which it points; a swing averages out."""
        assert isinstance(self._tracker, RoomEkf | RoomSignBank)
        cosine, sine = heading_of(pose.orientation, self._boresight)
        ahead = self._settings.cane_ahead
        place = self._cane_gate.update(pose.stamp, (pose.position[0] - ahead * cosine, pose.position[1] - ahead * sine))
        if self._cane_gate.holding:
            self._news["held:cane"] = None
        self._tracker.walked(pose.stamp, place)

    def _stands(self, stamp: int, read: ImuReading) -> bool | None:
        """Whether the wearer stands; None without an accelerometer."""
        if read.linear_accel is None:
            return None
        assert read.orientation is not None
        return self._steps.update(stamp, read.gyro, rotate(read.orientation, read.linear_accel))

    def _pose(self, stamp: int) -> Pose:
        estimate = self._tracker.estimate(stamp)
        (x, y), (u, v) = estimate.position, estimate.velocity
        if math.hypot(u, v) > SLOWEST_TO_FACE:
            self._course = math.atan2(v, u)
        covariance = np.diag([FLOOR_VARIANCE] * 6)
        plane = np.ix_((0, 1, 3, 4), (0, 1, 3, 4))
        covariance[plane] = estimate.covariance
        return Pose(
            stamp=stamp,
            position=(x, y, 0.0),
            velocity=(u, v, 0.0),
            orientation=self._facing or from_yaw(self._course),
            covariance=covariance,
            method=self._settings.method,
            status=self._status(stamp),
        )

    def _status(self, stamp: int) -> str | None:
        """What the pose has to do without; None when all is well."""
        words = [] if self._tracker.moving else ["static_or_lost"]
        words += [f"without:{sensor}" for sensor in self._heard_ns if self._is_silent(sensor, stamp)]
        words += self._news
        self._news = {}
        return " ".join(words) or None

    def _is_silent(self, sensor: str, stamp: int) -> bool:
        assert self._begin_ns is not None
        heard = self._heard_ns[sensor]
        return stamp - (self._begin_ns if heard is None else heard) > self._settings.silent_after * 1e9


def tracker(settings: RoomTrackerSettings, context: Context, names: list[str]) -> RoomTracker:
    """The tracker that `method` names, with the sensors `names` of the rig; raises MessageError for a stranger."""
    sensors, start = sensors_of(context.rig, names), start_of(context.rig)
    match settings.method:
        case "particle":
            return ParticleTracker(settings.particle, sensors, start, context.random)
        case "heading_particle":
            return HeadingParticleTracker(settings.heading_particle, sensors, start, context.random)
        case "ekf":
            return RoomEkf(settings.ekf, sensors, start)
        case "best":
            return RoomSignBank(settings.best, sensors, start, settings.signs)


def sensors_of(rig: Rig, names: list[str]) -> Mapping[str, StaticSensor]:
    """The rig's sensors `names`; raises MessageError when there are none, or for one that the rig lacks."""
    if not names:
        raise MessageError("room_tracker: no sensor is wired; each is an input named as in rig.sensors")
    strangers = [name for name in names if name not in rig.sensors]
    if strangers:
        there = ", ".join(rig.sensors) or "none"
        raise MessageError(f"rig.sensors has no {', '.join(strangers)}; there are: {there}")
    return {
        name: StaticSensor(
            position=rig.sensors[name].position[:2], azimuth=rig.sensors[name].azimuth, k=rig.sensors[name].k
        )
        for name in names
    }


def start_of(rig: Rig) -> RoomStart:
    """The user's guess, else anywhere in the area; raises MessageError when neither is known."""
    if rig.start is not None:
        return RoomStart(guess=rig.start.position, error=rig.start.sd, area=rig.area)
    return RoomStart(area=rig.need("area"))


if __name__ == "__main__":
    run(RoomTrackerOperator)
