"""A walk with a cane that carries range sensors, past things in the way: all sensors, and the truth of both."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng

from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.imu import SAMPLE_RATE, ImuSettings, measure
from caneflow.simulation.obstacle_course import (
    SCENES,
    ObstacleCourse,
    SceneKind,
    Solid,
    Thing,
    ThingKind,
    approach,
)
from caneflow.simulation.radar import RANGE_STEP, RadarSettings, scans
from caneflow.simulation.ranger import DOWN, UP, RangerSettings, Readings, read
from caneflow.simulation.scenario import EPOCH_NS, Walk
from caneflow.simulation.scene import Passer, SceneSettings, passer, scene, with_boxes
from caneflow.simulation.walk import RATE, Motion, MotionSettings, Rig, walk

RANGERS: Mapping[str, RangerSettings] = {"tof_up": UP, "tof_down": DOWN}
USER: Mapping[str, object] = {"shoulder": 0.35, "height": 2.0, "hand": [0.30, -0.08]}
PATH_STEP = 0.05  # s


@dataclass(frozen=True, kw_only=True)
class GuidedWalk:
    """What a cane with range sensors says of a walk past things, and what is true."""

    walk: Walk
    readings: Mapping[str, Readings]
    scene: Mapping[str, object]  # the recording's metadata record


class Way(NamedTuple):
    """The place, the cane and the motion of a walk past things."""

    course: ObstacleCourse
    rig: Rig
    pitch: float  # rad, the cane's nominal attitude
    motion: Motion  # at 1 kHz
    sampled: Motion  # at 100 Hz


def simulate_guided_walk(
    kind: SceneKind,
    seed: int,
    thing: ThingKind | None = None,
    duration: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> GuidedWalk:
    """A walk through a scene, by default to its end; `thing` is what an approach ends at.

    `progress` is told the part done, 0..1. Raises ValueError for what is not there.
    """
    scatter_rng, radar_rng, imu_rng, up_rng, down_rng = _generators(seed)[2:]
    way = guided_way(kind, seed, thing, duration)
    room = scene(SceneSettings(), way.course.course, scatter_rng)
    room = with_boxes(room, _scattering(way.course), _passing(way.course, scatter_rng), scatter_rng)
    radar = RadarSettings()
    received = scans(way.sampled, room, way.rig, way.pitch, radar, radar_rng, progress)
    generators = {"tof_up": up_rng, "tof_down": down_rng}
    rangers = {name: each.as_map() for name, each in RANGERS.items()}
    walked = Walk(
        stamps_ns=EPOCH_NS + 1_000_000_000 // SAMPLE_RATE * np.arange(len(way.sampled.time), dtype=np.int64),
        imu=measure(way.motion, ImuSettings(), imu_rng),
        position=way.sampled.position,
        velocity=way.sampled.velocity,
        orientation=way.sampled.orientation,
        scans=received,
        scan_period=1.0 / SAMPLE_RATE,
        range_start=radar.range_start,
        range_step=RANGE_STEP,
        carrier=radar.carrier,
        bandwidth=radar.bandwidth,
        rig=way.rig.as_map() | {"rangers": rangers, "user": dict(USER)},
    )
    return GuidedWalk(
        walk=walked,
        readings={name: read(way.sampled, way.course, RANGERS[name], rng) for name, rng in generators.items()},
        scene=truth_of(way, seed),
    )


def guided_way(kind: SceneKind, seed: int, thing: ThingKind | None = None, duration: float | None = None) -> Way:
    """The place and the motion of `simulate_guided_walk`, without what the sensors say."""
    place_rng, person_rng = _generators(seed)[:2]
    course = _place(kind, thing, place_rng)
    rig = Rig(hand_height=float(place_rng.uniform(0.9, 1.0)))
    settings = _person(place_rng)
    motion = whole = walk(settings, rig, person_rng, None, course.course)
    if duration is not None:  # where a person meets the walker is known from the whole walk
        motion = walk(settings, rig, _generators(seed)[1], duration, course.course)
    course = replace(course, things=tuple(_timed(each, course, whole) for each in course.things))
    sampled = Motion(*(values[:: RATE // SAMPLE_RATE] for values in motion))
    return Way(course, rig, settings.pitch, motion, sampled)


def truth_of(way: Way, seed: int) -> dict[str, object]:
    """The metadata record `scene`: what stands where, and the way of the body's middle."""
    motion, course = way.sampled, way.course
    distance = np.interp(np.arange(0.0, motion.time[-1], PATH_STEP), motion.time, motion.distance)
    place, heading = course.course.position(distance), course.course.heading(distance)
    time = PATH_STEP * np.arange(len(distance))
    return {
        "kind": course.kind,
        "seed": seed,
        "things": [thing.as_map() for thing in course.things],
        "solids": [list(solid.box) for solid in course.solids if not _is_road(solid)],
        "path": np.column_stack([time, place, heading]).tolist(),
        "ends": {},
        "frozen": {},
    }


def _generators(seed: int) -> list[Generator]:
    """Of the place, the person, the scatterers, the radar, the IMU, and the two rangers."""
    if seed < 0:
        raise ValueError(f"seed {seed}; it must be 0 or more")
    return [default_rng(child) for child in SeedSequence([seed, 21]).spawn(7)]


def _place(kind: SceneKind, thing: ThingKind | None, rng: Generator) -> ObstacleCourse:
    if kind == "approach":
        if thing is None:
            raise ValueError("an approach needs a thing: pole, box, table, sign, person or stairs")
        return approach(thing, rng)
    if thing is not None:
        raise ValueError(f"a {kind} has things of its own; only an approach takes one")
    return SCENES[kind](rng)


def _person(rng: Generator) -> MotionSettings:
    """0.55 to 1.0 m/s, with the cane in the right hand; ranges chosen as those of `varied`."""
    speed = float(rng.uniform(0.55, 1.0))
    return MotionSettings(
        speed=speed,
        step_length=0.42 * float(np.sqrt(speed / 0.465)),
        hand_ahead=0.30,
        hand_aside=-0.08,
        pitch=DEGREE * float(rng.uniform(40.0, 44.0)),
        rest_after=1.5,
    )


def _scattering(course: ObstacleCourse) -> list[tuple[Floats, float]]:
    """Boxes (x0, x1, y0, y1, z0, z1) near the walk that the radar sees, with their reflectivity."""
    walls = [(np.array(solid.box), 0.1) for solid in course.solids if abs(solid.box[2]) < 2.0]
    things = [(np.array(part.box), 0.3) for thing in course.things if not thing.halt for part in thing.parts]
    return walls + things


def _passing(course: ObstacleCourse, rng: Generator) -> Passer | None:
    """The one who walks."""
    for thing in course.things:
        if thing.velocity[0]:
            box = np.array([*thing.box, *thing.z])
            return passer(box, thing.velocity[0], thing.halt, rng)
    return None


def _timed(thing: Thing, course: ObstacleCourse, motion: Motion) -> Thing:
    """Where a thing that moves has to be at the first stamp, to be where it was put when the walker gets there."""
    if not thing.velocity[0]:
        return thing
    if course.kind.startswith("approach"):  # it stops as the walker does
        halt = float(np.interp(course.course.length - 0.3, motion.distance, motion.time))
        return replace(thing.moved(-thing.velocity[0] * halt), halt=halt)
    place = course.course.position(motion.distance)[:, 0]
    meets = float(motion.time[np.searchsorted(place, thing.box[0] - 0.1)])
    return thing.moved(-thing.velocity[0] * meets)


def _is_road(solid: Solid) -> bool:
    return solid.box[5] <= 0.0
