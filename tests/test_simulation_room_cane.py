"""Someone with a cane in a room: both sensor sets have one walk, and the truth is the person's."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from caneflow.messages import DopplerBlock, Imu, Pose, RadarFrame, decode
from caneflow.recording import Recording
from caneflow.simulation.room_cane import CaneInRoom, cane_in_room_settings, simulate_cane_in_room
from caneflow.simulation.room_scenario import Reflections, RoomSettings
from caneflow.simulation.walk import MotionSettings, course_of
from tools.simulate import cane_in_room_samples, written

BARE = RoomSettings(reflections=Reflections(floor=0.0, walls=0.0))
BRIEF = MotionSettings(shape="straight", length=3.0, speed=0.7, step_length=0.5)


@cache
def brief(seed: int = 4) -> CaneInRoom:
    return simulate_cane_in_room(BARE, seed, BRIEF)


def test_the_cane_is_ahead_of_the_person_all_the_way() -> None:
    walked = brief()
    count = len(walked.room.stamps_ns)
    np.testing.assert_array_equal(walked.room.stamps_ns, walked.cane.stamps_ns[:count])
    ahead = walked.cane.position[:count] - walked.room.position
    # 0.35 m of forearm and 0.3 m of shaft at 42 deg; the cane's frame begins elsewhere
    moved = ahead[:, :2] - ahead[0, :2]
    assert np.abs(moved).max() < 0.3  # the swing, and the gait
    assert np.linalg.norm(walked.room.position[-1] - walked.room.position[0]) == pytest.approx(3.0, abs=0.01)
    assert walked.room.position[:, :2].mean(axis=0) == pytest.approx([4.0, 4.0], abs=0.6)


def test_both_rigs_are_one_and_seeds_reproduce() -> None:
    one, again = brief(), simulate_cane_in_room(BARE, 4, BRIEF)
    assert {"boresight", "pivot", "sensors", "area", "start"} <= one.rig.keys()
    assert one.rig == again.rig
    np.testing.assert_array_equal(one.room.blocks["south"], again.room.blocks["south"])
    np.testing.assert_array_equal(one.cane.scans, again.cane.scans)
    assert (one.room.blocks["west"][:100] != brief(5).room.blocks["west"][:100]).any()


def test_a_recording_has_both_sensor_sets_in_order(tmp_path: Path) -> None:
    path, walked = tmp_path / "cane.mcap", brief()
    written(path, "cane_in_room", walked.rig, cane_in_room_samples(walked))
    kinds = {("imu", "imu"): Imu, ("radar", "frame"): RadarFrame, ("south", "block"): DopplerBlock}
    with Recording(path) as got:
        assert set(got.streams) == {*kinds, ("west", "block"), ("truth", "pose")}
        for name, kind in kinds.items():
            samples = [sample.decoded() for sample in got.samples([name])]
            assert all(isinstance(sample, kind) for sample in samples)
            assert [sample.seq for sample in samples] == list(range(len(samples)))
        truth = [decode(sample.payload, Pose) for sample in got.samples([("truth", "pose")])]
    assert truth[0].position == pytest.approx(tuple(walked.room.position[0]))


@pytest.mark.parametrize("seed", range(5))
def test_the_course_fits_into_the_room(seed: int) -> None:
    motion = cane_in_room_settings(seed)
    course = course_of(motion)
    track = course.position(np.linspace(0.0, course.length, 500))
    assert np.ptp(track, axis=0) == pytest.approx([5.0, 4.0], abs=0.3)
    assert len(motion.pauses) == 1
    assert replace(motion, clockwise=not motion.clockwise) != motion
