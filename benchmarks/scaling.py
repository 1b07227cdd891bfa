"""How caneflow's cost grows: with the rate, the nodes in a chain, the readers of a stream and the size of a frame.

One thing grows, all else is a chain of one relay with IMU samples at 100 Hz. Cost is the CPU time of all processes,
launcher included, for a sample and a hop; latency goes from the source's stamp to the (last) sink. Run it alone.

    python -m benchmarks.scaling --write docs/performance_scaling.md   # and .json, .png; about 4 minutes a repeat
"""

import argparse
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks import pages
from benchmarks.contenders import CANEFLOW, HERE
from benchmarks.measuring import Measured, measured, median, spread
from benchmarks.work import Job

SECONDS = 10  # that a source goes on: settling and measuring, and some
LOST = re.compile(r"(\d+) (?:lost|dropped|refused)")


@dataclass(frozen=True, kw_only=True)
class Point:
    """One graph and what goes through it."""

    x: float
    job: Job
    chain: int = 1  # relays, one behind the other
    fan: int = 1  # sinks of the last one

    @property
    def hops(self) -> int:
        """How often a sample crosses from one process to another."""
        return self.chain + self.fan

    def commands(self, job: Job) -> list[list[str]]:
        """What starts it."""
        file = Path(job.folder) / "scaling.yaml"
        file.write_text(flow(self.chain, self.fan))
        return [[*CANEFLOW, "run", str(file)]]


def imu(rate: float) -> Job:
    """IMU samples at `rate` (Hz)."""
    return Job(kind="imu", rate=rate, count=int(SECONDS * rate))


AXES: dict[str, tuple[str, list[Point]]] = {
    "rate": ("Hz", [Point(x=rate, job=imu(rate)) for rate in (10.0, 100.0, 500.0, 1000.0, 2000.0, 5000.0)]),
    "chain": ("relays", [Point(x=n, job=imu(100.0), chain=n) for n in (1, 2, 5, 10, 20)]),
    "fan-out": ("readers", [Point(x=n, job=imu(100.0), fan=n) for n in (1, 2, 5, 10, 20)]),
    "size": (
        "kB",
        [
            Point(x=kb, job=Job(kind="bytes", rate=20.0, count=20 * SECONDS, size=int(kb * 1000)))
            for kb in (1, 10, 100, 1000, 4000)
        ],
    ),
}
Found = dict[str, list[list[Measured]]]  # by axis; for each of its points the runs


def main() -> None:
    """Measure every point, again and again, and show medians with their spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axis", choices=list(AXES), help="one only")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each point (default: 3)")
    pages.add_options(parser)
    options = parser.parse_args()
    os.environ["PYTHONPATH"] = str(HERE.parent)  # of the nodes, which start elsewhere
    axes = {name: AXES[name] for name in ([options.axis] if options.axis else AXES)}
    found: Found = {name: [[] for _ in points] for name, (_, points) in axes.items()}
    picture = options.write and options.write.parent / "pictures" / f"{options.write.stem}.png"
    with pages.written_at_the_end(options, picture=picture) as paths:
        for _ in range(options.repeats):
            for name, (unit, points) in axes.items():
                for point, runs in zip(points, found[name], strict=True):
                    runs.append(measured(point.commands, point.job))
                    print(f"{point.x:g} {unit}: {figures(runs[-1], point)}", file=sys.stderr)
        print("\n".join(tables(found, options.repeats)))
        if paths is not None:
            paths[0].write_text("\n".join(tables(found, options.repeats)) + "\n")
            paths[1].write_text(json.dumps(plain(found), indent=1) + "\n")
            draw(found, paths[2])


def flow(chain: int, fan: int) -> str:
    """The graph: a source, a chain of relays, and sinks that all read the last one."""
    nodes = [f"  source: {{ run: {HERE}/caneflow_source.py }}"]
    before = "source"
    for number in range(chain):
        nodes.append(f"  relay_{number}: {{ run: {HERE}/caneflow_relay.py, inputs: {{ in: {before}/out }} }}")
        before = f"relay_{number}"
    nodes += [f"  sink_{n}: {{ run: {HERE}/caneflow_sink.py, inputs: {{ hop: {before}/out }} }}" for n in range(fan)]
    return "\n".join(("flow: scaling", "nodes:", *nodes, ""))


def figures(run: Measured, point: Point) -> dict[str, float]:
    """What is shown of a run; times in us."""
    lost = sum(int(number) for number in LOST.findall(run.said)) + round(run.lost * point.job.count)
    return {"cpu": run.cpu / point.hops, "p50": run.p50, "p99": run.p99, "lost": lost}


def tables(found: Mapping[str, Sequence[Sequence[Measured]]], repeats: int) -> Iterator[str]:
    """The page."""
    yield "<!-- made by `python -m benchmarks.scaling --write` -->"
    yield f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores, median of {repeats} runs [least..largest]."
    for name, by_point in found.items():
        unit, points = AXES[name]
        yield f"\n| {name} ({unit}) | CPU for a sample and hop, us | p50, us | p99, us | lost |"
        yield "|---|---|---|---|---|"
        for point, runs in zip(points, by_point, strict=True):
            shown = [figures(run, point) for run in runs]
            cells = [
                f"{median([each[key] for each in shown]):.4g} {spread([each[key] for each in shown])}"
                for key in ("cpu", "p50", "p99")
            ]
            yield f"| {point.x:g} | " + " | ".join(cells) + f" | {sum(each['lost'] for each in shown):g} |"


def plain(found: Mapping[str, Sequence[Sequence[Measured]]]) -> dict[str, list[dict[str, object]]]:
    """All figures, for JSON."""
    return {
        name: [
            {"x": point.x, "job": asdict(point.job), "runs": [figures(run, point) for run in runs]}
            for point, runs in zip(AXES[name][1], by_point, strict=True)
        ]
        for name, by_point in found.items()
    }


def draw(found: Mapping[str, Sequence[Sequence[Measured]]], path: Path) -> None:
    """One panel for each axis: cost and latency."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(found), figsize=(3.4 * len(found), 3.4), squeeze=False, layout="constrained")
    for panel, (name, by_point) in zip(panels[0], found.items(), strict=True):
        unit, points = AXES[name]
        for key, label, style in (
            ("cpu", "CPU, sample and hop", "o-"),
            ("p50", "latency p50", "s--"),
            ("p99", "latency p99", "^:"),
        ):
            values = [
                median([figures(run, point)[key] for run in runs]) for point, runs in zip(points, by_point, strict=True)
            ]
            panel.loglog([point.x for point in points], values, style, label=label)
        panel.set(xlabel=f"{name} ({unit})", ylabel="us" if panel is panels[0][0] else "")
        panel.grid(visible=True, which="both", alpha=0.25)
    panels[0][0].legend(fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
