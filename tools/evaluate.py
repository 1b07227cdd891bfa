"""`caneflow eval`: the methods of a flow's estimator side by side over recordings."""

import csv
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

from caneflow.algorithms.judging.error_summary import TABLE_I, ErrorSummary, consistent_mean, summarized
from caneflow.options import FlowFile, Overwrite
from caneflow.outputs import require_no_input, whole
from caneflow.printable import printable
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.dataflow.shipped import flow_for
from caneflow.runtime.replays.evaluation import FIGURES, Evaluation, Figures, chosen_methods, evaluated, without_nodes
from caneflow.runtime.replays.results_file import ResultsFile

FAILED_STATUS = 1

# Figure -> its head, whose second word stands below the first, its unit and how many digits are worth reading.
COLUMNS = {
    "final_distance": ("end- start", "m", 3),
    "final_error": ("end error", "m", 3),
    "ate": ("ATE", "m", 3),
    "rpe": ("RPE", "m", 3),
    "drift_percent": ("drift", "%", 1),
    "path_length_ratio": ("path ratio", "", 3),
    "extent": ("extent ratio", "", 3),
    "local_1s": ("local 1s", "m", 3),
    "local_5s": ("local 5s", "m", 3),
    "nees": ("NEES", "", 1),
}
NOTES = """\
end-start: from where the track ends to where it starts, the paper's error; none but on a closed walk.
end error, ATE, RPE over 1 m: against the truth, horizontal, aligned at the start's position and yaw only.
local: how far off a point 2 m ahead is drawn 1 s and 5 s after it was first, 95 % of the time.
sd with n - 1; growth: mean over the mean duration of the tracks, rests included; paper: Table I, ten walks.
NEES: of the final horizontal position, 2 on average when the covariance is right."""

By = dict[str, dict[str, Figures]]  # method, recording as given


