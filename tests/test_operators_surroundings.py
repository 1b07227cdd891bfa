"""The surroundings' operator: a post, a stair, a blind sensor in event time; the reference corridors through it."""

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.algorithms.rotations import Quaternion, Vector, multiply, rotate
from caneflow.algorithms.surroundings.sensor_rays import zone_directions
from caneflow.messages import Cue, Grid, Imu, MessageError, Obstacles, Pose, Ranges, Sample, numbered
from caneflow.messages.rig import Rig, read_rig
from caneflow.runtime import Context, Refused
from caneflow.runtime.dataflow.loading import examine
from caneflow.runtime.dataflow.programs import check_settings
from caneflow.runtime.stages.snapshot import pack, unpack
from operators.surroundings import Surroundings

ROOT = Path(__file__).parents[1]
CORRIDORS = ROOT.parent / "shared" / "data" / "corridors"
SECOND = 1_000_000_000  # ns
START = 1_700_000_000 * SECOND
EYE = math.sqrt(0.5)
RIG: dict[str, Any] = {
    "hand_height": 0.95,
    "pivot": [0, -0.3, 0],
    "boresight": [0, 1, 0],
    "rangers": {  # along the body's y: the shaft is held level here
        name: {
            "position": [0, 0, 0],
            "boresight": [0, math.cos(tilt), math.sin(tilt)],
            "up": [0, -math.sin(tilt), math.cos(tilt)],
            "rows": 8,
            "columns": 8,
            "field": [0.785, 0.785],
            "reach": [0.02, 4.0],
        }
        for name, tilt in (("tof_down", -0.6), ("tof_up", 0.15))
    },
}
PORTS: dict[str, type[Sample]] = {"pose": Pose, "imu": Imu, "tof_down": Ranges, "tof_up": Ranges}
FORWARD: Quaternion = (EYE, 0.0, 0.0, -EYE)  # the body's y along x0
Scene = Callable[[Vector, Vector], float | None]  # the distance (m) from a place along a direction


def floor(origin: Vector, direction: Vector) -> float | None:
    return -origin[2] / direction[2] if direction[2] < 0 else None


def post_at(x: float, y: float, width: float = 0.3) -> Scene:
    """A floor, and a square post to above the head."""

    def scene(origin: Vector, direction: Vector) -> float | None:
        down = floor(origin, direction)
        t = (x - width / 2 - origin[0]) / direction[0] if direction[0] > 0.01 else -1.0
        hit = t > 0 and abs(origin[1] + t * direction[1] - y) < width / 2 and 0 < origin[2] + t * direction[2] < 2.2
        return t if hit and (down is None or t < down) else down

    return scene


def stair_at(x: float) -> Scene:
    """A floor that ends, above nothing."""

    def scene(origin: Vector, direction: Vector) -> float | None:
        down = floor(origin, direction)
        return down if down is not None and origin[0] + down * direction[0] < x else None

    return scene


def reading(name: str, stamp: int, scene: Scene, x: float) -> Ranges:
    """What the ranger sees from (x, 0) at the hand's height; the hand is 0.3 m behind the sensors."""
    ranger = read_rig(RIG).rangers[name]
    found = []
    for row in zone_directions(ranger.boresight, ranger.up, ranger.rows, ranger.columns, ranger.field).tolist():
        distance = scene((x + 0.3, 0.0, 0.95), rotate(FORWARD, (row[0], row[1], row[2])))
        found.append(0.0 if distance is None or distance > 2.6 else distance)
    ranges = np.array(found, np.float32)
    noise = np.random.default_rng(stamp % 2**32).normal(0, 0.005, len(ranges)).astype(np.float32)
    ranges = np.where(ranges > 0, np.maximum(ranges + noise, np.float32(0.03)), ranges)
    return Ranges(stamp=stamp, ranges=ranges, status=(ranges == 0).astype(np.uint8), exposure=0.066, delay=0.033)


def pose(stamp: int, x: float, speed: float = 0.0) -> Pose:
    return Pose(
        stamp=stamp,
        position=(x + 0.3, 0.0, 0.0),
        velocity=(speed, 0.0, 0.0),
        orientation=FORWARD,
        method="best",
        covariance=np.eye(6) * 1e-3,
    )


