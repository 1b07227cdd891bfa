"""Courses in a room: where a person walks, turns and stands, as functions of time at 200 Hz.

A course is a list of legs. Between two legs the person stands, and turns on the spot to where the next one begins.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.course import Course
from caneflow.simulation.smooth_noise import slow

RATE = 200  # Hz, of a person's motion: ten times what a limb does (see doppler_module.py for what lies between)

RoomShape: TypeAlias = Literal["circle", "back_and_forth", "random", "square", "figure_eight"]
SHAPES: tuple[RoomShape, ...] = get_args(RoomShape)

Area: TypeAlias = tuple[float, float, float, float]  # xmin, xmax, ymin, ymax, m

NotNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]

SLOWEST, FASTEST = 0.5, 1.5  # m/s of a walking person (room.md; paper section 3)


@dataclass(frozen=True, kw_only=True)
class CourseSettings:
    """One course; every number without a source is chosen."""

    shape: RoomShape = "circle"
    stops: Annotated[int, Ge(0)] | None = None  # None: what belongs to the shape, see STOPS
    speed: Annotated[float, Gt(0.6), Gt(0)] = 1.0  # m/s at which this person likes to walk
    speed_variation: NotNegative = 0.7  # sd, in units in which 1 is most of the way from 1.0 to 1.5 m/s
    speed_scale: Positive = 6.0  # m over which the speed changes: "not constant speed" (paper, section 3)
    # A walker eases the speed off in a bend, towards the slowest one: by half where the radius is this
    slow_radius: Positive = 0.5  # m
    rounding: Positive = 0.2  # m, sd of the smoothing of a corner: 90 deg become a bend of 0.3 m radius
    turn_rate: Positive = 150.0 * DEGREE  # rad/s, mean while turning on the spot: about face in 1.2 s
    ramp: Positive = 0.8  # s from standing to walking: one or two steps
    stop_duration: tuple[float, float] = (2.0, 5.0)  # s
    rest_before: Positive = 2.0  # s of standing (as cane.md, row 15)
    rest_after: Positive = 1.0  # s


STOPS: dict[RoomShape, int] = {"circle": 0, "back_and_forth": 0, "random": 2, "square": 2, "figure_eight": 1}
REVOLUTIONS = 10  # of the circle (paper, section 3)


class Trajectory(NamedTuple):
    """A person's way over the floor at RATE, n samples; the average over a stride, without bob and sway."""

    time: Floats  # (n,) s
    position: Floats  # (n, 2) m
    velocity: Floats  # (n, 2) m/s
    heading: Floats  # (n,) rad from x0, counter-clockwise, continuous: where the person faces
    distance: Floats  # (n,) m walked


class Leg(NamedTuple):
    """A stretch that is walked without stopping, after some standing."""

    course: Course
    start: float  # m along the course
    end: float  # m along the course
    wait: float  # s of standing before it, besides turning


class _Walked(NamedTuple):
    """A leg in time."""

    leg: Leg
    before: float  # m walked on the legs before
    begins: float  # s
    ends: float  # s
    elapsed: Floats  # (m,) s of cruise time ...
    along: Floats  # (m,) ... at which so many m of the course are reached


def course_legs(area: Area, settings: CourseSettings, rng: Generator) -> list[Leg]:
    """The legs of a course of `settings.shape` within `area`; all that is free comes from `rng`."""
    shape_rng, stop_rng = rng.spawn(2)
    low, high = np.array([area[0], area[2]]), np.array([area[1], area[3]])
    centre, half = 0.5 * (low + high), 0.5 * float(min(high - low))
    match settings.shape:
        case "circle":
            legs = _circle(centre, half, settings, shape_rng)
        case "back_and_forth":
            angle = shape_rng.uniform(0.0, np.pi)
            reach = 0.8 * half * np.array([np.cos(angle), np.sin(angle)])
            legs = back_and_forth(centre - reach, centre + reach, 8, settings, shape_rng)
        case "random":
            legs = _random(low + 0.1 * half, high - 0.1 * half, settings, shape_rng)
        case "square":
            legs = [_whole(_square(centre, 0.65 * half, settings, shape_rng))]
        case "figure_eight":
            legs = [_whole(_figure_eight(centre, half, settings, shape_rng))]
    stops = STOPS[settings.shape] if settings.stops is None else settings.stops
    return _with_stops(legs, stops, settings, stop_rng)


