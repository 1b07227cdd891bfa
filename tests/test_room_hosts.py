"""The room's graphs in both hosts: the same recording gives the same bytes, particles and all."""

from pathlib import Path

import pytest

from caneflow.recording import Recording
from caneflow.simulation.room_scenario import Reflections, RoomSettings, simulate_room
from tests.flows import caneflow, caneflow_here
from tools.simulate import room_samples, written

ROOT = Path(__file__).parents[1]
POSES = ("room_tracker", "pose")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One walk along the axis of the western module, some ten seconds."""
    settings = RoomSettings(axial_traverses=1, reflections=Reflections(floor=0.0, walls=0.0))
    path = tmp_path_factory.mktemp("room") / "walk.mcap"
    recorded = simulate_room(settings, "axial_x", 3)
    written(path, "room", recorded.rig, room_samples(recorded))
    return path


def poses(walk: Path, out: Path, method: str, *options: str) -> list[bytes]:
    run = caneflow_here if "--in-process" in options else caneflow
    part, chosen = ("--replay", walk, "--duration", 6), ("--set", f"room_tracker.method={method}")
    done = run("run", ROOT / "dataflows" / "room.yaml", *part, "--record", out, *chosen, *options)
    assert done.returncode == 0, done.stderr
    with Recording(out) as got:
        return [sample.payload for sample in got.samples([POSES])]


@pytest.mark.parametrize("method", ["particle", pytest.param("best", marks=pytest.mark.long)])
def test_processes_give_the_same_bytes_as_one_process(walk: Path, tmp_path: Path, method: str) -> None:
    alone = poses(walk, tmp_path / "alone.mcap", method, "--in-process")
    assert len(alone) > 100
    assert poses(walk, tmp_path / "processes.mcap", method, "--speed", "max") == alone