def walk(
    scene: Scene, seconds: float, speed: float = 0.6, ends: dict[str, float] | None = None
) -> Iterator[tuple[str, Sample]]:
    """A second of standing, then straight along x0: poses at 100 Hz, each ranger at 15 Hz, 33 ms apart."""
    ends = ends or {}
    events: list[tuple[int, int, str]] = [(i * 10_000_000, 0, "pose") for i in range(round(seconds * 100))]
    for order, (name, shift) in enumerate((("tof_down", 0.0), ("tof_up", 0.033)), start=1):
        events += [(round((0.1 + shift + i / 15) * SECOND), order, name) for i in range(round((seconds - 0.2) * 15))]
    for time, _, name in sorted(events):
        if time * 1e-9 > ends.get(name, math.inf):
            continue
        way = max(time * 1e-9 - 1.0, 0.0) * speed
        if name == "pose":
            yield name, pose(START + time, way, speed if way else 0.0)
        else:
            yield name, reading(name, START + time, scene, max(time * 1e-9 - 0.033 - 1.0, 0.0) * speed)


def operator(settings: dict[str, Any] | None = None, rig: dict[str, Any] = RIG, without: str = "imu") -> Surroundings:
    checked, mistakes = check_settings(Surroundings, settings or {})
    assert not mistakes
    ports = {port: kind for port, kind in PORTS.items() if port != without}
    random = np.random.default_rng(1)
    return Surroundings(checked, Context(node="surroundings", rig=read_rig(rig), ports=ports, random=random))


def emitted(samples: Iterator[tuple[str, Sample]], program: Surroundings | None = None) -> dict[str, list[Any]]:
    program = program or operator()
    found: dict[str, list[Any]] = {"grid": [], "obstacles": [], "cue": []}
    for port, message in samples:
        for out, each in program.handle(port, message):
            found[out].append(each)
    return found


def test_a_post_comes_out_where_it_stands() -> None:
    found = emitted(walk(post_at(2.5, 0.0), 2.0))
    last: Obstacles = found["obstacles"][-1]
    hand = last.stamp / SECOND - START / SECOND - 1.0
    for level in range(3):
        assert last.nearest[1, level] == pytest.approx(2.35 - 0.6 * hand, abs=0.12)
        assert last.place is not None
        np.testing.assert_allclose(last.place[1, level], [2.4, 0.0], atol=0.2)
    assert last.nearest[1, 3] == 0.0
    assert last.walking
    assert last.heading == pytest.approx(0.0, abs=1e-6)
    assert last.closing is not None
    assert last.closing[1, 1] == pytest.approx(0.6, abs=0.3)


def test_a_post_at_two_metres_and_half_a_metre_to_the_left_is_there_in_the_grid() -> None:
    grid: Grid = emitted(walk(post_at(2.15, 0.5), 2.0, speed=0.0))["grid"][-1]
    s, i, j = np.nonzero(grid.occupancy >= 168)
    x, y = (i + grid.origin[0] + 0.5) * grid.cell, (j + grid.origin[1] + 0.5) * grid.cell
    assert len(x) > 4
    assert np.abs(x - 2.0).max() < 0.16
    assert np.abs(y - 0.5).max() < 0.21
    assert (grid.occupancy.shape, grid.unit, grid.cell, grid.slice) == ((8, 64, 64), 1 / 32, 0.1, 0.25)
    assert (s.min(), s.max()) == (0, 7), "from the floor to where the upper sensor looks: 0.95 m + 1.7 m tan 0.49"


def test_the_floor_ends_and_a_drop_is_told_of() -> None:
    found = emitted(walk(stair_at(3.0), 4.5))
    drops = [cue for cue in found["cue"] if cue.kind == "drop"]
    first = drops[0]
    truth = 3.0 - 0.6 * ((first.stamp - START) / SECOND - 1.0)
    assert truth > 0.7
    assert first.distance == pytest.approx(truth, abs=0.3)
    assert {cue.kind for cue in found["cue"] if cue.stamp < first.stamp - SECOND} == {"blind", "none"}


