"""A shell completes names: of flows, nodes and streams that run, of what a file and a program's source say."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from caneflow import completion
from caneflow.completion import candidates
from caneflow.messages import Imu, numbered, sample_key
from caneflow.recording import RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.hosts.launcher.run_directory import RunDirectory
from caneflow.runtime.replays.evaluation import offered_methods
from caneflow.runtime.replays.smoothed_method import SMOOTHED
from caneflow.simulation.scenario import SCENARIOS
from caneflow.words import _tool

ROOT = Path(__file__).parents[1]
HERE = "tcp/127.0.0.1:20000"
OWN = '''
"""Yours."""
import nothing_of_the_kind
Mode: TypeAlias = Literal["slow", "fast"]
class MineSettings:
    mode: Mode = "slow"
    loud: bool = False
    gain: float = 1.0
'''
FLOW = """
flow: mine
machines: {gateway: {listen: [tcp/127.0.0.1:7447]}, phone: {connect: [tcp/127.0.0.1:7447]}}
nodes:
  imu: {run: drivers.bno055, machine: gateway}
  fusion: {run: operators.fusion, machine: phone, inputs: {imu: imu/imu}}
  mine: {run: ./mine.py, machine: phone, inputs: {imu: imu/imu}}
"""


@pytest.fixture(scope="module")
def running() -> Iterator[str]:
    """The name of a flow that runs, as far as a shell can know."""
    name = f"flow{os.getpid()}x"  # other tests run theirs at the same time
    with RunDirectory(name) as run, run.announced(HERE, {"imu": ("imu",), "radar": ("frame", "truth")}):
        yield name


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "mine.yaml").write_text(FLOW)
    return tmp_path / "mine.yaml"


def test_flows_nodes_and_streams_that_run(running: str) -> None:
    for word in ("status", "top", "view", "stop", "doctor", "echo", "hz", "restart"):
        assert candidates([word], running[:-1]) == [running]
    assert candidates(["status", "--json"], running[:-1]) == [running]
    assert candidates(["status", running], "") == []
    assert candidates(["restart", running], "") == ["imu", "radar"]
    assert candidates(["logs", running, "--node"], "") == ["caneflow", "imu", "radar"]
    assert candidates(["echo", running, "--json"], "radar/") == ["radar/frame", "radar/truth"]


def test_what_a_file_says(file: Path) -> None:
    assert candidates(["run", str(file), "--without"], "m") == ["mine"]
    assert candidates(["doctor", str(file), "--machine"], "") == ["gateway", "phone"]
    settings = candidates(["run", str(file), "--set"], "mine.")
    assert settings == ["mine.mode=slow", "mine.mode=fast", "mine.loud=true", "mine.loud=false", "mine.gain="]
    assert candidates(["run", str(file), "--set"], "fusion.method=k") == ["fusion.method=kalman"]
    assert candidates(["run", "nowhere.yaml", "--set"], "fusion.") == []


@pytest.mark.parametrize("words", [["mine.mode", "=", "f"], ["mine.mode", "=", ""], ["mine.mode", "="]])
def test_bash_splits_at_equals(file: Path, words: list[str]) -> None:
    *before, incomplete = words
    found = candidates(["run", str(file), "--set", *before], incomplete)
    assert found == (["fast"] if incomplete == "f" else ["slow", "fast"])


def test_methods_and_scenarios_are_those_that_there_are(tmp_path: Path) -> None:
    methods = {*offered_methods(load(ROOT / "dataflow.yaml")), SMOOTHED}
    assert set(candidates(["eval", "walk.mcap", "--methods"], "") or ()) == methods
    assert candidates(["eval", "--methods"], "best,lu") == ["best,luenberger", "best,luenberger_fixed"]
    assert candidates(["simulate", "walk", "--scenario"], "") == list(SCENARIOS)
    for word in ("simulate", "emulate", "import", "keys", "mcu", "new", "calibrate"):
        module = {"import": "import_recording"}.get(word, word)
        assert set(candidates([word], "") or ()) == set(_tool(module).commands)


def test_streams_of_a_recording(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", flow="mine", source="simulated", rig={}) as writer:
        payload = numbered(Imu(stamp=1, gyro=(0.0, 0.0, 0.0)), 0)
        writer.write(sample_key("mine", "imu", "imu"), Imu, payload, stamp=1, seq=0, log_time=1)
    assert candidates(["export", str(tmp_path / "a.mcap"), "--format", "csv", "--stream"], "") == ["imu/imu"]
    (tmp_path / "b.mcap").write_bytes(b"no recording")
    assert candidates(["export", str(tmp_path / "b.mcap"), "--stream"], "") == []


def asked(*words: str) -> list[str]:
    """What the command answers to a bash that asks what the last of `words` may become."""
    environment = {"COMP_WORDS": "\n".join(("caneflow", *words)), "COMP_CWORD": str(len(words))}
    done = subprocess.run(
        [*(sys.executable, "-X", "importtime", "-m", "caneflow.command")],
        env={**os.environ, **environment, "_CANEFLOW_COMPLETE": "complete_bash"},
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert "numpy" not in done.stderr or words[-1].startswith("-"), "nobody waits for what is not needed"
    return done.stdout.split()


def test_the_command_answers_a_shell(running: str, file: Path) -> None:
    assert asked("status", running[:-1]) == [running]
    assert asked("run", str(file), "--set", "mine.mode", "=", "s") == ["slow"]
    assert asked("run", str(file.parent)) == [], "paths are the shell's"
    assert "--follow" in asked("logs", "--fo")


def test_no_flag_is_taken_for_an_option_with_a_value() -> None:
    for module in ("status", "logs", "run", "echo", "view", "list_flows", "record_now"):
        for option in _tool(module).params:
            flags = {name for name in option.opts if name in completion.FLAGS}
            assert not flags or option.is_flag, option.name
