"""`caneflow experiments`: the paper's experiments on simulated walks, as a page beside the paper's figures."""

import ast
import hashlib
import math
import platform
import statistics
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import scipy
import typer
from rich.console import Console
from rich.progress import track

import caneflow
from caneflow.algorithms.judging.error_summary import TABLE_I, ErrorSummary, consistent_mean, summarized
from caneflow.algorithms.judging.track_errors import aligned
from caneflow.errors import CaneflowError, not_installed
from caneflow.options import Overwrite
from caneflow.outputs import made_folder, whole
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.replays.evaluation import Evaluation, chosen_methods, evaluated
from caneflow.simulation import scenario as walk_scenarios

Item = TypeVar("Item")

FAILED_STATUS = 1
WALKS = Path(walk_scenarios.__file__)
ONE_WALK = "swing"  # the scenario of Table I, and of the picture with tracks
PICTURED = ("luenberger", "best")  # methods whose tracks are drawn, where fusion has them
NAMES = {"luenberger": "Luenberger", "kalman": "Kalman", "shs": "adapted SHS", "naive_ins": "naive INS"}
ROWS = ("largest", "sd", "mean", "growth_rate")  # of Table I
WIDTH = 115  # characters of the page
FAINT = "#b0b0b0"
# told apart by the colour-blind too (Okabe, Ito)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One scenario of the simulator and what is to be learnt from it."""

    title: str
    about: str
    closed: bool = True  # ends where it starts, so that the paper's distance is an error


# By the simulator's scenario.
EXPERIMENTS = {
    "swing": Experiment(
        title="Swing at each step",
        about="The paper's walk: a loop of 8 x 3 m, 22 m, about 50 s, a swing at each step.",
    ),
    "swing_stop": Experiment(
        title="Swing stopped midway",
        about="As before, but the swing ends somewhere between 40 and 60 % of the way. "
        "The paper's walk of this kind: Luenberger 1 m, Kalman 1.3 m, SHS fails (figure 13).",
    ),
    "stops": Experiment(title="Stops", about="The walker stands still twice, for 3 to 5 s."),
    "hard": Experiment(
        title="Walls and a person",
        about="Walls, a person who walks by, few scatterers on the floor, 5 dB instead of 15, and one stop.",
    ),
    "straight": Experiment(
        title="Open straight path",
        about="22 m straight on. What a loop hides shows here: a constant scale, a quarter turn of the heading. "
        "The paper's distance between end and start means nothing on it.",
        closed=False,
    ),
    "figure_eight": Experiment(title="Figure eight", about="8 x 3 m: errors of left turns meet those of right turns."),
    "slow": Experiment(title="A quarter of a metre per second", about="The same loop at 0.25 m/s."),
    "brisk": Experiment(
        title="1 m/s",
        about="The same loop at the pace of a practised user, with the steps that go with it; the step length in "
        "the rig is still the nominal one.",
    ),
    "step_back": Experiment(
        title="A step back",
        about="Midway the walker stops, steps back by 0.5 to 1 m and goes on. The paper's speed has no sign.",
    ),
    "varied": Experiment(
        title="Varied persons and places",
        about="Another rig, loop, gait, floor, room and hand for each seed; gyro biases of 0.02 to 0.3 deg/s.",
    ),
    "field": Experiment(
        title="Real devices",
        about="The paper's walk with what recordings of real devices have: noise within the radar's band, wrong "
        "readings of the IMU (one in 5 s), holes of 0.05 to 0.65 s in its samples (three a minute), 9 % of the scans "
        "lost, stamps that were equal, a stated carrier 2 % off, a stated rig 5 cm and 5 degrees off, and a magnetic "
        "field that turns by 30 degrees or wanders by 15.",
    ),
}


