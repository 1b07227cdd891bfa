"""`caneflow simulate`: a recording of a walk that nobody walked, with the truth beside it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from caneflow.messages import Imu, Pose, RadarFrame, Sample, numbered, sample_key
from caneflow.recording import TRUTH, RecordingWriter, require_writable
from caneflow.simulation.scenario import SCENARIOS, Walk, simulate_walk

FLOW = "cane"
IMU, RADAR = ("imu", "imu"), ("radar", "frame")


def walk(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    scenario: Annotated[str, typer.Option(metavar="NAME", help=f"One of {', '.join(SCENARIOS)}.")] = "swing",
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers: the same seed is the same walk.")] = 1,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.1, help="s; by default until the course has been walked (swing: 53 s)."),
    ] = None,
) -> None:
    """Simulate a walk with a white cane: IMU and radar at 100 Hz, and where the cane truly was.

    Example: caneflow simulate walk --scenario stops --seed 3 -o stops_3.mcap
    """
    if scenario not in SCENARIOS:
        raise typer.BadParameter(f"no walk {scenario!r}; there are {', '.join(SCENARIOS)}", param_hint="--scenario")
    require_writable(output)
    with progress_bar(f"{scenario}, seed {seed}") as progress:
        walked = simulate_walk(scenario, seed, duration, progress)
    with RecordingWriter(output, flow=FLOW, source="simulated", rig=dict(walked.rig)) as writer:
        for seq, samples in enumerate(samples_of(walked)):
            for name, sample in samples:
                payload, stamp = numbered(sample, seq), sample.stamp
                writer.write(sample_key(FLOW, *name), type(sample), payload, stamp=stamp, seq=seq, log_time=stamp)
    seconds = float(walked.stamps_ns[-1] - walked.stamps_ns[0]) / 1e9
    print(f"{output}: {scenario}, seed {seed}: {len(walked.stamps_ns)} samples a stream, {seconds:.2f} s")


def samples_of(walked: Walk) -> Iterator[tuple[tuple[tuple[str, str], Sample], ...]]:
    """At each instant what the IMU and the radar say, and the truth; by node and port."""
    imu = walked.imu
    for i, stamp in enumerate(walked.stamps_ns.tolist()):
        yield (
            (
                IMU,
                Imu(
                    stamp=stamp,
                    gyro=tuple(imu.gyro[i].tolist()),
                    accel=tuple(imu.accel[i].tolist()),
                    mag=tuple(imu.mag[i].tolist()),
                    orientation=tuple(imu.orientation[i].tolist()),
                    linear_accel=tuple(imu.linear_accel[i].tolist()),
                    calibration=tuple(imu.calibration[i].tolist()),
                ),
            ),
            (
                RADAR,
                RadarFrame(
                    stamp=stamp,
                    scans=walked.scans[i : i + 1],
                    scan_period=walked.scan_period,
                    range_start=walked.range_start,
                    range_step=walked.range_step,
                    carrier=walked.carrier,
                    bandwidth=walked.bandwidth,
                ),
            ),
            (
                TRUTH,
                Pose(
                    stamp=stamp,
                    position=tuple(walked.position[i].tolist()),
                    velocity=tuple(walked.velocity[i].tolist()),
                    orientation=tuple(walked.orientation[i].tolist()),
                    method="truth",
                ),
            ),
        )


@contextmanager
def progress_bar(text: str) -> Iterator[Callable[[float], None]]:
    """A function that is told the part done, 0..1; it draws a bar on a terminal and nothing elsewhere."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(text, total=1.0)
        yield lambda done: bar.update(task, completed=done)


commands = {"walk": walk}
