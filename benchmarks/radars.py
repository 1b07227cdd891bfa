"""The paper's walk with each radar: `python -m benchmarks.radars --write docs/results_radars.md --overwrite`.

Walks that are not there yet are simulated (an A121's take half a minute each) and kept in build/radars.
"""

import argparse
import statistics
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from caneflow.outputs import OutputError, whole
from caneflow.runtime.replays.evaluation import Evaluation, evaluated

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "build" / "radars"
USAGE_STATUS = 2
METHODS = ("best", "luenberger", "kalman")
NAMES = {"best": "best", "luenberger": "Luenberger (paper)", "kalman": "Kalman (paper)"}
FIGURES = ("final_error", "ate", "path_length_ratio", "nees")

HEAD = """\
# Results with radars that can be bought

The paper's walk (`swing`: a loop of 8 x 3 m, 22 m, a swing at each step) with another radar in the P440's place, seeds
1 to {seeds}. `python -m benchmarks.radars --seeds {seeds} --write docs/results_radars.md --overwrite` writes this page.

Nothing here was measured: walks, floors and radars are simulated (`caneflow simulate walk --radar ...`), and no number
was fitted to a result. An A121's echoes have an absolute power: the vendor's loop gain, and a floor of -15 dB (rough:
asphalt and concrete, Ulaby and Dobson 1989), -20 (usual, chosen) or -30 dB (polished: what water at 45 deg sends back
in recordings, -28 to -35). It is mounted 0.35 m above the floor, the others 0.75 m. The P440's floor is at 15 dB. The
TI radar looks ahead, between walls; 10 to 35 % of its points are wild. Person and course are the same for each; the IMU
sits beside the radar. `best` reads `velocity`, the paper's methods `speed`.

Errors are horizontal, m, the estimate laid on the truth at the start. *end error*: mean and largest over the walks.
*ATE*: root mean square over a walk, mean. *path*: length of the estimate's path over the truth's. *NEES*: of the end, 2
on average when the covariance is right.

| radar | floor | method | end error, mean | max | ATE, mean | path, mean | NEES, mean | failed |
|---|---|---|---|---|---|---|---|---|
"""


class Case(NamedTuple):
    """One radar on one floor."""

    name: str  # of the files
    radar: str
    floor: str
    flow: str
    words: tuple[str, ...]


CASES = (
    Case("p440", "P440", "15 dB", "dataflow.yaml", ()),
    *(
        Case(f"a121_{floor}", "A121", floor, "dataflows/cane_a121.yaml", ("--radar", "a121", "--floor", floor))
        for floor in ("rough", "usual", "polished")
    ),
    Case("mmwave", "TI mmWave", "walls", "dataflows/cane_mmwave.yaml", ("--radar", "mmwave")),
)


def main() -> None:
    """Simulate what is missing, evaluate all, write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="walks of each radar")
    parser.add_argument("--write", type=Path, default=ROOT / "docs" / "results_radars.md", help="the page")
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    try:
        with whole(options.write, overwrite=options.overwrite) as page:
            rows = [row for case in CASES for row in rows_of(case, evaluations(case, options.seeds))]
            page.write_text(HEAD.format(seeds=options.seeds) + "\n".join(rows) + "\n", encoding="utf-8")
    except OutputError as error:
        print(error, file=sys.stderr)
        sys.exit(USAGE_STATUS)


def evaluations(case: Case, seeds: int) -> list[Evaluation]:
    """Of the walks of one radar."""
    KEPT.mkdir(parents=True, exist_ok=True)
    paths = [KEPT / f"{case.name}_{seed}.mcap" for seed in range(1, seeds + 1)]
    for seed, path in enumerate(paths, 1):
        if not path.exists():
            words = ["simulate", "walk", *case.words, "--seed", str(seed), "-o", str(path)]
            subprocess.run([sys.executable, "-m", "caneflow.command", *words], check=True)
    return list(evaluated(ROOT / case.flow, paths, METHODS))


def rows_of(case: Case, found: Sequence[Evaluation]) -> Iterator[str]:
    """A row for each method."""
    for method in METHODS:
        figures = [each.figures[method] for each in found if method in each.figures]
        failed = len(found) - len(figures)
        cells = [case.radar, case.floor, NAMES[method], *_cells(figures), str(failed)]
        yield f"| {' | '.join(cells)} |"


def _cells(figures: Sequence[Mapping[str, float | None]]) -> Iterator[str]:
    for name in FIGURES:
        values = [value for each in figures if (value := each.get(name)) is not None]
        yield f"{statistics.mean(values):.2f}" if values else "-"
        if name == "final_error":
            yield f"{max(values):.2f}" if values else "-"


if __name__ == "__main__":
    main()
