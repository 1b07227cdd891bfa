"""Named walks with a white cane, and everything that its sensors and the truth say about one.

`simulate_walk("swing", seed=1)` is the paper's walk. A scenario is a function from a Generator to settings, so
that what differs from walk to walk (direction, where the stops are, nearly all of `varied`) comes from the seed.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.field_faults import FieldFaults, Received, glitched, received, stated_rig
from caneflow.simulation.imu import SAMPLE_RATE, ImuSamples, ImuSettings, measure
from caneflow.simulation.radar import RANGE_STEP, RadarSettings, scans
from caneflow.simulation.scene import SceneSettings, scene
from caneflow.simulation.walk import RATE, Motion, MotionSettings, Pause, Rig, course_of, walk

EPOCH_NS = 1_700_000_000_000_000_000  # stamp of the first sample unless told otherwise


@dataclass(frozen=True, kw_only=True)
class WalkSettings:
    """Everything about a walk but its random numbers."""

    rig: Rig = field(default_factory=Rig)
    motion: MotionSettings = field(default_factory=MotionSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    radar: RadarSettings = field(default_factory=RadarSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    faults: FieldFaults = field(default_factory=FieldFaults)


@dataclass(frozen=True, kw_only=True)
class Walk:
    """n instants at 100 Hz: one IMU sample, one scan and one true pose each. Frames and units as in wire.md."""

    stamps_ns: NDArray[np.int64]  # (n,)
    imu: ImuSamples

    # the truth
    position: Floats  # (n, 3) m, of the IMU's origin in R0
    velocity: Floats  # (n, 3) m/s, R0
    orientation: Floats  # (n, 4)

    scans: NDArray[np.int32]  # (n, bins) LSB
    scan_period: float  # s
    range_start: float  # m
    range_step: float  # m
    carrier: float  # Hz
    bandwidth: float  # Hz

    rig: Mapping[str, object]  # as in wire.md, as it is stated
    received: Received | None = None  # None: every sample and scan, with its own stamp


def simulate_walk(
    scenario: str | WalkSettings,
    seed: int,
    duration: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Walk:
    """A walk of `duration` s, by default until it has been walked to its end (53 s for `swing`).

    The random numbers of person, scene, radar and IMU are independent of each other: other walls leave the gait as
    it is. `progress` is told the part done, 0..1.
    Raises ValueError for a scenario that is not there, a negative seed or a duration that is not positive.
    """
    settings = walk_settings(scenario, seed) if isinstance(scenario, str) else scenario
    if duration is not None and not duration > 0.0:
        raise ValueError(f"a walk of {duration} s; the duration must be > 0 s")
    _, person_rng, scene_rng, radar_rng, imu_rng, faults_rng = generators(seed)
    faults = settings.faults
    glitch_rng, received_rng, rig_rng = faults_rng.spawn(3)
    radar = replace(settings.radar, carrier=settings.radar.carrier / (1.0 + faults.carrier_off))
    motion = walk(settings.motion, settings.rig, person_rng, duration)
    room = scene(settings.scene, course_of(settings.motion), scene_rng)
    sampled = Motion(*(values[:: RATE // SAMPLE_RATE] for values in motion))
    heard = scans(sampled, room, settings.rig, settings.motion.pitch, radar, radar_rng, progress)
    period_ns = 1_000_000_000 // SAMPLE_RATE
    stamps_ns = EPOCH_NS + period_ns * np.arange(len(sampled.time), dtype=np.int64)
    return Walk(
        stamps_ns=stamps_ns,
        imu=glitched(measure(motion, settings.imu, imu_rng), faults, glitch_rng),
        position=sampled.position,
        velocity=sampled.velocity,
        orientation=sampled.orientation,
        scans=heard,
        scan_period=1.0 / SAMPLE_RATE,
        range_start=settings.radar.range_start,
        range_step=RANGE_STEP,
        carrier=settings.radar.carrier,
        bandwidth=settings.radar.bandwidth,
        rig=stated_rig(settings.rig, faults, rig_rng),
        received=received(stamps_ns, faults, received_rng),
    )


def walk_settings(scenario: str, seed: int) -> WalkSettings:
    """What a named scenario is for a seed; raises ValueError for a name that is not there or a negative seed."""
    if scenario not in SCENARIOS:
        raise ValueError(f"no walk '{scenario}'; there are {', '.join(SCENARIOS)}")
    return SCENARIOS[scenario](generators(seed)[0])


def generators(seed: int) -> list[Generator]:
    """Of the scenario, the person, the scene, the radar, the IMU and the faults."""
    if seed < 0:
        raise ValueError(f"seed {seed}; it must be 0 or more")
    return [default_rng(child) for child in SeedSequence(seed).spawn(6)]


def _swing(rng: Generator) -> WalkSettings:
    """The paper's first experiment: a swing at each step, either way round."""
    return WalkSettings(motion=_motion(rng))


