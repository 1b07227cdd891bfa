"""What the radar sees: scatterers on the floor, on walls and on a person who walks by.

Amplitudes are square roots of radar cross-sections (m^2), so that floor, wall, person and tip stand in a physical
ratio to each other; the receiver's noise is set from the floor (see radar.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Gt
from numpy.random import Generator
from numpy.typing import NDArray

from caneflow.simulation.attitude import Floats
from caneflow.simulation.course import Course

Complexes: TypeAlias = NDArray[np.complex128]

_MARGIN = 3.5  # m of floor around the course: the radar's range and the arm


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """The room."""

    # 400 points per m^2 put about 30 into a resolution cell (0.09 m by the beam's 0.7 m at 1 m): developed speckle
    floor_density: Annotated[float, Gt(0)] = 400.0  # 1/m^2; the mean power does not depend on it
    # -15 dB, the order of what handbooks give for asphalt and concrete near 45 deg of grazing (Ulaby and Dobson,
    # Handbook of Radar Scattering Statistics for Terrain, 1989); it matters only against wall, person and tip
    floor_reflectivity: Annotated[float, Gt(0)] = 0.03  # m^2 per m^2
    walls: bool = False  # four walls around the course
    person: bool = False  # someone who walks the same course the other way


class Walker(NamedTuple):
    """A person of p scatterers."""

    course: Course
    start: float  # m along the course
    aside: float  # m to the left of the course
    offsets: Floats  # (p, 2) m, sideways and above the floor
    stride: Floats  # (p,) m by which a scatterer swings forwards and back
    amplitudes: Complexes  # (p,) m

    def positions(self, time: Floats) -> Floats:
        """Where the scatterers are at `time` (b,) s: (b, p, 3) m."""
        distance = (self.start - _WALKER_SPEED * time) % self.course.length
        heading = self.course.heading(distance)
        cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
        phase = np.pi * _WALKER_SPEED / _WALKER_STEP * time[:, None]
        along = self.stride * np.sin(phase)
        aside = self.aside + self.offsets[:, 0]
        here = self.course.position(distance)
        x = here[:, :1] + cos * along - sin * aside
        y = here[:, 1:] + sin * along + cos * aside
        return np.stack([x, y, np.broadcast_to(self.offsets[:, 1], x.shape)], axis=-1)


class Passer(NamedTuple):
    """A person of p scatterers who comes straight along x0, and may stop."""

    points: Floats  # (p, 3) m, at time 0
    velocity: float  # m/s along x0
    halt: float  # s after which the person stands
    amplitudes: Complexes  # (p,) m

    def positions(self, time: Floats) -> Floats:
        """Where the scatterers are at `time` (b,) s: (b, p, 3) m."""
        moved = self.velocity * np.minimum(time, self.halt)
        places: Floats = self.points + moved[:, None, None] * np.array([1.0, 0.0, 0.0])
        return places


class Scene(NamedTuple):
    """Everything that scatters."""

    points: Floats  # (k, 3) m
    amplitudes: Complexes  # (k,) m
    walker: Walker | Passer | None
    floor_reflectivity: float  # m^2 per m^2


_WALL_DISTANCE = (0.9, 1.4)  # m outside the course, chosen: a corridor
_WALL_HEIGHT = 2.2  # m; what is higher is out of range
_WALL_DENSITY = 60.0  # 1/m^2
_WALL_REFLECTIVITY = 0.1  # m^2 per m^2, chosen: 5 dB above the floor, because it is met at a steeper angle
_FOOT_DENSITY = 10.0  # 1/m along the foot of a wall
_FOOT_SECTION = 0.02  # m^2 per m, chosen: floor and wall together throw back what they get
_WALKER_SPEED = 1.0  # m/s, against the walker with the cane, chosen
_WALKER_STEP = 0.65  # m
_PERSON_SECTION = 0.5  # m^2, usual for an adult at these frequencies (0.3 to 1 m^2)


def scene(settings: SceneSettings, course: Course, rng: Generator) -> Scene:
    """The room around a course."""
    floor_rng, wall_rng, person_rng = rng.spawn(3)
    outline = course.position(np.linspace(0.0, course.length, 500))
    low, high = outline.min(axis=0), outline.max(axis=0)
    parts = [_floor(settings, low - _MARGIN, high + _MARGIN, floor_rng)]
    if settings.walls:
        gap = wall_rng.uniform(*_WALL_DISTANCE)
        parts += _walls(low - gap, high + gap, wall_rng)
    points = np.concatenate([points for points, _ in parts])
    amplitudes = np.concatenate([amplitudes for _, amplitudes in parts])
    walker = _walker(course, person_rng) if settings.person else None
    return Scene(points, amplitudes, walker, settings.floor_reflectivity)


def with_boxes(room: Scene, boxes: Sequence[tuple[Floats, float]], passer: Passer | None, rng: Generator) -> Scene:
    """The same with scatterers all over boxes (x0, x1, y0, y1, z0, z1 in m; m^2 per m^2), and one who passes."""
    parts = [(room.points, room.amplitudes)]
    for box, reflectivity in boxes:
        low, high = box[0::2], np.minimum(box[1::2], [np.inf, np.inf, _WALL_HEIGHT])
        low = np.maximum(low, [-_MARGIN, -np.inf, 0.0])
        size = high - low
        if size.min() <= 0.0:
            continue
        area = 2.0 * float(size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
        count = int(rng.poisson(_WALL_DENSITY * area))
        points = rng.uniform(low, high, (count, 3))
        faces = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        axis = rng.choice(3, count, p=faces / faces.sum())
        points[np.arange(count), axis] = np.where(rng.random(count) < 0.5, low[axis], high[axis])
        parts.append((points, _amplitudes(count, reflectivity / _WALL_DENSITY, rng)))
    points, amplitudes = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Scene(points, amplitudes, passer, room.floor_reflectivity)


def passer(box: Floats, velocity: float, halt: float, rng: Generator) -> Passer:
    """A person within a box (x0, x1, y0, y1, z0, z1), m."""
    points = rng.uniform(box[0::2], box[1::2], (16, 3))
    return Passer(points, velocity, halt, _amplitudes(16, _PERSON_SECTION / 16.0, rng))


def _floor(settings: SceneSettings, low: Floats, high: Floats, rng: Generator) -> tuple[Floats, Complexes]:
    count = int(rng.poisson(settings.floor_density * np.prod(high - low)))
    points = np.zeros((count, 3))
    points[:, :2] = rng.uniform(low, high, (count, 2))
    return points, _amplitudes(count, settings.floor_reflectivity / settings.floor_density, rng)


def _walls(low: Floats, high: Floats, rng: Generator) -> list[tuple[Floats, Complexes]]:
    """Four faces of a box and the lines in which they meet the floor."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    parts = []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        extent = float(np.linalg.norm(end - begin))
        for density, top, section in (
            (_WALL_DENSITY * _WALL_HEIGHT, _WALL_HEIGHT, _WALL_REFLECTIVITY / _WALL_DENSITY),
            (_FOOT_DENSITY, 0.0, _FOOT_SECTION / _FOOT_DENSITY),
        ):
            count = int(rng.poisson(density * extent))
            along = rng.uniform(0.0, 1.0, (count, 1))
            height = rng.uniform(0.0, 1.0, (count, 1)) * top
            parts.append((np.hstack([begin + along * (end - begin), height]), _amplitudes(count, section, rng)))
    return parts


