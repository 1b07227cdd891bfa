"""What every contender does: the samples that are sent, the relay's work on them, and what the sink notes down."""

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from caneflow.messages import Imu, RadarFrame, Sample, decode, numbered

VARIABLE = "CANEFLOW_HOP"  # environment variable that holds the Job as JSON
KINDS: dict[str, type[Sample]] = {"imu": Imu, "frame": RadarFrame, "block": RadarFrame, "bytes": RadarFrame}


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run: told to every process of it by the environment."""

    kind: str  # of KINDS
    rate: float  # Hz; 0: as fast as it goes, nothing dropped
    count: int  # samples
    wait: bool = True  # the source begins once someone listens
    size: int = 0  # bytes of a "bytes" sample
    folder: str = ""  # where the sink puts its notes, and sockets lie

    @staticmethod
    def told() -> "Job":
        """What this process was started for."""
        return Job(**json.loads(os.environ[VARIABLE]))

    def environment(self) -> dict[str, str]:
        """The environment for the processes of this run."""
        return {**os.environ, VARIABLE: json.dumps(asdict(self))}


def sample(job: Job, stamp: int) -> Sample:
    """A sample of the job's kind: an IMU's (about 200 bytes), a frame of 480 bins, a block of 64 such scans."""
    if job.kind == "imu":
        return Imu(
            stamp=stamp,
            gyro=(0.01, -0.02, 0.03),
            accel=(0.1, 9.7, 0.3),
            mag=(2e-5, 1e-5, -4e-5),
            orientation=(0.7, 0.1, 0.1, 0.7),
            linear_accel=(0.1, 0.2, 0.3),
        )
    shape = {"frame": (1, 480), "block": (64, 480), "bytes": (1, max(job.size // 4, 1))}[job.kind]
    return RadarFrame(
        stamp=stamp,
        scans=_scans(shape),
        scan_period=0.01,
        range_start=0.0,
        range_step=0.00915,
        carrier=4.3e9,
        bandwidth=2.2e9,
    )


def samples(job: Job) -> Iterator[Sample]:
    """The job's samples, each when it is due and stamped just then."""
    begin = time.perf_counter()
    for index in range(job.count):
        if job.rate:
            time.sleep(max(begin + index / job.rate - time.perf_counter(), 0.0))
        yield sample(job, time.time_ns())


def relayed(job: Job) -> Callable[[bytes], bytes]:
    """The relay's work: decoded with all checks, numbered again, encoded."""
    kind = KINDS[job.kind]

    def relay(payload: bytes) -> bytes:
        message = decode(payload, kind)
        return numbered(message, message.seq)

    return relay


@dataclass
class Notes:
    """What the sink saw; written once the last sample has come."""

    job: Job
    latencies: list[int] = field(default_factory=list)  # ns from stamp to arrival
    seqs: list[int] = field(default_factory=list)
    first: int = 0  # ns, arrival of the first sample
    last: int = 0

    def take(self, message: Sample) -> None:
        """Note down the arrival of a sample that was decoded."""
        now = time.time_ns()
        self.first = self.first or now
        self.last = now
        self.latencies.append(now - message.stamp)
        self.seqs.append(message.seq)
        if message.seq >= self.job.count - 1:
            self.write()

    def write(self) -> None:
        """Put the notes where the benchmark waits for them."""
        path = Path(self.job.folder) / "notes.json"
        fresh = path.with_suffix(f".{os.getpid()}")  # several sinks may write theirs
        said = {"latencies": self.latencies, "seqs": self.seqs, "first": self.first, "last": self.last}
        fresh.write_text(json.dumps(said))
        fresh.replace(path)


def _scans(shape: tuple[int, int]) -> np.ndarray:
    if shape not in _MADE:
        _MADE[shape] = np.random.default_rng(1).standard_normal(shape).astype(np.float32)
    return _MADE[shape]


_MADE: dict[tuple[int, int], np.ndarray] = {}
