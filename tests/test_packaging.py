"""The house: every room is installed, and the settings of the tools agree."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_room_is_packaged() -> None:
    packages = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    rooms = {".".join(path.parent.relative_to(ROOT / "src").parts) for path in (ROOT / "src").rglob("__init__.py")}
    programs = {f"caneflow.{room}" for room in ("operators", "drivers", "tools")}
    assert packages == rooms | programs
