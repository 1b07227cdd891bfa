"""The paper's speed on recorded walks, against their truth."""

import json
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from caneflow.algorithms.inertial.attitude_history import AttitudeHistory
from caneflow.algorithms.radar.footprint import CaneGeometry
from caneflow.algorithms.radar.moving_returns import MovingReturnsFilter, MovingReturnsSettings, RadarParameters
from caneflow.algorithms.radar.paper_speed import PaperSpeed, PaperSpeedSettings, SpeedEstimate
from caneflow.algorithms.radar.range_doppler import hann

DATA = Path(__file__).parents[1].parent / "shared" / "data"


def array_of(code: int, data: bytes) -> object:
    assert code == 1
    kind = {"i": "<i4"}[chr(data[0])]
    return np.frombuffer(data, kind, offset=2 + 4 * data[1]).reshape(1, -1)


def walk(name: str) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Streams by port, and the rig, read independently of the project's own reader."""
    path = DATA / "walks" / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"the recorded walk {name} is not here")
    streams: dict[str, list[Any]] = {"imu": [], "frame": [], "pose": []}
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages():
            streams[channel.topic.split("/")[-1]].append(msgpack.unpackb(message.data, ext_hook=array_of))
        rigs = [json.loads(m.metadata["json"]) for m in reader.iter_metadata() if m.name == "rig"]
    return streams, rigs[0]


def walked(streams: dict[str, list[Any]], rig: dict[str, Any]) -> list[SpeedEstimate]:
    returns = MovingReturnsFilter(MovingReturnsSettings())
    attitudes = AttitudeHistory()
    names = ("hand_height", "aperture", "pivot", "boresight", "antenna")
    paper = PaperSpeed(PaperSpeedSettings(), CaneGeometry(**{name: rig[name] for name in names}))
    out = []
    for imu, frame in zip(streams["imu"], streams["frame"], strict=True):
        attitudes.add(imu["stamp"], tuple(imu["orientation"]), tuple(imu["gyro"]))
        made = ("scan_period", "range_start", "range_step", "carrier", "bandwidth")
        parameters = RadarParameters(**{name: frame[name] for name in made})
        out.append(paper.update(returns.update(frame["stamp"], frame["scans"], parameters), attitudes))
    return out


def boresight(poses: list[Any], rig: dict[str, Any]) -> np.ndarray:
    """Horizontal unit vectors of the boresight, shape (n, 2)."""
    wxyz = np.array([p["orientation"] for p in poses])
    axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).apply(rig["boresight"])[:, :2]
    return np.asarray(axes / np.linalg.norm(axes, axis=1)[:, None])


@pytest.mark.parametrize(("name", "final"), [("swing_1", 1.0), pytest.param("hard_4", 1.5, marks=pytest.mark.long)])
def test_recorded_walks(name: str, final: float) -> None:
    """Against the truth's velocity along the boresight, weighed over the window as the spectrum weighs it."""
    streams, rig = walk(name)
    out = walked(streams, rig)
    velocity = np.array([p["velocity"] for p in streams["pose"]])
    along = (velocity[:, :2] * boresight(streams["pose"], rig)).sum(axis=1)
    weights = hann(64) / hann(64).sum()
    truth = np.convolve(along, weights)[: len(along)]
    speeds, valid, sure = (np.array([getattr(e, n) for e in out]) for n in ("speed", "valid", "quality"))
    walking = (truth > 0.1) & valid & (sure > 0)
    error = (speeds - truth)[walking]
    assert valid[63:].mean() > 0.98
    assert abs(error.mean()) < 0.02
    assert error.std() < 0.07

    fastest = np.array([np.linalg.norm(velocity[max(k - 63, 0) : k + 1], axis=1).max() for k in range(len(out))])
    resting = valid & (sure == 0)
    assert resting[(fastest < 0.02) & (np.arange(len(out)) >= 63)].all(), "rest is found"
    assert truth[resting].max() < 0.15, "walking is not taken for rest"

    # The speed along the chip's yaw, half a window earlier, simply summed up; a closed walk.
    yaw = boresight(streams["imu"], rig)
    lag = 0.5 * (yaw[32:] + yaw[31:-1])
    steps = speeds[63:, None] * lag[: len(speeds) - 63] * 0.01
    truly = np.array([p["position"] for p in streams["pose"]])
    miss = np.linalg.norm(steps.sum(axis=0) - (truly[-32] - truly[31])[:2])
    assert miss < final
