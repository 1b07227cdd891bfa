"""One run of a job: its processes are started, watched and ended; latency, CPU, rate and losses come out."""

import json
import math
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import psutil

from benchmarks.work import Job

DEADLINE = 90.0  # s for anything that is waited for
SETTLING = 3.0  # s from the start of the processes, that are not counted
MEASURED = 4.0  # s of CPU time that are


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What one run of one contender showed."""

    p50: float  # us from the source's stamp to the sink
    p99: float  # us
    cpu: float  # us per sample, of all processes together; nan when there is no rate
    rate: float  # samples per s that arrived
    lost: float  # share
    start_up: float  # s from the command to the first sample
    said: str = field(default="", repr=False)  # what the processes printed


def measured(commands_for: Callable[[Job], list[list[str]]], job: Job) -> Measured:
    """One run of what `commands_for` starts."""
    with tempfile.TemporaryDirectory(prefix="hop") as folder:
        job = replace(job, folder=folder)
        commands = commands_for(job)
        notes = Path(folder) / "notes.json"
        begun = time.time_ns()
        with running(commands, job) as parents:
            cpu = cpu_per_sample(parents, job, notes) if job.rate else math.nan
            wait_for(notes.exists, str(job))
        said_at_end = (Path(folder) / "log").read_text()
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
        said=said_at_end,
    )


@contextmanager
def running(commands: list[list[str]], job: Job) -> Iterator[list[int]]:
    """The processes while it runs; all ended, with their children, afterwards."""
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


def spread(values: Sequence[float]) -> str:
    """The range of a figure over runs."""
    return f"[{min(values):.4g}..{max(values):.4g}]"


def median(values: Sequence[float]) -> float:
    """Of a figure over runs."""
    return float(statistics.median(values))
