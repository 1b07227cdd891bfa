"""Someone with a white cane in a room of static Doppler modules: one walk, both sensor sets, one truth.

The person follows the cane's course (walk.py), moved to the middle of the room. The cane's radar and IMU hear and feel
it as scenario.py has it; the modules see the person's body as room_walk.py has it, whose steps are not those of the
cane's hand. The cane itself, a thin rod, is not among what the modules see.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import SeedSequence, default_rng

from caneflow.simulation.doppler_module import Kind
from caneflow.simulation.imu import SAMPLE_RATE
from caneflow.simulation.room_course import RATE as ROOM_RATE
from caneflow.simulation.room_course import Trajectory
from caneflow.simulation.room_scenario import BLOCK_NS, RoomRecording, RoomSettings, simulate_kinds
from caneflow.simulation.scenario import Walk, WalkSettings, simulate_walk
from caneflow.simulation.walk import MotionSettings, Pause, course_of, walk


@dataclass(frozen=True, kw_only=True)
class CaneInRoom:
    """The same walk twice: as the cane's sensors have it, and as the room's. The truth is the room's: the person."""

    cane: Walk
    room: RoomRecording
    rig: Mapping[str, object]  # both, keys as in wire.md


def cane_in_room_settings(seed: int) -> MotionSettings:
    """Four laps of 5 x 4 m at 0.7 m/s, either way round, with one stop; the step length goes with the speed."""
    rng = default_rng(SeedSequence((_COURSE, seed)))
    nominal = MotionSettings()
    motion = MotionSettings(
        length=5.0,
        width=4.0,
        laps=4,
        clockwise=bool(rng.random() < 0.5),
        speed=0.7,
        step_length=nominal.step_length * (0.7 / nominal.speed) ** 0.5,
    )
    stop = Pause(at=course_of(motion).length * rng.uniform(0.3, 0.7), duration=rng.uniform(3.0, 5.0))
    return replace(motion, pauses=(stop,))


def simulate_cane_in_room(
    settings: RoomSettings,
    seed: int,
    motion: MotionSettings | None = None,
    progress: Callable[[float], None] | None = None,
) -> CaneInRoom:
    """A walk through installation `seed` (and person `seed`), whose empty room and calibration are `simulate_room`'s.

    `motion` is by default that of `cane_in_room_settings`. Raises ValueError for a negative seed.
    """
    motion = cane_in_room_settings(seed) if motion is None else motion
    walked = simulate_walk(WalkSettings(motion=motion), seed, None, _share(progress, 0))
    way = _person(settings, motion, seed, walked)
    kinds: tuple[Kind, ...] = (settings.modules,)
    seen = simulate_kinds(settings, "course", seed, kinds, None, _share(progress, 1), way)[settings.modules]
    return CaneInRoom(cane=walked, room=seen, rig={**walked.rig, **seen.rig})


_COURSE = 7  # what a seed is for, besides those of room_scenario.py


def _person(settings: RoomSettings, motion: MotionSettings, seed: int, walked: Walk) -> Trajectory:
    """The body that carries the cane, in the room, for as many whole blocks as the cane's walk has."""
    # the very random numbers with which simulate_walk made its person
    person_rng = default_rng(SeedSequence(seed).spawn(5)[1])
    made = walk(motion, WalkSettings(motion=motion).rig, person_rng)
    course = course_of(motion)
    track = course.position(np.linspace(0.0, course.length, 1000))
    middle = 0.5 * (track.min(axis=0) + track.max(axis=0))
    west, east, south, north = settings.area
    offset = np.array([0.5 * (west + east), 0.5 * (south + north)]) - middle
    block = round(ROOM_RATE * BLOCK_NS * 1e-9)
    count = len(walked.stamps_ns) * (ROOM_RATE // SAMPLE_RATE) // block * block
    distance = np.interp(np.arange(count) / ROOM_RATE, made.time, made.distance)
    position = course.position(distance) + offset
    return Trajectory(
        time=np.arange(count) / ROOM_RATE,
        position=position,
        velocity=np.gradient(position, 1.0 / ROOM_RATE, axis=0),
        heading=course.heading(distance),
        distance=distance,
    )


def _share(progress: Callable[[float], None] | None, half: int) -> Callable[[float], None] | None:
    """Progress of one of two equal shares."""
    if progress is None:
        return None
    return lambda done: progress(0.5 * (half + done))