def command(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Page to write; its pictures go beside it.")
    ] = Path("docs/results.md"),
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="Walks per experiment: seeds 1 to N.")] = 10,
    only: Annotated[
        str | None, typer.Option(metavar="NAME,...", help=f"Of {', '.join(EXPERIMENTS)}; by default all.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="How many walks at a time.")] = 1,
    flow: Annotated[Path, typer.Option(metavar="FILE", help="The dataflow.")] = Path("dataflow.yaml"),
    folder: Annotated[
        Path, typer.Option(metavar="DIR", help="Where the walks are kept until the simulator changes.")
    ] = Path("build/experiments"),
    overwrite: Overwrite = False,
) -> None:
    """Simulate the walks that are not there yet (10 s each), run every method over them, write the page.

    The same sources write the same page again. Exit status 1: some walk or method failed; the page says which.

    Example: caneflow experiments --seeds 10 --jobs 2 --overwrite
    """
    scenarios = _scenarios(only)
    pictures = {name: output.parent / "pictures" / f"results_{name}.png" for name in ("tracks", "errors")}
    with ExitStack() as outputs:
        page_path = outputs.enter_context(whole(output, inputs=[flow], overwrite=overwrite))
        outputs.enter_context(made_folder(output.parent / "pictures"))
        drawn_at = {
            name: outputs.enter_context(whole(path, inputs=[flow], overwrite=overwrite))
            for name, path in pictures.items()
        }
        pyplot = _pyplot()
        methods = chosen_methods(load(flow))
        walks = {
            scenario: [folder / fingerprint() / f"{scenario}_{seed}.mcap" for seed in range(1, seeds + 1)]
            for scenario in scenarios
        }
        every = [path for paths in walks.values() for path in paths]
        simulate([path for path in every if not path.exists()], jobs)
        by_path = _evaluations(flow, every, methods, jobs)
        results = {scenario: [by_path[path] for path in paths] for scenario, paths in walks.items()}
        drawn = draw(pyplot, results, methods, drawn_at)
        made_by = f"caneflow experiments --seeds {seeds}" + (f" --only {only}" if only else "")
        lines = [*_head(made_by, seeds), *page(results, methods, drawn)]
        page_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if any(result.failures for result in by_path.values()):
        print(f"caneflow experiments: some walks failed; {output} says which", file=sys.stderr)
        raise typer.Exit(FAILED_STATUS)


def fingerprint(walks: Path = WALKS) -> str:
    """Of the code that makes walks, comments and layout aside: walks of another simulator are other walks."""
    digest = hashlib.sha256()
    for source in sorted(_with_imports(walks, {})):
        digest.update(source.encode())
    return digest.hexdigest()[:12]


def simulate(missing: Sequence[Path], jobs: int) -> None:
    """Make walks named `SCENARIO_SEED.mcap`, each by a `caneflow simulate` of its own, which ends with this."""
    for path in missing:
        path.parent.mkdir(parents=True, exist_ok=True)
    running: list[subprocess.Popen[str]] = []
    with ThreadPoolExecutor(jobs) as pool:
        try:
            for _ in _shown(pool.map(partial(_simulate, running), missing), "simulating", len(missing)):
                pass
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for program in running:
                program.terminate()
            raise


def page(
    results: Mapping[str, Sequence[Evaluation]], methods: Sequence[str], drawn: Mapping[str, str]
) -> Iterator[str]:
    """The results, line by line. `drawn`: links to pictures by what they show."""
    if ONE_WALK in results:
        yield from _table_one(results[ONE_WALK], methods)
    for link in drawn.values():
        yield from ("", link)
    for scenario, evaluations in results.items():
        yield from _experiment(EXPERIMENTS[scenario], scenario, evaluations, methods)
    yield from _walk_by_walk(results, methods)


def draw(
    pyplot: Any, results: Mapping[str, Sequence[Evaluation]], methods: Sequence[str], paths: Mapping[str, Path]
) -> dict[str, str]:
    """Draw the pictures to their `paths`, `tracks` where there are any; links to them, as seen from the page."""
    drawn = {}
    pictured = [method for method in PICTURED if method in methods]
    if ONE_WALK in results and pictured:
        _draw_tracks(pyplot, results[ONE_WALK], pictured, paths["tracks"])
        names = " and ".join(_name(method) for method in pictured)
        drawn["tracks"] = f"![Tracks of the swing walks by {names}, the truth in grey](pictures/results_tracks.png)"
    _draw_errors(pyplot, results, methods, paths["errors"])
    drawn["errors"] = "![Final error of every walk, by experiment and method](pictures/results_errors.png)"
    return drawn


def _scenarios(only: str | None) -> list[str]:
    if only is None:
        return list(EXPERIMENTS)
    wanted = [word.strip() for word in only.split(",")]
    for word in wanted:
        if word not in EXPERIMENTS:
            raise CaneflowError(f"--only {word}: no such experiment; there are {', '.join(EXPERIMENTS)}")
    return list(dict.fromkeys(wanted))


def _with_imports(source: Path, known: dict[Path, str]) -> Iterable[str]:
    """The code of a module of the simulator, and of those beside it that it imports."""
    tree = ast.parse(source.read_text(encoding="utf-8"))
    known[source] = ast.dump(_without_docstrings(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for name in (node.module.rpartition(".")[2], *(each.name for each in node.names)):
                beside = source.with_name(f"{name}.py")
                if beside not in known and beside.exists():
                    _with_imports(beside, known)
    return known.values()


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return tree


def _simulate(running: list[subprocess.Popen[str]], path: Path) -> None:
    scenario, _, seed = path.stem.rpartition("_")
    words = ["simulate", "walk", "--scenario", scenario, "--seed", seed, "--output", str(path)]
    command = [sys.executable, "-m", "caneflow.command", *words]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    running.append(program)
    _, said = program.communicate()
    if program.returncode and not path.exists():  # it does where another command has simulated the same walk
        reason = " ".join(said.split()) or f"status {program.returncode}"
        raise CaneflowError(f"caneflow {' '.join(words)}: {reason}")


def _evaluations(flow: Path, paths: Sequence[Path], methods: Sequence[str], jobs: int) -> dict[Path, Evaluation]:
    """An evaluation of each walk; with the tracks where they are to be drawn."""
    drawn = [path for path in paths if path.stem.rpartition("_")[0] == ONE_WALK]
    others = [path for path in paths if path not in drawn]
    done = [
        *_shown(evaluated(flow, drawn, methods, jobs=jobs, keep_tracks=True), f"evaluating {ONE_WALK}", len(drawn)),
        *_shown(evaluated(flow, others, methods, jobs=jobs), "evaluating", len(others)),
    ]
    return {each.recording: each for each in done}


def _shown(items: Iterator[Item], text: str, total: int) -> Iterator[Item]:
    """The same, with a bar on a terminal and nothing elsewhere."""
    console = Console(stderr=True)
    hidden = not console.is_terminal
    return iter(track(items, text, total=total, console=console, transient=True, disable=hidden))


def _head(made_by: str, seeds: int) -> Iterator[str]:
    versions = f"caneflow {caneflow.__version__}, Python {platform.python_version()}"
    low, high = consistent_mean(seeds)
    yield f"""# Results

The paper's experiments (Barra et al., ECC 2019, section VI) on simulated walks, and some more. This page and its
pictures are written by `{made_by}`; do not edit them. Made with {versions},
numpy {np.__version__}, scipy {scipy.__version__}.

## What was simulated, and what the paper measured

The paper walked: a prototype with a BNO055 and a P440, ten times around a closed loop indoors, without a tracking
system. All it could measure is how far the end of the track lies from its start. Its data is not public.

Nobody walked here. Person, cane, floor, radar and IMU are models (`src/caneflow/simulation`), with errors from
data sheets where there are any and chosen numbers, marked as such, where there are none. No number was fitted to
a result. The floor is kinder than a real one: point scatterers everywhere, at 15 dB. So a figure that agrees with
the paper says that the models have the paper's main errors in about their size; it does not say what a real cane
would do.

Seeds are 1 to {seeds}: walk N is what `caneflow simulate walk --scenario NAME --seed N` writes. All methods get
the same walks with the settings of `dataflow.yaml`, nothing set per walk or scenario, and never the truth. Errors
are horizontal, the estimate laid on the truth at the start by position and yaw only. A seed draws the same random
numbers for person, scene, radar and IMU in every scenario, so scenarios are not independent of each other; seeds are.

* *end - start*: from the end of the estimate to its start, the paper's error; none but on a closed walk.
* *end error*: from the end of the estimate to that of the truth. *ATE*: root mean square of that distance over
  the walk. *RPE*: the same for the displacement over 1 m. *path*: length of the estimate's path over the truth's.
* *sd*: over the walks, with n - 1. The mean of n walks is itself uncertain by sd / sqrt(n): for ten, a third.
* *NEES*: squared end error over the covariance that the method states, 2 on average when that is right; its mean
  over {seeds} walks lies within {low:.2f} .. {high:.2f} then, 19 times in 20."""


def _table_one(evaluations: Sequence[Evaluation], methods: Sequence[str]) -> Iterator[str]:
    yield "\n## Table I\n"
    yield textwrap.fill(
        f"Distance from end to start; ten walks in the paper, {len(evaluations)} here. The growth rate is the "
        "mean over the mean duration: 50 s in the paper, "
        f"{_duration(evaluations):.1f} s here with 3 s of rest in them.",
        WIDTH,
    )
    yield ""
    yield from _header("method", "", "max, m", "sd, m", "mean, m", "growth rate, m/s", left=2)
    for method in methods:
        name = _name(method)
        if method in TABLE_I:
            printed = (f"{getattr(TABLE_I[method], figure):g}" for figure in ROWS)
            yield _row(name, "paper", *printed)
            name = ""
        yield _row(name, "here", *_summary_cells(_summary(evaluations, method, "final_distance"), ROWS))


def _experiment(
    experiment: Experiment, scenario: str, evaluations: Sequence[Evaluation], methods: Sequence[str]
) -> Iterator[str]:
    yield f"\n## {experiment.title}\n"
    walks = f"{len(evaluations)} x {_duration(evaluations):.0f} s"
    yield textwrap.fill(f"{experiment.about} Scenario `{scenario}`, {walks} on average.", WIDTH) + "\n"
    yield from _header(
        *("method", "end - start, mean, m", "end error, mean, m", "sd, m", "max, m"),
        *("ATE, mean, m", "RPE, mean, m", "path, mean", "NEES, mean"),
    )
    for method in methods:
        end = _summary(evaluations, method, "final_error")
        yield _row(
            _name(method),
            _mean(evaluations, method, "final_distance", 2) if experiment.closed else "",
            *_summary_cells(end, ("mean", "sd", "largest")),
            *(_mean(evaluations, method, name, 2) for name in ("ate", "rpe", "path_length_ratio", "nees")),
        )
    for evaluation in evaluations:
        for method, reason in evaluation.failures.items():
            yield f"\n**{_name(method)} failed on {evaluation.recording.stem}**: {reason}"


def _walk_by_walk(results: Mapping[str, Sequence[Evaluation]], methods: Sequence[str]) -> Iterator[str]:
    yield "\n## Walk by walk\n"
    yield "End error in m, for every seed.\n"
    count = max(len(evaluations) for evaluations in results.values())
    yield from _header("scenario", "method", *map(str, range(1, count + 1)), left=2)
    for scenario, evaluations in results.items():
        for method in methods:
            first = f"`{scenario}`" if method == methods[0] else ""
            yield _row(first, _name(method), *(_figure(each, method, "final_error", 2) for each in evaluations))


def _header(*cells: str, left: int = 1) -> Iterator[str]:
    """The head of a table whose first `left` columns are words."""
    yield _row(*cells)
    yield _row(*["---"] * left, *["---:"] * (len(cells) - left))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _name(method: str) -> str:
    return NAMES.get(method, f"`{method}`")


def _known(evaluations: Sequence[Evaluation], method: str, name: str) -> list[float]:
    figures = [each.figures[method][name] for each in evaluations if method in each.figures]
    return [value for value in figures if value is not None]


def _summary(evaluations: Sequence[Evaluation], method: str, name: str) -> ErrorSummary | None:
    errors = _known(evaluations, method, name)
    return summarized(errors, _known(evaluations, method, "duration")) if errors else None


def _summary_cells(summary: ErrorSummary | None, names: Sequence[str]) -> list[str]:
    if summary is None:
        return ["-"] * len(names)
    return [_number(getattr(summary, name), 3 if name == "growth_rate" else 2) for name in names]


def _mean(evaluations: Sequence[Evaluation], method: str, name: str, digits: int) -> str:
    values = _known(evaluations, method, name)
    return _number(statistics.fmean(values) if values else None, digits)


def _figure(evaluation: Evaluation, method: str, name: str, digits: int) -> str:
    return _number(evaluation.figures.get(method, {}).get(name), digits)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _duration(evaluations: Sequence[Evaluation]) -> float:
    """Mean duration (s) of the tracks of one scenario, which is the same for all methods."""
    durations = [figures["duration"] or 0.0 for each in evaluations for figures in each.figures.values()]
    return statistics.fmean(durations) if durations else math.nan


def _pyplot() -> Any:
    """The pyplot of matplotlib, drawing to files only; raises CaneflowError where it is not installed."""
    try:
        import matplotlib
        from matplotlib import pyplot
    except ImportError as error:
        raise CaneflowError(not_installed("matplotlib", "plot")) from error
    matplotlib.use("Agg")
    return pyplot


def _draw_tracks(pyplot: Any, evaluations: Sequence[Evaluation], methods: Sequence[str], path: Path) -> None:
    """The tracks of all walks, a panel per method, aligned as the errors are; clockwise ones mirrored."""
    figure, panels = pyplot.subplots(
        1, len(methods), figsize=(4.6 * len(methods), 3.4), sharex=True, sharey=True, squeeze=False
    )
    for panel, method in zip(panels[0], methods, strict=True):
        for each in evaluations:
            if each.truth is None or method not in each.tracks:
                continue
            estimated, true, _ = aligned(each.tracks[method], each.truth)
            way = np.array([1.0, 1.0 if true[:, 1].mean() > 0.0 else -1.0])
            estimated, true = estimated * way, true * way
            panel.plot(*true.T, color=FAINT, linewidth=0.6, zorder=1)
            (line,) = panel.plot(*estimated.T, linewidth=0.9, alpha=0.85, zorder=2)
            panel.plot(*estimated[-1], "o", color=line.get_color(), markersize=4, zorder=3)
        panel.plot(0.0, 0.0, "k+", markersize=10, zorder=4)
        panel.set_title(_name(method).strip("`"))
        panel.set_aspect("equal")
        panel.set_xlabel("x, m")
    panels[0][0].set_ylabel("y, m")
    _save(pyplot, figure, path)


def _draw_errors(pyplot: Any, results: Mapping[str, Sequence[Evaluation]], methods: Sequence[str], path: Path) -> None:
    """The end error of every walk as a dot, their mean as a bar, on a logarithmic axis."""
    figure, panel = pyplot.subplots(figsize=(1.6 + 0.95 * len(results), 4.2))
    for m, method in enumerate(methods):
        colour = COLOURS[m % len(COLOURS)]
        panel.plot([], [], ".", color=colour, label=_name(method).strip("`"))  # for the legend
        for s, evaluations in enumerate(results.values()):
            errors = _known(evaluations, method, "final_error")
            if not errors:
                continue
            at = s + 0.8 * ((m + 0.5) / len(methods) - 0.5)
            panel.plot([at] * len(errors), errors, ".", color=colour, markersize=4, alpha=0.6)
            half = 0.3 / len(methods)
            panel.plot([at - half, at + half], [statistics.fmean(errors)] * 2, color=colour, linewidth=2.0)
    panel.set_yscale("log")
    panel.set_xticks(range(len(results)), list(results), rotation=30, ha="right")
    panel.set_ylabel("end error, m; bar: mean")
    panel.grid(axis="y", color=FAINT, linewidth=0.4)
    panel.legend(fontsize="small", ncols=2, loc="upper left")
    panel.set_ylim(top=panel.get_ylim()[1] * 3.0)
    _save(pyplot, figure, path)


def _save(pyplot: Any, figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=100, metadata={"Software": None})  # the same picture gives the same bytes
    pyplot.close(figure)
