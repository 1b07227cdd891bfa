"""The simulated walker: courses, gait and cane against geometry and against their own derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from caneflow.simulation import attitude
from caneflow.simulation import smooth_noise as wander
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.course import Shape, course
from caneflow.simulation.walk import RATE, Motion, MotionSettings, Pause, Rig, walk

QUIET = MotionSettings(  # a walker without a tremor or moods
    speed_variation=0.0,
    step_variation=0.0,
    swing_variation=0.0,
    pitch_spread=0.0,
    wander=0.0,
    hand_height_error=0.0,
    restlessness=0.0,
    tremor=0.0,
)


@pytest.fixture(scope="module")
def loop() -> Motion:
    return walk(MotionSettings(), Rig(), default_rng(3))


@pytest.fixture(scope="module")
def quiet() -> Motion:
    return walk(QUIET, Rig(), default_rng(0))


def as_scipy(orientation: Floats) -> Rotation:
    return Rotation.from_quat(np.roll(orientation, -1, axis=-1))


# --- rotations and random functions


def test_array_rotations_agree_with_scipy() -> None:
    rng = default_rng(1)
    a, b = (np.roll(Rotation.random(50, random_state=rng).as_quat(), 1, axis=-1) for _ in range(2))
    v = rng.normal(size=(50, 3))
    assert attitude.rotate(a, v) == pytest.approx(as_scipy(a).apply(v))
    assert as_scipy(attitude.multiply(a, b)).as_matrix() == pytest.approx((as_scipy(a) * as_scipy(b)).as_matrix())
    assert attitude.to_rotation_vector(a) == pytest.approx(as_scipy(a).as_rotvec())
    turn = 0.9 * v / np.linalg.norm(v, axis=1, keepdims=True)
    assert attitude.to_rotation_vector(attitude.from_rotation_vector(turn)) == pytest.approx(turn)


def test_angles_are_those_of_the_contract() -> None:
    yaw, pitch, roll = np.array([0.7]), np.array([0.5]), np.array([0.3])
    q = attitude.from_angles(yaw, pitch, roll)
    boresight = attitude.rotate(q, (0.0, 1.0, 0.0))[0]
    assert boresight == pytest.approx([np.cos(0.5) * np.cos(0.7), np.cos(0.5) * np.sin(0.7), -np.sin(0.5)])
    assert attitude.yaw_of(q) == pytest.approx(yaw)


def test_a_wander_has_the_deviation_and_the_correlation_it_was_asked_for() -> None:
    rng = default_rng(2)
    at = np.array([0.0, 1.5, 3.0])
    draws = np.array([wander.slow(rng, 0.4, 1.5)(at) for _ in range(3000)])
    covariance = np.cov(draws.T) / 0.4**2
    expected = np.exp(-0.5 * (at[:, None] - at) ** 2 / 1.5**2)
    assert covariance == pytest.approx(expected, abs=0.08)  # three standard errors


# --- courses


@pytest.mark.parametrize("clockwise", [False, True])
def test_the_papers_loop_is_22_m_long_closed_and_about_8_by_3_m(clockwise: bool) -> None:
    loop = course("loop", 8.0, 3.0, 0.5, 1, clockwise)
    points = loop.position(np.linspace(0.0, loop.length, 20_000))
    assert loop.length == pytest.approx(22.0)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(22.0, abs=1e-3)
    assert points[-1] == pytest.approx(points[0], abs=0.002)
    assert np.ptp(points, axis=0) == pytest.approx([8.0, 3.0], abs=0.3)
    turned = loop.heading(np.array([0.0, loop.length]))
    assert turned == pytest.approx([0.0, -2.0 * np.pi if clockwise else 2.0 * np.pi])


def test_laps_follow_each_other() -> None:
    one, two = (course("loop", 8.0, 3.0, 0.5, laps, False) for laps in (1, 2))
    assert two.length == pytest.approx(2.0 * one.length)
    assert two.position(np.array([25.0])) == pytest.approx(one.position(np.array([3.0])), abs=0.005)
    assert two.heading(np.array([44.0])) == pytest.approx(4.0 * np.pi)


def test_a_figure_eight_closes_and_turns_by_nothing() -> None:
    eight = course("figure_eight", 8.0, 3.0, 0.5, 1, False)
    points = eight.position(np.linspace(0.0, eight.length, 2000))
    assert points[-1] == pytest.approx(points[0], abs=0.03)
    assert eight.heading(np.array([eight.length])) == pytest.approx(0.0, abs=1e-3)


def test_heading_is_the_direction_of_travel() -> None:
    shapes: tuple[Shape, ...] = ("loop", "straight", "figure_eight")
    for shape in shapes:
        track = course(shape, 8.0, 3.0, 0.5, 1, True)
        s = np.linspace(0.1, track.length - 0.1, 300)
        step = track.position(s + 1e-3) - track.position(s - 1e-3)
        along = np.stack([np.cos(track.heading(s)), np.sin(track.heading(s))], axis=1)
        assert step / 2e-3 == pytest.approx(along, abs=1e-4)


def test_corners_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"radius 2\.0 m do not fit into a loop of 8\.0 x 3\.0 m"):
        course("loop", 8.0, 3.0, 2.0, 1, False)


# --- the walk


def test_a_walk_stands_walks_22_m_in_about_50_s_and_stands(loop: Motion) -> None:
    assert np.ptp(loop.distance[loop.time <= 2.0]) == 0.0
    assert np.ptp(loop.distance[loop.time >= loop.time[-1] - 1.0]) < 1e-9
    assert loop.distance[-1] == pytest.approx(22.0, abs=1e-3)
    assert loop.time[-1] - 3.0 == pytest.approx(50.0, abs=4.0)
    assert np.diff(loop.distance).min() >= 0.0


def test_the_sensors_end_where_they_began(loop: Motion) -> None:
    assert np.linalg.norm(loop.position[-1] - loop.position[0]) < 0.05


def test_velocity_and_acceleration_are_the_derivatives_of_position(loop: Motion) -> None:
    integrated = np.cumsum(loop.velocity, axis=0)[:-1] / RATE
    drift = loop.position[1:] - loop.position[0] - integrated
    assert np.abs(drift - drift.mean(axis=0)).max() < 1e-3
    gained = np.cumsum(loop.acceleration, axis=0) / RATE
    error = loop.velocity - loop.velocity[0] - gained
    assert np.abs(error - error.mean(axis=0)).max() < 2e-3
    assert np.abs(loop.acceleration).max() < 4.0  # nothing jumps: a person, not a machine


def test_rate_integrates_to_orientation(loop: Motion) -> None:
    turn = as_scipy(loop.orientation[0])
    for rate in loop.rate[:8000]:
        turn = turn * Rotation.from_rotvec(rate / RATE)
    missing = (turn.inv() * as_scipy(loop.orientation[8000])).magnitude()
    assert missing < 0.1 * DEGREE  # half a sample of the swing's 70 deg/s is 0.035 deg


def test_the_cane_turns_about_the_hand(loop: Motion) -> None:
    to_hand = attitude.rotate(loop.orientation, Rig().pivot)
    assert loop.position + to_hand == pytest.approx(loop.hand, abs=1e-12)


def test_steps_are_whole_even_and_of_the_length_asked_for(quiet: Motion) -> None:
    assert quiet.steps[-1] == pytest.approx(round(quiet.steps[-1]), abs=1e-6)
    assert round(quiet.steps[-1]) % 2 == 0
    cruising = (quiet.time > 5.0) & (quiet.time < 8.0)
    length = np.ptp(quiet.distance[cruising]) / np.ptp(quiet.steps[cruising])
    assert length == pytest.approx(0.42, rel=0.03)


def test_the_cane_swings_by_20_deg_once_a_step_at_42_deg_of_pitch(quiet: Motion) -> None:
    straight = (quiet.time > 4.0) & (quiet.time < 14.0)  # within the first side: heading 0
    yaw = attitude.yaw_of(quiet.orientation)[straight]
    assert np.array([yaw.min(), yaw.max()]) / DEGREE == pytest.approx([-20.0, 20.0], abs=0.5)
    crossings = np.count_nonzero(np.diff(np.sign(yaw)))
    assert crossings == pytest.approx(np.ptp(quiet.steps[straight]), abs=1.0)
    down = -attitude.rotate(quiet.orientation, (0.0, 1.0, 0.0))[straight, 2]
    pitch = np.arcsin(down) / DEGREE
    assert pitch.max() == pytest.approx(42.0, abs=0.01)
    assert pitch.min() == pytest.approx(42.0 - 0.03 / (0.95 / np.sin(42.0 * DEGREE)) / DEGREE, abs=0.01)


def test_the_swing_stops_where_it_is_told_to() -> None:
    motion = walk(replace(QUIET, shape="straight", length=12.0, swing_until=0.5), Rig(), default_rng(0))
    yaw = attitude.yaw_of(motion.orientation) / DEGREE
    assert np.abs(yaw[(motion.distance > 4.0) & (motion.distance < 5.5)]).max() > 19.0
    assert np.abs(yaw[motion.distance > 7.0]).max() < 0.01


def test_corners_are_walked_more_slowly(quiet: Motion) -> None:
    speed = np.gradient(quiet.distance, 1.0 / RATE)
    assert np.median(speed) == pytest.approx(0.465, rel=0.01)
    corner = speed[np.argmin(np.abs(quiet.distance - (6.2 + 0.4)))]
    assert corner == pytest.approx(0.465 / 1.25, rel=0.05)


def test_a_pause_is_a_rest_and_a_step_back_goes_back() -> None:
    rest, back = Pause(at=3.0, duration=2.0), Pause(at=6.0, duration=1.0, back=0.6)
    motion = walk(replace(QUIET, shape="straight", length=9.0, pauses=(back, rest)), Rig(), default_rng(0))
    standing = np.abs(motion.distance - 3.0) < 1e-4
    assert np.count_nonzero(standing) / RATE == pytest.approx(2.0, abs=0.2)
    assert np.abs(motion.velocity[standing]).max() < 0.01
    after = motion.distance[np.argmax(motion.distance > 5.9999) :]
    assert after[: 5 * RATE].min() == pytest.approx(5.4, abs=1e-3)
    assert motion.velocity[:, 0].min() < -0.1
    assert motion.distance[-1] == pytest.approx(9.0, abs=1e-3)


@pytest.mark.parametrize("pause", [Pause(at=30.0, duration=1.0), Pause(at=1.0, duration=1.0, back=2.0)])
def test_a_pause_off_the_course_is_refused(pause: Pause) -> None:
    with pytest.raises(ValueError, match=r"must lie between 0\.00 and 22\.00 m"):
        walk(replace(QUIET, pauses=(pause,)), Rig(), default_rng(0))


def test_a_rest_is_not_quite_still(loop: Motion) -> None:
    resting = loop.time < 2.0
    rate = np.linalg.norm(loop.rate[resting], axis=1) / DEGREE
    assert 0.1 < np.sqrt(np.mean(rate**2)) < 2.0
    assert np.linalg.norm(loop.velocity[resting], axis=1).max() < 0.03


def test_a_short_walk_is_the_beginning_of_the_long_one(loop: Motion) -> None:
    short = walk(MotionSettings(), Rig(), default_rng(3), duration=4.0)
    assert len(short.time) == 4 * RATE + 1
    for part, whole in zip(short, loop, strict=True):
        np.testing.assert_array_equal(part, whole[: len(part)])


def test_a_long_walk_ends_in_standing() -> None:
    motion = walk(replace(QUIET, shape="straight", length=2.0), Rig(), default_rng(0), duration=20.0)
    assert motion.time[-1] == pytest.approx(20.0)
    assert np.abs(motion.velocity[motion.time > 10.0]).max() < 1e-9
