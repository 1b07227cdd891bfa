"""`caneflow eval --methods smoothed`: a recording in hindsight, through the graph, against `best` and by order."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from caneflow.algorithms.cane.cane_filter import CaneFilterSettings
from caneflow.messages import GroundSpeed, Imu, Pose
from caneflow.messages.rig import Rig
from caneflow.recording import Recording
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.program import Context
from caneflow.runtime.replays.evaluation import chosen_methods, offered_methods
from caneflow.runtime.replays.smoothed_method import smoothed_poses, smoother
from tests.flows import caneflow_here
from tools import simulate

ROOT = Path(__file__).parents[1]
FLOW = ROOT / "dataflow.yaml"
RIG = Rig(boresight=(0.0, 1.0, 0.0), pivot=(0.0, -0.3, 0.0))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first third of the paper's walk, seed 1."""
    path = tmp_path_factory.mktemp("walk") / "swing_1.mcap"
    simulate.walk(output=path, scenario="swing", seed=1, duration=12.0)
    return path


def test_hindsight_is_closer_on_the_way_than_best(walk: Path) -> None:
    done = caneflow_here("eval", walk, "--methods", "best,smoothed", "--json", cwd=ROOT)
    assert done.returncode == 0, done.stderr
    by_method = json.loads(done.stdout)
    (best,), (smoothed,) = (list(by_method[name].values()) for name in ("best", "smoothed"))
    assert smoothed["poses"] == best["poses"]
    assert smoothed["ate"] < best["ate"]
    assert smoothed["final_error"] == pytest.approx(best["final_error"], abs=0.02), "at the end nothing is hindsight"
    assert 0.0 < smoothed["nees"] < 9.2  # 99 % of a true covariance's


def test_it_is_there_to_be_asked_for_and_not_one_of_all(tmp_path: Path) -> None:
    graph = load(FLOW)
    assert "smoothed" not in offered_methods(graph)
    assert "smoothed" not in chosen_methods(graph)
    assert chosen_methods(graph, ["smoothed", "best"]) == ("smoothed", "best")
    with pytest.raises(DataflowError, match="smoothed"):
        chosen_methods(graph, ["smooth"])


def test_the_order_in_which_streams_come_does_not_matter(walk: Path) -> None:
    with Recording(walk) as recording:
        decoded = [sample.decoded() for sample in recording.samples(end_ns=recording.span()[0] + 4_000_000_000)]  # type: ignore[index]
    readings = [each for each in decoded if isinstance(each, Imu)]
    speeds = [
        GroundSpeed(stamp=each.stamp, speed=0.4, quality=0.1, rays=16, valid=True, delay=0.3) for each in readings
    ]
    expected = list(smoothed_poses(readings, speeds, CaneFilterSettings(), RIG))
    found: list[Pose] = []
    sink = smoother(CaneFilterSettings(), found)(
        None, Context(node="x", rig=RIG, ports={}, random=np.random.default_rng())
    )
    for each in (*speeds, *readings):
        sink.take("cane/any/port", each, b"", 0)
    sink.finish()
    assert len(found) == len(readings) == 400
    assert [msgspec.structs.replace(each, covariance=None) for each in found] == [
        msgspec.structs.replace(each, covariance=None) for each in expected
    ]