def back_and_forth(
    start: Floats, end: Floats, traverses: int, settings: CourseSettings, rng: Generator, astray: float = 0.08
) -> list[Leg]:
    """Legs from `start` (2,) m to `end` (2,) m and back again, `traverses` in all.

    The walker strays sideways by `astray` (m, sd, chosen), for nobody walks along a line that is not drawn.
    """
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    aside = np.array([-along[1], along[0]])
    stray = slow(rng, astray, 3.0)
    part = np.linspace(0.0, length, max(2, round(length / _NODE)))
    legs = []
    for traverse in range(traverses):
        here = part if traverse % 2 == 0 else length - part
        offset = stray(traverse * length + part)
        line = start + here[:, None] * along + offset[:, None] * aside
        legs.append(_whole(_rounded(line, settings.rounding), wait=rng.uniform(0.2, 0.6)))
    return legs


def trajectory(legs: Sequence[Leg], settings: CourseSettings, rng: Generator, block: int = 10) -> Trajectory:
    """The legs walked in time; the number of samples is a multiple of `block`.

    While a person walks the speed stays between SLOWEST and FASTEST; it leaves and reaches 0 within `ramp` s.
    """
    speed_rng, side_rng = rng.spawn(2)
    liking = np.arctanh(np.clip((settings.speed - 1.0) / _SPAN, -0.9, 0.9))
    wander = slow(speed_rng, settings.speed_variation, settings.speed_scale)
    walked: list[_Walked] = []
    turns: list[tuple[float, float, float]] = []  # begins, ends (s), by (rad)
    now, before, facing = settings.rest_before, 0.0, None
    for leg in legs:
        heads = float(leg.course.heading(np.array([leg.start]))[0])
        if facing is not None:
            by = _short_way(heads - facing, side_rng)
            lasts = abs(by) / settings.turn_rate
            if lasts > 0.05:  # s; a course that goes on as it came needs no turn
                lasts = max(lasts, 0.5)
                turns.append((now + leg.wait, now + leg.wait + lasts, by))
                now += lasts
            now += leg.wait
        along = np.linspace(leg.start, leg.end, max(3, round((leg.end - leg.start) / _PACE_NODE)))
        pace = 1.0 + _SPAN * np.tanh(liking + wander(before + along - leg.start))
        bend = settings.slow_radius * np.abs(leg.course.curvature(along))
        slowness = 1.0 / (SLOWEST + (pace - SLOWEST) / (1.0 + bend))
        elapsed = np.concatenate([[0.0], np.cumsum(0.5 * (slowness[1:] + slowness[:-1])) * (along[1] - along[0])])
        ends = now + elapsed[-1] + min(settings.ramp, elapsed[-1])
        walked.append(_Walked(leg, before, now, ends, elapsed, along))
        now, before = ends, before + leg.end - leg.start
        facing = float(leg.course.heading(np.array([leg.end]))[0])
    count = int(np.ceil((now + settings.rest_after) * RATE / block)) * block
    return _sampled(walked, turns, np.arange(count) / RATE, settings.ramp)


def standing(place: Floats, heading: float, duration: float) -> Trajectory:
    """A person who stands at `place` (2,) m for `duration` s."""
    time = np.arange(round(duration * RATE)) / RATE
    zeros = np.zeros(len(time))
    return Trajectory(time, np.tile(place, (len(time), 1)), np.zeros((len(time), 2)), zeros + heading, zeros)


_NODE = 0.02  # m between the points of a curve
_PACE_NODE = 0.02  # m between the points at which a speed is set
_SPAN = 0.45  # m/s: the pace stays within 1.0 +- 0.45 m/s, so that bob and rounding leave it in 0.5..1.5
_SHARP = 105.0 * DEGREE  # rad; a sharper corner is turned on the spot, else a walker would spin at over 300 deg/s


