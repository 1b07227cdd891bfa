"""Files of Acconeer's tools: the sign, the ranges, the time of a frame; and real water flows away."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.errors import CaneflowError
from caneflow.messages import RadarFrame, decode
from caneflow.protocols import a121 as radar
from caneflow.recording import Recording
from tools.import_a121 import a121

FLOW = Path(__file__).parents[1].parent / "shared" / "data" / "a121-flow"


def frames_of(path: Path) -> list[RadarFrame]:
    with Recording(path) as recording:
        return [decode(sample.payload, RadarFrame) for sample in recording.samples()]


def written(
    path: Path, frames: np.ndarray, ticks: Sequence[int], parts: Sequence[dict[str, Any]], **flags: Any
) -> Path:
    """A file as the vendor's tools write it, frames complex."""
    h5py = pytest.importorskip("h5py", reason="h5py (the extra a121) is not installed")
    samples = np.empty(frames.shape, [("real", "<i2"), ("imag", "<i2")])
    samples["real"], samples["imag"] = frames.real.round(), frames.imag.round()
    config = {"sweep_rate": 2000.0, "frame_rate": None, "continuous_sweep_mode": True, "subsweeps": list(parts)}
    with h5py.File(path, "w") as file:
        file["server_info"] = json.dumps({"ticks_per_second": 1000})
        session = file.create_group("sessions/session_0")
        session["session_config"] = json.dumps({"groups": [{"1": config}]})
        entry = session.create_group("group_0/entry_0")
        entry["metadata"] = json.dumps({"base_step_length_m": 0.0025, "max_sweep_rate": 4000.0})
        result = entry.create_group("result")
        result["frame"], result["tick"] = samples, np.array(ticks, np.uint32)
        for name, values in flags.items():
            result[name] = np.array(values)
    return path


def part(start: int, points: int, step: int, profile: int = 3) -> dict[str, Any]:
    return {"start_point": start, "num_points": points, "step_length": step, "profile": f"PROFILE_{profile}"}


def test_sign_ranges_and_time(tmp_path: Path) -> None:
    """A raw phase that turns forward recedes; the device's clock wraps, and a frame is missing."""
    turning = 500.0 * np.exp(0.3j * np.arange(60)).reshape(3, 20, 1) * np.ones(5)
    ticks = [2**32 - 10, 0, 20]  # ms: 10 apart, then 20: one is missing
    file = written(tmp_path / "x.h5", turning, ticks, [part(280, 2, 24, 1), part(400, 3, 12)])
    a121(file, tmp_path / "x.mcap", subsweep=1, range_offset=0.02)
    found = frames_of(tmp_path / "x.mcap")
    assert [each.stamp for each in found] == pytest.approx([9_500_000, 19_500_000, 39_500_000], abs=2)
    first = found[0]
    assert first.scans.shape == (20, 3)
    assert (first.range_start, first.range_step) == pytest.approx((0.98, 0.03))
    assert (first.scan_period, first.carrier) == (1 / 2000.0, 60.5e9)
    assert first.bandwidth == pytest.approx(0.44 * 299_792_458.0 / 0.28)
    assert np.angle(first.scans[1, 0] * first.scans[0, 0].conj()) == pytest.approx(-0.3, abs=0.01)


def test_saturated_frames_are_left_out(tmp_path: Path) -> None:
    frames = np.ones((3, 20, 1), complex)
    file = written(tmp_path / "x.h5", frames, [0, 10, 20], [part(280, 1, 24)], data_saturated=[False, True, False])
    a121(file, tmp_path / "x.mcap")
    assert len(frames_of(tmp_path / "x.mcap")) == 2


def test_what_is_no_such_file_is_said_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="h5py (the extra a121) is not installed")
    (tmp_path / "x.h5").write_text("nothing")
    for path, reason in ((tmp_path / "x.h5", "not an HDF5 file"), (tmp_path / "y.h5", "no such file")):
        with pytest.raises(CaneflowError, match=reason):
            a121(path, tmp_path / "x.mcap")
    file = written(tmp_path / "z.h5", np.ones((2, 20, 1), complex), [0, 10], [part(280, 1, 24)])
    with pytest.raises(CaneflowError, match="no session 3; it has 1"):
        a121(file, tmp_path / "x.mcap", session=3)
    with pytest.raises(CaneflowError, match="no subsweep 1; it has 1"):
        a121(file, tmp_path / "x.mcap", subsweep=1)
    assert not (tmp_path / "x.mcap").exists()


def test_disturbed_samples_are_replaced_and_counted() -> None:
    clean = (300.0 * np.exp(0.1j * np.arange(64))[:, None] * np.ones(3)).astype(np.complex64)
    wild = clean.copy()
    wild[20, 1] += 2000.0
    mended, count = radar.repaired(wild)
    assert count == 1
    assert np.abs(mended - clean).max() < 4.0
    assert radar.repaired(clean)[1] == 0
    assert radar.repaired(wild[:24])[1] == 0  # too few sweeps to know what is usual


@pytest.mark.parametrize(("profile", "points", "averages", "rate"), [(3, 20, 16, 2570.0), (3, 30, 8, 3127.0)])
def test_the_time_of_a_sweep_is_the_vendors(profile: int, points: int, averages: int, rate: float) -> None:
    setup = radar.SweepSetup(start_point=280, points=points, step_length=24, profile=profile, averages=averages)
    assert 1.0 / setup.sweep_time == pytest.approx(rate, rel=0.013)


@pytest.mark.parametrize("name", ["surface_velocity_1_dist", "surface_velocity_4_dist"])
def test_real_water_flows_away(name: str, tmp_path: Path) -> None:
    """Seen at 45 deg, 1.5 to 1.6 m/s radial by an independent script; away from the sensor."""
    if not FLOW.exists():
        pytest.skip("../shared/data/a121-flow is not here")
    pytest.importorskip("h5py", reason="h5py (the extra a121) is not installed")
    a121(FLOW / f"{name}.h5", tmp_path / "x.mcap")
    speeds = []
    for frame in frames_of(tmp_path / "x.mcap"):
        moving = frame.scans - frame.scans.mean(axis=0)
        phase = float(np.angle((moving[1:] * moving[:-1].conj()).sum()))
        speeds.append(phase * 299_792_458.0 / (4.0 * np.pi * frame.carrier * frame.scan_period))
    assert -1.7 < np.mean(speeds) < -1.4
