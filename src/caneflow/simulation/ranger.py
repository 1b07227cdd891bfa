"""A multizone time-of-flight ranger: what its zones say of boxes and a floor, with the smear of its exposure.

Each zone is nine rays spread over its angle and over the exposure; what comes back of them is added up as photons are,
and the strongest cluster of distances is the zone's answer. Figures are those of a VL53L5CX (ST DS13754): 45 x 45 deg,
17 % grey seen to about 2.5 m at 15 Hz indoors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.obstacle_course import ObstacleCourse, Solid, Thing
from caneflow.simulation.walk import Motion

NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True, kw_only=True)
class RangerSettings:
    """One sensor on the shaft."""

    position: tuple[float, float, float]  # m from the IMU, body
    tilt: float  # rad by which it looks up from the shaft
    first: float = 0.2  # s, stamp of its first reading
    rows: int = 8
    columns: int = 8
    field: float = 45.0 * DEGREE  # rad over the rows and over the columns
    reach: tuple[float, float] = (0.02, 4.0)  # m
    period: Annotated[float, Gt(0)] = 1.0 / 15.0  # s, all of it exposure
    grey_seen_to: Annotated[float, Gt(0)] = 2.5  # m, of 17 % grey, head-on, over a whole zone
    noise: NotNegative = 0.015  # of the range, sd
    zone_bias: NotNegative = 0.01  # of the range, sd between zones
    outliers: NotNegative = 0.003  # of the readings of a zone
    cluster: Annotated[float, Gt(0)] = 0.12  # m
    mount_error: NotNegative = 0.5 * DEGREE  # rad, sd about each axis: as well as a person screws it on

    @property
    def boresight(self) -> tuple[float, float, float]:
        """Unit vector, body frame."""
        return 0.0, float(np.cos(self.tilt)), float(np.sin(self.tilt))

    @property
    def up(self) -> tuple[float, float, float]:
        """Unit vector, body frame."""
        return 0.0, -float(np.sin(self.tilt)), float(np.cos(self.tilt))

    def as_map(self) -> dict[str, object]:
        """As in `rig.rangers`."""
        return {
            "position": list(self.position),
            "boresight": list(self.boresight),
            "up": list(self.up),
            "rows": self.rows,
            "columns": self.columns,
            "field": [float(self.field), float(self.field)],
            "reach": list(self.reach),
            "kind": "tof",
        }


# For a shaft held 42 degrees down: one looks 10 degrees up, the other 33 degrees down.
UP = RangerSettings(position=(0.0, -0.2, 0.03), tilt=52.0 * DEGREE, first=0.2)
DOWN = RangerSettings(position=(0.0, -0.17, 0.03), tilt=9.0 * DEGREE, first=0.2 + 0.5 / 15.0)


class Readings(NamedTuple):
    """n readings of one ranger."""

    time: Floats  # (n,) s, ends of the exposures
    ranges: NDArray[np.float32]  # (n, zones) m
    status: NDArray[np.uint8]  # (n, zones)
    sigma: NDArray[np.float32]  # (n, zones) m


def read(motion: Motion, course: ObstacleCourse, settings: RangerSettings, rng: Generator) -> Readings:
    """All readings of a ranger during a motion."""
    mount = Rotation.from_rotvec(rng.normal(0.0, settings.mount_error, 3))
    bias = 1.0 + settings.zone_bias * rng.normal(0.0, 1.0, settings.rows * settings.columns)
    slerp = Slerp(motion.time, Rotation.from_quat(motion.orientation[:, [1, 2, 3, 0]]))
    rays = mount.apply(_rays(settings)).reshape(9, -1, 3)
    moments = np.array([0, 5, 7, 3, 4, 1, 8, 2, 6])[:, None] / 8.0 * settings.period  # no order in space and time
    times = np.arange(settings.first, motion.time[-1], settings.period)
    answers = []
    for end in times:
        taken = end - settings.period + moments[:, 0]
        turned = slerp(np.clip(taken, motion.time[0], motion.time[-1])).as_quat()[:, [3, 0, 1, 2]]
        origin = np.stack([np.interp(taken, motion.time, motion.position[:, axis]) for axis in range(3)], axis=1)
        origin = origin + attitude.rotate(turned, settings.position)
        directions = np.stack([attitude.rotate(turned[i : i + 1], rays[i]) for i in range(9)])
        distance, signal = cast(origin, directions, course, float(end) - 0.5 * settings.period)
        answers.append(_zones(distance, signal, course.sunlight, settings, bias, rng))
    ranges, status = (np.array(each) for each in zip(*answers, strict=True))
    return Readings(
        time=times,
        ranges=ranges.astype(np.float32),
        status=status.astype(np.uint8),
        sigma=(ranges * np.hypot(settings.noise, settings.zone_bias)).astype(np.float32),
    )


def cast(origin: Floats, directions: Floats, course: ObstacleCourse, time: float) -> tuple[Floats, Floats]:
    """Distance (m, inf where there is nothing) and signal (reflectance cos / distance^2) of rays.

    `origin` (m, 3), `directions` (m, k, 3), at `time` s.
    """
    solids = [*course.solids, *(part for thing in course.things for part in _parts_at(thing, time))]
    distance, reflected = _floor(origin, directions, course)
    for first in range(0, len(solids), 32):
        hit, back = _boxes(origin, directions, solids[first : first + 32])
        nearer = hit < distance
        distance = np.where(nearer, hit, distance)
        reflected = np.where(nearer, back, reflected)
    with np.errstate(divide="ignore", invalid="ignore"):
        signal = np.where(np.isfinite(distance), reflected / distance**2, 0.0)
    return distance, signal


def _parts_at(thing: Thing, time: float) -> Sequence[Solid]:
    dx = thing.velocity[0] * min(time, thing.halt)
    if dx == 0.0:
        return thing.parts
    return [part._replace(box=(part.box[0] + dx, part.box[1] + dx, *part.box[2:])) for part in thing.parts]


def _floor(origin: Floats, directions: Floats, course: ObstacleCourse) -> tuple[Floats, Floats]:
    down = directions[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(down < -1e-6, -origin[:, None, 2] / down, np.inf)
        x = origin[:, None, 0] + distance * directions[..., 0]
        y = origin[:, None, 1] + distance * directions[..., 1]
    for x0, x1, y0, y1 in course.holes:
        distance = np.where((x > x0) & (x < x1) & (y > y0) & (y < y1), np.inf, distance)
    distance = np.where(distance > 0.0, distance, np.inf)
    return distance, course.floor_reflectance * np.abs(down)


def _boxes(origin: Floats, directions: Floats, solids: Sequence[Solid]) -> tuple[Floats, Floats]:
    """The nearest of some boxes along each ray: distance (m), and reflectance by the cosine of incidence."""
    boxes = np.array([solid.box for solid in solids]).reshape(-1, 3, 2)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    near = (boxes[:, :, 0] - origin[:, None, None, :]) * inverse[:, :, None, :]
    far = (boxes[:, :, 1] - origin[:, None, None, :]) * inverse[:, :, None, :]
    entries, exits = np.minimum(near, far), np.maximum(near, far)
    axis = entries.argmax(axis=-1)
    enter = np.take_along_axis(entries, axis[..., None], axis=-1)[..., 0]
    enter = np.where((enter < exits.min(axis=-1)) & (enter > 0.0), enter, np.inf)
    cosine = np.abs(np.take_along_axis(directions[:, :, None, :], axis[..., None], axis=-1)[..., 0])
    glass = np.array([solid.glass for solid in solids])
    back = np.array([solid.reflectance for solid in solids]) * cosine
    enter = np.where(glass & (cosine < np.cos(3.0 * DEGREE)), np.inf, enter)  # a mirror shows itself head-on only
    nearest = enter.argmin(axis=-1)[..., None]
    return np.take_along_axis(enter, nearest, -1)[..., 0], np.take_along_axis(back, nearest, -1)[..., 0]


def _zones(
    distance: Floats, signal: Floats, sunlight: float, settings: RangerSettings, bias: Floats, rng: Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """What each zone answers to its nine rays (9, zones)."""
    weakest = 0.17 / settings.grey_seen_to**2 * sunlight
    order = np.argsort(distance, axis=0)
    distance, signal = (np.take_along_axis(each, order, axis=0) for each in (distance, signal))
    best = np.zeros(distance.shape[1])
    answer = np.zeros(distance.shape[1])
    finite = np.where(np.isfinite(distance), distance, 0.0)
    for first in range(9):
        within = (distance >= distance[first]) & (distance <= distance[first] + settings.cluster)
        total = np.where(within, signal, 0.0).sum(axis=0) / 9.0
        weighed = np.where(within, signal * finite, 0.0).sum(axis=0)
        mean = np.divide(weighed, 9.0 * total, where=total > 0, out=np.zeros_like(total))
        better = total > best
        best, answer = np.where(better, total, best), np.where(better, mean, answer)
    answer = answer * bias * (1.0 + settings.noise * rng.normal(0.0, 1.0, len(answer)))
    seen = best >= weakest
    wild = rng.random(len(answer)) < settings.outliers
    answer = np.where(wild, rng.uniform(0.1, settings.reach[1], len(answer)), answer)
    seen = (seen | wild) & (answer < settings.reach[1])
    near = seen & (answer < settings.reach[0])
    status = np.where(near, 2, np.where(seen, 0, 1))
    return np.where(status == 0, answer, 0.0), status


def _rays(settings: RangerSettings) -> Floats:
    """Nine rays for each zone, (9, zones, 3): unit vectors in the body frame."""
    ahead, up = np.array(settings.boresight), np.array(settings.up)
    left = np.cross(up, ahead)
    rays = []
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            e = settings.field * (0.5 - (np.arange(settings.rows) + 0.5 + down / 3.0) / settings.rows)
            a = settings.field * (0.5 - (np.arange(settings.columns) + 0.5 + right / 3.0) / settings.columns)
            e, a = e[:, None, None], a[None, :, None]
            zone = np.cos(e) * np.cos(a) * ahead + np.cos(e) * np.sin(a) * left + np.sin(e) * up
            rays.append(zone.reshape(-1, 3))
    return np.array(rays).reshape(-1, 3)
