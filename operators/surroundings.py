"""What stands in the way: range sensors and the pose into a local grid, the nearest obstacles, and one cue.

in   pose     : Pose       of the cane, best from `fusion` with method: best
in   <ranger> : Ranges     any number; the port's name is the sensor's in rig.rangers
in   imu      : Imu        only to notice one that repeats itself; may be left out
out  grid     : Grid       2 Hz
out  obstacles: Obstacles  at each reading of the sensor that looks highest
out  cue      : Cue        with each Obstacles, and every 0.1 s when no reading comes

It is not a mobility aid. caneflow is research software, no medical device, it does not replace the cane, and nobody may
rely on it to walk.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from caneflow.algorithms.quantities import Factor, Time
from caneflow.algorithms.rotations import Vector, rotate, yaw_of
from caneflow.algorithms.surroundings.cues import LEVELS, CueChoice, CueSettings
from caneflow.algorithms.surroundings.floor_reach import FloorReach
from caneflow.algorithms.surroundings.nearest_obstacles import (
    AHEAD,
    DROP,
    NearestObstacles,
    NearestSettings,
    View,
)
from caneflow.algorithms.surroundings.occupancy_grid import (
    CELL,
    NO_TARGET,
    NOTHING,
    RANGE,
    SLICE,
    TARGET,
    UNIT,
    GridSettings,
    OccupancyGrid,
    Rays,
    world_coordinate,
)
from caneflow.algorithms.surroundings.sensor_rays import Placed, PoseTrack, world_directions, zone_directions
from caneflow.algorithms.surroundings.stream_watch import StreamWatch
from caneflow.algorithms.surroundings.walking_direction import WalkingDirection
from caneflow.messages import Cue, Grid, Imu, MessageError, Obstacles, Pose, Ranges, Sample
from caneflow.messages.rig import Ranger, Rig, User
from caneflow.runtime import ANY_PORT, Context, Emitted, InFlow, Objection, Operator, Refused
from caneflow.runtime.node import run

POSE, IMU = "pose", "imu"
GOOD_METHOD: Final = "best"  # of the fusion
CUE_NS: Final = 100_000_000  # ns after which a cue is due, whether a reading comes or not
GRID_NS: Final = 500_000_000  # ns between grids
CENTRE_AHEAD: Final = 1.0  # m, of the grid's middle in front of the hand
FARTHEST: Final = 16.0  # m; what is farther lies beyond the grid all the same
LONGEST_GAP: Final = 1.0  # s between two poses, after which the map begins again
LARGEST_JUMP: Final = 0.3  # m by which a pose may differ from where the one before was going
LARGEST_TURN: Final = 0.87  # cosine of half the turn between two poses: 60 deg
MOST_FORGETTING: Final = 64  # times in a row, after which nothing is left
FEWEST_TO_REPEAT: Final = 3  # targets in a reading that may not repeat itself


@dataclass(frozen=True, kw_only=True)
class SurroundingsSettings:
    """The grid, what counts as an obstacle, what is told of, and how soon it is forgotten."""

    __pydantic_config__ = {"extra": "forbid"}

    grid: GridSettings = field(default_factory=GridSettings)
    nearest: NearestSettings = field(default_factory=NearestSettings)
    cue: CueSettings = field(default_factory=CueSettings)
    forget_every: Time = 0.25  # s in which a count loses a sixteenth
    sure_speed: Factor = (
        0.1  # m/s, sd of the velocity up to which the pose counts as good; beyond, forgetting is faster
    )
    fastest_forgetting: Factor = 8.0  # times as fast at most
    unsure_forgetting: Factor = 2.0  # times as fast for a pose without covariance


class Sensor:
    """One range sensor: where it sits, where its zones look, and whether it is alive."""

    def __init__(self, name: str, ranger: Ranger, pivot: Vector) -> None:
        self.name = name
        self.zones = ranger.rows * ranger.columns
        self.nearest, self.farthest = ranger.reach
        self.boresight = ranger.boresight
        self.position = ranger.position
        self.from_hand = _plus(ranger.position, (-pivot[0], -pivot[1], -pivot[2]))
        self.directions = zone_directions(ranger.boresight, ranger.up, ranger.rows, ranger.columns, ranger.field)
        self.reach = FloorReach()
        self.watch = StreamWatch(f"{name}/ranges")


class Surroundings(Operator):
    """Every reading goes into the grid; each one of the sensor that looks highest makes obstacles and a cue."""

    inputs = {POSE: Pose, IMU: Imu, ANY_PORT: Ranges}
    outputs = {"grid": Grid, "obstacles": Obstacles, "cue": Cue}
    optional_inputs = frozenset({IMU})
    Settings = SurroundingsSettings

    def __init__(self, settings: SurroundingsSettings, context: Context) -> None:
        rig = context.rig
        names = [port for port in context.ports if port not in (POSE, IMU)]
        user = rig.user or User()
        self._settings = settings
        self._aside = user.hand[1]
        self._pivot: Vector = rig.need("pivot")
        self._hand_height: float = rig.need("hand_height")
        self._boresight: Vector = rig.boresight
        self._sensors = sensors_of(rig, names)
        slices = math.ceil(user.height / SLICE)
        self._grid = OccupancyGrid(settings.grid, slices)
        self._nearest = NearestObstacles(settings.nearest, user.shoulder, slices)
        self._choice = CueChoice(settings.cue)
        self._track = PoseTrack()
        self._direction = WalkingDirection()
        self._pose: Pose | None = None  # the newest
        self._pose_watch = StreamWatch(POSE)
        self._imu_watch = StreamWatch(IMU) if IMU in context.ports else None
        self._watches = [*(sensor.watch for sensor in self._sensors.values()), self._pose_watch]
        if self._imu_watch is not None:
            self._watches.append(self._imu_watch)
        self._leader: str | None = None  # the sensor that looks highest, once a pose is known
        self._worn = 0.0  # s since the map was last made to forget, longer where the pose is worse
        self._start_ns: int | None = None  # stamp of the first sample
        self._cue_ns: int | None = None  # of the last cue
        self._was_blind = False
        self._grid_ns: int | None = None  # of the last grid
        self._last_ns: dict[str, int] = {}  # by port the stamp of the last sample

    @classmethod
    def objections(cls, flow: InFlow) -> Iterator[Objection]:
        """A rig without its range sensors, and a pose that is not good enough for a map."""
        rangers = flow.rig.get("rangers") or {}
        strangers = [port for port in flow.writers if port not in (POSE, IMU) and port not in rangers]
        if not rangers:
            yield Objection(("rig", "rangers"), "is missing; surroundings needs the place and direction of each ranger")
        elif strangers:
            said = f"has no {', '.join(strangers)}, which {flow.node} reads; there are: {', '.join(rangers)}"
            yield Objection(("rig", "rangers"), said)
        method = getattr(flow.writers.get(POSE), "method", GOOD_METHOD)
        if method != GOOD_METHOD:
            yield Objection(
                ("nodes", flow.node, "inputs", POSE),
                f"comes from the method {method}, which draws a point 2 m away 26 to 38 cm off after 1 s "
                f"({GOOD_METHOD}: 12 to 18 cm); use method: {GOOD_METHOD}",
                warning=True,
            )

    def handle(self, port: str, message: Sample) -> Emitted:
        """Take the sample; yield what is due."""
        self._require_usable(port, message)
        self._last_ns[port] = message.stamp
        if self._start_ns is None:
            self._start_ns = message.stamp
        if isinstance(message, Pose):
            self._take_pose(message)
        elif isinstance(message, Ranges):
            self._take_ranges(self._sensors[port], message)
            if port == self._leader and self._track:
                yield from self._look(message.stamp, message.stamp - _delay_ns(message))
                return
        elif isinstance(message, Imu) and self._imu_watch is not None:
            self._imu_watch.take(message.stamp, (message.gyro, message.accel, message.orientation))
        if self._cue_ns is None or message.stamp - self._cue_ns >= CUE_NS or self._has_gone_blind(message.stamp):
            yield from self._cue(message.stamp, *self._blind(message.stamp))

    def _require_usable(self, port: str, message: Sample) -> None:
        """Raise Refused before anything has changed."""
        last = self._last_ns.get(port)
        if last is not None and message.stamp <= last:
            raise Refused(f"{port}: stamp {message.stamp} ns is not after the one before, {last} ns")
        if isinstance(message, Ranges) and len(message.ranges) != self._sensors[port].zones:
            zones = self._sensors[port].zones
            raise Refused(f"{port}: a reading of {len(message.ranges)} zones; rig.rangers.{port} has {zones}")

    def _take_pose(self, pose: Pose) -> None:
        last, self._pose = self._pose, pose
        self._pose_watch.take(pose.stamp, None)
        if last is not None:
            elapsed = (pose.stamp - last.stamp) * 1e-9
            if jumped(last, pose, elapsed):
                self._begin_again()
            self._forget(elapsed, pose)
        self._track.add(pose.stamp, Placed(pose.position, pose.orientation))
        x, y, _ = _plus(pose.position, rotate(pose.orientation, self._pivot))
        self._direction.update(pose.stamp, x, y, yaw_of(rotate(pose.orientation, self._boresight)))
        if self._leader is None:
            self._leader = max(self._sensors.values(), key=lambda s: rotate(pose.orientation, s.boresight)[2]).name

    def _begin_again(self) -> None:
        """Forget the map: the poses went on elsewhere."""
        self._grid.clear()
        self._nearest.clear()
        self._track.clear()
        self._direction.clear()

    def _forget(self, elapsed: float, pose: Pose) -> None:
        """Let the map fade: faster where the velocity, by which it was drawn, is less sure."""
        settings = self._settings
        pace = settings.unsure_forgetting
        if pose.covariance is not None:
            spread = math.sqrt(max(float(pose.covariance[3, 3] + pose.covariance[4, 4]), 0.0))
            pace = min(max(spread / settings.sure_speed, 1.0), settings.fastest_forgetting)
        self._worn += elapsed * pace
        times = int(min(self._worn / settings.forget_every, MOST_FORGETTING))
        if times:
            self._worn = max(self._worn - times * settings.forget_every, 0.0) if times < MOST_FORGETTING else 0.0
            for _ in range(times):
                self._grid.forget()

    def _take_ranges(self, sensor: Sensor, reading: Ranges) -> None:
        """Put a reading into the grid, if it is known from where it was taken."""
        targets = np.count_nonzero(reading.status == 0)
        content = (reading.ranges.tobytes(), reading.status.tobytes()) if targets >= FEWEST_TO_REPEAT else None
        sensor.watch.take(reading.stamp, content)
        placed = self._track.at(reading.stamp - _delay_ns(reading))
        if placed is None or sensor.watch.is_frozen:
            return
        self._centre()
        rays = self._rays(sensor, reading, placed)
        floor = self._grid.take(rays)
        sensor.reach.update(reading.stamp, rays.ranges[floor].astype(np.float64) / RANGE)

    def _rays(self, sensor: Sensor, reading: Ranges, placed: Placed) -> Rays:
        """The reading as rays of integers."""
        says = np.full(sensor.zones, NOTHING, np.uint8)
        seen = (reading.status == 0) & (reading.ranges > 0) & (reading.ranges >= sensor.nearest)
        says[seen & (reading.ranges < sensor.farthest)] = TARGET
        says[(reading.status == 1) | (seen & (reading.ranges >= sensor.farthest))] = NO_TARGET
        x, y, _ = _plus(placed.position, rotate(placed.orientation, sensor.position))
        height = self._hand_height + rotate(placed.orientation, sensor.from_hand)[2]
        return Rays(
            origin=(world_coordinate(x), world_coordinate(y), round(height * 65536)),
            directions=world_directions(placed.orientation, sensor.directions),
            ranges=np.rint(np.minimum(reading.ranges, FARTHEST) * RANGE).astype(np.int32),
            says=says,
            floor_reach=round(sensor.reach.reach * RANGE),
        )

    def _view(self) -> View:
        """From where the user looks, which way."""
        assert self._pose is not None
        x, y, _ = _plus(self._pose.position, rotate(self._pose.orientation, self._pivot))
        cos, sin = math.cos(self._direction.heading), math.sin(self._direction.heading)
        return View(x + self._aside * sin, y - self._aside * cos, cos, sin)

    def _centre(self) -> None:
        view = self._view()
        self._grid.centre_on(view.x + CENTRE_AHEAD * view.cos, view.y + CENTRE_AHEAD * view.sin)

    def _look(self, stamp: int, middle_ns: int) -> Iterator[tuple[str, Sample]]:
        """One update: the nearest obstacles, the cue, and now and then the grid."""
        assert self._pose is not None
        self._nearest.update(stamp, middle_ns, self._grid, self._view())
        yield "obstacles", self._obstacles(stamp)
        yield from self._cue(stamp, *self._blind(stamp))
        if self._grid_ns is None or stamp - self._grid_ns >= GRID_NS:
            self._grid_ns = stamp
            occupancy, missing = self._grid.unrolled()
            yield (
                "grid",
                Grid(
                    stamp=stamp,
                    occupancy=occupancy,
                    floor_missing=missing,
                    unit=UNIT,
                    cell=CELL,
                    bottom=0.0,
                    slice=SLICE,
                    origin=self._grid.origin,
                    pose_stamp=self._pose.stamp,
                ),
            )

    def _obstacles(self, stamp: int) -> Obstacles:
        nearest = [[each.found.distance if each.found else 0.0 for each in sector] for sector in self._nearest.entries]
        closing = [[each.closing() for each in sector] for sector in self._nearest.entries]
        place = [
            [(each.found.x, each.found.y) if each.found else (0.0, 0.0) for each in sector]
            for sector in self._nearest.entries
        ]
        return Obstacles(
            stamp=stamp,
            heading=self._direction.heading,
            walking=self._direction.walking,
            nearest=np.array(nearest, np.float32),
            known=self._nearest.known.astype(np.float32),
            closing=np.array(closing, np.float32),
            place=np.array(place, np.float32),
        )

    def _cue(self, stamp: int, reason: str, since_ns: int) -> Iterator[tuple[str, Sample]]:
        """The cue at `stamp`, unless there is one already; `reason`: why nothing is seen, empty when all is well."""
        if self._cue_ns is not None and stamp <= self._cue_ns:
            return
        self._cue_ns, self._was_blind = stamp, bool(reason)
        if reason:
            yield "cue", Cue(stamp=stamp, kind="blind", reason=reason, since=since_ns)
            return
        told = self._choice.choose(self._nearest.entries[AHEAD])
        if told is None:
            yield "cue", Cue(stamp=stamp, kind="none", since=stamp)
            return
        yield (
            "cue",
            Cue(
                stamp=stamp,
                kind="drop" if told.level == DROP else "obstacle",
                level=LEVELS[told.level],
                distance=told.distance,
                azimuth=told.azimuth,
                urgency=told.urgency,
                time=told.time,
                since=told.since_ns,
            ),
        )

    def _has_gone_blind(self, now_ns: int) -> bool:
        """Whether something is missing that the last cue did not say."""
        if self._was_blind:
            return False
        return any(watch.is_silent(now_ns) or watch.is_frozen for watch in self._watches)

    def _blind(self, now_ns: int) -> tuple[str, int]:
        """Why nothing can be seen, empty when all is well, and the stamp of the last good sample of what is missing."""
        silent = [watch for watch in self._watches if watch.is_silent(now_ns)]
        frozen = [watch for watch in self._watches if watch.is_frozen and watch not in silent]
        if not silent and not frozen:
            return "", now_ns
        said = [f"{', '.join(w.name for w in silent)}: no sample"] if silent else []
        said += [f"{', '.join(w.name for w in frozen)}: repeats itself"] if frozen else []
        assert self._start_ns is not None
        return "; ".join(said), min(watch.last_good_ns(self._start_ns) for watch in (*silent, *frozen))


def jumped(last: Pose, pose: Pose, elapsed: float) -> bool:
    """Whether a pose, `elapsed` s after the last, goes on elsewhere: a filter reset, a room fix, a restart."""
    if elapsed > LONGEST_GAP:
        return True
    expected = [p + v * elapsed for p, v in zip(last.position, last.velocity, strict=True)]
    if math.dist(expected[:2], pose.position[:2]) > LARGEST_JUMP:
        return True
    if abs(sum(a * b for a, b in zip(last.orientation, pose.orientation, strict=True))) < LARGEST_TURN:
        return True
    return _spread(pose) - _spread(last) > LARGEST_JUMP


def _spread(pose: Pose) -> float:
    """Standard deviation (m) of the horizontal position."""
    if pose.covariance is None:
        return 0.0
    return math.sqrt(max(float(pose.covariance[0, 0] + pose.covariance[1, 1]), 0.0))


def sensors_of(rig: Rig, names: list[str]) -> dict[str, Sensor]:
    """The rig's rangers `names`; raises MessageError when there are none, or for one that the rig lacks."""
    if not names:
        raise MessageError("surroundings: no range sensor is wired; each is an input named as in rig.rangers")
    strangers = [name for name in names if name not in rig.rangers]
    if strangers:
        there = ", ".join(rig.rangers) or "none"
        raise MessageError(f"rig.rangers has no {', '.join(strangers)}; there are: {there}")
    pivot: Vector = rig.need("pivot")
    return {name: Sensor(name, rig.rangers[name], pivot) for name in names}


def _delay_ns(reading: Ranges) -> int:
    return round((reading.delay or 0.0) * 1e9)


def _plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


if __name__ == "__main__":
    run(Surroundings)
