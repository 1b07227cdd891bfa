"""Position by dead reckoning: the radar's speed over ground along the IMU's heading, by the method of choice.

in   imu   : Imu          orientation, linear acceleration, gyro, 100 Hz
in   speed : GroundSpeed  one per radar frame, 100 Hz; shs, naive_ins and zero_velocity need none
out  pose  : Pose         one per IMU sample
out  local : Pose         likewise, if `with_local`, of `best`: in a frame that never leaps, for a local map

`zero_velocity` is for an IMU on a foot: it takes raw gyro and accelerometer, and no orientation.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from caneflow.algorithms.cane.cane_filter import CaneFilter, CaneFilterSettings
from caneflow.algorithms.cane.dead_reckoning import DeadReckoning, PoseEstimate
from caneflow.algorithms.cane.kalman import KalmanFilter, KalmanSettings
from caneflow.algorithms.cane.luenberger import LuenbergerObserver, LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import FixedLuenbergerObserver, observer_constants
from caneflow.algorithms.cane.naive_ins import NaiveIns, NaiveInsSettings
from caneflow.algorithms.cane.speed_gate import CaneGlitchSettings, SpeedGate
from caneflow.algorithms.cane.step_heading import StepHeading, StepHeadingSettings
from caneflow.algorithms.cane.zero_velocity import ZeroVelocity, ZeroVelocitySettings
from caneflow.algorithms.glitches import GlitchGate
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.inertial.imu_sample import (
    require_later,
    required_acceleration,
    required_force,
    required_orientation,
)
from caneflow.algorithms.radar.ground_velocity import UNOBSERVED
from caneflow.messages import GroundSpeed, Imu, MessageError, Pose, Sample
from caneflow.messages.rig import Rig
from caneflow.runtime import Context, Emitted, Operator, Refused
from caneflow.runtime.node import run

Method: TypeAlias = Literal["luenberger", "luenberger_fixed", "kalman", "shs", "naive_ins", "best", "zero_velocity"]
WITHOUT_SPEED = ("shs", "naive_ins", "zero_velocity")  # methods that an IMU alone is enough for


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """Which estimator, and what each may be told."""

    method: Method = "luenberger"
    with_local: bool = False  # fill the output local; method best alone
    luenberger: LuenbergerSettings = field(default_factory=LuenbergerSettings)  # also in fixed point
    kalman: KalmanSettings = field(default_factory=KalmanSettings)
    shs: StepHeadingSettings = field(default_factory=StepHeadingSettings)
    naive_ins: NaiveInsSettings = field(default_factory=NaiveInsSettings)
    best: CaneFilterSettings = field(default_factory=CaneFilterSettings)
    zero_velocity: ZeroVelocitySettings = field(default_factory=ZeroVelocitySettings)
    # fixed point has their defaults; a foot has its own, zero_velocity.glitches
    glitches: CaneGlitchSettings = field(default_factory=CaneGlitchSettings)

    def __post_init__(self) -> None:
        if self.with_local and self.method != "best":
            raise ValueError(f"with_local is for the method best; {self.method} has one pose")
        if self.method == "luenberger_fixed":  # raises for what fixed point does not have
            observer_constants(self.luenberger, (0.0, 1.0, 0.0))


class Fusion(Operator):
    """One estimator, told of every speed and asked at every IMU sample."""

    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose, "local": Pose}
    optional_outputs = frozenset({"local"})  # with_local
    optional_inputs = frozenset({"speed"})  # of a graph without radar, for methods that need none
    Settings = FusionSettings

    def __init__(self, settings: FusionSettings, context: Context) -> None:
        if settings.method not in WITHOUT_SPEED and context.ports and "speed" not in context.ports:
            raise MessageError(
                f"method {settings.method} needs the input speed, which is not wired; "
                f"without a radar there are {', '.join(WITHOUT_SPEED)}"
            )
        self._settings, self._rig = settings, context.rig
        self._method = settings.method
        on_foot = settings.method == "zero_velocity"
        self._gate = GlitchGate(settings.zero_velocity.glitches if on_foot else settings.glitches)
        self._speeds, self._velocities = SpeedGate(settings.glitches), SpeedGate(settings.glitches)
        self._held: tuple[str, ...] = ()  # what was held back of speeds since the last pose
        self._samples = 0  # of the IMU; counted until two agree
        self._last_ns: int | None = None  # stamp of the last
        self._start()

    def _start(self) -> None:
        self._estimator = estimator(self._settings, self._rig)

    def handle(self, port: str, message: Sample) -> Emitted:
        """The pose at an IMU sample's stamp; a speed only informs the estimator."""
        if isinstance(message, Imu):
            pose = self._pose(message)
            if self._settings.with_local and isinstance(self._estimator, CaneFilter):
                return ("pose", pose), ("local", _pose(pose.stamp, self._estimator.local(), pose.method, pose.status))
            return (("pose", pose),)
        if isinstance(message, GroundSpeed):
            self._take_speed(message)
        return ()

    def _take_speed(self, ground: GroundSpeed) -> None:
        stamp, velocity, covariance = ground.stamp, ground.velocity, ground.velocity_cov
        if velocity is not None and covariance is not None:
            says_nothing = min(covariance[0], covariance[2]) >= UNOBSERVED
            if says_nothing or self._velocities.passes(stamp, *velocity, ground.velocity_delay):
                self._estimator.velocity(stamp, velocity, covariance, ground.velocity_delay)
            else:
                self._hold("velocity")
        if ground.spread is not None:
            self._estimator.spread(stamp, ground.spread, ground.spread_delay)
        has_gates = self._estimator.has_gates
        if has_gates or not ground.valid or self._speeds.passes(stamp, ground.speed, 0.0, ground.delay):
            self._estimator.speed(stamp, ground.speed, ground.quality, ground.valid, ground.delay)
        else:
            self._hold("speed")

    def _hold(self, what: str) -> None:
        if what not in self._held:
            self._held += (what,)

    def _pose(self, imu: Imu) -> Pose:
        reading = ImuReading(
            gyro=imu.gyro, accel=imu.accel, mag=imu.mag, orientation=imu.orientation, linear_accel=imu.linear_accel
        )
        try:
            self._require(imu.stamp, reading)
        except ValueError as error:
            raise Refused(str(error)) from error
        if not self._estimator.has_gates:
            reading = self._gate.update(imu.stamp, reading)
            if self._samples < 2:
                self._begin()
        estimate = self._estimator.imu(imu.stamp, reading)
        held = self._estimator.held if self._estimator.has_gates else self._gate.held + self._held
        self._held = ()
        status = " ".join([f"held:{what}" for what in held]) if held else None
        return _pose(imu.stamp, estimate, self._method, status)

    def _require(self, stamp_ns: int, reading: ImuReading) -> None:
        """Raise ValueError for a sample that the method cannot use, before it has changed anything."""
        require_later(stamp_ns, self._last_ns)
        if self._method == "zero_velocity":
            required_force(reading.accel, self._method)
        else:
            required_orientation(reading.orientation, self._method)
        if self._method not in ("shs", "zero_velocity"):
            required_acceleration(reading, self._method)
        self._last_ns = stamp_ns

    def _begin(self) -> None:
        """A walk begins at the first sample that the next one agrees with: one that does not is forgotten."""
        if self._samples and self._gate.contradicted:
            self._start()
        else:
            self._samples += 1


def _pose(stamp_ns: int, estimate: PoseEstimate, method: str, status: str | None) -> Pose:
    return Pose(
        stamp=stamp_ns,
        position=estimate.position,
        velocity=estimate.velocity,
        orientation=estimate.orientation,
        covariance=estimate.covariance,
        method=method,
        status=status,
    )


def estimator(settings: FusionSettings, rig: Rig) -> DeadReckoning:
    """The estimator that `method` names."""
    match settings.method:
        case "luenberger":
            return LuenbergerObserver(settings.luenberger, boresight=rig.boresight)
        case "luenberger_fixed":
            return FixedLuenbergerObserver(settings.luenberger, boresight=rig.boresight)
        case "kalman":
            return KalmanFilter(settings.kalman, boresight=rig.boresight)
        case "shs":
            return StepHeading(settings.shs, boresight=rig.boresight, step_length=rig.need("step_length"))
        case "naive_ins":
            return NaiveIns(settings.naive_ins)
        case "zero_velocity":
            return ZeroVelocity(settings.zero_velocity)
        case "best":
            return CaneFilter(
                settings.best,
                boresight=rig.boresight,
                pivot=rig.need("pivot"),
                antenna=rig.antenna,
            )


if __name__ == "__main__":
    run(Fusion)
