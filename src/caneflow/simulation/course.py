"""Courses on the floor: where the walker's body goes, as a function of the distance walked.

All of them have a continuous curvature, so that a body that follows one has a continuous acceleration.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from caneflow.simulation.attitude import Floats

Shape: TypeAlias = Literal["loop", "straight", "figure_eight"]

_STEP = 0.005  # m between the nodes of the splines, about
_EASING = 0.15  # m over which a walker leads into a bend (chosen: a third of a step)
_LEAD = 1.0  # m of straight between the last corner and the start, so that no walk starts within a bend


@dataclass(frozen=True)
class Course:
    """A plane curve by its arc length; the curve starts at the origin, towards +x0."""

    length: float  # m
    _spline: CubicSpline  # distance -> x, y (m), heading (rad)

    def position(self, distance: Floats) -> Floats:
        """Points (n, 2), m, at distances (n,), m."""
        return np.asarray(self._spline(distance), dtype=np.float64)[:, :2]

    def heading(self, distance: Floats) -> Floats:
        """Direction of travel (n,), rad from x0, counter-clockwise, continuous along the curve."""
        return np.asarray(self._spline(distance), dtype=np.float64)[:, 2]

    def curvature(self, distance: Floats) -> Floats:
        """Curvature (n,), 1/m, positive to the left."""
        return np.asarray(self._spline(distance, 1), dtype=np.float64)[:, 2]


def course(shape: Shape, length: float, width: float, corner_radius: float, laps: int, clockwise: bool) -> Course:
    """The course of a shape; `length` and `width` in m, corners rounded to `corner_radius`, m.

    loop: rectangle with rounded corners that is walked in exactly 2 (length + width): the paper gives 8 x 3 m and
    22 m, which only a rectangle with sharp corners has, so each side is widened by what its rounding saves.
    straight: `length` along x0, `width` is not used. figure_eight: a Gerono lemniscate of `length` by `width`.

    Raises ValueError when the corners do not fit into the rectangle.
    """
    if shape == "straight":
        lap_length, heading = length, np.zeros(2)
    elif shape == "loop":
        lap_length, heading = 2.0 * (length + width), _loop(length, width, corner_radius)
    else:
        lap_length, heading = _figure_eight(length, width)
    nodes = round(lap_length / _STEP) + 1
    heading = np.interp(np.linspace(0.0, 1.0, nodes), np.linspace(0.0, 1.0, len(heading)), heading)
    walked = np.concatenate([lap * heading[-1] + heading[min(lap, 1) :] for lap in range(laps)])
    return _from_heading(-walked if clockwise else walked, lap_length / (nodes - 1))


def course_through(points: Floats) -> Course:
    """The course through points (n, 2), m, that lie close to each other; it starts at the first, eased in its bends."""
    steps = np.diff(points, axis=0)
    walked = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    nodes = round(float(walked[-1]) / _STEP) + 1
    distance = np.linspace(0.0, walked[-1], nodes)
    middle = 0.5 * (walked[1:] + walked[:-1])
    heading = np.interp(distance, middle, np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))
    return _from_heading(heading, float(walked[-1]) / (nodes - 1))


def _from_heading(heading: Floats, step: float) -> Course:
    """The curve through nodes `step` apart whose directions are `heading`, eased."""
    heading = gaussian_filter1d(heading, _EASING / step, mode="nearest")
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * step])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * step])
    distance = step * np.arange(len(heading))
    return Course(float(distance[-1]), CubicSpline(distance, np.stack([x, y, heading], axis=1)))


def _loop(length: float, width: float, radius: float) -> Floats:
    """Heading (rad) at equally spaced points along one lap of a rounded rectangle, counter-clockwise."""
    arc = 0.5 * np.pi * radius
    saved = 2.0 * radius - arc  # what one rounded corner saves
    along, across = length + saved - 2.0 * radius, width + saved - 2.0 * radius
    if min(along - _LEAD, across) < 4.0 * _EASING:
        raise ValueError(f"corners of radius {radius} m do not fit into a loop of {length} x {width} m")
    ends = np.cumsum([0.0, along - _LEAD, arc, across, arc, along, arc, across, arc, _LEAD])
    turned = 0.5 * np.pi * np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    return np.interp(np.linspace(0.0, ends[-1], 100_001), ends, turned)


def _figure_eight(length: float, width: float) -> tuple[float, Floats]:
    """Length (m) of one lap of x = a sin u, y = b sin 2u, and heading (rad) at equally spaced points along it."""
    u = np.linspace(0.0, 2.0 * np.pi, 100_001)
    dx, dy = 0.5 * length * np.cos(u), width * np.cos(2.0 * u)  # a = length / 2, b = width / 2
    speed = np.hypot(dx, dy)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1])) * (u[1] - u[0])])
    heading = np.unwrap(np.arctan2(dy, dx))
    return float(distance[-1]), np.interp(np.linspace(0.0, distance[-1], len(u)), distance, heading - heading[0])
