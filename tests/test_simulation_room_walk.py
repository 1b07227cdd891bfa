"""A person in a room: gait against the published model, feet on the floor, and the IMU on the belt."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from caneflow.physics import LOCAL_GRAVITY
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.belt_imu import (
    ACCEL_STEP,
    GYRO_STEP,
    BeltImuSettings,
    BeltSamples,
    belt,
    measure,
    room_field,
)
from caneflow.simulation.room_course import (
    RATE,
    CourseSettings,
    Trajectory,
    back_and_forth,
    course_legs,
    standing,
    trajectory,
)
from caneflow.simulation.room_walk import Gait, PersonSettings, body, gait, person, seen_from

PLAIN = PersonSettings(
    height_spread=0.0, gait_spread=0.0, trunk_spread=0.0, trunk_wander=0.0, trunk_lead=0.0, standing_sway=0.0
)
IDEAL = BeltImuSettings(
    gyro_noise=0.0,
    gyro_bias=0.0,
    gyro_start=0.0,
    gyro_scale=0.0,
    accel_noise=0.0,
    accel_bias=0.0,
    mag_noise=0.0,
    hard_iron=0.0,
    belt_turn=0.0,
    belt_tilt=0.0,
    field_error=0.0,
)


def straight(speed: float = 1.0, duration: float = 12.0) -> Trajectory:
    """Along x at a constant speed, without a start or an end."""
    time = np.arange(round(duration * RATE)) / RATE
    zeros = np.zeros_like(time)
    position = np.column_stack([speed * time, zeros])
    return Trajectory(time, position, np.column_stack([zeros + speed, zeros]), zeros, speed * time)


def walker(way: Trajectory, settings: PersonSettings = PLAIN) -> Gait:
    return gait(way, person(settings, default_rng(1)), settings, default_rng(2))


def limb_points(way: Trajectory) -> Floats:
    return body(walker(way), person(PLAIN, default_rng(1)), PLAIN).limbs


def test_strides_are_those_of_the_published_model() -> None:
    leg = 0.491 * 1.72
    for speed in (0.6, 1.0, 1.4):
        walk = walker(straight(speed))
        length = 1.346 * np.sqrt(speed / leg) * leg  # Boulic et al.
        assert walk.stride_length == pytest.approx(length)
        made = walk.strides[-1] - walk.strides[0]
        assert made * length == pytest.approx(walk.trajectory.distance[-1], rel=1e-3)
        bob = np.ptp(walk.centre[:, 2])
        assert bob == pytest.approx(2.0 * 0.015 * speed / leg * leg, rel=0.1)


def test_feet_stand_still_on_the_floor_and_overtake_the_body() -> None:
    feet = limb_points(straight(1.0))[[6, 12]]  # head, left arm and leg, right arm and leg
    speed = np.diff(feet[..., 0], axis=1) * RATE
    walk = walker(straight(1.0))
    standing_part = np.mean(np.abs(speed) < 0.02, axis=1)
    assert standing_part == pytest.approx(walk.support[0], abs=0.02)
    assert 0.6 < walk.support[0] < 0.7  # of a stride, at 1 m/s (Boulic et al.)
    assert 3.0 < speed.max() < 4.5  # a foot in the air is some three to four times as fast as the body
    assert np.mean(speed) == pytest.approx(1.0, abs=0.02)
    together = (np.abs(speed[0]) < 0.02) | (np.abs(speed[1]) < 0.02)
    assert together.all()  # one foot is always down: that is what walking is


def test_limbs_stay_near_the_body_and_the_trunk_on_the_course() -> None:
    walk = walker(straight(1.2))
    points = limb_points(straight(1.2))
    offset = points[..., 0] - walk.trajectory.position[:, 0]
    assert np.abs(offset).max() < 0.75
    assert points[..., 2].min() > 0.0
    assert points[..., 2].max() < 1.75
    assert np.abs(walk.centre[:, :2] - walk.trajectory.position).max() < 0.05
    # arms swing against the leg of their side
    left_hand, left_foot = offset[3], offset[6]
    assert np.corrcoef(left_hand, left_foot)[0, 1] < -0.5


def test_the_body_surges_by_a_tenth_of_its_speed() -> None:
    walk = walker(straight(1.0))
    speed = np.gradient(walk.centre[:, 0], 1.0 / RATE)[1:-1]
    assert np.sqrt(2.0) * speed.std() == pytest.approx(0.12, abs=0.01)


def test_who_stands_stands() -> None:
    way = standing(np.array([3.0, 4.0]), 0.3, 5.0)
    points = limb_points(way)
    assert np.ptp(points, axis=1).max() == pytest.approx(0.0, abs=1e-12)


def test_the_trunks_cross_section_is_its_mean_over_the_aspects() -> None:
    settings = replace(PLAIN, fluctuation=0.0)
    who = person(settings, default_rng(3))
    around = standing(np.array([0.0, 0.0]), 0.0, 20.0)
    turning = around._replace(heading=np.linspace(0.0, 2.0 * np.pi, len(around.time)))
    someone = body(gait(turning, who, settings, default_rng(0)), who, settings)
    seen = seen_from(someone, np.array([6.0, 0.0, 1.2]), settings, default_rng(1))
    trunk = np.sum(seen.amplitudes[:11] ** 2, axis=0)
    assert trunk.mean() == pytest.approx(0.6, rel=0.05)
    chest, side = trunk[0], trunk[len(trunk) // 4]
    assert 10.0 * np.log10(chest / side) == pytest.approx(3.0, abs=0.8)
    # the specular point lies on the skin towards the sensor: half a depth or half a breadth away from the axis
    reach = seen.points[0, :, 0] - someone.axis[:, 0]
    assert reach.min() == pytest.approx(0.11, abs=0.005)
    assert reach.max() == pytest.approx(0.17, abs=0.005)


def test_the_cross_section_fluctuates_slowly_by_a_decibel_and_a_half() -> None:
    way = standing(np.array([3.0, 4.0]), 0.3, 400.0)
    who = person(PLAIN, default_rng(1))
    someone = body(walker(way), who, PLAIN)
    logs = []
    for seed in range(6):
        seen = seen_from(someone, np.array([0.0, 0.0, 1.2]), PLAIN, default_rng(seed))
        logs.append(20.0 * np.log10(seen.amplitudes[0]))
    level = np.array(logs)
    level -= 20.0 * np.log10(np.sqrt(0.6 * 0.6 * (1.0 + 0.33 * np.cos(2.0 * (np.arctan2(-4.0, -3.0) - 0.3)))))
    assert np.sqrt(np.mean(level**2)) == pytest.approx(1.5, rel=0.15)
    lag = 2 * RATE
    assert np.mean(level[:, lag:] * level[:, :-lag]) / np.mean(level**2) == pytest.approx(np.exp(-0.5), abs=0.15)


# --- the belt


def circling() -> Trajectory:
    settings = CourseSettings(shape="circle")
    way = trajectory(course_legs((0.0, 8.0, 0.0, 8.0), settings, default_rng(5)), settings, default_rng(6))
    return Trajectory(*(values[: 60 * RATE] for values in way))


def worn(way: Trajectory, settings: BeltImuSettings = IDEAL, who: PersonSettings = PLAIN, seed: int = 3) -> BeltSamples:
    return measure(walker(way, who), belt(settings, default_rng(4)), settings, default_rng(seed), default_rng(9))


def test_the_gyro_integrates_to_the_heading() -> None:
    way = circling()
    gyro = worn(way).gyro
    turn = Rotation.from_euler("z", way.heading[0])
    yaw = []
    for rate in 0.5 * (gyro[1:] + gyro[:-1]):
        turn = turn * Rotation.from_rotvec(rate / 100.0)
        ahead = turn.apply([1.0, 0.0, 0.0])
        yaw.append(np.arctan2(ahead[1], ahead[0]))
    error = np.angle(np.exp(1j * (np.array(yaw) - way.heading[2::2])))
    assert np.ptp(way.heading) > 2.0 * np.pi
    # the pelvis turns by 4 deg RV to each side in every stride; the average over them is the heading
    smooth = np.convolve(error, np.ones(500) / 500, "valid")
    assert np.abs(smooth).max() < 2.0 * DEGREE
    assert np.abs(error).max() < 10.0 * DEGREE


def test_a_belt_at_rest_feels_gravity_and_north() -> None:
    way = standing(np.array([2.0, 3.0]), 0.0, 5.0)
    imu = worn(way)
    assert imu.accel == pytest.approx(np.tile([0.0, 0.0, LOCAL_GRAVITY], (500, 1)), abs=ACCEL_STEP)
    assert not imu.gyro.any()
    # facing east (x0), north (y0) is to the left (y of the body), and the field points down
    assert imu.mag[0] == pytest.approx([0.0, 22.5, -41.5], abs=0.1)
    turned = worn(way, replace(IDEAL, north=0.5 * np.pi + 0.4))
    assert np.arctan2(turned.mag[0, 1], turned.mag[0, 0]) == pytest.approx(0.5 * np.pi + 0.4, abs=0.01)


def test_noise_is_the_data_sheets() -> None:
    way = standing(np.array([2.0, 3.0]), 0.0, 60.0)
    noisy = replace(IDEAL, gyro_noise=0.01 * DEGREE, accel_noise=300e-6 * LOCAL_GRAVITY, mag_noise=0.5)
    imu = worn(way, noisy)
    assert imu.gyro.std(axis=0) == pytest.approx(
        np.hypot(0.01 * DEGREE * np.sqrt(50.0), GYRO_STEP / np.sqrt(12.0)), rel=0.05
    )
    assert imu.accel.std(axis=0) == pytest.approx(300e-6 * LOCAL_GRAVITY * np.sqrt(50.0), rel=0.05)
    assert imu.mag.std(axis=0) == pytest.approx(0.5, rel=0.05)


def test_errors_are_drawn_with_the_deviations_asked_for() -> None:
    drawn = [belt(BeltImuSettings(), default_rng(seed)) for seed in range(300)]
    for values, deviation in (
        ([one.gyro_bias for one in drawn], 0.5 * DEGREE),
        ([one.accel_bias for one in drawn], 0.15),
        ([one.hard_iron for one in drawn], 2.0),
    ):
        assert np.sqrt(np.mean(np.square(values))) == pytest.approx(deviation, rel=0.1)
    still = standing(np.array([2.0, 3.0]), 0.0, 1.0)
    started = [worn(still, replace(IDEAL, gyro_start=0.1 * DEGREE), seed=seed).gyro[0] for seed in range(200)]
    assert np.std(started) == pytest.approx(0.1 * DEGREE, rel=0.12)


def test_the_field_is_the_rooms_and_errs_by_6_deg() -> None:
    places = np.array([[1.0, 2.0, 0.9], [6.0, 5.0, 0.9]])
    settings = BeltImuSettings()
    fields = np.array([room_field(places, settings, default_rng(seed)) for seed in range(800)])
    direction = np.arctan2(fields[..., 1], fields[..., 0]) - 0.5 * np.pi
    assert direction.std() == pytest.approx(6.0 * DEGREE, rel=0.2)
    again = room_field(places, settings, default_rng(7))
    assert np.array_equal(again, fields[7])


def test_the_trunk_is_not_quite_along_the_travel() -> None:
    settings = CourseSettings()
    legs = back_and_forth(np.array([0.5, 4.0]), np.array([7.5, 4.0]), 6, settings, default_rng(1))
    way = trajectory(legs, settings, default_rng(2))
    deviations = []
    for seed in range(20):
        who = person(PersonSettings(), default_rng(seed))
        walk = gait(way, who, PersonSettings(), default_rng(seed + 50))
        turned = belt(BeltImuSettings(), default_rng(seed + 90)).turned
        deviations.append(np.median(walk.trunk_heading - way.heading) + 2.0 * turned[3])
        wander = (walk.trunk_heading - way.heading)[np.hypot(*way.velocity.T) > 0.5]
        assert 1.0 * DEGREE < wander.std() < 12.0 * DEGREE
    assert 2.0 * DEGREE < np.std(deviations) < 7.0 * DEGREE
