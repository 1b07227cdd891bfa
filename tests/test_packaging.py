"""The house: every room is installed, and the settings of the tools agree."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
UNIT = ROOT / "deploy" / "caneflow@.service"


def test_every_room_is_packaged() -> None:
    packages = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    rooms = {".".join(path.parent.relative_to(ROOT / "src").parts) for path in (ROOT / "src").rglob("__init__.py")}
    programs = {f"caneflow.{room}" for room in ("operators", "drivers", "tools", "flows")}
    assert packages == rooms | programs


def test_the_unit_of_a_service_leaves_a_flow_what_it_needs_and_no_more() -> None:
    lines = [line.split("=", 1) for line in UNIT.read_text().splitlines() if "=" in line and not line.startswith("#")]
    unit: dict[str, list[str]] = {}
    for key, value in lines:
        unit.setdefault(key, []).append(value)

    closed = ["NoNewPrivileges", "PrivateTmp", "ProtectHome", "LockPersonality", "MemoryDenyWriteExecute"]
    closed += [f"Protect{what}" for what in ("Clock", "Hostname", "KernelTunables", "KernelModules", "KernelLogs")]
    closed += [f"Restrict{what}" for what in ("SUIDSGID", "Realtime", "Namespaces")]
    assert {key: unit.get(key) for key in closed} == {key: ["yes"] for key in closed}
    assert unit["CapabilityBoundingSet"] == [""]
    assert unit["SystemCallFilter"] == ["@system-service", "~@privileged"]
    assert unit["UMask"] == ["0077"]
    assert unit["ProtectProc"] == ["invisible"]
    assert unit["MemoryMax"] == ["75%"]
    assert unit["OOMPolicy"] == [
        "continue"
    ]  # systemd would end the whole flow where its launcher starts one node again
    assert set(unit["RestrictAddressFamilies"][0].split()) == {"AF_INET", "AF_INET6", "AF_UNIX"}
    # Devices need their groups, the launcher its nodes' figures under /proc, two units one user's shared memory.
    assert not {"PrivateUsers", "PrivateDevices", "ProcSubset", "RemoveIPC"} & set(unit)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed here")
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    copy = tmp_path / "caneflow@gateway.service"
    copy.write_text(UNIT.read_text().replace("/opt/caneflow/bin/caneflow", "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_each_promise_of_the_readme_names_tests_that_there_are() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    promises = readme.partition("## What it promises")[2].partition("\n## ")[0]
    rows = [line for line in promises.splitlines() if line.startswith("| **")]
    there = {
        name
        for path in (ROOT / "tests").glob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert len(rows) > 5
    for row in rows:
        named = re.findall(r"`(test_\w+)`", row)
        assert named, row
        assert set(named) <= there, row


def test_the_locked_versions_are_whole_and_fit() -> None:
    """Each package that pyproject.toml names is in constraints.txt, in a version that it allows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    locked = {name.replace("_", "-"): version for name, _, version in (line.partition("==") for line in lines)}
    extras = project["optional-dependencies"]
    own, *tools = map(Requirement, extras["dev"])
    named = [*project["dependencies"], *(each for extra in own.extras for each in extras[extra])]
    for each in [*map(Requirement, named), *tools]:
        assert each.specifier.contains(locked[each.name.lower().replace("_", "-")]), each


def test_the_version_is_the_newest_of_the_changelog() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    changes = re.findall(r"^## (\S+) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert changes[0] == version
