"""What people's own programs import: caneflow.testing, caneflow.evaluation."""

import math
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from caneflow.attach import Flow, attached
from caneflow.errors import CaneflowError
from caneflow.evaluation import evaluate, run_flow, table
from caneflow.messages import GroundSpeed, Imu, Pose, Sample, encode
from caneflow.recording import Recording
from caneflow.runtime import Brought, Context, Emitted, Operator, Quiet, Refused, Source
from caneflow.runtime.hosts.launcher.run_directory import running_flows
from caneflow.testing import context, run_operator, run_source
from tests.flows import CANEFLOW, launchers, wait_for, write_walk

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, kw_only=True)
class Times:
    """What a speed is multiplied with."""

    factor: float = 2.0


class Multiplied(Operator):
    """Each speed times a factor, once the IMU has turned; without any random number."""

    inputs = {"speed": GroundSpeed, "imu": Imu}
    outputs = {"speed": GroundSpeed}
    Settings = Times

    def __init__(self, settings: Times, context: Context) -> None:
        self.factor, self.turned = settings.factor, False
        self.last: Sample | None = None

    def handle(self, port: str, message: Sample) -> Emitted:
        if isinstance(message, Imu):
            self.turned = message.gyro[2] > 0
            return
        assert isinstance(message, GroundSpeed)
        if not self.turned:
            raise Refused("the imu has not turned")
        yield "speed", speed(message.stamp, self.factor * message.speed)


def speed(stamp: int, value: float) -> GroundSpeed:
    return GroundSpeed(stamp=stamp, speed=value, quality=0.0, rays=1, valid=True)


def test_an_operator_gets_its_messages_in_event_time_and_its_outputs_are_numbered() -> None:
    turn = [Imu(stamp=20, gyro=(0.0, 0.0, 1.0))]
    done = run_operator(Multiplied, {"speed": [speed(10, 1.0), speed(30, 2.0), speed(40, 3.0)], "imu": turn})
    assert [(each.stamp, each.seq) for each in done["speed"]] == [(30, 0), (40, 1)]
    assert [each.speed for each in done["speed"] if isinstance(each, GroundSpeed)] == [4.0, 6.0]
    assert done.refused == {"speed": 1, "imu": 0}  # the one before the turn


@pytest.mark.parametrize("settings", [Times(factor=3.0), {"factor": 3.0}])
def test_settings_are_an_object_or_as_in_a_file(settings: Any) -> None:
    turn = [Imu(stamp=0, gyro=(0.0, 0.0, 1.0))]
    done = run_operator(Multiplied, {"imu": turn, "speed": [speed(1, 1.0)]}, settings=settings)
    assert done["speed"][0].speed == 3.0  # type: ignore[attr-defined]  # it is a GroundSpeed


def test_a_port_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match="no input 'gyro'; there are speed, imu"):
        run_operator(Multiplied, {"gyro": []})


def test_a_context_has_the_rig_and_the_same_random_numbers_for_a_seed() -> None:
    assert context(rig={"hand_height": 0.9}).rig.need("hand_height") == 0.9
    assert context(seed=3).random.random() == context(seed=3).random.random()
    with pytest.raises(CaneflowError, match="hand_height"):
        context(rig={"hand_height": -1.0})


def test_a_source_is_closed_after_its_first_samples() -> None:
    closed = []

    class Counting(Source):
        outputs = {"imu": Imu}

        def __init__(self, settings: Any, context: Context) -> None:
            pass

        def samples(self) -> Brought:
            try:
                for stamp in range(1_000_000):
                    yield Quiet(stamp)
                    yield "imu", Imu(stamp=stamp + 1, gyro=(0.0, 0.0, 0.0))
            finally:
                closed.append(True)

    assert [(port, sample.stamp) for port, sample in run_source(Counting, 3)] == [("imu", 1), ("imu", 2), ("imu", 3)]
    assert closed == [True]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap", 150)


