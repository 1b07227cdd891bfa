"""What recordings of real devices have and simulated walks are given: how much of it, and that it is nothing else."""

from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng
from typer import BadParameter

from caneflow.messages import Imu, RadarFrame
from caneflow.recording import Recording
from caneflow.simulation.attitude import DEGREE
from caneflow.simulation.field_faults import SCANS_PER_GAP, FieldFaults, glitched, received, stated_rig
from caneflow.simulation.imu import FIELD_TURNS, ImuSettings, measure
from caneflow.simulation.radar import RadarSettings, scans
from caneflow.simulation.scenario import WalkSettings, simulate_walk, walk_settings
from caneflow.simulation.scene import SceneSettings, scene
from caneflow.simulation.walk import Motion, MotionSettings, Rig, course_of, walk
from tools import simulate

COUNT = 200_000
STAMPS = 10_000_000 * np.arange(COUNT, dtype=np.int64)
LIGHT = SceneSettings(floor_density=1.0)


def lengths(kept: np.ndarray) -> list[int]:
    return [len(list(run)) for value, run in groupby(kept.tolist()) if not value]


@pytest.mark.parametrize("share", [0.02, 0.09, 0.4])
def test_scans_are_lost_in_gaps_of_one_to_three_up_to_the_share(share: float) -> None:
    got = received(STAMPS, FieldFaults(scan_loss=share), default_rng(1))
    assert np.mean(~got.scan_kept) == pytest.approx(share, rel=0.05)
    if share < 0.1:  # so few that they seldom meet
        assert np.isin(lengths(got.scan_kept), SCANS_PER_GAP).mean() > 0.8
    assert got.imu_kept.all()


def test_holes_of_the_imu_are_as_many_and_as_long_as_asked_for() -> None:
    got = received(STAMPS, FieldFaults(holes=6.0), default_rng(2))
    found = np.array(lengths(got.imu_kept)) / 100.0
    assert len(found) == pytest.approx(6.0 * COUNT / 6000.0, rel=0.15)
    assert found.min() >= 0.04
    # a number between low and high, evenly over orders of magnitude, is (high - low) / ln(high / low) on average
    assert found.mean() == pytest.approx(0.6 / np.log(13.0), rel=0.1)
    assert got.scan_kept.all()


def test_pairs_that_came_together_are_late_and_stamps_increase() -> None:
    got = received(STAMPS, FieldFaults(equal_stamps=0.1, holes=20.0), default_rng(3))
    late = got.imu_stamps_ns - STAMPS
    assert set(late.tolist()) == {0, 10_000_000, 5_000_000}
    assert all(b > a for a, b in pairwise(got.imu_stamps_ns[got.imu_kept].tolist()))
    # a second of a pair begins none, and the holes have their part
    kept = np.mean(got.imu_kept)
    assert np.mean(late == 5_000_000) == pytest.approx(0.1 * (1.0 - 0.1) * kept, rel=0.03)


def test_less_time_is_the_beginning_of_more() -> None:
    faults = FieldFaults(holes=20.0, scan_loss=0.1, equal_stamps=0.1)
    short, long = (received(STAMPS[:n], faults, default_rng(4)) for n in (5000, 9000))
    np.testing.assert_array_equal(short.scan_kept, long.scan_kept[:5000])
    np.testing.assert_array_equal(short.imu_kept, long.imu_kept[:5000])
    np.testing.assert_array_equal(short.imu_stamps_ns[:-1], long.imu_stamps_ns[:4999])


def still(seconds: float) -> Motion:
    settings = MotionSettings(rest_before=seconds)
    return Motion(*(values[: round(1000 * seconds)] for values in walk(settings, Rig(), default_rng(5), seconds)))


def test_a_glitch_is_one_reading_of_sixteen_bits() -> None:
    imu = measure(still(60.0), ImuSettings(), default_rng(6))
    wrong = glitched(imu, FieldFaults(glitches=2.0), default_rng(7))
    changed = [getattr(imu, name) != getattr(wrong, name) for name in ("gyro", "accel", "mag", "linear_accel")]
    per_sample = np.sum([each.sum(axis=1) for each in changed], axis=0)
    assert per_sample.max() == 1
    assert per_sample.sum() == pytest.approx(120, abs=30)
    assert np.abs(wrong.accel).max() <= 327.68
    assert np.abs(wrong.accel).max() > 100.0
    np.testing.assert_array_equal(wrong.orientation, imu.orientation)