def test_a_cue_comes_at_least_every_110_ms_and_agrees_with_the_newest_obstacles() -> None:
    found = emitted(walk(post_at(2.0, 0.0), 2.5, ends={"tof_up": 1.8}))
    cues: list[Cue] = found["cue"]
    stamps = np.array([cue.stamp for cue in cues])
    assert np.diff(stamps).min() > 0
    assert np.diff(stamps).max() <= 0.11 * SECOND
    for cue in cues:
        newest = [each for each in found["obstacles"] if each.stamp <= cue.stamp][-1:]
        if cue.kind == "obstacle":
            level = ("low", "waist", "head").index(cue.level or "")
            assert newest[0].nearest[1, level] == pytest.approx(cue.distance)
    first = next(cue for cue in cues if cue.kind == "obstacle")
    assert first.stamp - first.since <= 0.15 * SECOND


@pytest.mark.parametrize("name", ["tof_up", "tof_down", "pose"])
def test_a_stream_that_ends_makes_blind_at_once_and_for_good(name: str) -> None:
    cues: list[Cue] = emitted(walk(floor, 3.0, ends={name: 2.0}))["cue"]
    blind = [cue for cue in cues if cue.kind == "blind" and cue.stamp > START + 2 * SECOND]
    assert blind[0].stamp - START - 2 * SECOND < 0.3 * SECOND
    assert all(cue.kind == "blind" for cue in cues if cue.stamp >= blind[0].stamp)
    assert all(name in (cue.reason or "") for cue in blind)
    assert 1.9 * SECOND < blind[0].since - START <= 2.0 * SECOND
    assert [cue.kind for cue in cues if 0.2 * SECOND < cue.stamp - START < 2 * SECOND].count("blind") == 0


@pytest.mark.parametrize("name", ["tof_up", "tof_down"])
def test_a_sensor_that_repeats_its_last_reading_makes_blind(name: str) -> None:
    held: Ranges | None = None

    def frozen() -> Iterator[tuple[str, Sample]]:
        nonlocal held
        for port, message in walk(post_at(2.0, 0.0), 3.0, speed=0.1):
            if port == name and message.stamp > START + 2 * SECOND:
                assert held is not None
                yield port, Ranges(stamp=message.stamp, ranges=held.ranges, status=held.status, delay=held.delay)
                continue
            if port == name:
                assert isinstance(message, Ranges)
                held = message
            yield port, message

    cues: list[Cue] = emitted(frozen())["cue"]
    blind = [cue for cue in cues if cue.kind == "blind" and cue.stamp > START + 2 * SECOND]
    assert held is not None
    assert blind[0].stamp - held.stamp < 0.45 * SECOND
    assert "repeats itself" in (blind[0].reason or "")
    assert blind[0].since == held.stamp


def test_before_the_first_reading_of_every_sensor_it_is_blind() -> None:
    cues: list[Cue] = emitted(walk(floor, 1.0))["cue"]
    assert cues[0].stamp == START
    assert cues[0].kind == "blind"
    assert "tof_up/ranges" in (cues[0].reason or "")
    assert cues[0].since == START


def test_a_pose_that_jumps_clears_the_map() -> None:
    program = operator()
    samples = list(walk(post_at(2.0, 0.0), 2.0, speed=0.0))
    emitted(iter(samples), program)
    last = samples[-1][1].stamp
    list(program.handle("pose", pose(last + 10_000_000, 3.0)))
    scene = reading("tof_up", last + 60_000_000, floor, 3.0)
    found = {out: each for out, each in program.handle("tof_up", scene)}
    assert isinstance(found["obstacles"], Obstacles)
    assert not found["obstacles"].nearest.any()


def test_a_snapshot_goes_on_to_the_last_bit() -> None:
    samples = list(walk(post_at(2.5, 0.1), 2.5))
    half = len(samples) // 2
    program = operator()
    emitted(iter(samples[:half]), program)
    again = unpack(pack(program, Surroundings.__module__), Surroundings.__module__)
    assert isinstance(again, Surroundings)
    first, second = (emitted(iter(samples[half:]), each) for each in (program, again))
    for port, messages in first.items():
        assert [numbered(m, 0) for m in messages] == [numbered(m, 0) for m in second[port]]


