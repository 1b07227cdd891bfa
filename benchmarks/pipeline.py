"""The cane's pipeline as a whole: in one process, from the command to the first sample, side by side, over a fleet.

Everything that is not a hop, in one run, with its spread. Run it alone, on a walk:

    python -m benchmarks.pipeline walk.mcap --write docs/performance_pipeline.md   # about 4 minutes a repeat
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import psutil

from benchmarks import canes, pages
from benchmarks.contenders import CANEFLOW, HERE
from benchmarks.measuring import spread
from benchmarks.peers import versions
from benchmarks.start_up import start_up

DATAFLOW = HERE.parent / "dataflow.yaml"
GRAPHS = {  # what `caneflow bench` is told, by graph
    "the paper's chain (`--set ground_speed.with_velocity=false`)": ["--set", "ground_speed.with_velocity=false"],
    "`dataflow.yaml` as it is: Luenberger, the pulse pair beside it": [],
    "`fusion.method=best`": ["--set", "fusion.method=best"],
}
FLEET = 12  # walks
COMPUTED = (4, 8, 16, 64)  # workers, beyond the two that are measured
STARTS = 9
LATEST_MS = 25.0  # from stamp to recorded pose, the 99th percentile up to which a machine holds its canes
MOST_CANES = 40


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """A fleet of recordings run over by `caneflow eval`."""

    seconds: dict[int, list[float]]  # by number of workers, one value a run
    start: float  # s that a run takes without any recording
    collecting: float  # s of the parent's processor time for each recording


@dataclass(frozen=True, kw_only=True)
class Found:
    """All figures."""

    times_real_time: dict[str, list[float]]  # by graph
    start_up: list[float]  # s
    canes: dict[int, list[dict[str, object]]]  # by number
    held: dict[str, list[int]]  # by what a cane's nodes share: how many canes the machine holds
    fleet: Fleet


def main() -> None:
    """Measure everything, show it and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--repeats", type=int, default=3, help="runs of each (default: 3)")
    parser.add_argument("--canes", type=int, nargs="+", default=[1, 4, 6, 8], help="at once (default: 1 4 6 8)")
    pages.add_options(parser)
    options = parser.parse_args()
    walk, repeats = options.walk.resolve(), range(options.repeats)
    with pages.written_at_the_end(options, inputs=[walk]) as paths, tempfile.TemporaryDirectory() as folder:
        found = Found(
            times_real_time={graph: [times_real_time(walk, more) for _ in repeats] for graph, more in GRAPHS.items()},
            start_up=[start_up(DATAFLOW, walk, Path(folder) / "out.mcap") for _ in range(STARTS)],
            canes={number: [side_by_side(walk, number) for _ in repeats] for number in options.canes},
            held={layout: [most_canes(walk, layout) for _ in repeats] for layout in canes.LAYOUTS},
            fleet=fleet(Path(folder), len(repeats)),
        )
        page = "\n".join(written(found, options.repeats))
        print(page)
        if paths is not None:
            paths[0].write_text(page + "\n")
            paths[1].write_text(json.dumps(asdict(found), indent=1) + "\n")


def times_real_time(walk: Path, more: Sequence[str]) -> float:
    """How many times real time a graph runs in one process, the fastest of five."""
    command = [*CANEFLOW, "bench", str(walk), "--flow", str(DATAFLOW), "--json", *more]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return float(json.loads(done.stdout)["times_real_time"])


def side_by_side(walk: Path, number: int, layout: str = "five processes") -> dict[str, object]:
    """So many canes, live."""
    with tempfile.TemporaryDirectory() as folder:
        return canes.measured(Path(folder), canes.graph(walk, "best", layout), number, seconds=20.0)


def most_canes(walk: Path, layout: str) -> int:
    """How many canes this machine holds with nothing lost and no pose late: one more at a time, until it fails."""
    held = 0
    while held < MOST_CANES and is_held(walk, held + 1, layout):
        held += 1
    return held


def is_held(walk: Path, number: int, layout: str) -> bool:
    """Whether this machine holds so many canes; one whose flows do not come up does not."""
    try:
        return holds(side_by_side(walk, number, layout))
    except canes.EndedByItselfError:
        return False


def holds(run: Mapping[str, object]) -> bool:
    """Whether nothing was lost in a run, and hardly a pose was late."""
    ages = run["stamp_to_recorded_pose_ms"]
    return isinstance(ages, dict) and ages["p99"] <= LATEST_MS and not (run["losses_said"] or run["poses_missing"])


