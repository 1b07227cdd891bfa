"""The bench of real data: its own formulas, a folder of a user's files, and recordings that are not here."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import real
from benchmarks.real_figures import methods, of_folder, orientation_errors, rotated, spread

ROOT = Path(__file__).parents[1]


def test_an_orientations_error_is_split_into_heading_and_inclination() -> None:
    """A turn of 3 degrees about the vertical and then one of 4 about a horizontal axis of the world."""
    truth = Rotation.from_euler("ZYX", [[10, 20, 30], [-50, 5, 170], [0, 0, 0]], degrees=True)
    estimate = Rotation.from_euler("x", 4, degrees=True) * Rotation.from_euler("z", 3, degrees=True) * truth
    one, other = (each.as_quat(scalar_first=True) for each in (estimate, truth))
    total, heading, inclination = orientation_errors(one, other, np.ones(3, dtype=np.bool_))
    cosine = math.cos(math.radians(1.5)) * math.cos(math.radians(2.0))
    assert total == pytest.approx(math.degrees(2 * math.acos(cosine)))
    assert heading == pytest.approx(3.0)
    assert inclination == pytest.approx(4.0)


def test_vectors_are_rotated_into_the_world() -> None:
    turns = Rotation.from_euler("ZYX", [[10, 20, 30], [-50, 5, 170]], degrees=True)
    vectors = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 9.8]])
    assert rotated(turns.as_quat(scalar_first=True), vectors) == pytest.approx(turns.apply(vectors))


def test_the_spread_is_the_deviation_of_normal_errors_whatever_the_few_say() -> None:
    errors = np.random.default_rng(1).standard_normal(10_000)
    errors[:100] = 1e6
    assert spread(errors) == pytest.approx(1.0, abs=0.05)


def test_the_flow_of_an_imu_alone_offers_the_methods_that_need_no_radar() -> None:
    assert {"shs", "naive_ins"} <= set(methods(ROOT / "dataflows" / "imu.yaml"))


def test_a_folder_of_ones_own_is_imported_and_drawn(tmp_path: Path) -> None:
    mine, made = tmp_path / "mine", tmp_path / "made"
    mine.mkdir()
    made.mkdir()
    (mine / "walk.csv").write_text("t,x,y,z\n" + "".join(f"{k / 100},0.1,0,0\n" for k in range(100)))
    (mine / "walk.columns").write_text("time=t,gyro_x=x,gyro_y=y,gyro_z=z\n")
    (mine / "notes.txt").write_text("nothing that a device wrote\n")
    notes, imported, plotted = of_folder(mine, made)
    assert (notes.recording, notes.measured) == ("notes.txt", "import")
    assert notes.here.startswith("status 2: caneflow import")
    assert imported[:4] == ("walk.csv", "not known", "import", "100 samples, 100.00 Hz, 1.0 s; no row left out")
    assert plotted.here == "imu: 100 samples, 100.0 Hz"


def test_without_the_recordings_nothing_is_written(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    command = [sys.executable, "-m", "benchmarks.real", str(tmp_path), "--write", str(page)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"{tmp_path}: none of the recordings is there; expected p440-rail-mocap ...\n"
    assert not page.exists()
    assert [row.here for row in real.rows(tmp_path)] == ["not measured: the recording is not here"] * len(real.MEASURES)
