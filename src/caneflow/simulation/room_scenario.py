"""Installations of the room tracker, and everything that their sensors and the truth say of a person in them.

An installation (its seed: mounting, modules, walls, magnetic field) and a person (their seed: body, gait, belt) yield
a set of recordings: the empty room, a calibration walk along either axis, and the course.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from caneflow.simulation.attitude import DEGREE, Floats, from_rotation_vector
from caneflow.simulation.belt_imu import BeltImuSettings, BeltSamples, belt, measure
from caneflow.simulation.doppler_module import (
    REAL_AMPLIFIER,
    Complexes,
    Kind,
    Module,
    ModuleSettings,
    Mounting,
    Wall,
    echo,
    module,
    receive,
)
from caneflow.simulation.imu import SAMPLE_RATE
from caneflow.simulation.room_course import (
    RATE,
    SHAPES,
    Area,
    CourseSettings,
    Trajectory,
    back_and_forth,
    course_legs,
    standing,
    trajectory,
)
from caneflow.simulation.room_walk import Gait, Person, PersonSettings, body, gait, person, seen_from
from caneflow.simulation.scenario import EPOCH_NS

World: TypeAlias = Literal["nominal", "harsh", "field"]
Part: TypeAlias = Literal["empty", "axial_x", "axial_y", "course"]
WORLDS: tuple[World, ...] = get_args(World)
PARTS: tuple[Part, ...] = get_args(Part)
BLOCK_NS = 50_000_000  # of samples per DopplerBlock, as the tracker's hop (room.md, row 8)

NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, kw_only=True)
class Reflections:
    """Floor and walls as mirrors: one amplitude each, for what is not said of materials and roughness.

    Fresnel's reflection at right angles is 0.25 of plasterboard (relative permittivity 2.7) and 0.39 of concrete
    (5.2; both Recommendation ITU-R P.2040), less by what roughness scatters, more by metal behind or in front.
    """

    floor: NotNegative
    walls: NotNegative  # mean of the four
    spread: Annotated[float, Ge(0), Gt(-1)] = 0.3  # sd between walls, relative (chosen)


NOMINAL = Reflections(floor=0.15, walls=0.2)  # chosen: a carpet, plasterboard
HARSH = Reflections(floor=0.35, walls=0.45)  # chosen: stone, concrete with cabinets and radiators before it


@dataclass(frozen=True, kw_only=True)
class RoomSettings:
    """Everything about an installation and what happens in it, but the random numbers."""

    course: CourseSettings = field(default_factory=CourseSettings)
    modules: Kind = "real"
    sensors: Annotated[int, Ge(2)] = 2  # 2 to 4: the first of SENSORS
    reflections: Reflections = NOMINAL
    area: Area = (0.0, 8.0, 0.0, 8.0)  # m (paper section 3)
    walls_at: Area = (-3.5, 11.5, -3.5, 11.5)  # m (chosen: a metre behind the modules)
    height: Annotated[float, Gt(0)] = 1.2  # m of the modules above the floor (chosen: a trunk's)
    # An installer puts a module about where it belongs, and then measures where it is (all chosen)
    position_spread: NotNegative = 0.15  # m, sd
    azimuth_spread: NotNegative = 2.5 * DEGREE  # rad, sd
    position_error: NotNegative = 0.02  # m, sd, of what the rig says
    azimuth_error: NotNegative = 1.0 * DEGREE  # rad, sd
    start_error: Annotated[float, Gt(0)] = 0.5  # m, sd of the user's guess of the start (room.md, row 16)
    empty_duration: Annotated[float, Gt(0)] = 20.0  # s (room.md)
    # Calibration: between 3 and 10 m of the module whose axis it is (room.md, row 6)
    axial_reach: tuple[float, float] = (3.0, 10.0)  # m
    axial_traverses: Annotated[int, Gt(0)] = 5
    person: PersonSettings = field(default_factory=PersonSettings)
    module: ModuleSettings = field(default_factory=ModuleSettings)
    imu: BeltImuSettings = field(default_factory=BeltImuSettings)


@dataclass(frozen=True, kw_only=True)
class RoomRecording:
    """One part: m instants at 100 Hz and b blocks of 50 ms. Frames and units as in wire.md."""

    stamps_ns: NDArray[np.int64]  # (m,) of IMU and truth
    imu: BeltSamples

    # the truth: the person on the floor, and where they face
    position: Floats  # (m, 3) m
    velocity: Floats  # (m, 3) m/s
    orientation: Floats  # (m, 4), x ahead

    block_stamps_ns: NDArray[np.int64]  # (b,) of the last sample of each block
    blocks: Mapping[str, NDArray[np.int16] | Complexes]  # by sensor: (b, samples per block)
    sample_rate: float  # Hz
    carrier: float  # Hz

    rig: Mapping[str, object]  # as in wire.md


class Site(NamedTuple):
    """Where a module belongs."""

    position: tuple[float, float]  # m
    azimuth: float  # rad


SENSORS: Mapping[str, Site] = MappingProxyType(  # room.md
    {
        "south": Site((4.0, -2.5), 0.5 * np.pi),
        "west": Site((-2.5, 4.0), 0.0),
        "north": Site((4.0, 10.5), -0.5 * np.pi),
        "east": Site((10.5, 4.0), np.pi),
    }
)


def room_settings(
    course: str = "circle",
    *,
    modules: Kind = "real",
    sensors: int = 2,
    world: World = "nominal",
    stops: int | None = None,
) -> RoomSettings:
    """Settings by name; raises ValueError, naming what there is, for what there is not."""
    shapes = [shape for shape in SHAPES if shape == course]
    if not shapes:
        raise ValueError(f"no course {course!r}; there are {', '.join(SHAPES)}")
    if modules not in get_args(Kind):
        raise ValueError(f"no modules {modules!r}; there are {', '.join(get_args(Kind))}")
    if world not in WORLDS:
        raise ValueError(f"no world {world!r}; there are {', '.join(WORLDS)}")
    if not 2 <= sensors <= len(SENSORS):
        raise ValueError(f"{sensors} sensors; there may be 2 to {len(SENSORS)}")
    return RoomSettings(
        course=CourseSettings(shape=shapes[0], stops=stops),
        modules=modules,
        sensors=sensors,
        reflections=HARSH if world == "harsh" else NOMINAL,
        module=REAL_AMPLIFIER if world == "field" else ModuleSettings(),
    )


def simulate_room(
    settings: RoomSettings,
    part: Part,
    seed: int,
    person_seed: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> RoomRecording:
    """One recording of installation `seed` with person `person_seed`, by default the one of the same number.

    Parts, and what they are made of, have their own random numbers: another course, another person's gait or more
    sensors leave everything else as it was. `progress` is told the part done, 0..1.
    Raises ValueError for a part that is not there or a negative seed.
    """
    return simulate_kinds(settings, part, seed, (settings.modules,), person_seed, progress)[settings.modules]


def simulate_kinds(
    settings: RoomSettings,
    part: Part,
    seed: int,
    kinds: Sequence[Kind],
    person_seed: int | None = None,
    progress: Callable[[float], None] | None = None,
    way: Trajectory | None = None,
) -> Mapping[Kind, RoomRecording]:
    """The same walk as modules of several kinds hear it, each as by `simulate_room`, in the time of one.

    `way` is walked instead of the one that settings and seeds would make; whole blocks long.
    """
    person_seed = seed if person_seed is None else person_seed
    if part not in PARTS:
        raise ValueError(f"no part {part!r}; there are {', '.join(PARTS)}")
    for number in (seed, person_seed):
        if number < 0:
            raise ValueError(f"seed {number}; it must be 0 or more")
    place = _installation(settings, seed)
    who_rng, belt_rng = _generators((_PERSON, person_seed), 2)
    who = person(settings.person, who_rng)
    way_rng, gait_rng, imu_rng, start_rng, *sensor_rngs = _generators(
        (_RECORDING, seed, person_seed, _number(settings, part)), 4 + len(SENSORS)
    )
    way = way or _way(settings, part, way_rng)
    walk = gait(way, who, settings.person, gait_rng)
    sampled = measure(walk, belt(settings.imu, belt_rng), settings.imu, imu_rng, default_rng(place.field))
    heard: dict[Kind, dict[str, NDArray[np.int16] | Complexes]] = {kind: {} for kind in kinds}
    for i, name in enumerate(place.mountings):
        echoes = _echoes(settings, part, walk, who, place, name, sensor_rngs[i], _share(progress, i, settings.sensors))
        for kind in kinds:
            rng = deepcopy(sensor_rngs[i])  # every kind hears the noise that it would hear alone
            samples = receive(echoes, place.modules[name], kind, settings.module, rng)
            heard[kind][name] = samples.reshape(-1, settings.module.sample_rate * BLOCK_NS // 1_000_000_000)
    rig = _rig(settings, part, place, walk, start_rng)
    return {kind: _recording(settings, walk.trajectory, sampled, blocks, rig) for kind, blocks in heard.items()}


class _Installation(NamedTuple):
    """What the installation's seed decides, by sensor."""

    mountings: dict[str, Mounting]
    measured: dict[str, Mounting]  # what the rig says
    modules: dict[str, Module]
    walls: list[Wall]
    field: SeedSequence  # of the room's magnetic field


