"""Rays, walking direction, nearest obstacles, cues, watches: against formulas, places known beforehand, and limits."""

import math

import numpy as np
import pytest

from caneflow.algorithms.rotations import from_rotation_vector, from_yaw, multiply, rotate
from caneflow.algorithms.surroundings.cues import CueChoice, CueSettings
from caneflow.algorithms.surroundings.floor_reach import FloorReach
from caneflow.algorithms.surroundings.nearest_obstacles import (
    AHEAD,
    DROP,
    HEAD,
    LEFT,
    LOW,
    RIGHT,
    WAIST,
    Entry,
    Found,
    NearestObstacles,
    NearestSettings,
    View,
)
from caneflow.algorithms.surroundings.occupancy_grid import GridSettings, OccupancyGrid
from caneflow.algorithms.surroundings.sensor_rays import Placed, PoseTrack, slerp, world_directions, zone_directions
from caneflow.algorithms.surroundings.stream_watch import StreamWatch
from caneflow.algorithms.surroundings.walking_direction import WalkingDirection

MS = 1_000_000  # ns


def test_zones_look_where_the_rig_says() -> None:
    directions = zone_directions((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 8, 8, (math.radians(45), math.radians(45)))
    first, last = directions[0], directions[-1]
    assert math.degrees(math.asin(first[2])) == pytest.approx(22.5 * 7 / 8)  # the top row first
    assert math.degrees(math.atan2(first[1], first[0])) == pytest.approx(22.5 * 7 / 8)  # from left to right
    assert last[1:] == pytest.approx(-first[1:])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)


def test_one_zone_looks_along_the_boresight() -> None:
    directions = zone_directions((0.0, 0.6, 0.8), (0.0, -0.8, 0.6), 1, 1, (0.47, 0.47))
    np.testing.assert_allclose(directions, [[0.0, 0.6, 0.8]], atol=1e-12)


