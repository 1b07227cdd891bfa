"""`caneflow eval` on two short simulated walks: its figures are those of what `run` records of them."""

import csv
import importlib.util
import json
import re
import sqlite3
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from caneflow.algorithms.judging.error_summary import consistent_mean
from caneflow.messages import Pose
from caneflow.recording import TRUTH, Recording, RecordingWriter
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.shipped import flow_for
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.program import Emitted, Operator
from caneflow.runtime.replays.evaluation import (
    FIGURES,
    chosen_methods,
    estimates,
    evaluated,
    offered_methods,
    without_nodes,
)
from caneflow.runtime.replays.results_file import ResultsFile
from caneflow.runtime.replays.workers import mapped_on_cluster
from tests.flows import caneflow_here
from tools import evaluate, simulate

ROOT = Path(__file__).parents[1]
CHECKS = ROOT.parent / "shared" / "checks"
FLOW = ROOT / "dataflow.yaml"
METHODS = offered_methods(load(FLOW))


def caneflow(*arguments: object) -> "subprocess.CompletedProcess[str]":
    return caneflow_here(*arguments, cwd=ROOT)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("walks")
    paths = [folder / "swing_1.mcap", folder / "stops_2.mcap"]
    for seed, path in enumerate(paths, start=1):
        simulate.walk(output=path, scenario=path.stem.partition("_")[0], seed=seed, duration=4.0)
    return paths


@pytest.fixture(scope="module")
def answer(walks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """What `--json` prints of both, and the file that `--csv` writes."""
    table = tmp_path_factory.mktemp("table") / "eval.csv"
    done = caneflow("eval", *walks, "--json", "--csv", table)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout), table


def copied(path: Path, to: Path, *, truth: bool, rig: dict[str, Any] | None = None) -> Path:
    """The recording again, with or without its truth, and with another rig."""
    with (
        Recording(path) as source,
        RecordingWriter(to, flow=source.flow, source="simulated", rig=source.rig if rig is None else rig) as writer,
    ):
        streams = [name for name in source.streams if truth or name != TRUTH]
        for s in source.samples(streams):
            assert s.kind is not None
            writer.write(s.key, s.kind, s.payload, stamp=s.stamp, seq=s.seq, log_time=s.log_time)
    return to


def score() -> ModuleType:
    """The outside check's own formula."""
    if not (CHECKS / "score.py").exists():
        pytest.skip("the outside checks are not here")
    sys.path.insert(0, str(CHECKS))
    try:
        spec = importlib.util.spec_from_file_location("score", CHECKS / "score.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(CHECKS))


def test_every_method_that_fusion_offers_is_there_with_every_recording_and_figure(
    answer: tuple[dict[str, Any], Path], walks: list[Path]
) -> None:
    by_method, _ = answer
    assert tuple(by_method) == METHODS
    assert {"luenberger", "kalman", "shs", "naive_ins"} <= set(by_method)
    for by_recording in by_method.values():
        assert list(by_recording) == list(map(str, walks))
        assert all(tuple(figures) == FIGURES for figures in by_recording.values())


def test_the_figures_are_those_of_the_recording_that_run_makes(
    answer: tuple[dict[str, Any], Path], walks: list[Path], tmp_path: Path
) -> None:
    output = tmp_path / "out.mcap"
    done = caneflow(
        "run", FLOW, "--replay", walks[0], "--in-process", "--set", "fusion.method=naive_ins", "--record", output
    )
    assert done.returncode == 0, done.stderr
    expected = score().score("walk", walks[0], output)
    figures = answer[0]["naive_ins"][str(walks[0])]
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value, abs=0.51e-2 if name == "drift_percent" else 0.51e-3), name


def test_methods_that_run_side_by_side_give_what_each_gives_alone(walks: list[Path]) -> None:
    graph = load(FLOW)
    together, _ = estimates(graph, walks[0], METHODS)
    for method in METHODS:
        alone, _ = estimates(graph, walks[0], [method])
        assert (alone[method].track.positions == together[method].track.positions).all(), method


def test_without_the_radar_what_needs_none_is_the_same(answer: tuple[dict[str, Any], Path], walks: list[Path]) -> None:
    without = ["radar", "ground_speed"]
    (result,) = evaluated(FLOW, walks[:1], ["naive_ins"], without=without)
    assert result.figures["naive_ins"] == answer[0]["naive_ins"][str(walks[0])]
    with pytest.raises(DataflowError, match="--without sonar: no such node; there are"):
        without_nodes(load(FLOW), ["sonar"])
    with pytest.raises(DataflowError, match="room_tracker: --without leaves it no input; leave it out too"):
        without_nodes(load(ROOT / "dataflows" / "room.yaml"), ["south_line", "west_line", "attitude"])