_INSTALLATION, _PERSON, _RECORDING = range(3)  # what a seed is for, so that none of them serves twice
_OUTSIDE = (-6.0, -6.0)  # m: where the person waits while the room is empty, out of every beam


def _generators(key: tuple[int, ...], count: int) -> list[Generator]:
    return [default_rng(child) for child in SeedSequence(key).spawn(count)]


def _number(settings: RoomSettings, part: Part) -> int:
    """Which recording of an installation: each course is one."""
    return PARTS.index(part) + (SHAPES.index(settings.course.shape) if part == "course" else 0)


def _installation(settings: RoomSettings, seed: int) -> _Installation:
    """Modules, their places, and the walls; the same for any number of sensors."""
    wall_rng, *site_rngs = _generators((_INSTALLATION, seed), 1 + len(SENSORS))
    mountings, measured, modules = {}, {}, {}
    for (name, site), rng in zip(list(SENSORS.items())[: settings.sensors], site_rngs, strict=False):
        offset, turn, error, misread = rng.normal(0.0, 1.0, 3), rng.normal(), rng.normal(0.0, 1.0, 3), rng.normal()
        position = np.array([*site.position, settings.height]) + offset * settings.position_spread * [1.0, 1.0, 0.2]
        mountings[name] = Mounting(position, site.azimuth + float(turn) * settings.azimuth_spread)
        measured[name] = Mounting(
            position + error * settings.position_error,
            mountings[name].azimuth + float(misread) * settings.azimuth_error,
        )
        modules[name] = module(settings.module, rng)
    spread = np.clip(1.0 + settings.reflections.spread * wall_rng.normal(0.0, 1.0, 4), 0.0, 2.0)
    # a mirror turns the phase over
    walls = [Wall(2, 0.0, -settings.reflections.floor)]
    for i, at in enumerate(settings.walls_at):
        walls.append(Wall(i // 2, at, -settings.reflections.walls * float(spread[i])))
    seen = [wall for wall in walls if wall.reflection != 0.0]
    return _Installation(mountings, measured, modules, seen, SeedSequence((_INSTALLATION, seed, 1)))


def _way(settings: RoomSettings, part: Part, rng: Generator) -> Trajectory:
    """Where the person is."""
    if part == "empty":
        return standing(np.array(_OUTSIDE), 0.25 * np.pi, settings.empty_duration)
    course = replace(settings.course, speed=float(settings.course.speed + rng.uniform(-0.1, 0.1)))
    legs_rng, pace_rng = rng.spawn(2)
    if part == "course":
        return trajectory(course_legs(settings.area, course, legs_rng), course, pace_rng)
    site = SENSORS["west" if part == "axial_x" else "south"]
    along = np.array([np.cos(site.azimuth), np.sin(site.azimuth)])
    near, far = (np.array(site.position) + reach * along for reach in settings.axial_reach)
    legs = back_and_forth(near, far, settings.axial_traverses, course, legs_rng)
    return trajectory(legs, course, pace_rng)


def _echoes(
    settings: RoomSettings,
    part: Part,
    walk: Gait,
    who: Person,
    place: _Installation,
    name: str,
    rng: Generator,
    progress: Callable[[float], None] | None,
) -> Complexes:
    """What reflects to one module; of an empty room, nothing that moves."""
    mounting = place.mountings[name]
    if part == "empty":
        return np.zeros(len(walk.strides) * settings.module.sample_rate // RATE, dtype=np.complex64)
    seen = seen_from(body(walk, who, settings.person), mounting.position, settings.person, rng)
    return echo(seen.points, seen.amplitudes, mounting, place.walls, settings.module, progress)


def _recording(
    settings: RoomSettings,
    way: Trajectory,
    imu: BeltSamples,
    blocks: Mapping[str, NDArray[np.int16] | Complexes],
    rig: Mapping[str, object],
) -> RoomRecording:
    """Stamps and truth of a way, with what the sensors say of it."""
    every = RATE // SAMPLE_RATE
    count = len(way.time[::every])
    flat = np.zeros((count, 1))
    facing = np.column_stack([flat, flat, way.heading[::every]])
    last_ns = BLOCK_NS - 1_000_000_000 // settings.module.sample_rate
    return RoomRecording(
        stamps_ns=EPOCH_NS + 1_000_000_000 // SAMPLE_RATE * np.arange(count, dtype=np.int64),
        imu=imu,
        position=np.column_stack([way.position[::every], flat]),
        velocity=np.column_stack([way.velocity[::every], flat]),
        orientation=from_rotation_vector(facing),
        block_stamps_ns=EPOCH_NS + last_ns + BLOCK_NS * np.arange(len(next(iter(blocks.values()))), dtype=np.int64),
        blocks=blocks,
        sample_rate=float(settings.module.sample_rate),
        carrier=settings.module.carrier,
        rig=rig,
    )


def _rig(settings: RoomSettings, part: Part, place: _Installation, walk: Gait, rng: Generator) -> Mapping[str, object]:
    """The rig as a plain map, keys as in wire.md; a course has the user's guess of the start."""
    rig: dict[str, object] = {
        "area": list(settings.area),
        "sensors": {
            name: {"position": mounting.position.tolist(), "azimuth": float(mounting.azimuth)}
            for name, mounting in place.measured.items()
        },
    }
    if part == "course":
        guess = walk.trajectory.position[0] + rng.normal(0.0, settings.start_error, 2)
        rig["start"] = {"position": guess.tolist(), "sd": settings.start_error}
    return rig


def _share(progress: Callable[[float], None] | None, index: int, count: int) -> Callable[[float], None] | None:
    """Progress of one of `count` equal shares."""
    if progress is None:
        return None
    return lambda done: progress((index + done) / count)
