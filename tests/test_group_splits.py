"""However a cane's nodes and its recorder share processes, the bytes are the same: in every split, and with kills."""

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from tests.flows import launchers, node_processes, results, write_walk
from tests.test_groups import grouped

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

SAMPLES = 300  # of each sensor


def splits(names: Sequence[str]) -> Iterator[list[list[str]]]:
    """All ways to put `names` into groups: 52 of five."""
    if not names:
        yield []
        return
    first, rest = names[0], names[1:]
    for groups in splits(rest):
        yield [[first], *groups]
        for at, group in enumerate(groups):
            yield [*groups[:at], [first, *group], *groups[at + 1 :]]


def processes(groups: Sequence[Sequence[str]]) -> Mapping[str, str]:
    """By node the process that it shares, as the file has it."""
    return {
        node: "recorder" if "recorder" in group else f"shared_{number}"
        for number, group in enumerate(groups)
        for node in group
        if len(group) > 1 and node != "recorder"
    }


ALL = list(splits(["imu", "radar", "ground_speed", "fusion", "recorder"]))


def called(groups: Sequence[Sequence[str]]) -> str:
    return " ".join("+".join(group) for group in groups if len(group) > 1) or "one each"


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap", SAMPLES)


@pytest.fixture(scope="module")
def expected(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, list[bytes]]:
    folder = tmp_path_factory.mktemp("expected")
    flow, out = grouped(folder / "flow.yaml", {}), folder / "out.mcap"
    with launchers() as launch:
        launched = launch("run", flow, "--replay", walk, "--in-process", "--record", out, log=folder / "log")
        assert launched.ends() == 0, launched.said
    found = results(out)
    assert len(found["fusion/pose"]) == SAMPLES
    return found


@pytest.mark.parametrize("groups", ALL, ids=called)
def test_every_split_computes_the_same_bytes(
    groups: Sequence[Sequence[str]], walk: Path, expected: Mapping[str, list[bytes]], tmp_path: Path
) -> None:
    flow, out = grouped(tmp_path / "flow.yaml", processes(groups)), tmp_path / "out.mcap"
    with launchers() as launch:
        launched = launch("run", flow, "--replay", walk, "--speed=max", "--record", out, log=tmp_path / "log")
        assert launched.ends() == 0, launched.said
    assert results(out) == expected


A_FEW = [groups for groups in ALL if ["recorder"] in groups and len(groups) in (2, 3)][::4]


@pytest.mark.parametrize("groups", A_FEW, ids=called)
def test_a_split_under_load_whose_processes_are_killed_computes_the_same_bytes(
    groups: Sequence[Sequence[str]], walk: Path, expected: Mapping[str, list[bytes]], tmp_path: Path
) -> None:
    flow, out = grouped(tmp_path / "flow.yaml", processes(groups)), tmp_path / "out.mcap"
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
    try:
        with launchers() as launch:
            launched = launch("run", flow, "--replay", walk, "--record", out, log=tmp_path / "log")
            launched.wait_for("ready: 5 nodes")
            for name, process in node_processes(launched.process.pid).items():
                if name != "recorder":
                    process.kill()
            assert launched.ends() == 0, launched.said
            assert "killed by SIGKILL" in launched.said
    finally:
        for each in busy:
            each.kill()
            each.wait()
    assert results(out) == expected
