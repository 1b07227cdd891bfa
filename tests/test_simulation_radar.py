"""The simulated radar against the radar equation, the Doppler formula and a slow sum over pulses."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.signal import hilbert

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.course import course
from caneflow.simulation.radar import (
    RANGE_STEP,
    RadarSettings,
    echoes,
    floor_power,
    pattern,
    pulse_length,
    scans,
)
from caneflow.simulation.scene import Scene, SceneSettings, scene
from caneflow.simulation.walk import Motion, MotionSettings, Rig, course_of, walk

SETTINGS = RadarSettings()
RIG = Rig()
PITCH = 42.0 * DEGREE
NOTHING = Scene(np.zeros((0, 3)), np.zeros(0, dtype=complex), None, 0.03)


def at_origin(count: int) -> tuple[Floats, Floats]:
    """An antenna at the origin that looks along x, `count` times."""
    return np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0], (count, 1))


def standing(count: int) -> Motion:
    """A cane held still for `count` scans."""
    zeros = np.zeros((count, 3))
    q = attitude.from_angles(np.zeros(count), np.full(count, PITCH), np.zeros(count))
    place = zeros + np.array([0.0, 0.0, 0.75])
    time = np.arange(count) / 100.0
    return Motion(time, place, zeros, zeros, q, zeros, place, zeros[:, 0], zeros[:, 0])


def test_an_approaching_scatterer_has_positive_doppler_of_the_right_size() -> None:
    speed, period = 0.4, 0.01  # m/s towards the scatterer, s
    antenna, boresight = at_origin(60)
    antenna[:, 0] = speed * period * np.arange(60)
    echo = echoes(antenna, boresight, np.array([[1.6, 0.0, 0.0]]), np.ones(1, complex), RIG.aperture, SETTINGS)
    analytic = hilbert(echo.real, axis=1)  # as an operator sees it: from the real scan alone
    at_bin = analytic[:, np.argmin(np.abs(SETTINGS.ranges() - 1.5))]
    step = np.angle(np.sum(at_bin[1:] * np.conj(at_bin[:-1])))
    doppler = step / (2.0 * np.pi * period)
    assert doppler == pytest.approx(2.0 * speed * SETTINGS.carrier / SPEED_OF_LIGHT, rel=1e-3)


def test_power_falls_as_the_fourth_power_of_range() -> None:
    antenna, boresight = at_origin(1)
    power = [
        np.sum(
            np.abs(echoes(antenna, boresight, np.array([[r, 0, 0]]), np.ones(1, complex), RIG.aperture, SETTINGS)) ** 2
        )
        for r in (0.8, 1.6)
    ]
    assert power[0] / power[1] == pytest.approx(16.0, rel=1e-2)


def test_the_pattern_is_3_db_down_one_way_at_half_the_aperture() -> None:
    assert pattern(np.array([0.0, 0.4]), 0.8) == pytest.approx([1.0, 0.5])
    antenna, boresight = at_origin(1)
    off = 0.5 * RIG.aperture
    points = np.array([[np.cos(off), np.sin(off), 0.0]])
    echo = echoes(antenna, boresight, points, np.ones(1, complex), RIG.aperture, SETTINGS)
    assert np.abs(echo).max() == pytest.approx(0.5, rel=1e-2)  # -6 dB both ways; 1 on the boresight


def test_the_pulse_has_1_7_ghz_between_its_10_db_points() -> None:
    antenna, boresight = at_origin(1)
    echo = echoes(antenna, boresight, np.array([[1.5, 0, 0]]), np.ones(1, complex), RIG.aperture, SETTINGS)
    spectrum = np.abs(np.fft.rfft(echo.real[0], 1 << 14)) ** 2
    frequency = np.fft.rfftfreq(1 << 14, 2.0 * RANGE_STEP / SPEED_OF_LIGHT)
    wide = frequency[spectrum > 0.1 * spectrum.max()]
    assert frequency[spectrum.argmax()] == pytest.approx(4.3e9, rel=2e-3)
    assert wide[-1] - wide[0] == pytest.approx(1.7e9, rel=2e-2)
    assert pytest.approx(9.149e-3, abs=1e-6) == RANGE_STEP


def test_echoes_agree_with_the_slow_sum_over_pulses() -> None:
    rng = default_rng(1)
    antenna = np.array([[0.0, 0.0, 0.75], [0.02, 0.01, 0.74]])
    boresight = np.array([[0.8, 0.0, -0.6], [0.6, 0.0, -0.8]])
    points = np.column_stack([rng.uniform(0.2, 2.0, 40), rng.uniform(-1.0, 1.0, 40), np.zeros(40)])
    amplitudes = rng.normal(size=40) + 1j * rng.normal(size=40)
    slow = np.zeros((2, SETTINGS.bins), dtype=complex)
    k = 4.0 * np.pi * SETTINGS.carrier / SPEED_OF_LIGHT
    for i in range(2):
        for point, amplitude in zip(points, amplitudes, strict=True):
            d = point - antenna[i]
            r = np.linalg.norm(d)
            gain = 2.0 ** (-4.0 * (np.arccos(d @ boresight[i] / r) / RIG.aperture) ** 2)
            behind = SETTINGS.ranges() - r
            pulse = np.exp(-0.5 * (behind / pulse_length(SETTINGS)) ** 2) * np.exp(1j * k * behind)
            slow[i] += amplitude * gain / r**2 * pulse
    fast = echoes(antenna, boresight, points, amplitudes, RIG.aperture, SETTINGS)
    assert np.abs(fast - slow).max() < 3e-3 * np.abs(slow).max()


def test_the_floors_mean_power_is_the_radar_equations() -> None:
    rng = default_rng(2)
    q = attitude.from_angles(np.zeros(1), np.array([PITCH]), np.zeros(1))
    boresight = attitude.rotate(q, (0.0, 1.0, 0.0))
    antenna = np.array([[0.0, 0.0, RIG.hand_height]]) - attitude.rotate(q, RIG.pivot)
    density, total = 60.0, np.zeros(SETTINGS.bins)
    for _ in range(300):
        xy = rng.uniform(-3.2, 3.2, (round(density * 6.4**2), 2))
        points = np.column_stack([xy, np.zeros(len(xy))])
        amplitudes = np.sqrt(0.03 / density) * np.exp(2j * np.pi * rng.random(len(xy)))
        total += echoes(antenna, boresight, points, amplitudes, RIG.aperture, SETTINGS)[0].real ** 2
    expected = floor_power(RIG, PITCH, 0.03, SETTINGS)
    strong = expected > 0.1 * expected.max()
    # 300 draws of an exponential are good to 6 % per bin, and neighbouring bins are alike
    assert total[strong].sum() / 300.0 == pytest.approx(expected[strong].sum(), rel=0.06)
    assert total[strong] / 300.0 == pytest.approx(expected[strong], rel=0.4)


def test_the_snr_is_that_of_the_floors_strongest_range() -> None:
    motion = walk(MotionSettings(pitch_spread=0.0), RIG, default_rng(1), duration=11.0)
    sampled = Motion(*(values[3000::10] for values in motion))
    settings = replace(SETTINGS, snr=15.0, coupling=-200.0, tip_section=0.0)
    room = scene(SceneSettings(floor_density=60.0), course_of(MotionSettings()), default_rng(2))
    power = np.mean(scans(sampled, room, RIG, PITCH, settings, default_rng(3)).astype(float) ** 2, axis=0)
    ratio = 10.0 * np.log10(power.max() / settings.noise**2)
    assert ratio == pytest.approx(15.0, abs=1.5)
    assert np.sqrt(power[:20].mean()) == pytest.approx(settings.noise, rel=0.1)  # before the floor


def test_noise_is_white_gaussian_and_quantised() -> None:
    quiet = replace(SETTINGS, coupling=-200.0, tip_section=0.0)
    noise = scans(standing(200), NOTHING, RIG, PITCH, quiet, default_rng(4))
    assert noise.dtype == np.int32
    assert noise.std() == pytest.approx(200.0, rel=0.02)
    spectrum = np.mean(np.abs(np.fft.rfft(noise, axis=1)[:, 1:-1]) ** 2, axis=0).reshape(11, 13).mean(axis=1)
    assert spectrum / spectrum.mean() == pytest.approx(1.0, abs=0.1)


def test_jitter_turns_the_phase_of_what_stands_still() -> None:
    settings = replace(SETTINGS, jitter=3e-12, snr=60.0, coupling=-200.0)
    received = hilbert(scans(standing(400), NOTHING, RIG, PITCH, settings, default_rng(5)), axis=1)
    tip = received[:, np.abs(received[0]).argmax()]
    turned = np.std(np.angle(tip / tip.mean()))
    assert turned == pytest.approx(2.0 * np.pi * 4.3e9 * 3e-12, rel=0.1)  # 400 draws: 3.5 %


def test_the_tip_and_the_coupling_stand_still_at_their_ranges() -> None:
    settings = replace(SETTINGS, snr=40.0)
    mean = scans(standing(100), NOTHING, RIG, PITCH, settings, default_rng(6)).mean(axis=0)
    ranges = settings.ranges()
    tip = 0.95 / np.sin(PITCH) - 0.3
    beyond = ranges > 0.9
    assert ranges[beyond][np.abs(mean[beyond]).argmax()] == pytest.approx(tip, abs=0.02)
    floor = np.sqrt(2.0) * settings.noise * 10.0 ** (40.0 / 20.0)  # amplitude of the strongest floor echo
    assert np.abs(mean[:30]).max() == pytest.approx(floor * 10.0 ** (26.0 / 20.0), rel=0.3)


def test_a_sparse_floor_is_as_strong_as_a_dense_one() -> None:
    track = course("loop", 8.0, 3.0, 0.5, 1, False)
    dense, sparse = (scene(SceneSettings(floor_density=density), track, default_rng(7)) for density in (400.0, 40.0))
    assert len(dense.points) == pytest.approx(10 * len(sparse.points), rel=0.05)
    ratio = np.sum(np.abs(dense.amplitudes) ** 2) / np.sum(np.abs(sparse.amplitudes) ** 2)
    assert ratio == pytest.approx(1.0, abs=0.1)


def test_walls_stand_around_the_course_and_leave_the_floor_as_it_is() -> None:
    track = course("loop", 8.0, 3.0, 0.5, 1, False)
    bare, walled = (scene(SceneSettings(walls=walls), track, default_rng(8)) for walls in (False, True))
    count = len(bare.points)
    np.testing.assert_array_equal(walled.points[:count], bare.points)
    walls = walled.points[count:]
    path = track.position(np.linspace(0.0, track.length, 400))
    outside = np.maximum(walls[:, :2] - path.max(axis=0), path.min(axis=0) - walls[:, :2]).max(axis=1)
    assert outside.min() > 0.85
    assert outside.max() < 1.45
    assert 2.0 < walls[:, 2].max() <= 2.2


def test_a_person_walks_at_1_m_s_beside_the_course() -> None:
    track = course("loop", 8.0, 3.0, 0.5, 1, False)
    walker = scene(SceneSettings(person=True), track, default_rng(9)).walker
    assert walker is not None
    trunk = walker.positions(np.linspace(0.0, 21.0, 2101))[:, :8].mean(axis=1)
    speed = np.linalg.norm(np.diff(trunk, axis=0), axis=1) / 0.01
    assert np.median(speed) == pytest.approx(1.0, rel=0.05)
    assert np.sum(np.abs(walker.amplitudes) ** 2) == pytest.approx(0.5, rel=0.8)


def test_the_scans_of_a_short_walk_are_the_beginning_of_those_of_a_long_one() -> None:
    motion = walk(MotionSettings(), RIG, default_rng(1), duration=3.0)
    whole = Motion(*(values[::10] for values in motion))
    part = Motion(*(values[:2450:10] for values in motion))
    room = scene(SceneSettings(floor_density=20.0, person=True), course_of(MotionSettings()), default_rng(2))
    done: list[float] = []
    long = scans(whole, room, RIG, PITCH, SETTINGS, default_rng(3), done.append)
    short = scans(part, room, RIG, PITCH, SETTINGS, default_rng(3))
    np.testing.assert_array_equal(short, long[:245])
    assert done == sorted(done)
    assert done[-1] == 1.0