def _swing_stop(rng: Generator) -> WalkSettings:
    """The paper's second one: the swing is stopped midway."""
    return WalkSettings(motion=replace(_motion(rng), swing_until=rng.uniform(0.4, 0.6)))


def _stops(rng: Generator) -> WalkSettings:
    """The walker stands still twice."""
    motion = _motion(rng)
    length = course_of(motion).length
    first = Pause(at=length * rng.uniform(0.15, 0.45), duration=rng.uniform(3.0, 5.0))
    second = Pause(at=length * rng.uniform(0.55, 0.85), duration=rng.uniform(3.0, 5.0))
    return WalkSettings(motion=replace(motion, pauses=(first, second)))


def _hard(rng: Generator) -> WalkSettings:
    """Walls, a person who walks by, few scatterers on the floor, 5 dB, and one stop."""
    motion = _motion(rng)
    stop = Pause(at=course_of(motion).length * rng.uniform(0.3, 0.7), duration=rng.uniform(3.0, 4.0))
    return WalkSettings(
        motion=replace(motion, pauses=(stop,)),
        scene=SceneSettings(floor_density=25.0, walls=True, person=True),
        radar=RadarSettings(snr=5.0),
    )


def _varied(rng: Generator) -> WalkSettings:
    """Another rig, loop, gait, floor, room and gyro, and a restless hand: the spread of persons and places.

    Ranges are chosen, but for the gyro's bias (cane.md: 0.02 to 0.3 deg/s). The rig's step length stays nominal.
    """
    rig = Rig(
        hand_height=rng.uniform(0.85, 1.05),
        aperture=DEGREE * rng.uniform(40.0, 60.0),
        pivot=(0.0, -rng.uniform(0.2, 0.4), 0.0),
        antenna=(rng.uniform(-0.02, 0.02), rng.uniform(0.0, 0.05), rng.uniform(-0.02, 0.02)),
    )
    step = rng.uniform(0.36, 0.52)
    length, width = rng.uniform(5.0, 12.0), rng.uniform(2.5, 6.0)
    stop = Pause(at=rng.uniform(0.2, 0.8) * 2.0 * (length + width), duration=rng.uniform(2.0, 5.0))
    motion = MotionSettings(
        length=length,
        width=width,
        corner_radius=rng.uniform(0.3, 0.8),
        clockwise=_coin(rng),
        speed=step * rng.uniform(0.9, 1.3),  # steps per second
        speed_variation=rng.uniform(0.03, 0.1),
        step_length=step,
        surge=rng.uniform(0.05, 0.2),
        bob=rng.uniform(0.006, 0.018),
        sway=rng.uniform(0.01, 0.035),
        pauses=(stop,) if _coin(rng) else (),
        hand_ahead=rng.uniform(0.25, 0.45),
        swing=DEGREE * rng.uniform(10.0, 28.0),
        swing_until=rng.uniform(0.3, 0.8) if _coin(rng) else None,
        pitch=DEGREE * rng.uniform(38.0, 50.0),
        wander=DEGREE * rng.uniform(1.0, 3.0),
        restlessness=rng.uniform(1.0, 4.0),
    )
    return WalkSettings(
        rig=rig,
        motion=motion,
        scene=SceneSettings(
            floor_density=_spread(rng, 40.0, 400.0),
            walls=_coin(rng),
            person=_coin(rng),
        ),
        radar=RadarSettings(snr=rng.uniform(8.0, 18.0)),
        imu=ImuSettings(gyro_bias=DEGREE * _spread(rng, 0.02, 0.3)),
    )