def test_directions_are_turned_as_one_vector_is() -> None:
    orientation = multiply(from_yaw(0.7), from_rotation_vector((0.2, -0.4, 0.1)))
    body = zone_directions((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 2, 3, (0.8, 0.8))
    found = world_directions(orientation, body)
    expected = np.array([rotate(orientation, (float(x), float(y), float(z))) for x, y, z in body]) * 16384
    assert np.abs(found - expected).max() <= 0.5 + 1e-9


def test_an_attitude_between_two_poses_has_gone_its_part_of_the_way_at_constant_rate() -> None:
    older, newer = from_yaw(0.2), from_yaw(1.2)
    for share in (0.0, 0.25, 0.5, 1.0):
        assert slerp(older, newer, share) == pytest.approx(from_yaw(0.2 + share))
    w, x, y, z = newer
    assert slerp(older, (-w, -x, -y, -z), 0.5) == pytest.approx(from_yaw(0.7))  # the same rotation, the shorter way
    assert slerp(older, older, 0.3) == older


def test_a_pose_is_that_of_the_instant_asked_for() -> None:
    track = PoseTrack()
    assert track.at(0) is None
    for i in range(400):
        track.add(i * 10 * MS, Placed((0.01 * i, 0.0, 0.0), from_yaw(0.001 * i)))
    placed = track.at(3905 * MS)
    assert placed is not None
    assert placed.position[0] == pytest.approx(3.905)
    assert placed.orientation == pytest.approx(from_yaw(0.3905))
    assert track.at(0) is None, "what is old is forgotten"
    assert track.at(4050 * MS) == track.at(3990 * MS), "the newest holds a moment"
    assert track.at(4200 * MS) is None


def test_the_floors_reach_rises_at_once_and_falls_slowly() -> None:
    reach = FloorReach()
    for i in range(30):
        reach.update(i * 66 * MS, np.full(20, 2.0))
    assert reach.reach == pytest.approx(2.0, abs=0.01)
    for i in range(30, 45):
        reach.update(i * 66 * MS, np.full(20, 1.2))
    assert reach.reach > 1.9
    reach.update(50 * 66 * MS, np.array([]))
    assert reach.reach > 1.9


def test_before_the_first_step_the_walking_direction_follows_the_canes_yaw() -> None:
    """Of a step of the yaw, 1 - exp(-t / 0.65 s) is there after t."""
    direction = WalkingDirection()
    for i in range(101):
        direction.update(i * 10 * MS, 0.0, 0.0, 0.4)
    for i in range(1, 66):
        direction.update((100 + i) * 10 * MS, 0.0, 0.0, 1.0)
    assert direction.heading == pytest.approx(1.0 - 0.6 * math.exp(-1.0))


def test_the_walking_direction_is_the_chord_of_a_step_and_is_held_at_rest() -> None:
    direction = WalkingDirection()
    for i in range(100):  # standing: where the cane points, on average
        direction.update(i * 10 * MS, 0.0, 0.0, 0.4)
    assert not direction.walking
    assert direction.heading == pytest.approx(0.4)
    for i in range(100):
        way = 0.008 * i
        direction.update((100 + i) * 10 * MS, way * math.cos(2.0), way * math.sin(2.0), 0.4)
    assert direction.walking
    assert direction.heading == pytest.approx(2.0)
    assert direction.speed == pytest.approx(0.8)
    for i in range(100):
        direction.update((200 + i) * 10 * MS, way * math.cos(2.0), way * math.sin(2.0), 0.4)
    assert not direction.walking
    assert direction.heading == pytest.approx(2.0), "after the first step it is held"


def standing_at(cells: list[tuple[float, float, int]], view: View, updates: int = 2) -> NearestObstacles:
    """Obstacles of a grid with occupied cells at (x, y, slice), looked at so many times, 67 ms apart."""
    grid = OccupancyGrid(GridSettings(), 8)
    grid.centre_on(view.x, view.y)
    rows, columns = grid.world_lines(0), grid.world_lines(1)
    for x, y, s in cells:
        i, j = math.floor(x * 10 + 1e-9), math.floor(y * 10 + 1e-9)
        plane = grid.floor_missing if s < 0 else grid.occupancy[s]
        plane[np.flatnonzero(rows == i)[0], np.flatnonzero(columns == j)[0]] = 60
    nearest = NearestObstacles(NearestSettings(), 0.35, 8)
    for i in range(updates):
        nearest.update((100 + 67 * i) * MS, (67 + 67 * i) * MS, grid, view)
    return nearest


@pytest.mark.parametrize("heading", [0.0, 1.0, math.pi / 2, -2.5])
@pytest.mark.parametrize(
    ("ahead", "aside", "sector"), [(2.0, 0.0, AHEAD), (1.0, 0.7, LEFT), (1.0, -0.7, RIGHT), (2.0, 0.7, None)]
)
def test_a_post_is_told_of_where_it_stands(heading: float, ahead: float, aside: float, sector: int | None) -> None:
    view = View(3.0, -2.0, math.cos(heading), math.sin(heading))
    x = view.x + ahead * view.cos - aside * view.sin
    y = view.y + ahead * view.sin + aside * view.cos
    nearest = standing_at([(x, y, s) for s in range(8)], view)
    for level in (LOW, WAIST, HEAD):
        for each in (LEFT, AHEAD, RIGHT):
            found = nearest.entries[each][level].found
            if each != sector:
                assert found is None
            else:
                assert found is not None
                assert found.distance == pytest.approx(ahead, abs=0.08)
                assert found.aside == pytest.approx(aside, abs=0.08)
                assert math.hypot(found.x - x, found.y - y) < 0.08
                assert nearest.entries[each][level].since_ns == 67 * MS


@pytest.mark.parametrize(("s", "level"), [(0, LOW), (1, LOW), (2, WAIST), (4, WAIST), (5, HEAD), (7, HEAD), (-1, DROP)])
def test_a_level_is_told_of_by_its_own_heights(s: int, level: int) -> None:
    cells = [(1.55, 0.05 + 0.1 * i, s) for i in (-3, -2, -1, 0, 1, 2)]
    found = [entry.found is not None for entry in standing_at(cells, View(0.0, 0.0, 1.0, 0.0)).entries[AHEAD]]
    assert found == [each == level for each in range(4)]


def test_two_cells_or_three_slices_make_an_obstacle_and_one_does_not() -> None:
    view = View(0.0, 0.0, 1.0, 0.0)
    assert standing_at([(1.55, 0.05, 3)], view).entries[AHEAD][WAIST].found is None
    assert standing_at([(1.55, 0.05, 3), (1.95, 0.05, 3)], view).entries[AHEAD][WAIST].found is None
    assert standing_at([(1.55, 0.05, 3), (1.85, 0.05, 3)], view).entries[AHEAD][WAIST].found is not None
    assert standing_at([(1.55, 0.05, 3), (1.55, 0.05, 4)], view).entries[AHEAD][WAIST].found is not None
    assert standing_at([(1.55, 0.05 * i, -1) for i in (-3, -1, 1, 3)], view).entries[AHEAD][DROP].found is None
    assert standing_at([(1.55, 0.05, 3), (1.85, 0.05, 3)], view, updates=1).entries[AHEAD][WAIST].found is None


def test_an_obstacle_is_held_over_three_updates_without_it() -> None:
    entry, found, settings = Entry(), Found(1.0, 0.0, 1.0, 0.0), NearestSettings()
    told = []
    for i, seen in enumerate([1, 0, 1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1]):
        entry.update(i * 67 * MS, i * 67 * MS - 33 * MS, found if seen else None, settings)
        told.append(entry.found is not None)
    assert told == [False] * 3 + [True] * 8 + [False] * 2


def test_what_is_known_is_the_share_that_was_looked_at() -> None:
    view = View(0.0, 0.0, 1.0, 0.0)
    nearest = standing_at([(0.05 + 0.1 * i, 0.1 * j + 0.05, 6) for i in range(30) for j in (-1, 0, 1)], view)
    assert nearest.known[AHEAD, HEAD] == pytest.approx(0.5, abs=0.05)  # three of six columns
    assert nearest.known[AHEAD, LOW] == 0.0


def test_closing_is_the_speed_of_a_thing_that_comes_nearer() -> None:
    entry = Entry()
    for i in range(12):
        entry.update(i * 67 * MS, 0, Found(3.0 - 1.2 * 0.067 * i, 0.0, 0.0, 0.0), NearestSettings())
    assert entry.closing() == pytest.approx(1.2)
    assert Entry().closing() == 0.0


def entries(low: float = 0, waist: float = 0, head: float = 0, drop: float = 0) -> list[Entry]:
    return [
        Entry(found=Found(distance, 0.1, 0.0, 0.0) if distance else None, since_ns=7)
        for distance in (low, waist, head, drop)
    ]


def test_the_nearest_by_weight_is_told_of_and_stays_until_another_is_much_nearer() -> None:
    choice = CueChoice(CueSettings())
    assert choice.choose(entries()) is None
    told = choice.choose(entries(low=1.5, head=1.8))  # 1.5 against 1.38
    assert told is not None
    assert (told.level, told.distance, told.since_ns) == (HEAD, 1.8, 7)
    assert told.urgency == pytest.approx(1 - 1.8 / 1.3 / 3)
    assert math.tan(told.azimuth) * told.distance == pytest.approx(0.1)
    assert told.time is None
    held = choice.choose(entries(low=1.2, head=1.8))  # not nearer than 0.8 of it
    assert held is not None
    assert held.level == HEAD
    changed = choice.choose(entries(low=1.0, head=1.8))
    assert changed is not None
    assert changed.level == LOW
    drop = choice.choose(entries(low=1.0, drop=1.0))
    assert drop is not None
    assert drop.level == DROP


def test_a_watch_tells_silence_and_a_reading_that_repeats_itself() -> None:
    watch = StreamWatch("tof_up/ranges")
    assert watch.is_silent(0)
    assert watch.last_good_ns(5) == 5
    for i in range(6):
        watch.take(i * 67 * MS, b"the same")
        assert watch.is_frozen == (i >= 5)
    assert watch.last_good_ns(5) == 0
    watch.take(400 * MS, b"another")
    assert not watch.is_frozen
    assert not watch.is_silent(600 * MS)
    assert watch.is_silent(601 * MS)
    assert watch.last_good_ns(5) == 400 * MS
