"""The benchmarks' own parts: their graphs load, what has become slower is named, and nothing else."""

import os
from pathlib import Path

import pytest

from benchmarks import canes, peers, pipeline, scaling
from benchmarks.measuring import Measured
from benchmarks.work import VARIABLE
from caneflow.runtime.dataflow.loading import load


def run(p50: float, cpu: float) -> Measured:
    return Measured(p50=p50, p99=2 * p50, cpu=cpu, rate=1000.0, lost=0.0, start_up=1.0)


def test_what_costs_more_than_it_may_is_named_with_its_ratio() -> None:
    bound = peers.BOUNDS["hop"]["IMU, 1 kHz"]["cpu"]
    base = [run(100.0, 200.0), run(100.0, 210.0), run(900.0, 190.0)]  # one run in three met a busy machine
    fine = [run(110.0, 200.0 * bound - 1.0)] * 3
    worse = [run(110.0, 200.0 * bound + 10.0)] * 3
    for runs, said in ((fine, []), (worse, [f"hop, IMU, 1 kHz: cpu is {bound + 0.05:.2f} times that of raw Zenoh"])):
        found = {"hop": {"IMU, 1 kHz": {"caneflow": runs, "raw Zenoh": base}}}
        assert [line.partition(";")[0] for line in peers.regressions(found)] == said


def test_what_is_written_down_are_figures_and_nothing_that_processes_printed() -> None:
    noisy = Measured(p50=1.0, p99=2.0, cpu=3.0, rate=4.0, lost=0.0, start_up=5.0, said="Traceback: in /a/folder/here")
    (written,) = peers.plain({"hop": {"IMU": {"dora": [noisy]}}})["hop"]["IMU"]["dora"]
    assert written == {"p50": 1.0, "p99": 2.0, "cpu": 3.0, "rate": 4.0, "lost": 0.0, "start_up": 5.0}


@pytest.mark.parametrize(("chain", "fan"), [(1, 1), (20, 1), (1, 20)])
def test_the_graphs_that_grow(chain: int, fan: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    point = scaling.Point(x=1.0, job=scaling.imu(100.0), chain=chain, fan=fan)
    monkeypatch.setenv(VARIABLE, point.job.environment()[VARIABLE])
    monkeypatch.syspath_prepend(os.fspath(Path(__file__).parents[1]))
    file = tmp_path / "scaling.yaml"
    file.write_text(scaling.flow(chain, fan))
    graph = load(file)
    assert len(graph.nodes) == 1 + point.hops
    assert len(graph.wires) == point.hops


@pytest.mark.parametrize("layout", canes.LAYOUTS)
def test_the_graph_of_a_cane_that_plays_a_walk(tmp_path: Path, layout: str) -> None:
    file = tmp_path / "cane.yaml"
    file.write_text(canes.graph(Path("walk.mcap"), "best", layout).replace("{number}", "1"))
    nodes = load(file).nodes
    assert set(nodes) == {"imu", "radar", "ground_speed", "fusion"}
    assert len({node.process for node in nodes.values()}) == 1


def test_a_fleet_is_computed_from_its_work_until_collecting_it_takes_longer() -> None:
    """2 s of work and 0.1 s to collect for each of 12 walks: no more than 20 workers' worth, however many there are."""
    measured = pipeline.Fleet(seconds={1: [25.0, 26.0, 24.0], 2: [13.0, 13.0, 13.0]}, start=1.0, collecting=0.1)
    page = "\n".join(pipeline.fleet_table(measured)).splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page if "|" in line]
    by_workers = {row[0]: row[2:] for row in rows[2:]}
    assert by_workers["1"] == ["**1.00**", f"{10_000 * 2.0 / 60:.3g}"]
    assert by_workers["2"] == ["**1.92**", f"{10_000 * 1.0 / 60:.3g}"]
    assert by_workers["8, computed"] == ["8", f"{10_000 * 2.0 / 8 / 60:.3g}"]
    assert by_workers["64, computed"] == ["20", f"{10_000 * 0.1 / 60:.3g}"]


def test_what_canes_lost_is_named() -> None:
    def measured(p50: float, said: list[str]) -> dict[str, object]:
        ages = {"p50": p50, "p99": 2 * p50, "max": 3 * p50}
        return {"stamp_to_recorded_pose_ms": ages, "cpu_of_a_cane_percent": 40.0, "losses_said": said}

    runs = [measured(3.0, []), measured(5.0, ["12 late"]), measured(4.0, [])]
    assert list(pipeline.cane_figures(runs)) == ["**4** [3..5]", "**8** [6..10]", "40 [40..40]", "12 late"]
    assert list(pipeline.cane_figures(runs[:1]))[-1] == "none"