def fleet(folder: Path, repeats: int) -> Fleet:
    """A fleet of walks, evaluated by one worker and by two."""
    walks = [folder / f"walk_{seed}.mcap" for seed in range(FLEET)]
    for seed, path in enumerate(walks):
        command = [*CANEFLOW, "simulate", "walk", "--seed", str(seed), "--output", str(path)]
        subprocess.run(command, check=True, capture_output=True)
    runs = {jobs: [evaluated(walks, jobs) for _ in range(repeats)] for jobs in (1, 2)}
    seconds = {jobs: [took for took, _ in each] for jobs, each in runs.items()}
    one, all_of_them = evaluated(walks[:1], 1)[0], statistics.median(seconds[1])
    start = (FLEET * one - all_of_them) / (FLEET - 1)
    # The parent imports the same at its start in both runs: what more recordings add to its time is the collecting.
    parents = [evaluated(walks[:2], 2)[1], statistics.median(spent for _, spent in runs[2])]
    return Fleet(seconds=seconds, start=start, collecting=max(parents[1] - parents[0], 0.0) / (FLEET - 2))


def evaluated(walks: Sequence[Path], jobs: int) -> tuple[float, float]:
    """S that `caneflow eval` takes over the walks, and s of processor time of its own process among that."""
    command = [*CANEFLOW, "eval", *map(str, walks), "--flow", str(DATAFLOW), "--methods", "luenberger"]
    begun, spent = time.perf_counter(), 0.0
    process = psutil.Popen([*command, "--jobs", str(jobs), "--json"], stdout=subprocess.DEVNULL)
    while process.poll() is None:
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            break
        spent = max(spent, times.user + times.system)
        time.sleep(0.02)
    if process.wait() != 0:
        raise subprocess.CalledProcessError(process.returncode, command)
    return time.perf_counter() - begun, spent


def written(found: Found, repeats: int) -> Iterator[str]:
    """The page."""
    yield "<!-- made by `python -m benchmarks.pipeline --write` -->"
    yield f"{datetime.now(UTC):%Y-%m-%d}; {psutil.cpu_count()} cores; {', '.join(versions())}."
    yield f"Medians of {repeats} runs [least..largest]."
    yield "\n| in one process | times real time |\n|---|---|"
    for graph, values in found.times_real_time.items():
        yield f"| {graph} | **{statistics.median(values):.3g}** {spread(values)} |"
    yield "\n| start | s |\n|---|---|"
    starts = f"**{statistics.median(found.start_up):.2f}** {spread(found.start_up)}, {len(found.start_up)} runs"
    yield f"| from the command to the first recorded sample, five processes | {starts} |"
    yield "\n| canes at once | stamp to recorded pose, p50 (ms) | p99 (ms) | CPU of one, % of a core | lost or late |"
    yield "|---|---|---|---|---|"
    for number, runs in found.canes.items():
        yield f"| {number} | {' | '.join(cane_figures(runs))} |"
    yield f"\n| a cane's nodes | canes that the machine holds: nothing lost, p99 at most {LATEST_MS:g} ms |\n|---|---|"
    for layout, numbers in found.held.items():
        yield f"| {layout} | **{statistics.median(numbers):g}** {spread(numbers)} |"
    yield from fleet_table(found.fleet)


def cane_figures(runs: Sequence[Mapping[str, object]]) -> Iterator[str]:
    """The cells of so many canes."""
    ages = [run["stamp_to_recorded_pose_ms"] for run in runs]
    for key in ("p50", "p99"):
        values = [float(age[key]) for age in ages if isinstance(age, dict)]
        yield f"**{statistics.median(values):.3g}** {spread(values)}"
    shares = [float(str(run["cpu_of_a_cane_percent"])) for run in runs]
    yield f"{statistics.median(shares):.3g} {spread(shares)}"
    said = [each for run in runs for each in (run["losses_said"] if isinstance(run["losses_said"], list) else [])]
    yield ", ".join(said) or "none"


def fleet_table(fleet: Fleet) -> Iterator[str]:
    """Measured with one and two workers; beyond that computed: the work divided, or the parent's collecting."""
    one = statistics.median(fleet.seconds[1])
    recording = (one - fleet.start) / FLEET
    yield f"\n| workers | {FLEET} walks (s) | times as fast | 10 000 walks (min) |\n|---|---|---|---|"
    for jobs, seconds in fleet.seconds.items():
        many = 10_000 * (statistics.median(seconds) - fleet.start) / FLEET
        faster = f"**{one / statistics.median(seconds):.2f}**"
        yield f"| {jobs} | {statistics.median(seconds):.3g} {spread(seconds)} | {faster} | {many / 60:.3g} |"
    for jobs in COMPUTED:
        many = 10_000 * max(recording / jobs, fleet.collecting)
        yield f"| {jobs}, computed | | {10_000 * recording / many:.3g} | {many / 60:.3g} |"
    yield (
        f"\nComputed from {recording:.2f} s of work for a walk, divided among the workers, and "
        f"{1e3 * fleet.collecting:.1f} ms of the parent's time to collect it, which is not."
    )


if __name__ == "__main__":
    main()
