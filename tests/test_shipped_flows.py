"""The flows that come with caneflow: written out, found by themselves, the same as the checkout's."""

import subprocess
from pathlib import Path

import pytest

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, Imu, RadarFrame, Sample
from caneflow.recording import RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.shipped import flow_for, shipped, shipped_text
from tests.flows import CANEFLOW, write_walk

ROOT = Path(__file__).parents[1]


def without_schema(text: str) -> str:
    return "".join(line for line in text.splitlines(keepends=True) if "$schema" not in line)


def test_the_shipped_cane_is_the_flow_of_the_checkout() -> None:
    assert shipped_text("cane") == without_schema((ROOT / "dataflow.yaml").read_text())


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "dataflows").glob("*.yaml")))
def test_every_shipped_flow_is_right_away_from_the_checkout(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"{name}.yaml").write_text(shipped_text(name))
    assert load(Path(f"{name}.yaml")).nodes
    assert name in shipped()


def test_a_name_that_is_no_flow_lists_those_that_there_are() -> None:
    with pytest.raises(CaneflowError, match="no flow 'canes'; did you mean 'cane'"):
        shipped_text("canes")


def recording(path: Path, flow: str, streams: dict[str, type[Sample]]) -> Path:
    with RecordingWriter(path, flow=flow, source="live", rig={}) as writer:
        for key, kind in streams.items():
            writer.write(f"{flow}/{key}", kind, b"\x80", stamp=1, seq=0, log_time=1)
    return path


def test_the_flow_of_a_recording_is_that_whose_drivers_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sensors: dict[str, type[Sample]] = {"imu/imu": Imu, "radar/frame": RadarFrame}
    cane = recording(tmp_path / "1.mcap", "mine", sensors)
    room: dict[str, type[Sample]] = {"imu/imu": Imu, "south/block": DopplerBlock, "west/block": DopplerBlock}
    assert flow_for([cane]).stem == "cane"
    assert flow_for([recording(tmp_path / "2.mcap", "mine", room)]).stem == "room"
    four: dict[str, type[Sample]] = {**room, "north/block": DopplerBlock, "east/block": DopplerBlock}
    assert flow_for([recording(tmp_path / "3.mcap", "mine", four)]).stem == "room4"
    with pytest.raises(CaneflowError, match="caneflow new flow cane"):
        flow_for([recording(tmp_path / "4.mcap", "mine", {"gps/fix": Imu})])
    (tmp_path / "dataflow.yaml").write_text(shipped_text("room"))
    assert flow_for([cane]) == Path("dataflow.yaml")  # the folder's comes first,
    assert flow_for([cane], Path("other.yaml")) == Path("other.yaml")  # and what is said before all


def test_each_line_works_as_the_one_before_says_it(tmp_path: Path) -> None:
    def said(*command: str) -> list[str]:
        done = subprocess.run(
            [*CANEFLOW, *command], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    _, simulate, run = said("new", "flow", "cane")
    assert simulate == "caneflow simulate walk -o walk.mcap"
    write_walk(tmp_path / "walk.mcap", 100)  # in its place: shorter
    said(*run.split()[1:])
    said("verify", "track.mcap")
    said("bench", "walk.mcap", "--repeat", "1")