def _straight(rng: Generator) -> WalkSettings:
    """An open path of 22 m: what a loop hides, it shows."""
    return WalkSettings(motion=replace(_motion(rng), shape="straight", length=22.0))


def _figure_eight(rng: Generator) -> WalkSettings:
    """A lying eight of 8 x 3 m: left turns undo right turns."""
    return WalkSettings(motion=replace(_motion(rng), shape="figure_eight"))


def _slow(rng: Generator) -> WalkSettings:
    """A quarter of a metre per second."""
    return WalkSettings(motion=_paced(_motion(rng), 0.25))


def _brisk(rng: Generator) -> WalkSettings:
    """1 m/s, the pace of a practised user; the rig's step length is still the nominal one."""
    return WalkSettings(motion=_paced(_motion(rng), 1.0))


def _step_back(rng: Generator) -> WalkSettings:
    """Midway the walker stops, steps back by half a metre to a metre, stands, and goes on."""
    motion = _motion(rng)
    at = course_of(motion).length * rng.uniform(0.3, 0.7)
    back = Pause(at=at, duration=2.0, back=rng.uniform(0.5, 1.0))
    return WalkSettings(motion=replace(motion, pauses=(back,)))


def _field(rng: Generator) -> WalkSettings:
    """The paper's walk with everything at once that recordings of real devices have; field_faults.py has the sources.

    Rates are chosen where no recording states them, before any method was run on it.
    """
    motion, turns = _motion(rng), _coin(rng)
    return WalkSettings(
        motion=motion,
        radar=RadarSettings(noise_rise=10.0),
        imu=ImuSettings(
            field_turn=DEGREE * 30.0 if turns else 0.0,
            field_wander=0.0 if turns else DEGREE * 15.0,
        ),
        faults=FieldFaults(
            glitches=0.2,
            holes=3.0,
            scan_loss=0.09,
            carrier_off=0.02 if _coin(rng) else -0.02,
            equal_stamps=0.02,
            rig_shift=0.05,
            rig_turn=5.0 * DEGREE,
        ),
    )


SCENARIOS: Mapping[str, Callable[[Generator], WalkSettings]] = MappingProxyType(
    {
        "swing": _swing,
        "swing_stop": _swing_stop,
        "stops": _stops,
        "hard": _hard,
        "varied": _varied,
        "straight": _straight,
        "figure_eight": _figure_eight,
        "slow": _slow,
        "brisk": _brisk,
        "step_back": _step_back,
        "field": _field,
    }
)


def _motion(rng: Generator) -> MotionSettings:
    """The paper's walk, either way round."""
    return MotionSettings(clockwise=_coin(rng))


def _paced(motion: MotionSettings, speed: float) -> MotionSettings:
    """Another speed (m/s), with the step length that goes with it: square root, as in walk.py."""
    return replace(motion, speed=speed, step_length=motion.step_length * math.sqrt(speed / motion.speed))


def _coin(rng: Generator) -> bool:
    return bool(rng.random() < 0.5)


def _spread(rng: Generator, low: float, high: float) -> float:
    """A number between two, evenly spread over orders of magnitude."""
    return float(low * (high / low) ** rng.random())