def _sampled(
    walked: Sequence[_Walked], turns: Sequence[tuple[float, float, float]], time: Floats, ramp: float
) -> Trajectory:
    """Position, velocity and heading at every `time`."""
    first = walked[0].leg
    position = np.tile(first.course.position(np.array([first.start]))[0], (len(time), 1))
    came = float(first.course.heading(np.array([first.start]))[0])
    heading, distance = np.full(len(time), came), np.zeros(len(time))
    for walk, after in zip(walked, [*walked[1:], None], strict=True):
        course, start, end, _ = walk.leg
        until = np.inf if after is None else after.begins
        mine = (time >= walk.begins) & (time < until)
        cruise = _cruise(time[mine] - walk.begins, walk.ends - walk.begins, ramp)
        along = np.asarray(CubicSpline(walk.elapsed, walk.along)(cruise), dtype=np.float64)
        position[mine] = course.position(along)
        distance[mine] = walk.before + along - start
        # a course may begin with any multiple of 2 pi: what counts is what it turns from there on
        heading[mine] = came + course.heading(along) - course.heading(np.array([start]))
        came += float(np.diff(course.heading(np.array([start, end])))[0])
    for begins, ends, by in turns:
        heading += by * _eased((time - begins) / (ends - begins))
    return Trajectory(time, position, np.gradient(position, 1.0 / RATE, axis=0), heading, distance)


def _cruise(time: Floats, lasts: float, ramp: float) -> Floats:
    """Cruise time gone at `time` after the start of a leg of `lasts` s, with gentle start and end."""
    ramp = min(ramp, 0.5 * lasts)
    t = np.clip(time, 0.0, lasts)
    left = lasts - t
    gone = np.where(t < ramp, ramp * _eased_integral(t / ramp), t - 0.5 * ramp)
    return np.where(left < ramp, lasts - ramp - ramp * _eased_integral(left / ramp), gone)