def test_the_field_turns_once_or_wanders_and_takes_the_chips_heading_along() -> None:
    motion = still(60.0)
    quiet = ImuSettings(field_error=0.0, mag_noise=0.0)
    plain = measure(motion, quiet, default_rng(8))
    turned = measure(motion, replace(quiet, field_turn=30.0 * DEGREE), default_rng(8))
    assert np.linalg.norm(plain.mag - turned.mag, axis=1)[: round(100 * FIELD_TURNS[0])].max() == 0.0
    chord = np.linalg.norm(plain.mag - turned.mag, axis=1)[-1]
    assert chord == pytest.approx(2.0 * 22.5 * np.sin(15.0 * DEGREE), abs=0.2)  # of the horizontal part
    wandering = measure(motion, replace(quiet, field_wander=15.0 * DEGREE), default_rng(8))
    assert np.linalg.norm(wandering.mag - plain.mag, axis=1).max() > 1.0


def test_the_stated_rig_is_off_by_what_was_asked_for() -> None:
    rig = Rig(antenna=(0.01, 0.02, 0.0))
    assert stated_rig(rig, FieldFaults(), default_rng(9)) == rig.as_map()
    off = stated_rig(rig, FieldFaults(rig_shift=0.05, rig_turn=5.0 * DEGREE), default_rng(9))
    assert abs(off["hand_height"] - rig.hand_height) == pytest.approx(0.05)
    for name in ("pivot", "antenna"):
        assert np.linalg.norm(np.subtract(off[name], getattr(rig, name))) == pytest.approx(0.05)
    boresight = np.array(off["boresight"])
    assert np.linalg.norm(boresight) == pytest.approx(1.0)
    assert np.degrees(np.arccos(boresight[1])) == pytest.approx(5.0)


def noise_density(rise: float) -> tuple[float, float]:
    """Power of scans without echoes, and its density within the band over that without (dB)."""
    settings = RadarSettings(noise_rise=rise, coupling=-200.0, tip_section=0.0, snr=-200.0)
    motion = Motion(*(values[::10] for values in still(4.0)))
    nothing = scene(LIGHT, course_of(MotionSettings()), default_rng(10))
    noise = scans(motion, nothing, Rig(), 0.7, settings, default_rng(11)).astype(float)
    frequency = np.fft.rfftfreq(settings.bins, 61.035e-12)
    density = np.mean(np.abs(np.fft.rfft(noise)) ** 2, axis=0)
    within = np.abs(frequency - settings.carrier) < 0.45 * settings.bandwidth
    beyond = np.abs(frequency - settings.carrier) > 0.55 * settings.bandwidth
    return noise.std(), 10.0 * np.log10(density[within].mean() / density[beyond].mean())


def test_noise_rises_within_the_band_and_is_as_strong_as_before() -> None:
    (plain, flat), (coloured, risen) = noise_density(0.0), noise_density(10.0)
    assert plain == pytest.approx(200.0, rel=0.01)
    assert coloured == pytest.approx(200.0, rel=0.01)
    assert flat == pytest.approx(0.0, abs=0.2)
    assert risen == pytest.approx(10.0, abs=0.3)


def test_a_carrier_that_is_off_is_stated_as_if_it_were_not() -> None:
    settings = WalkSettings(scene=LIGHT, faults=FieldFaults(carrier_off=0.05))
    off = simulate_walk(settings, 3, 0.3)
    true = simulate_walk(replace(settings, faults=FieldFaults(), radar=RadarSettings(carrier=4.3e9 / 1.05)), 3, 0.3)
    assert (off.carrier, true.carrier) == (4.3e9, 4.3e9 / 1.05)
    np.testing.assert_array_equal(off.scans, true.scans)


def test_the_scenario_has_all_of_it() -> None:
    for seed in range(1, 5):
        settings = walk_settings("field", seed)
        assert min(settings.faults.glitches, settings.faults.holes, settings.faults.scan_loss) > 0.0
        assert min(settings.faults.equal_stamps, settings.faults.rig_shift, settings.faults.rig_turn) > 0.0
        assert abs(settings.faults.carrier_off) == 0.02
        assert settings.radar.noise_rise > 0.0
        assert (settings.imu.field_turn > 0.0) != (settings.imu.field_wander > 0.0)


def test_options_go_with_any_scenario_and_with_no_scene(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    faults = {"scan_loss": 0.3, "holes": 60, "equal_stamps": 0.2, "rig_turn": 10.0, "carrier_off": 0.1}
    simulate.walk(output=path, scenario="slow", duration=4.0, **faults)  # type: ignore[arg-type]
    with Recording(path) as recording:
        samples = [sample.decoded() for sample in recording.samples()]
        boresight = np.array(recording.rig["boresight"])
    imu, frames = ([each for each in samples if isinstance(each, kind)] for kind in (Imu, RadarFrame))
    assert len(imu) < 401
    assert len(frames) < 370
    assert [each.stamp for each in samples] == sorted(each.stamp for each in samples)
    assert any(later.stamp - earlier.stamp == 5_000_000 for earlier, later in pairwise(imu))
    assert np.degrees(np.arccos(boresight[1])) == pytest.approx(10.0)
    with pytest.raises(BadParameter, match="a scene has none of it"):
        simulate.walk(output=path, scene="approach", thing="pole", holes=1.0, overwrite=True)