def test_a_reading_of_other_zones_than_the_rig_has_is_refused() -> None:
    odd = Ranges(stamp=START, ranges=np.ones(16, np.float32), status=np.zeros(16, np.uint8))
    with pytest.raises(Refused, match=r"16 zones; rig.rangers.tof_up has 64"):
        list(operator().handle("tof_up", odd))


def test_a_sensor_that_the_rig_lacks_is_named() -> None:
    with pytest.raises(MessageError, match=r"rig.rangers has no tof_down, tof_up; there are: none"):
        operator(rig={**RIG, "rangers": {}})


def test_a_turned_world_is_told_of_in_the_same_way() -> None:
    """The whole walk turned by 90 degrees: sectors and distances do not know which way north is."""
    quarter: Quaternion = (EYE, 0.0, 0.0, EYE)

    def turned() -> Iterator[tuple[str, Sample]]:
        for port, message in walk(post_at(2.5, 0.1), 2.5):
            if isinstance(message, Pose):
                x, y, z = message.position
                vx, vy, vz = message.velocity
                yield (
                    port,
                    Pose(
                        stamp=message.stamp,
                        position=(-y, x, z),
                        velocity=(-vy, vx, vz),
                        orientation=multiply(quarter, message.orientation),
                        method="best",
                        covariance=message.covariance,
                    ),
                )
            else:
                yield port, message

    straight, other = emitted(walk(post_at(2.5, 0.1), 2.5)), emitted(turned())
    a, b = straight["obstacles"][-1], other["obstacles"][-1]
    np.testing.assert_allclose(a.nearest, b.nearest, atol=0.11)
    assert b.heading == pytest.approx(math.pi / 2)


@pytest.mark.skipif(not CORRIDORS.exists(), reason="the reference corridors (../shared/data) are not here")
@pytest.mark.parametrize(
    ("name", "least"), [("approach_box_41", 1.7), ("approach_stairs_44", 0.6), ("approach_person_43", 2.0)]
)
def test_a_reference_approach_is_told_of_in_time(
    name: str, least: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from caneflow import command

    recording, out = CORRIDORS / f"{name}.mcap", tmp_path / "out.mcap"
    arguments = ["run", ROOT / "dataflows" / "guide.yaml", "--replay", recording, "--in-process", "--record", out]
    monkeypatch.setattr(sys, "argv", ["caneflow", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        command.main()
    assert not end.value.code
    monkeypatch.syspath_prepend(str(CORRIDORS.parents[1] / "checks"))
    import score_surroundings  # type: ignore[import-not-found]

    result = score_surroundings.score(str(recording), str(out))
    assert result["told"][0]["first"] >= least
    assert (result["phantoms"], result["beside"], result["blind"]) == (0, 0, 0.0)
    assert result["gap"] <= 0.11
    assert result["agree"] >= 0.99


def test_the_rig_of_the_flow_is_sound() -> None:
    assert isinstance(read_rig(RIG), Rig)


GUIDE = ROOT / "dataflows" / "guide.yaml"


def test_check_warns_of_a_pose_that_is_not_good_enough_for_a_map(tmp_path: Path) -> None:
    assert not any("method" in str(problem) for problem in examine(GUIDE)[1])
    path = tmp_path / "guide.yaml"
    path.write_text(
        GUIDE.read_text()
        .replace("method: best, with_local: true", "method: luenberger")
        .replace("fusion/local", "fusion/pose")
    )
    graph, problems = examine(path)
    assert graph is not None
    (said,) = [str(problem) for problem in problems if "method" in str(problem)]
    assert "warning: nodes.surroundings.inputs.pose: comes from the method luenberger" in said


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [("rangers:", "sensors_of_mine:", "rig.rangers: is missing"), ("    tof_up:", "    upper:", "has no tof_up")],
)
def test_check_names_a_rig_without_the_range_sensors(old: str, new: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "guide.yaml"
    path.write_text(GUIDE.read_text().replace(old, new, 1))
    graph, problems = examine(path)
    assert graph is None
    assert any(says in str(problem) for problem in problems)