def _eased(x: Floats) -> Floats:
    """0 below 0, 1 above 1, and two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def _eased_integral(x: Floats) -> Floats:
    """Integral of `_eased` from 0 to x, for x in 0..1."""
    return x**4 * (2.5 + x * (x - 3.0))


def _short_way(angle: float, rng: Generator) -> float:
    """An angle in -pi..pi; about face may go either way round."""
    angle = float((angle + np.pi) % (2.0 * np.pi) - np.pi)
    if abs(angle) > 170.0 * DEGREE and rng.random() < 0.5:
        angle -= float(np.copysign(2.0 * np.pi, angle))
    return angle


def _whole(course: Course, wait: float = 0.0) -> Leg:
    return Leg(course, 0.0, course.length, wait)


def _with_stops(legs: Sequence[Leg], stops: int, settings: CourseSettings, rng: Generator) -> list[Leg]:
    """The legs with so many stops on them, anywhere but within 1.5 m of where a leg ends anyway."""
    lengths = np.array([max(leg.end - leg.start - 3.0, 0.0) for leg in legs])
    if stops == 0 or lengths.sum() == 0.0:
        return list(legs)
    # one stop in each of `stops` equal parts of what may be stopped on
    at = (np.arange(stops) + rng.uniform(0.2, 0.8, stops)) / stops * lengths.sum()
    durations = rng.uniform(*settings.stop_duration, stops)
    cut: list[Leg] = []
    for leg, length, before in zip(legs, lengths, np.cumsum(lengths) - lengths, strict=True):
        here, wait = leg.start, leg.wait
        for place, duration in zip(at - before, durations, strict=True):
            if 0.0 <= place < length:
                stop = leg.start + 1.5 + float(place)
                cut.append(Leg(leg.course, here, stop, wait))
                here, wait = stop, float(duration)
        cut.append(Leg(leg.course, here, leg.end, wait))
    return cut


def _circle(centre: Floats, half: float, settings: CourseSettings, rng: Generator) -> list[Leg]:
    """Ten revolutions, either way round, with two or three U-turns on the spot."""
    radius = half * rng.uniform(0.55, 0.7)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    way = rng.choice([-1.0, 1.0])
    pieces = int(rng.integers(3, 5))
    turns = (np.arange(1, pieces) + rng.uniform(-0.25, 0.25, pieces - 1)) / pieces * REVOLUTIONS
    legs = []
    for revolutions in np.diff(np.concatenate([[0.0], turns, [REVOLUTIONS]])):
        sweep = way * 2.0 * np.pi * revolutions
        angles = np.linspace(angle, angle + sweep, round(abs(sweep) * radius / _NODE))
        line = centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        legs.append(_whole(_rounded(line, settings.rounding), wait=rng.uniform(0.2, 0.6)))
        angle, way = angle + sweep, -way
    return legs


def _square(centre: Floats, half: float, settings: CourseSettings, rng: Generator) -> Course:
    """Four laps of a square, from the middle of a side, either way round."""
    corners = half * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    corners = np.roll(corners, rng.integers(4), axis=0)[:: rng.choice([-1, 1])]
    middle = 0.5 * (corners[-1] + corners[0])
    path = np.concatenate([[middle], np.tile(corners, (4, 1)), [middle]])
    return _rounded(centre + _dense(path), settings.rounding)


def _figure_eight(centre: Floats, half: float, settings: CourseSettings, rng: Generator) -> Course:
    """Four laps of a Gerono lemniscate, lying or standing."""
    u = np.linspace(0.0, 4 * 2.0 * np.pi, 4000)
    wide, high = 0.75 * half * np.sin(u), 0.5 * half * np.sin(2.0 * u) * rng.choice([-1.0, 1.0])
    line = np.stack([wide, high] if rng.random() < 0.5 else [high, wide], axis=1)
    return _rounded(centre + _dense(line), settings.rounding)


def _random(low: Floats, high: Floats, settings: CourseSettings, rng: Generator) -> list[Leg]:
    """About 100 m from one random point to the next, corners turned in walking or, where sharp, on the spot."""
    points = [rng.uniform(low, high)]
    length = 0.0
    while length < 100.0:
        there = rng.uniform(low, high)
        step = float(np.linalg.norm(there - points[-1]))
        if step >= 2.0:  # m, chosen: a shorter way is not a leg
            points.append(there)
            length += step
    path = np.array(points)
    heading = np.arctan2(np.diff(path[:, 1]), np.diff(path[:, 0]))
    turn = np.abs((np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi)
    ends = [0, *(np.flatnonzero(turn > _SHARP) + 1).tolist(), len(path) - 1]
    return [
        _whole(_rounded(_dense(path[a : b + 1]), settings.rounding), wait=rng.uniform(0.1, 0.4))
        for a, b in pairwise(ends)
    ]


def _dense(corners: Floats) -> Floats:
    """Points every 2 cm along a line through `corners` (k, 2), m."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.linspace(0.0, at[-1], max(2, round(at[-1] / _NODE)))
    return np.stack([np.interp(along, at, corners[:, axis]) for axis in (0, 1)], axis=1)


def _rounded(line: Floats, rounding: float) -> Course:
    """The curve along points (k, 2), m, about 2 cm apart, smoothed by a Gaussian of `rounding` m."""
    beyond = round(5.0 * rounding / _NODE)
    ahead = np.arange(1, beyond + 1)[:, None]
    # straight on beyond both ends, so that they stay where they are
    before, after = line[0] - ahead[::-1] * (line[1] - line[0]), line[-1] + ahead * (line[-1] - line[-2])
    spread = rounding / float(np.linalg.norm(line[1] - line[0]))
    smooth = gaussian_filter1d(np.concatenate([before, line, after]), spread, axis=0, truncate=4.0)
    smooth = smooth[beyond:-beyond]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    curve = CubicSpline(along, smooth)
    tangent = np.asarray(curve(along, 1), dtype=np.float64)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Course(float(along[-1]), CubicSpline(along, np.column_stack([smooth, heading])))