def test_the_flow_is_the_one_here_or_beside_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, beside = tmp_path / "here", tmp_path / "beside"
    here.mkdir()
    beside.mkdir()
    monkeypatch.chdir(here)
    recording = beside / "walk.mcap"
    (beside / "dataflow.yaml").touch()
    assert flow_for([recording]) == beside / "dataflow.yaml"
    (here / "dataflow.yaml").touch()
    assert flow_for([recording]) == Path("dataflow.yaml")
    assert flow_for([recording], FLOW) == FLOW


@pytest.mark.long
def test_several_processes_give_what_one_gives(walks: list[Path]) -> None:
    one = list(evaluated(FLOW, walks, ["kalman"]))
    two = list(evaluated(FLOW, walks, ["kalman"], jobs=2))
    assert [each.recording for each in two] == walks
    assert [each.figures for each in two] == [each.figures for each in one]


def test_the_csv_holds_what_the_json_holds(answer: tuple[dict[str, Any], Path]) -> None:
    by_method, table = answer
    with table.open(newline="") as text:
        rows = list(csv.DictReader(text))
    read: dict[str, Any] = {}
    for row in rows:
        figures = {name: float(row[name]) if row[name] else None for name in FIGURES}
        read.setdefault(row["method"], {})[row["recording"]] = figures
    assert read == by_method


