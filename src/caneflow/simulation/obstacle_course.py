"""Places to walk with things in the way: where boxes of matter stand, where the floor ends, and where the walker goes.

Everything is a box aligned with x0 and y0, with a diffuse reflectance in the near infrared. Sizes are those of common
furniture and buildings; what nobody has measured is marked chosen. None of it is fitted to an estimator's result.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.random import Generator
from scipy.interpolate import PchipInterpolator

from caneflow.simulation.attitude import Floats
from caneflow.simulation.course import Course, course_through

ThingKind: TypeAlias = Literal["pole", "box", "table", "sign", "person", "stairs"]
SceneKind: TypeAlias = Literal["approach", "corridor", "room", "stairs", "street"]

LOW, WAIST, HEAD, DROP = 0, 1, 2, 3
CORRIDOR = 1.2  # m from its middle to a wall
WALL = 0.2  # m
ROOMS = 3.0  # m of the rooms behind the doors
CEILING, CELLAR = 2.6, -1.5  # m
DOOR = 0.9  # m
HAND = 0.30  # m ahead of the body
STOP_BEFORE = HAND + 0.45  # m from the body to a thing, where an approach ends
CLEARANCE = 0.5  # m from the middle of the body to what is passed, chosen: shoulder and a hand's breadth
PERSON_SPEED = 0.9  # m/s, chosen: slowed down by a corridor
BLACK = 0.04  # reflectance of black cloth


class Solid(NamedTuple):
    """A box of matter: x0, x1, y0, y1, z0, z1 in m, and its reflectance; a glass pane reflects head-on only."""

    box: tuple[float, float, float, float, float, float]
    reflectance: float
    glass: bool = False


@dataclass(frozen=True, kw_only=True)
class Thing:
    """Something in the way: what it is made of, and what is true of it as a whole."""

    kind: str
    levels: tuple[int, ...]
    box: tuple[float, float, float, float]  # x0, x1, y0, y1 in m at the first stamp
    z: tuple[float, float]  # m
    parts: tuple[Solid, ...] = ()
    velocity: tuple[float, float] = (0.0, 0.0)  # m/s
    halt: float = 0.0  # s after which it stands

    def as_map(self) -> dict[str, object]:
        """As in the `scene` of a recording."""
        return {
            "kind": self.kind,
            "levels": list(self.levels),
            "box": list(self.box),
            "z": list(self.z),
            "velocity": list(self.velocity),
            "halt": self.halt,
        }

    def moved(self, x: float) -> "Thing":
        """The same, `x` m farther along x0."""
        x0, x1, y0, y1 = self.box
        parts = tuple(part._replace(box=(part.box[0] + x, part.box[1] + x, *part.box[2:])) for part in self.parts)
        return replace(self, box=(x0 + x, x1 + x, y0, y1), parts=parts)


@dataclass(frozen=True, kw_only=True)
class ObstacleCourse:
    """A place, the things in it, and the way through."""

    kind: str
    course: Course
    things: tuple[Thing, ...]
    solids: tuple[Solid, ...]  # walls and what else stands there without being in the way
    holes: tuple[tuple[float, float, float, float], ...]  # x0, x1, y0, y1 where there is no floor at height 0
    floor_reflectance: float
    sunlight: float = 1.0  # by how much the weakest signal that is seen is stronger than indoors


def approach(thing: ThingKind, rng: Generator) -> ObstacleCourse:
    """Straight along a corridor to one thing, ending with the hand 0.45 m before it."""
    length = float(rng.uniform(4.5, 6.5))
    made = THINGS[thing](rng, float(rng.uniform(-0.2, 0.2))).moved(length + STOP_BEFORE)
    if thing == "person":
        made = replace(made, velocity=(-PERSON_SPEED, 0.0))
    return _in_corridor(f"approach_{thing}", _straight(length), [made], rng)


def corridor(rng: Generator) -> ObstacleCourse:
    """Past several things with steps aside, to a stair down."""
    kinds = _shuffled(["pole", "table", "box", "sign"], rng)
    if rng.random() < 0.4:
        kinds[int(rng.integers(4))] = "person"
    x, things, way = 4.5, [], [(0.0, 0.0), (2.5, 0.0)]
    for kind in kinds:
        thing = THINGS[kind](rng, float(rng.uniform(-0.25, 0.25))).moved(x)
        aside = _past(thing)
        if kind == "person":
            thing = replace(thing, velocity=(-PERSON_SPEED, 0.0), halt=1000.0)
        way += [(x - 0.5, aside), (x + 0.5, aside)]
        things.append(thing)
        x += float(rng.uniform(3.5, 4.3))
    end = x + 1.5
    stair = stairs_down(rng, 0.0).moved(end + STOP_BEFORE)
    way += [(x - 0.5, 0.0), (end, 0.0)]
    return _in_corridor("corridor", course_through(_smooth(way)), [*things, stair], rng)


def stairs(rng: Generator) -> ObstacleCourse:
    """A corridor with a stair up in it, passed at its side, and a stair down at its end."""
    up = Thing(
        kind="stairs_up",
        levels=(LOW, WAIST),
        box=(0.0, 1.5, 0.0, 1.2),
        z=(0.0, 0.85),
        parts=tuple(
            Solid((0.3 * i, 0.3 * (i + 1), 0.0, 1.2, 0.0, 0.17 * (i + 1)), float(rng.uniform(0.2, 0.6)))
            for i in range(5)
        ),
    ).moved(5.0)
    down = stairs_down(rng, 0.0).moved(11.0 + STOP_BEFORE)
    way = [(0.0, 0.0), (2.5, 0.0), (4.5, -0.6), (7.0, -0.6), (9.0, 0.0), (11.0, 0.0)]
    return _in_corridor("stairs", course_through(_smooth(way)), [up, down], rng)


def room(rng: Generator) -> ObstacleCourse:
    """A wide room with furniture, a glass pane, something black, and people who stand."""
    half = float(rng.uniform(3.0, 5.0))
    walls = [
        Solid((-3.0, 22.0, side * half - 0.1, side * half + 0.1, CELLAR, CEILING), float(rng.uniform(0.4, 0.8)))
        for side in (-1, 1)
    ]
    walls.append(Solid((21.5, 22.0, -half, half, CELLAR, CEILING), 0.6))
    things = []
    for kind in _shuffled(["table", "person", "glass", "black"], rng):
        offset = float(rng.uniform(-0.2, 0.2))
        if kind == "glass":
            thing = _plain("glass", (LOW, WAIST, HEAD), (0.02, 0.8, 2.1), 0.0, 0.08, offset, glass=True)
        elif kind == "black":
            thing = _plain("black", (LOW, WAIST), (0.4, 0.5, 1.1), 0.0, BLACK, offset)
        else:
            thing = THINGS[kind](rng, offset)
        things.append(thing)
    things, way = _in_a_row(things)
    return ObstacleCourse(
        kind="room",
        course=course_through(_smooth(way)),
        things=tuple(things),
        solids=tuple(walls),
        holes=(),
        floor_reflectance=float(rng.uniform(0.17, 0.35)),
    )


def street(rng: Generator) -> ObstacleCourse:
    """A pavement in sunlight: a house on one side, a kerb down on the other, lamp posts, a branch, a person coming."""
    house = Solid((-3.0, 25.0, 1.4, 1.8, CELLAR, 6.0), float(rng.uniform(0.3, 0.6)))
    road = Solid((-3.0, 25.0, -6.0, -1.2, -0.3, -0.13), float(rng.uniform(0.1, 0.2)))
    things = []
    for kind in _shuffled(["pole", "branch", "person", "box"], rng):
        offset = float(rng.uniform(-0.2, 0.2))
        if kind == "branch":
            parts = tuple(
                Solid(_centred(float(rng.uniform(0.0, 0.3)), 0.03, 0.0, float(rng.uniform(0.4, 0.9)), z, z + 0.03), 0.4)
                for z in rng.uniform(1.5, 1.95, 6)
            )
            thing = Thing(kind="branch", levels=(HEAD,), box=(0.0, 0.33, -0.45, 0.45), z=(1.5, 1.98), parts=parts)
        else:
            thing = THINGS[kind](rng, offset)
        things.append(thing)
    things, way = _in_a_row(things)
    return ObstacleCourse(
        kind="street",
        course=course_through(_smooth(way)),
        things=tuple(things),
        solids=(house, road),
        holes=((-3.0, 25.0, -6.0, -1.2),),
        floor_reflectance=float(rng.uniform(0.15, 0.3)),
        sunlight=4.0,  # the reach halves (the data sheet's figures for 5 klux)
    )


def pole(rng: Generator, offset: float) -> Thing:
    """A post, 6 to 16 cm thick."""
    size = float(rng.uniform(0.06, 0.16))
    return _plain("pole", (LOW, WAIST, HEAD), (size, size, 2.2), 0.0, float(rng.uniform(0.15, 0.8)), offset)


def box(rng: Generator, offset: float) -> Thing:
    """A carton on the floor."""
    size = (0.3, float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.2, 0.45)))
    return _plain("box", (LOW,), size, 0.0, float(rng.uniform(0.15, 0.8)), offset)


def sign(rng: Generator, offset: float) -> Thing:
    """A board that hangs at head level."""
    size = (0.08, float(rng.uniform(0.4, 0.7)), 0.4)
    return _plain("sign", (HEAD,), size, float(rng.uniform(1.4, 1.6)), float(rng.uniform(0.15, 0.8)), offset)


def table(rng: Generator, offset: float) -> Thing:
    """A top on four legs."""
    depth, width, top = 0.6, float(rng.uniform(0.6, 0.9)), 0.75
    reflectance = float(rng.uniform(0.15, 0.8))
    y0, y1 = offset - 0.5 * width, offset + 0.5 * width
    parts = [Solid((0.0, depth, y0, y1, top - 0.04, top), reflectance)]
    for x in (0.0, depth - 0.05):
        for y in (y0, y1 - 0.05):
            parts.append(Solid((x, x + 0.05, y, y + 0.05, 0.0, top - 0.04), reflectance))
    return Thing(kind="table", levels=(LOW, WAIST), box=(0.0, depth, y0, y1), z=(0.0, top), parts=tuple(parts))


def person(rng: Generator, offset: float) -> Thing:
    """Someone who comes towards the walker, and stops before they meet."""
    wide, deep, tall = 0.44, 0.44, float(rng.uniform(1.55, 1.85))
    y0, y1 = offset - 0.5 * wide, offset + 0.5 * wide
    clothes, skin = float(rng.uniform(0.15, 0.8)), 0.5
    middle = 0.5 * (y0 + y1)
    parts = (
        Solid((0.12, 0.3, y0 + 0.04, middle - 0.03, 0.0, 0.48 * tall), clothes),
        Solid((0.0, 0.18, middle + 0.03, y1 - 0.04, 0.0, 0.48 * tall), clothes),  # the leg that is ahead
        Solid((0.06, 0.3, y0, y1, 0.48 * tall, 0.85 * tall), clothes),
        Solid((0.1, 0.28, middle - 0.09, middle + 0.09, 0.85 * tall, tall), skin),
    )
    return Thing(kind="person", levels=(LOW, WAIST, HEAD), box=(0.0, deep, y0, y1), z=(0.0, tall), parts=parts)


def stairs_down(rng: Generator, offset: float) -> Thing:
    """Eight steps down, as wide as the corridor."""
    rise, tread, shade = 0.175, 0.3, float(rng.uniform(0.17, 0.5))
    parts = tuple(
        Solid((tread * i, tread * (i + 1), -CORRIDOR, CORRIDOR, CELLAR, -rise * (i + 1)), shade) for i in range(8)
    )
    return Thing(
        kind="stairs", levels=(DROP,), box=(0.0, 8 * tread, -CORRIDOR, CORRIDOR), z=(-8 * rise, 0.0), parts=parts
    )


THINGS: Mapping[str, Callable[[Generator, float], Thing]] = MappingProxyType(
    {"pole": pole, "box": box, "table": table, "sign": sign, "person": person, "stairs": stairs_down}
)
SCENES: Mapping[str, Callable[[Generator], ObstacleCourse]] = MappingProxyType(
    {"corridor": corridor, "room": room, "stairs": stairs, "street": street}
)


def _in_corridor(kind: str, course: Course, things: list[Thing], rng: Generator) -> ObstacleCourse:
    """Walls with open doors on both sides, and rooms behind them."""
    end = max([course.length + 8.0, *(thing.box[1] + 3.0 for thing in things if thing.kind == "stairs")])
    solids = []
    for side in (-1.0, 1.0):
        at, shade = -3.0, float(rng.uniform(0.4, 0.8))
        for door in [*np.sort(rng.uniform(2.0, max(course.length, 3.0), rng.integers(2, 5))), np.inf]:
            if door < at + 0.5:
                continue
            solids.append(_wall(at, min(float(door), end), side, CORRIDOR, shade))
            if door < end:
                # A leaf that is open into the room
                leaf = (float(door), float(door) + 0.04, side * (CORRIDOR + WALL), side * (CORRIDOR + WALL + 0.85))
                solids.append(Solid((*leaf[:2], min(leaf[2:]), max(leaf[2:]), 0.0, 2.0), float(rng.uniform(0.3, 0.8))))
            at = float(door) + DOOR
        solids.append(_wall(-3.0, end, side, CORRIDOR + WALL + ROOMS - 0.2, float(rng.uniform(0.4, 0.8))))
    solids.append(Solid((end - 0.5, end, -5.0, 5.0, CELLAR, CEILING), float(rng.uniform(0.4, 0.8))))
    return ObstacleCourse(
        kind=kind,
        course=course,
        things=tuple(things),
        solids=tuple(solids),
        holes=tuple(thing.box for thing in things if DROP in thing.levels),
        floor_reflectance=float(rng.uniform(0.17, 0.35)),
    )


def _wall(begin: float, end: float, side: float, inner: float, shade: float) -> Solid:
    near, far = sorted((side * inner, side * (inner + WALL)))
    return Solid((begin, end, near, far, CELLAR, CEILING), shade)


def _plain(
    kind: str,
    levels: tuple[int, ...],
    size: tuple[float, float, float],
    bottom: float,
    reflectance: float,
    offset: float,
    *,
    glass: bool = False,
) -> Thing:
    deep, wide, tall = size
    whole = _centred(0.0, deep, offset, wide, bottom, bottom + tall)
    return Thing(kind=kind, levels=levels, box=whole[:4], z=whole[4:], parts=(Solid(whole, reflectance, glass),))


def _centred(
    x: float, deep: float, y: float, wide: float, bottom: float, top: float
) -> tuple[float, float, float, float, float, float]:
    return x, x + deep, y - 0.5 * wide, y + 0.5 * wide, bottom, top


def _past(thing: Thing) -> float:
    """Where to pass a thing: on the side that is nearer to the middle, within what a corridor leaves."""
    left, right = thing.box[3] + CLEARANCE, thing.box[2] - CLEARANCE
    aside = left if abs(left) <= abs(right) else right
    return float(np.clip(aside, 0.3 - CORRIDOR + 0.1, CORRIDOR - 0.3 - 0.1))


def _in_a_row(things: Sequence[Thing]) -> tuple[list[Thing], list[tuple[float, float]]]:
    """The things one after another, every 3.6 m from 4.5 m on, and a way (x, y in m) that passes each of them."""
    placed, way, x = [], [(0.0, 0.0), (2.5, 0.0)], 4.5
    for thing in things:
        placed.append(thing.moved(x))
        aside = _past(placed[-1])
        way += [(x - 0.5, aside), (x + 0.7, aside)]
        x += 3.6
    return placed, [*way, (x, 0.0)]


def _shuffled(kinds: list[str], rng: Generator) -> list[str]:
    return [kinds[i] for i in rng.permutation(len(kinds))]


def _straight(length: float) -> Course:
    return course_through(np.stack([np.linspace(0.0, length, 100), np.zeros(100)], axis=1))


def _smooth(way: Sequence[tuple[float, float]]) -> Floats:
    """A line through the points (x, y) that does not swing out beside them."""
    points = np.array(sorted(dict(way).items()), dtype=np.float64)
    x = np.linspace(points[0, 0], points[-1, 0], round((points[-1, 0] - points[0, 0]) / 0.01) + 1)
    return np.stack([x, np.asarray(PchipInterpolator(points[:, 0], points[:, 1])(x))], axis=1)
