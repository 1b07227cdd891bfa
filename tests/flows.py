"""A cane that is spread over machines, a recording for it, and launchers to run it with: for several test files."""

import io
import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import psutil
import pytest

from caneflow import command, dispatch
from caneflow.messages import Imu, RadarFrame, numbered, sample_key
from caneflow.recording import Recording, RecordingWriter

BOTH_LINKS = pytest.mark.parametrize("links", ["unix", "tcp"])  # of the fixture `links`: how a file's nodes are linked
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
NODES = {
    "imu": "run: drivers.bno055",
    "radar": "run: drivers.p440",
    "ground_speed": "run: operators.ground_speed, inputs: {frame: radar/frame, imu: imu/imu}",
    "fusion": "run: operators.fusion, inputs: {imu: imu/imu, speed: ground_speed/speed}",
}
RIG = {"boresight": [0, 1, 0], "hand_height": 0.95, "aperture": 0.87, "pivot": [0, -0.3, 0]}


def spread_cane(flow: str, machines: str, places: Mapping[str, str], more: str = "") -> str:
    """The cane's dataflow.yaml; `places`: by node the machine that it runs on."""
    nodes = "\n".join(f"  {name}: {{{node}, machine: {places[name]}}}" for name, node in NODES.items())
    return f"flow: {flow}\n{more}machines:\n{machines}nodes:\n{nodes}\nresults: [fusion/pose]\n"


def write_walk(path: Path, samples: int = 400) -> Path:
    """A recording at 100 Hz of IMU samples and radar frames of noise: the graph runs on it, whatever it makes of it."""
    rng = np.random.default_rng(3)
    with RecordingWriter(path, flow="elsewhere", source="simulated", rig=RIG) as writer:
        for seq in range(samples):
            stamp = 1_000_000_000 + seq * 10_000_000
            gyro, accel = rng.normal(size=(2, 3)).tolist()
            imu = Imu(stamp=stamp, gyro=gyro, linear_accel=accel, orientation=(0.94, -0.342, 0.0, 0.0))
            frame = RadarFrame(
                stamp=stamp,
                scans=rng.integers(-999, 999, size=(1, 96), dtype=np.int32),
                scan_period=0.01,
                range_start=0.5,
                range_step=0.009149,
                carrier=4.3e9,
                bandwidth=1.7e9,
            )
            for node, port, message in (("imu", "imu", imu), ("radar", "frame", frame)):
                key = sample_key("elsewhere", node, port)
                writer.write(key, type(message), numbered(message, seq), stamp=stamp, seq=seq, log_time=stamp)
    return path


def node_processes(launcher: int) -> dict[str, psutil.Process]:
    """The processes of a run's nodes by name: each is called by its plan, which is in the run's own folder."""
    found = {}
    for process in psutil.process_iter():
        try:
            named = re.search(rf"-{launcher}/(\w+)\.json", " ".join(process.cmdline()))
            if named and process.status() != psutil.STATUS_ZOMBIE:
                found[named[1]] = process
        except psutil.Error:
            continue
    return found


def results(path: Path) -> dict[str, list[bytes]]:
    """The payloads of what operators published, by node/port."""
    with Recording(path) as recording:
        found: dict[str, list[bytes]] = {}
        for sample in recording.samples():
            if sample.node in ("ground_speed", "fusion"):
                found.setdefault(f"{sample.node}/{sample.port}", []).append(sample.payload)
        return found


def caneflow(*args: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """The command, as a program: whatever starts processes, or is started."""
    words = [*CANEFLOW, *map(str, args)]
    return subprocess.run(words, capture_output=True, text=True, timeout=180, check=False, cwd=cwd)


def caneflow_here(*args: object, cwd: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """What a `caneflow` says that starts no processes, run in this one: an interpreter's start and imports less.

    Where this process computes by other kernels than a program would (pytest without workers), it is a program.
    """
    if not _computes_as_a_program():
        return caneflow(*args, cwd=cwd)
    words = ["caneflow", *map(str, args)]
    out, err = io.StringIO(), io.StringIO()
    with (
        chdir(cwd or Path.cwd()),
        patch.object(sys, "argv", words),
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        command.main()
    return subprocess.CompletedProcess(words, int(end.value.code or 0), out.getvalue(), err.getvalue())


@cache
def _computes_as_a_program() -> bool:
    return {"numpy", "mathematics"} <= set(dispatch.pinned())


class Launched:
    """A `caneflow` that was started and goes on; its output is kept as it comes."""

    def __init__(self, log: Path, *args: object, inside: list[str] | None = None) -> None:
        """`inside`: a command that runs what follows it, e.g. on another host. States are kept beside the log."""
        self.log = log
        with log.open("a") as output:
            self.process = subprocess.Popen(
                [*(inside or []), *CANEFLOW, *map(str, args)],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "STATE_DIRECTORY": str(log.parent)},
            )

    @property
    def said(self) -> str:
        return self.log.read_text()

    def wait_for(self, text: str, deadline: float = 60.0) -> None:
        wait_for(lambda: text in self.said or self.process.poll() is not None, text, deadline)
        assert text in self.said, self.said

    def ends(self, deadline: float = 90.0) -> int:
        """The exit status, once it has ended."""
        return self.process.wait(timeout=deadline)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def launchers() -> Iterator[Callable[..., Launched]]:
    """Start launchers; whatever still runs at the end is ended."""
    started: list[Launched] = []

    def launch(*args: object, log: Path, inside: list[str] | None = None) -> Launched:
        started.append(Launched(log, *args, inside=inside))
        return started[-1]

    try:
        yield launch
    finally:
        for each in started:
            if each.process.poll() is None:
                each.process.send_signal(signal.SIGTERM)
        for each in started:
            try:
                each.process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                each.kill()


# Each worker of pytest has a thousand ports of its own; runs beside one another begin at different ones.
_ports = itertools.cycle(
    10_000 + 1000 * int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 20_000 + (os.getpid() + each) % 1000
    for each in range(1000)
)


def free_port(address: str = "127.0.0.1") -> int:
    """A port that nobody listens on, and that no other test or system hands out meanwhile: below the ephemeral ones."""
    while True:
        port = next(_ports)
        with socket.socket() as probe, suppress(OSError):
            probe.bind((address, port))
            return port


def wait_for(condition: Callable[[], object], what: str, deadline: float = 60.0) -> None:
    end = time.monotonic() + deadline
    while not condition():
        assert time.monotonic() < end, f"waited {deadline} s for {what}"
        time.sleep(0.05)


STRANGER = 65_534  # nobody's uid


def as_stranger(work: Callable[[], object]) -> str:
    """What `work` gives as another user of this computer, as text, or the name of what it raised; skips unless root."""
    if os.getuid() != 0:
        pytest.skip("only root can be another user for a moment")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(STRANGER)
            os.setuid(STRANGER)
            os.write(writing, str(work()).encode())
        except OSError as error:
            os.write(writing, type(error).__name__.encode())
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as said:
        text = said.read()
    os.waitpid(child, 0)
    return text
