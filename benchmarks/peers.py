"""A hop beside its peers: caneflow, raw Zenoh, dora and a Unix socket do the same work in turn, on one machine.

source -> relay -> sink, three processes; the relay decodes, numbers and encodes. Ratios to raw Zenoh come first: a
machine is as fast as it happens to be, contenders in one run meet the same machine. Run it alone.

    python -m benchmarks.peers --write docs/performance_peers.md   # all; about 6 minutes a repeat
    python -m benchmarks.peers --part hop --repeats 1
"""

import argparse
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

from benchmarks import pages
from benchmarks.contenders import CONTENDERS, DORA, HERE
from benchmarks.measuring import Measured, measured, median, spread
from benchmarks.work import Job

BASE = "raw Zenoh"  # what ratios are taken to

PARTS: dict[str, dict[str, Job]] = {
    "hop": {
        "IMU, 100 Hz": Job(kind="imu", rate=100.0, count=1200),
        "IMU, 1 kHz": Job(kind="imu", rate=1000.0, count=12_000),
        "frame of 480, 100 Hz": Job(kind="frame", rate=100.0, count=1200),
        "block of 64 x 480, 100 Hz": Job(kind="block", rate=100.0, count=1200),
    },
    "drain": {  # as fast as it goes, nothing lost
        "IMU": Job(kind="imu", rate=0.0, count=60_000),
        "frame of 480": Job(kind="frame", rate=0.0, count=60_000),
        "block of 64 x 480": Job(kind="block", rate=0.0, count=6_000),
    },
    "start": {"IMU, 100 Hz": Job(kind="imu", rate=100.0, count=900, wait=False)},
}
ABOUT = {
    "hop": "A steady rate: from the source's stamp to the sink (us), and CPU of all processes together (us a sample).",
    "drain": "As fast as it goes with nothing lost: samples a second. dora has no mode that loses nothing.",
    "start": "From the command to the first sample (s), and the share of samples lost while starting.",
}
SHOWN = {"hop": ("p50", "p99", "cpu"), "drain": ("rate",), "start": ("start_up", "lost")}
# Ratios of caneflow to raw Zenoh in the same run that something has to have gone wrong for: a noisy machine moves both.
BOUNDS = {
    "hop": {"IMU, 100 Hz": {"cpu": 1.6}, "IMU, 1 kHz": {"p50": 2.0, "cpu": 1.5}, "frame of 480, 100 Hz": {"cpu": 1.5}},
    "start": {"IMU, 100 Hz": {"start_up": 2.0}},
}
RATIOS = {"hop": ("p50", "cpu"), "drain": ("rate",), "start": ("start_up",)}


Found = dict[str, dict[str, list[Measured]]]  # by job and contender


def main() -> None:
    """Measure all contenders in turn, again and again, and show medians with their spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=list(PARTS), help="one part only")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each contender (default: 3)")
    pages.add_options(parser)
    options = parser.parse_args()
    contenders = [name for name in CONTENDERS if name != "dora" or DORA.exists()]
    if "dora" not in contenders:
        print("dora is not installed (pip install 'caneflow[peers]') and left out", file=sys.stderr)
    os.environ["PYTHONPATH"] = str(HERE.parent)  # of the contenders' processes, which start elsewhere
    found = {}
    with pages.written_at_the_end(options) as paths:
        for part in [options.part] if options.part else PARTS:
            able = [name for name in contenders if part != "drain" or name != "dora"]
            found[part] = rounds(PARTS[part], able, options.repeats)
        page = "\n".join(written(found, options.repeats))
        slower = list(regressions(found))
        print(page)
        if paths is not None:
            paths[0].write_text(page + "\n")
            paths[1].write_text(json.dumps(plain(found), indent=1) + "\n")
    if slower:
        sys.exit("\n".join(slower))


def rounds(jobs: Mapping[str, Job], contenders: Sequence[str], repeats: int) -> Found:
    """Every contender in every job, one after the other, `repeats` times over."""
    found: Found = {job: {name: [] for name in contenders} for job in jobs}
    for _ in range(repeats):
        for title, job in jobs.items():
            for name in contenders:
                found[title][name].append(measured(CONTENDERS[name], job))
                print(f"{title}: {name}: {found[title][name][-1]}", file=sys.stderr)
    return found


def written(found: Mapping[str, Found], repeats: int) -> Iterator[str]:
    """The page: what was measured on, then a table per part, ratios first."""
    yield "<!-- made by `python -m benchmarks.peers --write` -->"
    yield f"{datetime.now(UTC):%Y-%m-%d}; {os.cpu_count()} cores, Linux {platform.release()}; {', '.join(versions())}."
    yield f"Median of {repeats} runs [least..largest]; x: ratio of the medians to {BASE} in the same run."
    for part, jobs in found.items():
        keys = SHOWN[part]
        yield f"\n{ABOUT[part]}\n"
        yield f"| {part} | contender | " + " | ".join([*(f"{key}, x" for key in RATIOS[part]), *keys]) + " |"
        yield "|" + "---|" * (2 + len(RATIOS[part]) + len(keys))
        for job, by_name in jobs.items():
            for name, runs in by_name.items():
                ratios = [f"**{ratio(runs, by_name[BASE], key):.2f}**" for key in RATIOS[part]]
                yield f"| {job} | {name} | " + " | ".join([*ratios, *(shown(runs, key) for key in keys)]) + " |"


def regressions(found: Mapping[str, Found]) -> Iterator[str]:
    """What costs more than it may, beside raw Zenoh in the same run."""
    for part, jobs in BOUNDS.items():
        for job, bounds in jobs.items():
            by_name = found.get(part, {}).get(job, {})
            for key, bound in bounds.items() if BASE in by_name else ():
                value = ratio(by_name["caneflow"], by_name[BASE], key)
                if value > bound:
                    yield f"{part}, {job}: {key} is {value:.2f} times that of {BASE}; it was below {bound} before"


def ratio(runs: Sequence[Measured], base: Sequence[Measured], key: str) -> float:
    """Of the medians of one figure."""
    return median([getattr(run, key) for run in runs]) / median([getattr(run, key) for run in base])


def shown(runs: Sequence[Measured], key: str) -> str:
    """Median and range of one figure."""
    values = [getattr(run, key) for run in runs]
    return f"{median(values):.4g} {spread(values)}"


def versions() -> Iterator[str]:
    """Of everything that takes part."""
    yield f"Python {platform.python_version()}"
    for package in ("caneflow", "eclipse-zenoh", "dora-rs"):
        try:
            yield f"{package} {version(package)}"
        except PackageNotFoundError:
            yield f"no {package}"


def plain(found: Mapping[str, Found]) -> dict[str, dict[str, dict[str, list[dict[str, float]]]]]:
    """All figures, for JSON; what processes printed is of one machine, and stays there."""

    def figures(run: Measured) -> dict[str, float]:
        return {key: value for key, value in asdict(run).items() if key != "said"}

    return {
        part: {job: {name: [figures(run) for run in runs] for name, runs in by.items()} for job, by in jobs.items()}
        for part, jobs in found.items()
    }


if __name__ == "__main__":
    main()
