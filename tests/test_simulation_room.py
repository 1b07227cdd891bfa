"""Installations of the room tracker: what the seeds decide, what a recording holds, and that it is plausible."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from caneflow.messages import DopplerBlock, decode
from caneflow.recording import Recording
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.doppler_module import ModuleSettings
from caneflow.simulation.room_course import FASTEST, CourseSettings
from caneflow.simulation.room_scenario import (
    HARSH,
    PARTS,
    SENSORS,
    Reflections,
    RoomRecording,
    RoomSettings,
    room_settings,
    simulate_kinds,
    simulate_room,
)
from caneflow.simulation.room_walk import PersonSettings
from tools.simulate import room, room_names

RECORDED = Path(__file__).parents[1].parent / "shared" / "data" / "rooms"

BARE = Reflections(floor=0.0, walls=0.0)  # for tests that are not about mirrors, which cost the most
BRIEF = RoomSettings(axial_traverses=1, empty_duration=2.0, reflections=BARE)


def same(one: RoomRecording, other: RoomRecording) -> dict[str, bool]:
    """Whether IMU, truth and blocks are equal."""
    return {
        "imu": all(np.array_equal(a, b) for a, b in zip(one.imu, other.imu, strict=True)),
        "truth": np.array_equal(one.position, other.position),
        "south": np.array_equal(one.blocks["south"], other.blocks["south"]),
        "west": np.array_equal(one.blocks["west"], other.blocks["west"]),
    }


def test_seeds_reproduce_a_recording_bit_for_bit() -> None:
    one, again = (simulate_room(BRIEF, "axial_x", 5, 6) for _ in range(2))
    assert all(same(one, again).values())
    assert one.rig == again.rig
    other_room, other_person = simulate_room(BRIEF, "axial_x", 7, 6), simulate_room(BRIEF, "axial_x", 5, 8)
    assert not any(same(one, other_room).values())
    assert not any(same(one, other_person).values())
    assert one.rig == other_person.rig
    assert one.rig != other_room.rig


def test_both_kinds_of_module_hear_what_each_would_hear_alone() -> None:
    both = simulate_kinds(BRIEF, "axial_x", 5, ("real", "iq"))
    assert all(same(both["real"], simulate_room(BRIEF, "axial_x", 5)).values())
    assert all(same(both["iq"], simulate_room(replace(BRIEF, modules="iq"), "axial_x", 5)).values())


def test_parts_and_sensors_have_their_own_random_numbers() -> None:
    plain = simulate_room(BRIEF, "axial_y", 2)
    for changed in (
        replace(BRIEF, sensors=4),
        replace(BRIEF, course=replace(BRIEF.course, shape="random"), empty_duration=3.0),
    ):
        assert all(same(plain, simulate_room(changed, "axial_y", 2)).values())
    walled = simulate_room(replace(BRIEF, reflections=HARSH), "axial_y", 2)
    assert same(plain, walled) == {"imu": True, "truth": True, "south": False, "west": False}
    both = simulate_room(replace(BRIEF, modules="iq"), "axial_y", 2)
    assert same(plain, both)["imu"]
    other = simulate_room(BRIEF, "axial_x", 2)
    assert not any(same(plain, other).values())
    assert np.corrcoef(plain.imu.accel[:100, 2], other.imu.accel[:100, 2])[0, 1] < 0.4


def test_an_empty_room_holds_the_noise_of_its_modules_and_nobody() -> None:
    empty = simulate_room(RoomSettings(modules="iq"), "empty", 4)
    samples = empty.blocks["south"].reshape(-1)
    assert len(samples) == 20 * 4000
    halves = [np.sqrt(np.mean(np.abs(half) ** 2)) for half in np.split(samples, 10)]
    assert np.ptp(halves) < 0.15 * np.mean(halves)  # as strong from beginning to end
    assert 0.01 < np.mean(halves) < 0.1
    assert abs(samples.mean()) < 1e-3
    assert np.linalg.norm(empty.position[0, :2] - 4.0) > 12.0
    noises = [empty.blocks[name].reshape(-1) for name in ("south", "west")]
    assert abs(np.vdot(noises[0], noises[1])) < 0.1 * np.linalg.norm(noises[0]) * np.linalg.norm(noises[1])
    again = simulate_room(RoomSettings(modules="iq"), "empty", 5).blocks["south"].reshape(-1)
    assert abs(np.vdot(samples, again)) < 0.1 * np.linalg.norm(samples) * np.linalg.norm(again)


def test_truth_is_a_walk_at_half_to_one_and_a_half_metres_a_second() -> None:
    settings = RoomSettings(course=CourseSettings(shape="figure_eight"), reflections=BARE)
    course = simulate_room(settings, "course", 3)
    speed = np.linalg.norm(course.velocity, axis=1)
    assert speed.max() <= FASTEST
    assert 0.6 < np.median(speed[speed > 0.3]) < 1.4
    assert np.mean((speed > 0.02) & (speed < 0.5)) < 0.06  # starting and stopping
    assert np.diff(course.position, axis=0)[:, :2] * 100.0 == pytest.approx(course.velocity[1:, :2], abs=0.06)
    assert not course.position[:, 2].any()
    yaw = 2.0 * np.arctan2(course.orientation[:, 3], course.orientation[:, 0])
    way = np.arctan2(course.velocity[:, 1], course.velocity[:, 0])
    assert np.abs(np.angle(np.exp(1j * (yaw - way)))[speed > 0.3]).max() < 2.0 * DEGREE
    start = course.rig["start"]
    assert isinstance(start, dict)
    assert start["sd"] == 0.5
    assert np.linalg.norm(np.array(start["position"]) - course.position[0, :2]) < 2.0


def test_stamps_are_of_the_last_sample_and_streams_end_together() -> None:
    got = simulate_room(BRIEF, "axial_x", 1)
    assert np.diff(got.stamps_ns).tolist() == [10_000_000] * (len(got.stamps_ns) - 1)
    assert got.block_stamps_ns[0] - got.stamps_ns[0] == 49_750_000
    assert np.diff(got.block_stamps_ns).tolist() == [50_000_000] * (len(got.block_stamps_ns) - 1)
    assert len(got.stamps_ns) == 5 * len(got.block_stamps_ns)
    assert {name: blocks.shape for name, blocks in got.blocks.items()} == {
        name: (len(got.block_stamps_ns), 200) for name in ("south", "west")
    }


def test_calibration_walks_lie_between_3_and_10_m_of_their_module() -> None:
    for part, name in (("axial_x", "west"), ("axial_y", "south")):
        walk = simulate_room(BRIEF, "axial_x" if part == "axial_x" else "axial_y", 1)
        reach = np.linalg.norm(walk.position[:, :2] - np.array(SENSORS[name].position), axis=1)
        assert reach.min() == pytest.approx(3.0, abs=0.05)
        assert reach.max() == pytest.approx(10.0, abs=0.05)


def test_modules_are_put_up_about_where_they_belong_and_measured_well() -> None:
    off, turned = [], []
    for seed in range(30):
        rig: dict[str, Any] = dict(simulate_room(replace(BRIEF, sensors=4), "empty", seed).rig)
        assert list(rig["sensors"]) == ["south", "west", "north", "east"]
        for name, sensor in rig["sensors"].items():
            off += (np.array(sensor["position"][:2]) - SENSORS[name].position).tolist()
            turned.append(sensor["azimuth"] - SENSORS[name].azimuth)
    assert np.std(off) == pytest.approx(0.15, rel=0.2)
    assert np.std(turned) == pytest.approx(np.hypot(2.5, 1.0) * DEGREE, rel=0.2)


def strengths(recorded: RoomRecording, name: str) -> tuple[Floats, Floats]:
    """Range of the person (h,), m, and peak of the spectrum (h,), full scale 1, by windows of 256 ms."""
    samples = np.asarray(recorded.blocks[name]).reshape(-1)
    scale = 2.0 / 32768.0 if samples.dtype == np.int16 else 1.0
    window = np.hanning(1025)[:-1]
    starts = np.arange(0, len(samples) - 1024, 200)
    spectra = np.abs(np.fft.fft(np.stack([samples[i : i + 1024] for i in starts]) * window)) / window.sum() * scale
    rig: dict[str, Any] = dict(recorded.rig)
    place = np.array(rig["sensors"][name]["position"][:2])
    middle = np.minimum((starts + 512) // 40, len(recorded.position) - 1)
    return np.linalg.norm(recorded.position[middle, :2] - place, axis=1), spectra[:, 2:144].max(axis=1)


def test_a_walkers_echo_falls_as_the_fourth_power_of_the_range() -> None:
    silent = RoomSettings(
        modules="iq",
        reflections=BARE,
        person=PersonSettings(fluctuation=0.0),
        module=ModuleSettings(detection_range=40.0),
        position_error=0.0,
    )
    walk = simulate_room(silent, "axial_x", 8)
    reach, peak = strengths(walk, "west")
    moving = np.linalg.norm(walk.velocity[:, :2], axis=1)[::5][: len(reach)] > 0.5
    slope = np.polyfit(np.log(reach[moving[: len(reach)]]), np.log(peak[moving[: len(reach)]] ** 2), 1)[0]
    assert slope == pytest.approx(-4.0, abs=0.7)


def test_detection_fades_at_9_to_10_m() -> None:
    levels: dict[str, list[float]] = {"near": [], "far": [], "beyond": []}
    for seed in range(3):
        settings = RoomSettings(axial_traverses=2)
        floor = np.median(strengths(simulate_room(settings, "empty", seed), "west")[1])
        reach, peak = strengths(simulate_room(settings, "axial_x", seed), "west")
        over = 20.0 * np.log10(peak / floor)
        for name, near, far in (("near", 3.5, 4.5), ("far", 6.5, 7.5), ("beyond", 9.0, 10.0)):
            levels[name].append(float(np.median(over[(reach > near) & (reach < far)])))
    near, far, beyond = (float(np.mean(levels[name])) for name in ("near", "far", "beyond"))
    # over the median of an empty window's strongest bin, which is itself some 7 dB over the mean noise of one
    assert near > 10.0
    assert near > far > beyond
    assert beyond < 4.0


# --- the command, and a simulator that is not ours


def test_a_set_of_recordings_is_named_after_the_course(tmp_path: Path) -> None:
    assert room_names(tmp_path / "a.mcap", "x", "all") == {
        "empty": tmp_path / "a_empty.mcap",
        "axial_x": tmp_path / "a_axial_x.mcap",
        "axial_y": tmp_path / "a_axial_y.mcap",
        "course": tmp_path / "a.mcap",
    }
    assert room_names(tmp_path / "new", "x", "empty") == {"empty": tmp_path / "new" / "x_empty.mcap"}
    assert not (tmp_path / "new").exists(), "a name makes nothing"
    assert room_names(tmp_path / "any.mcap", "x", "axial_x") == {"axial_x": tmp_path / "any.mcap"}
    assert set(room_names(tmp_path, "x", "all")) == set(PARTS)


def test_the_command_writes_what_other_simulators_write(tmp_path: Path) -> None:
    if not RECORDED.exists():
        pytest.skip("recordings of rooms by another simulator are not here (../shared/data/rooms)")
    for modules, sort in (("real", np.int16), ("iq", np.complex64)):
        output = tmp_path / f"{modules}_empty.mcap"
        room(output, seed=3, modules="iq" if modules == "iq" else "real", part="empty")
        theirs = RECORDED / f"nominal_{modules}2_circle_0_empty.mcap"
        ours_first, theirs_first = first_of(output), first_of(theirs)
        assert ours_first.keys() == theirs_first.keys()
        for topic, (schema, encoding, stamp, fields) in ours_first.items():
            assert (schema, encoding, stamp) == theirs_first[topic][:3]
            assert fields == theirs_first[topic][3], topic
        noise_of = [loudness(path) for path in (output, theirs)]
        assert blocks_of(output).dtype == blocks_of(theirs).dtype == sort
        assert noise_of[0] == pytest.approx(noise_of[1], rel=0.5)  # modules differ by 2 dB


def first_of(path: Path) -> dict[str, tuple[str, str, int, set[str]]]:
    """Schema, encoding, stamp and fields of each topic's first message."""
    found: dict[str, tuple[str, str, int, set[str]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in found and schema is not None:
                fields = set(msgpack.unpackb(message.data))
                found[channel.topic] = schema.name, channel.message_encoding, message.publish_time, fields
    return found


def blocks_of(path: Path) -> NDArray[Any]:
    with Recording(path) as recording:
        return np.concatenate(
            [decode(sample.payload, DopplerBlock).samples for sample in recording.samples([("south", "block")])]
        )


def loudness(path: Path) -> float:
    samples = blocks_of(path)
    return float(np.sqrt(np.mean(np.abs(samples.astype(np.complex128)) ** 2)))


@pytest.mark.parametrize(
    ("course", "modules", "sensors", "world", "message"),
    [
        ("jog", "real", 2, "nominal", r"no course 'jog'; there are circle, back_and_forth"),
        ("circle", "both", 2, "nominal", r"no modules 'both'; there are real, iq"),
        ("circle", "real", 5, "nominal", r"5 sensors; there may be 2 to 4"),
        ("circle", "real", 2, "mild", r"no world 'mild'; there are nominal, harsh"),
    ],
)
def test_what_there_is_not_is_refused(course: str, modules: Any, sensors: int, world: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        room_settings(course, modules=modules, sensors=sensors, world=world)


def test_seeds_are_not_negative() -> None:
    with pytest.raises(ValueError, match="seed -1; it must be 0 or more"):
        simulate_room(BRIEF, "empty", 1, -1)