def command(
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="REC...", help="Recordings, e.g. with ground truth.", show_default=False),
    ],
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="What to compare; by default all that fusion offers. "
            "Also: smoothed (`best`, run offline over the whole recording).",
        ),
    ] = None,
    flow: FlowFile = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NODE", help="Leave a node out, e.g. of a sensor that was not there (may be given again)."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="How many recordings at a time.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="A Dask cluster whose workers do it; they see the same files."),
    ] = None,
    results_file: Annotated[
        Path | None,
        typer.Option(
            "--results",
            metavar="FILE",
            help="SQLite file for the results as they come; what it holds is not run again.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object: method, recording, figure.")] = False,
    csv_file: Annotated[
        Path | None,
        typer.Option("--csv", metavar="FILE", help="Write a row per method and recording as well."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Run the methods of `fusion` over recordings, all in one process each, and hold them against the truth.

    Without truth in a recording only the distance between end and start is known. Exit status 1: some recording
    or method failed; the others are there. With --results a fleet of recordings goes on where it was killed.

    Example: caneflow eval walks/*.mcap --methods luenberger,best --jobs 2
    """
    recordings = list(dict.fromkeys(recordings))
    flow = flow_for(recordings, flow)
    left_out = without or []
    if results_file is not None:
        require_no_input(results_file, [flow, *recordings])
    with whole(csv_file, inputs=[flow, results_file, *recordings], overwrite=overwrite) as table:
        wanted = [word.strip() for word in methods.split(",")] if methods is not None else []
        graph = without_nodes(load(flow, settings or ()), left_out)
        chosen = chosen_methods(graph, wanted)
        run = partial(
            evaluated,
            flow,
            methods=chosen,
            overrides=settings or (),
            jobs=jobs,
            scheduler=scheduler,
            without=left_out,
        )
        with ResultsFile(results_file, graph, chosen) if results_file is not None else nullcontext() as kept:
            results = run(recordings) if kept is None else _resumed(kept, recordings, run)
            done = list(_shown(results, len(recordings)))
        by_method = gathered(chosen, done)
        if table is not None:
            write_csv(by_method, table)
    if as_json:
        print(json.dumps(by_method, indent=2, allow_nan=False))
    else:
        print("\n".join(lines(by_method)))
    failures = [line for result in done for line in failed(result)]
    for line in failures:
        print(f"caneflow eval: {printable(line)}", file=sys.stderr)
    if failures:
        raise typer.Exit(FAILED_STATUS)


def _resumed(
    kept: ResultsFile, recordings: Sequence[Path], run: Callable[[Sequence[Path]], Iterator[Evaluation]]
) -> Iterator[Evaluation]:
    """What is kept, then what had to be run, each kept as it comes; in the order in which they are had."""
    missing = []
    for recording in recordings:
        known = kept.get(recording)
        if known is None:
            missing.append(recording)
        else:
            yield known
    for made in run(missing):
        kept.add(made)
        yield made


def gathered(methods: Sequence[str], results: Sequence[Evaluation]) -> By:
    """The figures by method, then by recording as it was given; what failed is not there."""
    return {
        method: {str(each.recording): each.figures[method] for each in results if method in each.figures}
        for method in methods
    }


def failed(result: Evaluation) -> Iterator[str]:
    """A line for each reason why a method says nothing of a recording."""
    by_reason: dict[str, list[str]] = {}
    for method, reason in result.failures.items():
        by_reason.setdefault(reason, []).append(method)
    for reason, methods in by_reason.items():
        where = "" if len(by_reason) == 1 and not result.figures else f"{', '.join(methods)}: "
        named = reason.startswith(str(result.recording))
        yield f"{where}{reason}" if named else f"{result.recording}: {where}{reason}"


def write_csv(by_method: By, path: Path) -> None:
    """A row per method and recording with every figure; what is not known is empty."""
    with path.open("w", encoding="utf-8", newline="") as text:
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(("method", "recording", *FIGURES))
        for method, by_recording in by_method.items():
            for recording, figures in by_recording.items():
                rows.writerow((method, recording, *(figures[name] for name in FIGURES)))


def lines(by_method: By) -> Iterator[str]:
    """The table of all walks, then Table I's rows, then what the columns mean."""
    yield from _aligned(_walks(by_method), left=1)
    yield ""
    yield from _aligned(_summary(by_method), left=2)
    yield ""
    yield NOTES
    walks = max(sum(figures["nees"] is not None for figures in each.values()) for each in by_method.values())
    if walks:
        low, high = consistent_mean(walks)
        yield f"Over {walks} walk{'s' * (walks > 1)} its mean lies within {low:.2f} .. {high:.2f} in 95 % of all cases."


def _walks(by_method: By) -> Iterator[Sequence[str]]:
    heads = [(*head.partition(" ")[::2], unit) for head, unit, _ in COLUMNS.values()]
    yield from zip(("recording", "", ""), *heads, strict=True)
    recordings = dict.fromkeys(recording for each in by_method.values() for recording in each)
    for recording in recordings:
        yield (Path(recording).stem,)
        for method, by_recording in by_method.items():
            if recording in by_recording:
                figures = by_recording[recording]
                numbers = (_number(figures[key], digits) for key, (_, _, digits) in COLUMNS.items())
                yield f"  {method}", *numbers


def _summary(by_method: By) -> Iterator[Sequence[str]]:
    yield "", "", "", "end-", "", "", "", "end", "", "", "", ""
    yield "", "", "", "start", "", "", "", "error", "", "", "mean", "mean"
    yield "method", "", "walks", "max", "sd", "mean", "growth", "max", "sd", "mean", "ATE", "NEES"
    yield "", "", "", "m", "m", "m", "m/s", "m", "m", "m", "m", ""
    for method, by_recording in by_method.items():
        all_figures = list(by_recording.values())
        if all_figures:
            known = [figures for figures in all_figures if figures["final_error"] is not None]
            yield (
                *(method, "here", str(len(all_figures))),
                *_table_one(_summarized(all_figures, "final_distance")),
                *(_table_one(_summarized(known, "final_error"))[:3] if known else ["-"] * 3),
                *(_mean(all_figures, "ate", 3), _mean(all_figures, "nees", 2)),
            )
        if method in TABLE_I:
            paper = TABLE_I[method]
            printed = (f"{value:g}" for value in (paper.largest, paper.sd, paper.mean, paper.growth_rate))
            yield "", "paper", "10", *printed, *[""] * 5


def _summarized(all_figures: Sequence[Figures], name: str) -> ErrorSummary:
    errors = [figures[name] or 0.0 for figures in all_figures]
    return summarized(errors, [figures["duration"] or 0.0 for figures in all_figures])


def _table_one(summary: ErrorSummary) -> list[str]:
    errors = (summary.largest, summary.sd, summary.mean)
    return [*(_number(error, 2) for error in errors), _number(summary.growth_rate, 3)]


def _mean(all_figures: Sequence[Figures], name: str, digits: int) -> str:
    known = [value for figures in all_figures if (value := figures[name]) is not None]
    return _number(sum(known) / len(known) if known else None, digits)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _aligned(rows: Iterator[Sequence[str]], left: int) -> Iterator[str]:
    """Rows as lines: the first `left` columns flush left, the others flush right; a row of one cell is a heading."""
    table = list(rows)
    aligned = [row for row in table if len(row) > 1]
    widths = [max(map(len, column)) for column in zip(*aligned, strict=True)]
    for row in table:
        if len(row) == 1:
            yield row[0]
            continue
        cells = [
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield " ".join(cells).rstrip()


def _shown(results: Iterator[Evaluation], total: int) -> Iterator[Evaluation]:
    """The same, with a bar on a terminal and nothing elsewhere."""
    console = Console(stderr=True)
    return iter(
        track(results, "recordings", total=total, console=console, transient=True, disable=not console.is_terminal)
    )