def test_a_bad_recording_does_not_stop_the_others(walks: list[Path], tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_text("this is not a recording\n")
    missing = tmp_path / "missing.mcap"
    done = caneflow("eval", bad, walks[0], missing, "--methods", "luenberger", "--json")
    assert done.returncode == 1
    assert list(json.loads(done.stdout)["luenberger"]) == [str(walks[0])]
    said = done.stderr.splitlines()
    assert len(said) == 2
    assert f"{bad}: is not an MCAP file" in said[0]
    assert f"{missing}: cannot be read" in said[1]


def test_without_truth_only_the_papers_figure_is_known(
    answer: tuple[dict[str, Any], Path], walks: list[Path], tmp_path: Path
) -> None:
    blind = copied(walks[0], tmp_path / "blind.mcap", truth=False)
    (result,) = evaluated(FLOW, [blind], ["luenberger"])
    figures, with_truth = result.figures["luenberger"], answer[0]["luenberger"][str(walks[0])]
    for name in ("final_distance", "growth_rate", "duration", "poses"):
        assert figures[name] == pytest.approx(with_truth[name]), name
    for name in ("final_error", "ate", "rpe", "drift_percent", "path_length_ratio", "extent", "nees"):
        assert figures[name] is None, name
    text = "\n".join(evaluate.lines({"luenberger": {str(blind): figures}}))
    assert "blind" in text


def test_a_method_that_fails_does_not_stop_the_others(walks: list[Path], tmp_path: Path) -> None:
    """Step-and-heading needs the step length, which this rig leaves open."""
    with Recording(walks[0]) as source:
        rig = source.rig | {"step_length": None}
    poor = copied(walks[0], tmp_path / "poor.mcap", truth=True, rig=rig)
    (result,) = evaluated(FLOW, [poor], ["shs", "luenberger"])
    assert list(result.figures) == ["luenberger"]
    assert list(result.failures) == ["shs"]
    assert "step_length is not known" in result.failures["shs"]
    (line,) = evaluate.failed(result)
    assert line.startswith(f"{poor}: shs: rig.step_length")


def test_an_operator_that_breaks_fails_its_recording_only(walks: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    fusion = load(FLOW).nodes["fusion"].program
    assert fusion is not None
    assert issubclass(fusion, Operator)

    def broken(self: Operator, port: str, message: object) -> Emitted:
        raise ZeroDivisionError("nobody thought of this")

    monkeypatch.setattr(fusion, "handle", broken)
    (result,) = evaluated(FLOW, walks[:1], ["luenberger"])
    assert result.failures["luenberger"].startswith("ZeroDivisionError: nobody thought of this (line ")


def test_a_method_that_is_not_offered_is_named_in_one_line() -> None:
    said = f"no method 'kalmann'; did you mean 'kalman'? fusion offers {', '.join(METHODS)}, smoothed"
    with pytest.raises(DataflowError, match=f"^{re.escape(said)}$"):
        chosen_methods(load(FLOW), ["luenberger", "kalmann"])


def test_a_flow_without_an_estimator_is_an_error(tmp_path: Path) -> None:
    flow = tmp_path / "flow.yaml"
    flow.write_text("flow: cane\nnodes: {imu: {run: drivers.bno055, settings: {port: /dev/null}}}\n")
    with pytest.raises(DataflowError, match="no node 'fusion'; there are imu"):
        chosen_methods(load(flow))


def test_the_table_has_a_row_for_every_walk_and_the_papers_figures_beside_ours(
    answer: tuple[dict[str, Any], Path],
) -> None:
    text = "\n".join(evaluate.lines(answer[0]))
    assert text.count("swing_1") == text.count("stops_2") == 1
    assert all(len(line) <= 80 for line in text.partition("\n\nend-start:")[0].splitlines()), text
    luenberger = next(line for line in text.splitlines() if line.split()[:2] == ["luenberger", "here"])
    figures = list(answer[0]["luenberger"].values())
    mean = sum(each["final_distance"] for each in figures) / 2
    duration = sum(each["duration"] for each in figures) / 2
    assert luenberger.split()[2] == "2"
    assert float(luenberger.split()[5]) == pytest.approx(mean, abs=0.0051)
    assert float(luenberger.split()[6]) == pytest.approx(mean / duration, abs=0.00051)
    assert ["paper", "10", "2.7", "0.5", "1.3", "0.026"] in [line.split() for line in text.splitlines()]
    low, high = consistent_mean(2)
    assert f"{low:.2f} .. {high:.2f}" in text


def test_a_kalman_pose_has_a_covariance_and_so_a_nees(answer: tuple[dict[str, Any], Path]) -> None:
    by_method, _ = answer
    assert all(figures["nees"] > 0 for figures in by_method["kalman"].values())
    assert all(figures["nees"] is None for figures in by_method["naive_ins"].values())


def test_the_poses_are_not_recorded(walks: list[Path]) -> None:
    """The folder of the recordings holds what it held, and they hold no pose but the truth."""
    assert sorted(path.name for path in walks[0].parent.iterdir()) == ["stops_2.mcap", "swing_1.mcap"]
    with Recording(walks[0]) as recording:
        assert recording.streams_of(Pose) == []


def test_a_fleet_goes_on_where_it_was_killed(walks: list[Path], tmp_path: Path) -> None:
    """What was kept is not run again, until the recording or the settings are others."""
    kept, wrong = tmp_path / "fleet.sqlite", tmp_path / "wrong.mcap"
    wrong.write_text("no recording")
    graph = load(FLOW)
    (first, *_) = evaluated(FLOW, walks[:1], ["luenberger"])
    with ResultsFile(kept, graph, ["luenberger"]) as results:
        results.add(first)  # and here it was killed

    done = caneflow("eval", *walks, wrong, "--methods", "luenberger", "--results", kept, "--json")
    again = caneflow("eval", *walks, wrong, "--methods", "luenberger", "--results", kept, "--json")

    assert (done.returncode, again.returncode) == (1, 1)
    assert json.loads(again.stdout) == json.loads(done.stdout)
    assert json.loads(done.stdout)["luenberger"][str(walks[0])] == first.figures["luenberger"]
    with sqlite3.connect(kept) as file:
        finished = dict(file.execute("SELECT recording, count(*) FROM evaluations GROUP BY recording"))
        failures = file.execute("SELECT recording, method FROM failures").fetchall()
    assert finished == dict.fromkeys([*map(str, walks), str(wrong)], 1)
    assert failures == [(str(wrong), "luenberger")]
    with ResultsFile(kept, graph, ["luenberger"]) as results:
        assert results.get(walks[1]) is not None
        walks[1].touch()
        assert results.get(walks[1]) is None
    with ResultsFile(kept, load(FLOW, ["fusion.luenberger.pole_velocity=0.9"]), ["luenberger"]) as results:
        assert results.get(walks[0]) is None


def test_another_programs_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "theirs.sqlite"
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE theirs (value)")
    with pytest.raises(DataflowError, match="another program's"):
        ResultsFile(path, load(FLOW), ["luenberger"])
    path.write_text("no database at all, but long enough to be looked at")
    with pytest.raises(DataflowError, match=r"theirs\.sqlite"):
        ResultsFile(path, load(FLOW), ["luenberger"])


@pytest.mark.long
def test_a_cluster_gives_the_same_figures(walks: list[Path]) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (the extra `cluster`)")
    alone = caneflow("eval", *walks, "--methods", "luenberger", "--json")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        there = cluster.scheduler_address
        spread = caneflow("eval", *walks, "--methods", "luenberger", "--json", "--scheduler", there)
    assert spread.returncode == 0, spread.stderr
    assert json.loads(spread.stdout) == json.loads(alone.stdout)


def test_a_cluster_that_is_not_there_is_one_line(walks: list[Path]) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed (the extra `cluster`)")
    with pytest.raises(DataflowError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        list(mapped_on_cluster(str, walks, "tcp://127.0.0.1:9", timeout=1.0))
