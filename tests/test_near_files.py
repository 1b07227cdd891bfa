"""A file that is not there: the name that was meant, or nothing."""

from pathlib import Path

import pytest

from caneflow.near_files import near_file
from caneflow.recording import Recording, RecordingError
from caneflow.runtime.dataflow.yaml_file import read_yaml
from caneflow.runtime.errors import DataflowError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("walk_7.mcap", "walk_7.yaml", "cane.yaml"):
        (tmp_path / name).write_text("")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("walk7.mcap", "walk_7.mcap"),
        ("walk_7.yml", None),
        ("cnae.yaml", "cane.yaml"),
        ("room.mcap", None),
        ("cane.yaml", None),
        ("none/cane.yaml", None),
    ],
)
def test_the_nearest_name_of_the_same_ending_is_what_was_meant(folder: Path, name: str, meant: str | None) -> None:
    assert near_file(folder / name) == (f"; did you mean {folder / meant}?" if meant else "")


def test_recordings_and_dataflows_that_are_not_there_name_it(folder: Path) -> None:
    with pytest.raises(RecordingError, match=r"walk.mcap: .*No such file.*; did you mean .*walk_7.mcap\?"):
        Recording(folder / "walk.mcap")
    with pytest.raises(DataflowError, match=r"cane2.yaml: cannot be read: No such file.*; did you mean .*cane.yaml\?"):
        read_yaml(folder / "cane2.yaml")
