"""A hop beside its peers: caneflow, raw Zenoh, dora and a Unix socket do the same work in turn, on one machine.

source -> relay -> sink, three processes; the relay decodes, numbers and encodes. Ratios to raw Zenoh come first: a
machine is as fast as it happens to be, contenders in one run meet the same machine. Run it alone.

    python -m benchmarks.peers --write docs/performance_peers.md   # all; about 15 minutes
    python -m benchmarks.peers --part hop --repeats 1
"""

import argparse
import json
import math
import os
import platform
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

from benchmarks.contenders import CONTENDERS, DORA, HERE
from benchmarks.work import Job

DEADLINE = 90.0  # s for anything that is waited for
SETTLING = 3.0  # s from the start of a contender's processes, that are not counted
MEASURED = 4.0  # s of CPU time that are
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
RATIOS = {"hop": ("p50", "cpu"), "drain": ("rate",), "start": ("start_up",)}


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What one run of one contender showed."""

    p50: float  # us from the source's stamp to the sink
    p99: float  # us
    cpu: float  # us per sample, of all processes together; nan when there is no rate
    rate: float  # samples per s that arrived
    lost: float  # share
    start_up: float  # s from the command to the first sample


def main() -> None:
    """Measure all contenders in turn, again and again, and show medians with their spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=list(PARTS), help="one part only")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each contender (default: 5)")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the tables there, and all figures beside it")
    options = parser.parse_args()
    contenders = [name for name in CONTENDERS if name != "dora" or DORA.exists()]
    if "dora" not in contenders:
        print("dora is not installed (pip install 'caneflow[peers]') and left out", file=sys.stderr)
    os.environ["PYTHONPATH"] = str(HERE.parent)  # of the contenders' processes, which start elsewhere
    found = {}
    for part in [options.part] if options.part else PARTS:
        able = [name for name in contenders if part != "drain" or name != "dora"]
        found[part] = rounds(PARTS[part], able, options.repeats)
    page = "\n".join(written(found, options.repeats))
    print(page)
    if options.write:
        options.write.write_text(page + "\n")
        options.write.with_suffix(".json").write_text(json.dumps(plain(found), indent=1) + "\n")


Found = dict[str, dict[str, list[Measured]]]  # by job and contender


def rounds(jobs: Mapping[str, Job], contenders: Sequence[str], repeats: int) -> Found:
    """Every contender in every job, one after the other, `repeats` times over."""
    found: Found = {job: {name: [] for name in contenders} for job in jobs}
    for _ in range(repeats):
        for title, job in jobs.items():
            for name in contenders:
                found[title][name].append(measured(name, job))
                print(f"{title}: {name}: {found[title][name][-1]}", file=sys.stderr)
    return found


def measured(name: str, job: Job) -> Measured:
    """One run of one contender."""
    with tempfile.TemporaryDirectory(prefix="hop") as folder:
        job = replace(job, folder=folder)
        commands = CONTENDERS[name](job)
        notes = Path(folder) / "notes.json"
        begun = time.time_ns()
        with running(commands, job) as parents:
            cpu = cpu_per_sample(parents, job, notes) if job.rate else math.nan
            wait_for(notes.exists, f"{name}, {job}")
        said = json.loads(notes.read_text())
    latencies = sorted(said["latencies"][int(job.rate) :])  # without the first second
    seconds = (said["last"] - said["first"]) * 1e-9
    return Measured(
        p50=latencies[len(latencies) // 2] * 1e-3,
        p99=latencies[int(len(latencies) * 0.99)] * 1e-3,
        cpu=cpu,
        rate=(len(said["seqs"]) - 1) / seconds,
        lost=1.0 - len(set(said["seqs"])) / job.count,
        start_up=(said["first"] - begun) * 1e-9,
    )


@contextmanager
def running(commands: list[list[str]], job: Job) -> Iterator[list[int]]:
    """The contender's processes while it runs; all ended, with their children, afterwards."""
    with (Path(job.folder) / "log").open("w") as log:
        started = [
            subprocess.Popen(each, env=job.environment(), cwd=job.folder, stdout=log, stderr=log) for each in commands
        ]
        try:
            yield [each.pid for each in started]
        finally:
            everybody = [process for each in started for process in family(each.pid)]
            for each in started:
                each.send_signal(signal.SIGINT)
            for process in psutil.wait_procs(everybody, timeout=3)[1]:
                process.kill()
            for each in started:
                each.wait()


def family(pid: int) -> list[psutil.Process]:
    """A process and all that it started."""
    try:
        parent = psutil.Process(pid)
        return [parent, *parent.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def cpu_per_sample(parents: Sequence[int], job: Job, notes: Path) -> float:
    """CPU time (us) of all processes per sample, over the steady part of a run."""
    time.sleep(SETTLING)
    before, begin = cpu_ns(parents), time.perf_counter()
    time.sleep(MEASURED)
    spent, seconds = cpu_ns(parents) - before, time.perf_counter() - begin
    if notes.exists():
        sys.exit(f"{job} ended before it was measured: its count is too small")
    return spent * 1e-3 / (seconds * job.rate)


def cpu_ns(parents: Sequence[int]) -> int:
    """CPU time of the parents and all that they started, to the nanosecond."""
    total = 0
    for process in {each.pid for parent in parents for each in family(parent)}:
        for task in Path(f"/proc/{process}/task").glob("*/schedstat"):
            total += int(task.read_text().split()[0])
    return total


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Return once `condition` holds; the benchmark ends if it never does."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"waited {DEADLINE:g} s in vain: {what}")
        time.sleep(0.02)


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
                yield f"| {job} | {name} | " + " | ".join([*ratios, *(spread(runs, key) for key in keys)]) + " |"


def ratio(runs: Sequence[Measured], base: Sequence[Measured], key: str) -> float:
    """Of the medians of one figure."""
    return median(runs, key) / median(base, key)


def spread(runs: Sequence[Measured], key: str) -> str:
    """Median and range of one figure."""
    values = [getattr(run, key) for run in runs]
    return f"{median(runs, key):.4g} [{min(values):.4g}..{max(values):.4g}]"


def median(runs: Sequence[Measured], key: str) -> float:
    """Of one figure over the runs."""
    return float(statistics.median(getattr(run, key) for run in runs))


def versions() -> Iterator[str]:
    """Of everything that takes part."""
    yield f"Python {platform.python_version()}"
    for package in ("caneflow", "eclipse-zenoh", "dora-rs"):
        try:
            yield f"{package} {version(package)}"
        except PackageNotFoundError:
            yield f"no {package}"


def plain(found: Mapping[str, Found]) -> dict[str, dict[str, dict[str, list[dict[str, float]]]]]:
    """All figures, for JSON."""
    return {
        part: {job: {name: [asdict(run) for run in runs] for name, runs in by.items()} for job, by in jobs.items()}
        for part, jobs in found.items()
    }


if __name__ == "__main__":
    main()
