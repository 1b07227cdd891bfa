"""Named walks: what the seed decides, what a scenario changes, and that the whole is a plausible walk."""

from dataclasses import fields, replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.random import default_rng

from caneflow.simulation import attitude
from caneflow.simulation.attitude import DEGREE, Floats
from caneflow.simulation.imu import ImuSamples, ImuSettings, measure
from caneflow.simulation.scenario import SCENARIOS, Walk, WalkSettings, simulate_walk, walk_settings
from caneflow.simulation.scene import SceneSettings
from caneflow.simulation.walk import Motion, MotionSettings, walk

RECORDED = Path(__file__).parents[1].parent / "shared" / "data" / "walks" / "swing_1.mcap"

# a few scatterers, for tests that are not about the floor
LIGHT_FLOOR = SceneSettings(floor_density=20.0)


def parts(walk: Walk) -> dict[str, Floats]:
    """Every array of a walk by name."""
    plain = {f.name: getattr(walk, f.name) for f in fields(walk) if f.name not in ("imu", "rig")}
    return {k: np.asarray(v) for k, v in (plain | walk.imu._asdict()).items()}


def differing(one: Walk, other: Walk) -> set[str]:
    a, b = parts(one), parts(other)
    return {name for name in a if a[name].shape != b[name].shape or not np.array_equal(a[name], b[name])}


def test_a_seed_reproduces_a_walk_bit_for_bit() -> None:
    one, again, other = (simulate_walk("swing", seed, 0.5) for seed in (5, 5, 6))
    assert differing(one, again) == set()
    assert {"scans", "gyro", "position", "orientation", "mag"} <= differing(one, other)


def test_a_short_walk_is_the_beginning_of_a_longer_one() -> None:
    settings = WalkSettings(scene=LIGHT_FLOOR)
    short, long = parts(simulate_walk(settings, 1, 2.2)), parts(simulate_walk(settings, 1, 3.0))
    for name in ("stamps_ns", "position", "velocity", "orientation", "scans", "mag", "calibration"):
        np.testing.assert_array_equal(short[name], long[name][:221])
    # the low-pass filters of gyro and accelerometer look 20 ms ahead
    np.testing.assert_array_equal(short["gyro"][:-3], long["gyro"][:218])


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_walks(name: str) -> None:
    settings = walk_settings(name, 4)
    done: list[float] = []
    light = replace(settings, scene=replace(settings.scene, floor_density=20.0))
    walk = simulate_walk(light, 4, 0.5, done.append)
    assert walk.scans.shape == (51, 288)
    assert walk.scans.dtype == np.int32
    assert np.diff(walk.stamps_ns).tolist() == [10_000_000] * 50
    assert walk.position.shape == walk.velocity.shape == walk.imu.gyro.shape == (51, 3)
    assert walk.orientation.shape == walk.imu.orientation.shape == walk.imu.calibration.shape == (51, 4)
    assert (walk.scan_period, walk.carrier, walk.bandwidth) == (0.01, 4.3e9, 1.7e9)
    assert set(walk.rig) == {"boresight", "hand_height", "aperture", "pivot", "antenna", "step_length"}
    assert done[-1] == 1.0


def test_scenarios_are_what_their_names_say() -> None:
    settings = {name: walk_settings(name, 3) for name in SCENARIOS}
    assert settings["swing"].motion.swing_until is None
    assert 0.4 <= (settings["swing_stop"].motion.swing_until or 0.0) <= 0.6
    assert len(settings["stops"].motion.pauses) == 2
    assert settings["hard"].scene.walls
    assert settings["hard"].scene.person
    assert settings["hard"].radar.snr == 5.0
    assert settings["straight"].motion.shape == "straight"
    assert settings["slow"].motion.speed < settings["swing"].motion.speed < settings["brisk"].motion.speed
    assert settings["step_back"].motion.pauses[0].back >= 0.5
    assert {walk_settings("swing", seed).motion.clockwise for seed in range(12)} == {False, True}


def test_varied_walks_vary_within_the_published_range() -> None:
    varied = [walk_settings("varied", seed) for seed in range(40)]
    biases = np.array([settings.imu.gyro_bias for settings in varied]) / DEGREE
    assert 0.02 <= biases.min() < 0.04
    assert 0.15 < biases.max() <= 0.3
    assert len({settings.rig.hand_height for settings in varied}) == 40
    assert {settings.scene.walls for settings in varied} == {False, True}
    assert {settings.motion.swing_until is None for settings in varied} == {False, True}


