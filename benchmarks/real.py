"""Real recordings, that nobody of this project made, through the product: `make real` writes docs/results_real.md.

Run it as `python -m benchmarks.real [DATA] [--mine FOLDER] [--write FILE --overwrite]`. What is not in DATA is named as
such. Each figure comes of the public commands and flows: an import, a flow, and a comparison with what is known.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks import real_figures
from benchmarks.real_figures import Row
from caneflow.outputs import OutputError, whole
from caneflow.recording.platform import Platform

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
USAGE_STATUS = 2

HEAD = """\
# Results on real recordings

Recordings of others, made with other devices for other purposes, through the product. The project contains none of
them; [the recordings](#the-recordings) says where they come from. `make real` writes this page again. `make real
REAL=FOLDER` adds the files of a folder of yours: WAV and FLAC of Doppler modules, P440 logs, recordings, and tables of
an IMU with their `--columns` in a file of the same name that ends in `.columns`.

```{warning}
**What has never been measured**: a cane with both sensors and ground truth. There is no recording of a P440 that looks
at the ground from a moving cane, none of a radar and an IMU of this project's kinds on one clock, and none of two
Doppler modules in a room with a known position. The results of [the cane](results.md) and
[the room](results_room.md) are of simulators. What follows shows that single parts are right on single real sensors,
and nothing beyond that.
```

"""

SOURCES = """\
## The recordings

| folder | what | from | licence |
|---|---|---|---|
| `p440-rail-mocap`, `p440-udp-loss` | P440, raw packets | github jjimmykang/bwsi-backprojection | MIT |
| `cw24-walk` | 24 GHz CW modules, 44.1 kHz | github MishayNaidoo/Traffic-Monitoring-Using-Doppler-Radar | GPL-3.0 |
| `gait-loop-imu` | IMU on a foot, 398 Hz | github xioTechnologies/Gait-Tracking | MIT |
| `broad-imu` | hand-moved IMU, 286 Hz, trial 21 | github dlaidig/broad (Data 6(7), 2021) | CC BY 4.0 |
| `ti-handheld-loop` | IWR6843 and IMU in the hand, 205 Hz | github christopherdoer/rio | GPL-3.0 |
| `p4xx-walker-4nodes` | four static P4xx radars | github Hong-01/ET4173-Clutter-Suppression | MIT |
| `a121-flow` | Acconeer A121, vendor's h5 | github acconeer/acconeer-python-exploration | BSD-3-Clause-Clear |

## What the product cannot read

* `p4xx-walker-4nodes`: MATLAB files, no importer. `tests/test_room_trackers.py` follows the person by range alone,
  with a median distance below 0.15 m from the nominal triangle. No times are known of the triangle.
"""


class Measure(NamedTuple):
    """A recording and how it is judged."""

    folder: str
    figures: Callable[[Path, Path], Sequence[Row]]  # of the recording's folder and one for files


MEASURES = (
    Measure("p440-rail-mocap", real_figures.rail),
    Measure("p440-udp-loss", real_figures.packet_loss),
    Measure("cw24-walk", real_figures.doppler_modules),
    Measure("gait-loop-imu", real_figures.foot),
    Measure("broad-imu", real_figures.attitude),
    Measure("ti-handheld-loop", real_figures.handheld),
    Measure("a121-flow", real_figures.water),
)


def main() -> None:
    """Measure, print the tables, and write the page where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=DATA, help=f"folder of the recordings (default: {DATA})")
    parser.add_argument("--mine", type=Path, metavar="FOLDER", help="a folder of your own files")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the page there")
    parser.add_argument("--overwrite", action="store_true", help="replace the page")
    options = parser.parse_args()
    if options.mine is None and not any((options.data / measure.folder).is_dir() for measure in MEASURES):
        print(f"{options.data}: none of the recordings is there; expected {MEASURES[0].folder} ...", file=sys.stderr)
        sys.exit(USAGE_STATUS)
    if options.mine is not None and not options.mine.is_dir():
        print(f"--mine {options.mine}: not a folder", file=sys.stderr)
        sys.exit(USAGE_STATUS)
    try:
        with whole(options.write, overwrite=options.overwrite) as path:
            text = "\n".join(page(options.data, options.mine)) + "\n"
            if path is not None:
                path.write_text(text, encoding="utf-8")
    except OutputError as error:
        print(error, file=sys.stderr)
        sys.exit(USAGE_STATUS)
    print(text)


def page(data: Path, mine: Path | None) -> Iterator[str]:
    """The lines of the page."""
    yield HEAD.rstrip()
    yield ""
    yield from table(list(rows(data)))
    yield ""
    if mine is not None:
        yield f"## Your files, {mine}"
        yield ""
        with tempfile.TemporaryDirectory() as folder:
            yield from table(list(real_figures.of_folder(mine, Path(folder))))
        yield ""
    yield SOURCES.rstrip()
    yield ""
    here = Platform.here()
    yield f"Measured at {commit()}, {here.machine}, Python {here.python}, numpy {here.numpy}."


def rows(data: Path) -> Iterator[Row]:
    """The figures of each recording that is there; one that is not there says so."""
    for measure in MEASURES:
        source = data / measure.folder
        if not source.is_dir():
            yield Row(measure.folder, "", "", "not measured: the recording is not here", "")
            continue
        with tempfile.TemporaryDirectory() as folder:
            yield from measure.figures(source, Path(folder))


def table(found: Sequence[Row]) -> Iterator[str]:
    """A table of Markdown."""
    yield "| recording | what is known of the truth | what is measured | here | published, or by others |"
    yield "|---|---|---|---|---|"
    for row in found:
        yield "| " + " | ".join((row.recording, row.truth, row.measured, row.here, row.published)) + " |"


def commit() -> str:
    """The checkout's commit; its own name where that is not known."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return f"commit {done.stdout.strip()}" if done.returncode == 0 else "an unknown commit"


if __name__ == "__main__":
    main()
