"""The simulated BNO055 against its data sheet, against physics and against the motion it is carried through."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from caneflow.physics import LOCAL_GRAVITY
from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.imu import (
    ACCEL_STEP,
    EARTH_FIELD,
    GYRO_STEP,
    MAG_STEP,
    QUATERNION_STEP,
    ImuSamples,
    ImuSettings,
    magnetic_field,
    measure,
)
from caneflow.simulation.walk import Motion, MotionSettings, Rig, walk

IDEAL = ImuSettings(
    gyro_noise=0.0,
    gyro_bias=0.0,
    gyro_scale=0.0,
    accel_noise=0.0,
    accel_bias=0.0,
    mag_noise=0.0,
    tilt_error=0.0,
    field_error=0.0,
)


@pytest.fixture(scope="module")
def walked() -> tuple[Motion, ImuSamples]:
    motion = walk(MotionSettings(), Rig(), default_rng(2), duration=20.0)
    return motion, measure(motion, ImuSettings(), default_rng(3))


def standing(seconds: float, place: tuple[float, float, float] = (0.0, 0.0, 0.75)) -> Motion:
    """An IMU on a stand, pitched down by 42 deg."""
    count = round(1000 * seconds) + 1
    zeros = np.zeros((count, 3))
    q = attitude.from_angles(np.full(count, 0.4), np.full(count, 42.0 * DEGREE), np.zeros(count))
    position = zeros + np.array(place)
    return Motion(np.arange(count) / 1000.0, position, zeros, zeros, q, zeros, position, zeros[:, 0], zeros[:, 0])


def on_grid(values: Floats, step: float) -> bool:
    return bool(np.abs(values / step - np.rint(values / step)).max() < 1e-6)


def test_outputs_are_on_the_chips_grids(walked: tuple[Motion, ImuSamples]) -> None:
    _, imu = walked
    assert pytest.approx(1.0 / 16.0 * DEGREE) == GYRO_STEP
    assert on_grid(imu.gyro, GYRO_STEP)
    assert on_grid(imu.accel, ACCEL_STEP)
    assert on_grid(imu.linear_accel, ACCEL_STEP)
    assert on_grid(imu.mag, MAG_STEP)
    assert on_grid(imu.orientation, QUATERNION_STEP)
    assert np.linalg.norm(imu.orientation, axis=1) == pytest.approx(1.0, abs=1e-4)
    assert imu.calibration.min() >= 0
    assert imu.calibration.max() <= 3


def test_a_chip_at_rest_feels_gravity_upwards() -> None:
    imu = measure(standing(1.0), IDEAL, default_rng(0))
    expected = [0.0, -LOCAL_GRAVITY * np.sin(42.0 * DEGREE), LOCAL_GRAVITY * np.cos(42.0 * DEGREE)]
    assert imu.accel[50] == pytest.approx(expected, abs=ACCEL_STEP)
    assert imu.linear_accel[50] == pytest.approx([0.0, 0.0, 0.0], abs=ACCEL_STEP)
    assert np.abs(imu.gyro).max() == 0.0
    assert attitude.rotate(imu.orientation, imu.mag)[50] == pytest.approx(EARTH_FIELD, abs=0.1)


def test_linear_acceleration_and_gravity_are_the_acceleration(walked: tuple[Motion, ImuSamples]) -> None:
    _, imu = walked
    up = attitude.rotate(attitude.conjugate(imu.orientation), np.array([0.0, 0.0, LOCAL_GRAVITY]))
    # two roundings of a half step, and the rounding of the quaternion
    assert np.abs(imu.linear_accel + up - imu.accel).max() < ACCEL_STEP + 20.0 * QUATERNION_STEP


def test_an_ideal_chip_follows_the_motion() -> None:
    motion = walk(MotionSettings(), Rig(), default_rng(2), duration=12.0)
    imu = measure(motion, IDEAL, default_rng(0))
    assert np.abs(imu.orientation - motion.orientation[::10]).max() <= QUATERNION_STEP
    world = attitude.rotate(motion.orientation[::10], imu.linear_accel)
    gained = np.cumsum(world, axis=0)[:-1] / 100.0
    assert gained == pytest.approx(motion.velocity[10::10] - motion.velocity[0], abs=0.03)


def test_gyro_integrates_to_the_orientation() -> None:
    motion = walk(MotionSettings(), Rig(), default_rng(2), duration=12.0)
    gyro = measure(motion, IDEAL, default_rng(0)).gyro
    start, end = (Rotation.from_quat(np.roll(motion.orientation[i], -1)) for i in (0, -1))
    turn = start
    for rate in 0.5 * (gyro[1:] + gyro[:-1]):
        turn = turn * Rotation.from_rotvec(rate / 100.0)
    assert (turn.inv() * end).magnitude() < 0.25 * DEGREE  # coning and rounding, 1/16 deg/s x 12 s at worst 0.4


def test_gyro_and_accelerometer_noise_are_the_data_sheets() -> None:
    noisy = replace(IDEAL, gyro_noise=0.014 * DEGREE, accel_noise=190e-6 * LOCAL_GRAVITY)
    imu = measure(standing(60.0), noisy, default_rng(1))
    gyro = np.hypot(0.014 * DEGREE * np.sqrt(50.0), GYRO_STEP / np.sqrt(12.0))
    accel = np.hypot(190e-6 * LOCAL_GRAVITY * np.sqrt(50.0), ACCEL_STEP / np.sqrt(12.0))
    assert imu.gyro.std(axis=0) == pytest.approx(gyro, rel=0.05)
    assert imu.accel.std(axis=0) == pytest.approx(accel, rel=0.05)


def test_biases_and_scales_are_drawn_with_the_deviations_asked_for() -> None:
    still = standing(0.3)
    settings = replace(IDEAL, gyro_bias=0.3 * DEGREE, accel_bias=0.07)
    drawn = [measure(still, settings, default_rng(seed)) for seed in range(200)]
    ideal = measure(still, IDEAL, default_rng(0))
    gyro = np.array([imu.gyro[0] - ideal.gyro[0] for imu in drawn])
    accel = np.array([imu.accel[0] - ideal.accel[0] for imu in drawn])
    assert np.sqrt(np.mean(gyro**2)) / DEGREE == pytest.approx(0.3, rel=0.12)  # 600 draws: 3 % each
    assert np.sqrt(np.mean(accel**2)) == pytest.approx(0.07, rel=0.12)


def test_the_magnetometer_speaks_20_times_a_second() -> None:
    mag = measure(standing(2.0), ImuSettings(), default_rng(1)).mag
    assert np.flatnonzero(np.any(np.diff(mag, axis=0) != 0.0, axis=1)).tolist() == list(range(4, 200, 5))


def test_the_field_is_free_of_curl_and_divergence() -> None:
    place, h = np.array([1.0, 2.0, 0.8]), 1e-4
    around = np.concatenate([place + h * np.eye(3), place - h * np.eye(3)])
    field = magnetic_field(around, ImuSettings(), default_rng(4))
    gradient = (field[:3] - field[3:]) / (2.0 * h)  # [i, j] = dB_j / dx_i
    assert np.abs(gradient - gradient.T).max() < 1e-6 * np.abs(gradient).max()
    assert abs(np.trace(gradient)) < 1e-6 * np.abs(gradient).max()


def test_the_field_errs_by_10_deg_over_2_m() -> None:
    places = np.array([[0.0, 0.0, 0.75], [1.0, 0.0, 0.75], [4.5, 0.0, 0.75]])
    fields = np.array([magnetic_field(places, ImuSettings(), default_rng(seed)) for seed in range(1500)])
    direction = np.arctan2(-fields[..., 0], fields[..., 1])
    assert direction.std() / DEGREE == pytest.approx(10.0, abs=0.8)
    correlation = np.corrcoef(direction.T)[0]
    assert 0.6 < correlation[1] < 0.95
    assert abs(correlation[2]) < 0.25


def test_the_heading_is_pulled_to_the_field_in_5_s() -> None:
    motion = standing(15.0)
    moved = motion._replace(position=np.where(motion.time[:, None] < 1.0, motion.position, [5.0, 3.0, 0.75]))
    settings = replace(IDEAL, field_error=10.0 * DEGREE)
    rng = default_rng(5)
    imu = measure(moved, settings, rng)
    error = attitude.yaw_of(imu.orientation) - 0.4
    before, after = error[50], error[100] + (error[-1] - error[100]) / (1.0 - np.exp(-14.0 / 5.0))
    assert abs(after - before) > 2.0 * DEGREE  # this seed's field differs enough between the two places
    assert (error[600] - after) / (before - after) == pytest.approx(np.exp(-5.0 / 5.0), abs=0.02)
    # and the compass and the heading agree: both take the field's direction for north
    north = attitude.rotate(moved.orientation[::10], imu.mag)
    assert error[50] == pytest.approx(np.arctan2(north[50, 0], north[50, 1]), abs=0.2 * DEGREE)


def test_the_tilt_errs_by_a_quarter_of_a_degree_for_8_s() -> None:
    motion = standing(600.0)
    imu = measure(motion, replace(IDEAL, tilt_error=0.26 * DEGREE), default_rng(6))
    up = attitude.rotate(attitude.conjugate(motion.orientation[:1]), np.array([0.0, 0.0, 1.0]))
    seen = attitude.rotate(imu.orientation, up)[:, :2] / DEGREE  # where the chip puts the vertical
    assert seen.std() == pytest.approx(0.26, rel=0.2)  # 75 correlation times, two axes
    lagged = [np.corrcoef(axis[:-800], axis[800:])[0, 1] for axis in seen.T]
    assert np.mean(lagged) == pytest.approx(np.exp(-1.0), abs=0.2)