def _walker(course: Course, rng: Generator) -> Walker:
    """A trunk of eight scatterers and two legs of four in opposite phase; a third of the power is legs."""
    trunk = np.stack([rng.uniform(-0.2, 0.2, 8), rng.uniform(0.9, 1.6, 8)], axis=1)
    height = np.linspace(0.1, 0.8, 4)
    legs = [np.stack([np.full(4, side), height], axis=1) for side in (-0.1, 0.1)]
    swing = 0.5 * _WALKER_STEP * (1.0 - height / 0.9)  # from the hip at 0.9 m
    shares = np.repeat([2.0 / 3.0 / 8.0, 1.0 / 3.0 / 8.0], 8)
    return Walker(
        course=course,
        start=float(rng.uniform(0.0, course.length)),
        aside=float(rng.uniform(0.7, 1.0) * rng.choice([-1.0, 1.0])),
        offsets=np.concatenate([trunk, *legs]),
        stride=np.concatenate([np.zeros(8), swing, -swing]),
        amplitudes=_amplitudes(16, 1.0, rng) * np.sqrt(_PERSON_SECTION * shares),
    )


def _amplitudes(count: int, section: float, rng: Generator) -> Complexes:
    """Circular complex Gaussian amplitudes (count,) of mean square `section`, m^2."""
    parts = rng.normal(0.0, np.sqrt(0.5 * section), (2, count))
    return np.asarray(parts[0] + 1j * parts[1], dtype=np.complex128)
