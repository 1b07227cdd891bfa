"""Walks with radars that can be bought: power by the vendor's loop gain, the sign of Doppler, what a TI radar sees."""

from pathlib import Path

import numpy as np
import pytest
import typer
from numpy.typing import NDArray

from caneflow.messages import Imu, RadarFrame, RadarPoints
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols import a121 as chip
from caneflow.recording import Recording
from caneflow.simulation import a121, attitude, mmwave
from caneflow.simulation.a121 import A121Settings
from caneflow.simulation.mmwave import MmwaveSettings
from caneflow.simulation.radar_walk import FLOORS, level_ahead, simulate_a121_walk, simulate_mmwave_walk
from caneflow.simulation.scenario import walk_settings
from caneflow.simulation.scene import Scene
from caneflow.simulation.walk import Motion, Rig
from tools.simulate import walk

ALONG_Y = (0.0, 1.0, 0.0)


def moved(speed: float, seconds: float = 0.05) -> Motion:
    """A body that goes along y, its boresight, without turning."""
    time: NDArray[np.float64] = np.arange(round(1e3 * seconds) + 1, dtype=np.float64) * 1e-3
    velocity = np.outer(np.full(len(time), speed), ALONG_Y)
    position = np.outer(speed * time, ALONG_Y)
    level = np.tile((1.0, 0.0, 0.0, 0.0), (len(time), 1))
    none, zeros = np.zeros((len(time), 3)), np.zeros(len(time))
    return Motion(time, position, velocity, none, level, none, none, zeros, zeros)


def one_scatterer(distance: float, section: float) -> Scene:
    return Scene(np.array([[0.0, distance, 0.0]]), np.array([np.sqrt(section) + 0.0j]), None, 0.01)


def test_power_is_the_vendors_loop_gain() -> None:
    """SNR = gain + 10 log10(averages) + 10 log10(S) - 40 log10(d): profile 3, 16 averages, 0.1 m^2 at 0.6005 m."""
    settings = A121Settings(tip_section=0.0)
    distance = (settings.setup.start_point + 5 * settings.setup.step_length) * chip.BASE_STEP
    motion, rig = moved(0.0, 0.5), Rig(hand_height=0.95)
    _, frames = a121.frames(motion, one_scatterer(distance, 0.1), rig, 0.7, settings, np.random.default_rng(1))
    power = np.abs(frames.reshape(-1, settings.setup.points)) ** 2
    expected = 19.0 + 10 * np.log10(16) - 10.0 - 40 * np.log10(distance)
    assert 10 * np.log10(power[:, 5].mean() / settings.noise**2) == pytest.approx(expected, abs=0.2)
    assert power[:, 16].mean() == pytest.approx(settings.noise**2, rel=0.1)  # far away only noise
    half = 10 * np.log10(power[:, 6].mean() / power[:, 5].mean())  # 60 mm off; power FWHM 140 mm
    assert half == pytest.approx(10 * np.log10(0.5) * (0.06005 / 0.07) ** 2, abs=0.2)


def test_what_comes_nearer_turns_forward() -> None:
    settings = A121Settings(noise=1e-6, tip_section=0.0)
    rig = Rig(hand_height=0.95)
    scene = one_scatterer(0.6, 1e16)
    times, frames = a121.frames(moved(0.5), scene, rig, 0.7, settings, np.random.default_rng(1))
    assert np.diff(times) == pytest.approx(0.01)
    sweeps = frames.reshape(-1, settings.setup.points)[:, 5]
    turn = np.angle((sweeps[1:] * sweeps[:-1].conj()).sum())
    assert turn == pytest.approx(4 * np.pi * chip.CARRIER * 0.5 / 2000 / SPEED_OF_LIGHT, rel=0.01)


def test_a_ti_radar_is_level_and_its_points_give_the_velocity() -> None:
    """Without errors each Doppler is the velocity along the way to its point."""
    settings = MmwaveSettings(
        azimuth_error=0.0, elevation_error=0.0, range_error=0.0, most_wild=0.0, fewest_wild=0.0, doppler_step=1e-6
    )
    random = np.random.default_rng(2)
    scene = Scene(random.uniform((-4, 1, -2), (4, 9, 2), (500, 3)), np.ones(500, complex), None, 0.01)
    ahead = level_ahead(0.0)
    assert attitude.rotate(ahead, (1.0, 0.0, 0.0)) == pytest.approx(ALONG_Y)
    found = mmwave.frames(moved(0.8, 0.3), scene, Rig(), ahead, settings, random)
    frame = found[2]
    direction = frame.position / np.linalg.norm(frame.position, axis=1)[:, None]
    velocity, *_ = np.linalg.lstsq(direction, frame.doppler, rcond=None)
    assert velocity == pytest.approx([0.8, 0.0, 0.0], abs=1e-4)
    tilted = attitude.multiply(attitude.from_angles(np.zeros(1), np.array([0.7]), np.zeros(1))[0], level_ahead(0.7))
    assert attitude.rotate(tilted, (1.0, 0.0, 0.0))[2] == pytest.approx(0.0, abs=1e-9)
    assert attitude.rotate(tilted, (0.0, 0.0, 1.0))[2] == pytest.approx(1.0)


def test_walks_are_the_same_again_and_floors_differ_by_their_reflectivity() -> None:
    settings = walk_settings("swing", 3)
    one = simulate_a121_walk(settings, 3, "rough", A121Settings(tip_section=0.0), duration=0.2)
    again = simulate_a121_walk(settings, 3, "rough", A121Settings(tip_section=0.0), duration=0.2)
    dull = simulate_a121_walk(settings, 3, "polished", A121Settings(tip_section=0.0), duration=0.2)
    assert one.sweeps is not None and again.sweeps is not None and dull.sweeps is not None
    assert np.array_equal(one.sweeps[1], again.sweeps[1])
    assert (np.abs(one.sweeps[1]) ** 2).mean() > 2.0 * (np.abs(dull.sweeps[1]) ** 2).mean()
    assert list(FLOORS.values()) == sorted(FLOORS.values(), reverse=True)
    seen = simulate_mmwave_walk(settings, 3, duration=0.3)
    assert seen.rig["radar_orientation"] == pytest.approx(level_ahead(settings.motion.pitch))
    assert all(20 <= len(frame.doppler) <= 40 for frame in seen.points)


def test_the_command_writes_both(tmp_path: Path) -> None:
    walk(tmp_path / "a.mcap", radar="a121", floor="smooth", duration=0.3)
    walk(tmp_path / "m.mcap", radar="mmwave", duration=0.3)
    for name, kind, port in (("a", RadarFrame, "frame"), ("m", RadarPoints, "points")):
        with Recording(tmp_path / f"{name}.mcap") as recording:
            assert recording.rig["hand_height"] == 0.95
            assert [found.port for found in recording.streams_of(kind)] == [port]
            assert [found.node for found in recording.streams_of(Imu)] == ["imu"]
            stamps = [sample.stamp for sample in recording.samples()]
            assert stamps == sorted(stamps)
    for wrong in ({"floor": "rough"}, {"radar": "a121", "holes": 3.0}, {"radar": "mmwave", "scene": "corridor"}):
        with pytest.raises(typer.BadParameter, match="goes with --radar"):
            walk(tmp_path / "x.mcap", **wrong)