def test_a_flow_run_from_python_gives_the_bytes_of_the_command(walk: Path, tmp_path: Path) -> None:
    flow = ROOT / "dataflow.yaml"
    got = run_flow(flow, walk, ["fusion.method=kalman"], streams=["fusion/pose", "ground_speed/speed"])
    out = tmp_path / "out.mcap"
    command = [*CANEFLOW, "run", str(flow), "--replay", str(walk), "--in-process"]
    done = subprocess.run(
        [*command, "--set", "fusion.method=kalman", "--record", str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    with Recording(out) as recording:
        for stream, samples in got.items():
            node, _, port = stream.partition("/")
            assert [encode(each) for each in samples] == [each.payload for each in recording.samples([(node, port)])]
    assert len(got["fusion/pose"]) == 150
    assert table(got["fusion/pose"])["position"].shape == (150, 3)


def test_the_results_of_a_flow_are_what_it_gives_by_itself_and_a_wrong_name_is_said(walk: Path) -> None:
    assert list(run_flow(ROOT / "dataflow.yaml", walk)) == ["fusion/pose"]
    with pytest.raises(CaneflowError, match=r"no stream fusion/speed; there are .*fusion/pose"):
        run_flow(ROOT / "dataflow.yaml", walk, streams=["fusion/speed"])


def test_an_evaluation_has_the_figures_of_each_method(walk: Path) -> None:
    (found,) = evaluate(ROOT / "dataflow.yaml", [walk], ["luenberger", "naive_ins"])
    assert not found.failures
    assert set(found.figures) == {"luenberger", "naive_ins"}
    assert math.isfinite(found.figures["luenberger"]["final_distance"] or 0.0)


def test_a_running_flow_is_heard_decoded(walk: Path, tmp_path: Path) -> None:
    flow = tmp_path / "heard.yaml"
    flow.write_text((ROOT / "dataflow.yaml").read_text().replace("flow: cane", "flow: heard"))
    with launchers() as launch:
        run = launch("run", flow, "--replay", walk, "--speed", 0.05, log=tmp_path / "log")  # 30 s; ended below
        wait_for(lambda: "heard" in {each.flow for each in running_flows()}, "the flow")
        with attached("heard") as heard:
            assert "fusion" in {node.node for node in heard.status().nodes}
            samples = heard.samples("fusion/pose", "imu/imu", timeout=30.0)
            found: dict[str, list[Sample]] = {"fusion/pose": [], "imu/imu": []}
            while min(map(len, found.values())) < 2:
                stream, sample = next(samples)
                found[stream].append(sample)
            samples.close()
        assert run.process.poll() is None
    for stream, kind in {"fusion/pose": Pose, "imu/imu": Imu}.items():
        assert [type(each) for each in found[stream][:2]] == [kind, kind]
        assert found[stream][1].seq == found[stream][0].seq + 1
    assert heard.refused == heard.dropped == 0


def test_a_name_that_is_no_stream_is_refused() -> None:
    with pytest.raises(CaneflowError, match="'pose' names no stream"):
        next(Flow(cast("Any", SimpleNamespace(flow="f"))).samples("pose"))


def test_the_page_about_python_runs_as_it_stands(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "how-to" / "python.md").read_text()
    *blocks, running = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 4
    assert "attached" in running  # held by the test above
    shutil.copy(walk, tmp_path / "walk.mcap")
    shutil.copy(ROOT / "dataflow.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("caneflow.recording.reader.find_spec", lambda name: name == "polars" or None)
    monkeypatch.setattr("caneflow.recording.reader.import_module", lambda name: SimpleNamespace(DataFrame=dict))
    (twice,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, Any] = {"__name__": "page"}
    for block in (twice, *blocks):
        exec(block, names)  # noqa: S102 - the page's own lines
    assert set(names["walk"].figures) == {"best", "luenberger"}