def test_parts_have_their_own_random_numbers() -> None:
    settings = WalkSettings(scene=LIGHT_FLOOR)
    plain = simulate_walk(settings, 2, 2.5)
    walled = simulate_walk(replace(settings, scene=replace(LIGHT_FLOOR, walls=True)), 2, 2.5)
    better = simulate_walk(replace(settings, imu=ImuSettings(accel_bias=0.0)), 2, 2.5)
    restless = simulate_walk(replace(settings, motion=MotionSettings(restlessness=4.0)), 2, 2.5)
    assert differing(plain, walled) == {"scans"}
    assert differing(plain, better) == {"accel", "linear_accel"}
    assert {"position", "velocity", "scans", "gyro"} <= differing(plain, restless)


@pytest.mark.parametrize(
    ("scenario", "seed", "duration", "message"),
    [
        ("jog", 1, None, r"no walk 'jog'; there are swing, swing_stop"),
        ("swing", -1, None, r"seed -1; it must be 0 or more"),
        ("swing", 1, 0.0, r"a walk of 0\.0 s; the duration must be > 0 s"),
    ],
)
def test_what_cannot_be_walked_is_refused(scenario: str, seed: int, duration: float | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        simulate_walk(scenario, seed, duration)


# --- is it a plausible walk?


@pytest.fixture(scope="module")
def swings() -> list[tuple[Motion, ImuSamples]]:
    """Motion and IMU of the paper's walk for four seeds, without the radar."""
    walks = []
    for seed in range(4):
        settings, person, chip = walk_settings("swing", seed), default_rng(seed), default_rng(100 + seed)
        motion = walk(settings.motion, settings.rig, person)
        walks.append((motion, measure(motion, settings.imu, chip)))
    return walks


def test_double_integration_drifts_by_tens_of_metres(swings: list[tuple[Motion, ImuSamples]]) -> None:
    # the paper's Table I: 132 m in the mean of ten, 246 m at worst
    for _, imu in swings:
        world = attitude.rotate(imu.orientation, imu.linear_accel)
        drift = np.linalg.norm(np.cumsum(np.cumsum(world, axis=0), axis=0)[-1] * 1e-4)
        assert 10.0 < drift < 500.0


def test_the_chips_heading_is_what_costs_a_metre(swings: list[tuple[Motion, ImuSamples]]) -> None:
    # cane.md: true velocity along the chip's yaw ends 1.2 m off in the mean of ten, 2.8 m at worst
    ends = []
    for motion, imu in swings:
        error = attitude.yaw_of(imu.orientation) - attitude.yaw_of(motion.orientation[::10])
        velocity = motion.velocity[::10, 0] + 1j * motion.velocity[::10, 1]
        turned = velocity * (np.exp(1j * (error - error[:50].mean())) - 1.0)
        ends.append(abs(np.sum(turned)) * 0.01)
    assert 0.3 < np.mean(ends) < 2.5
    assert max(ends) < 4.0


def test_the_walk_is_like_one_by_another_simulator(swings: list[tuple[Motion, ImuSamples]]) -> None:
    if not RECORDED.exists():
        pytest.skip("the recordings of walks by another simulator are not here")
    theirs = statistics(*recorded())
    for motion, imu in swings:
        ours = statistics(imu.gyro, imu.linear_accel, motion.velocity[::10], motion.orientation[::10])
        for name, value in ours.items():
            assert theirs[name] / 1.6 < value < theirs[name] * 1.6, name


def statistics(gyro: Floats, linear_accel: Floats, velocity: Floats, orientation: Floats) -> dict[str, float]:
    """What can be compared between two persons on two loops, while they walk."""
    walking = slice(500, len(gyro) - 300)
    down = -attitude.rotate(orientation, (0.0, 1.0, 0.0))[walking, 2]
    return {
        "gyro": float(np.sqrt(np.mean(np.sum(gyro[walking] ** 2, axis=1)))),
        "acceleration": float(np.sqrt(np.mean(np.sum(linear_accel[walking] ** 2, axis=1)))),
        "speed": float(np.mean(np.linalg.norm(velocity[walking, :2], axis=1))),
        "pitch": float(np.mean(np.arcsin(down))),
        "duration": float(len(gyro)),
    }


def recorded() -> tuple[Floats, Floats, Floats, Floats]:
    """Gyro, linear acceleration, true velocity and orientation of a recording (wire.md)."""
    rows: dict[str, list[list[float]]] = {"gyro": [], "linear_accel": [], "velocity": [], "orientation": []}
    with RECORDED.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=["cane/imu/imu", "cane/truth/pose"]):
            sample = msgpack.unpackb(message.data)
            wanted = ("gyro", "linear_accel") if channel.topic.endswith("imu") else ("velocity", "orientation")
            for name in wanted:
                rows[name].append(sample[name])
    gyro, accel, velocity, orientation = (np.array(values) for values in rows.values())
    return gyro, accel, velocity, orientation
