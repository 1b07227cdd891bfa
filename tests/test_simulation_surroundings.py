"""Simulated walks past things: rays against geometry done by hand, the weakest signal, and the truth beside them."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from caneflow import command
from caneflow.simulation.attitude import Floats
from caneflow.simulation.guided_walk import RANGERS, guided_way, truth_of
from caneflow.simulation.obstacle_course import SCENES, THINGS, ObstacleCourse, Solid, approach
from caneflow.simulation.ranger import DOWN, UP, RangerSettings, cast, read
from caneflow.simulation.walk import Motion

GREY = 0.17


def place(
    *solids: Solid, floor: float = 0.3, holes: tuple[tuple[float, float, float, float], ...] = ()
) -> ObstacleCourse:
    empty = approach("pole", np.random.default_rng(1))
    return ObstacleCourse(
        kind="test", course=empty.course, things=(), solids=solids, holes=holes, floor_reflectance=floor
    )


def toward(*direction: float) -> Floats:
    vector: Floats = np.array(direction) / np.linalg.norm(direction)
    return vector[None, None, :]


WALL = Solid((2.0, 2.2, -5.0, 5.0, 0.0, 3.0), 0.5)
EYE = np.array([[0.0, 0.0, 1.0]])


def test_a_ray_ends_at_the_face_that_it_meets_first() -> None:
    distance, signal = cast(EYE, toward(1.0, 0.5, 0.0), place(WALL), 0.0)
    assert distance[0, 0] == pytest.approx(2.0 * math.hypot(1.0, 0.5))
    cosine = 1.0 / math.hypot(1.0, 0.5)
    assert signal[0, 0] == pytest.approx(0.5 * cosine / distance[0, 0] ** 2)  # Lambert


def test_a_ray_down_ends_at_the_floor_and_not_in_a_hole() -> None:
    down = toward(1.0, 0.0, -1.0)
    assert cast(EYE, down, place(), 0.0)[0][0, 0] == pytest.approx(math.sqrt(2.0))
    assert cast(EYE, down, place(holes=((0.9, 3.0, -1.0, 1.0),)), 0.0)[0][0, 0] == math.inf
    assert cast(EYE, toward(1.0, 0.0, 1.0), place(), 0.0)[0][0, 0] == math.inf


def test_glass_is_seen_head_on_only() -> None:
    pane = Solid((2.0, 2.02, -5.0, 5.0, 0.0, 3.0), 0.5, glass=True)
    assert cast(EYE, toward(1.0, 0.0, 0.0), place(pane), 0.0)[0][0, 0] == pytest.approx(2.0)
    assert cast(EYE, toward(1.0, 0.2, 0.0), place(pane), 0.0)[0][0, 0] == math.inf


def still(height: float = 1.0, seconds: float = 2.0) -> Motion:
    """The shaft held level towards x0, at rest."""
    n = round(seconds * 100)
    time = np.arange(n) / 100
    position = np.tile([0.0, 0.2, height], (n, 1))
    orientation = np.tile([math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)], (n, 1))
    zero = np.zeros((n, 3))
    return Motion(time, position, zero, zero, orientation, zero, position, np.zeros(n), np.zeros(n))


@pytest.mark.parametrize(("distance", "seen"), [(2.3, True), (2.8, False)])
def test_grey_is_seen_to_its_distance_and_the_noise_is_that_of_the_settings(distance: float, seen: bool) -> None:
    level = RangerSettings(position=(0.0, 0.0, 0.0), tilt=0.0, mount_error=0.0, outliers=0.0, zone_bias=0.0)
    wall = Solid((distance, distance + 1.0, -9.0, 9.0, 0.01, 9.0), GREY)
    readings = read(still(), place(wall, floor=0.001), level, np.random.default_rng(2))
    middle = [27, 28, 35, 36]
    status = readings.status[:, middle]
    assert (status == (0 if seen else 1)).all()
    if seen:
        relative = readings.ranges[:, middle] / (distance * math.hypot(1.0, math.tan(level.field / 16 * math.sqrt(2))))
        assert relative.mean() == pytest.approx(1.0, abs=0.01)
        assert relative.std() == pytest.approx(0.015, abs=0.004)


def test_sunlight_halves_the_reach() -> None:
    level = RangerSettings(position=(0.0, 0.0, 0.0), tilt=0.0, mount_error=0.0, outliers=0.0)
    course = place(Solid((1.6, 3.0, -9.0, 9.0, 0.01, 9.0), GREY), floor=0.001)
    bright = ObstacleCourse(
        kind="test",
        course=course.course,
        things=(),
        solids=course.solids,
        holes=(),
        floor_reflectance=0.001,
        sunlight=4.0,
    )
    assert (read(still(), course, level, np.random.default_rng(3)).status[:, 27] == 0).all()
    assert (read(still(), bright, level, np.random.default_rng(3)).status[:, 27] == 1).all()


def test_the_upper_sensor_looks_up_and_the_lower_one_down_when_the_shaft_is_42_degrees_down() -> None:
    pitch = math.radians(42.0)
    for sensor, elevation in ((UP, 10.0), (DOWN, -33.0)):
        _, y, z = sensor.boresight
        assert math.degrees(math.asin(-math.sin(pitch) * y + math.cos(pitch) * z)) == pytest.approx(elevation)


@pytest.mark.parametrize("thing", sorted(THINGS))
def test_an_approach_ends_with_the_hand_45_cm_before_the_thing(thing: str) -> None:
    way = guided_way("approach", 3, thing)  # type: ignore[arg-type]
    scene: Any = truth_of(way, 3)
    (truth,) = scene["things"]
    x, y, heading = scene["path"][-1][1:]
    gone = truth["velocity"][0] * min(way.motion.time[-1], truth["halt"])
    assert truth["box"][0] + gone - (x + 0.30) == pytest.approx(0.45, abs=0.02)
    assert (y, heading) == (0.0, 0.0)


@pytest.mark.parametrize("scene", sorted(SCENES))
def test_a_scene_is_walked_past_everything_that_stands_in_it(scene: str) -> None:
    course = SCENES[scene](np.random.default_rng(4))
    way = course.course.position(np.linspace(0.0, course.course.length, 2000))
    solids = [solid.box for solid in course.solids if solid.box[5] > 0.3]
    solids += [part.box for thing in course.things if thing.velocity == (0.0, 0.0) for part in thing.parts]
    for x0, x1, y0, y1, _, z1 in solids:
        away = np.hypot(
            np.maximum(np.maximum(x0 - way[:, 0], way[:, 0] - x1), 0),
            np.maximum(np.maximum(y0 - way[:, 1], way[:, 1] - y1), 0),
        )
        assert away.min() > 0.15 or z1 <= 0.0


def test_the_command_writes_what_the_sensors_say_and_what_is_true(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "walk.mcap"
    arguments = ["simulate", "walk", "--scene", "corridor", "--duration", "3", "--seed", "2", "-o", str(output)]
    monkeypatch.setattr(sys, "argv", ["caneflow", *arguments])
    with pytest.raises(SystemExit) as end:
        command.main()
    assert not end.value.code
    with output.open("rb") as file:
        reader = make_reader(file)
        records = {each.name: each.metadata for each in reader.iter_metadata()}
        stamps = [(message.publish_time, channel.topic) for _, channel, message in reader.iter_messages()]
    scene, rig = json.loads(records["scene"]["json"]), json.loads(records["rig"]["json"])
    assert set(rig["rangers"]) == set(RANGERS)
    assert (scene["kind"], scene["seed"], scene["ends"], scene["frozen"]) == ("corridor", 2, {}, {})
    assert len(scene["things"]) == 5
    assert scene["things"][-1]["kind"] == "stairs"
    assert {topic for _, topic in stamps} >= {"cane/tof_up/ranges", "cane/tof_down/ranges", "cane/truth/pose"}
    up = [stamp for stamp, topic in stamps if topic == "cane/tof_up/ranges"]
    assert (up[0] - 1_700_000_000 * 10**9, up[1] - up[0]) == (200_000_000, 66_666_667)
