"""Canes side by side, live at 100 Hz: what reaches the recorder, how old each pose is there, what a cane costs.

Each cane is a flow of its own: the IMU and the radar of a walk played as if they were here, ground speed, fusion and a
recorder, as five processes, as a group beside its recorder, or as one group with its recorder, in turn. Run it as
`python -m benchmarks.canes WALK.mcap --canes 1 4 --rounds 3`; prints one JSON object for each run, then the ratios.
"""

import argparse
import json
import math
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.contenders import CANEFLOW, HERE
from benchmarks.measuring import cpu_ns, family
from caneflow.recording import Recording

READY_PATIENCE = 60.0  # s
LAYOUTS = {  # what a cane's nodes share
    "five processes": "",
    "group, recorder": ", process: cane",
    "group with recorder": ", process: recorder",
}
SERVERS = ("caneflow.runtime.hosts.launcher.fork_server",)  # no nodes
WARM_UP = 6.0  # s: imports, and the radar's windows
FLOW = """
flow: cane_{number}
rig: {boresight: [0, 1, 0], hand_height: 0.95, aperture: 0.87, pivot: [0, -0.3, 0], step_length: 0.42}
nodes:
  imu: {run: {here}/walk_source.py, settings: {recording: {walk}, plays: imu}{process}}
  radar: {run: {here}/walk_source.py, settings: {recording: {walk}, plays: frame}{process}}
  ground_speed: {run: operators.ground_speed, inputs: {frame: radar/frame, imu: imu/imu}{process}}
  fusion:
    {run: operators.fusion, inputs: {imu: imu/imu, speed: ground_speed/speed}, settings: {method: {method}}{process}}
results: [fusion/pose]
"""


class EndedByItselfError(Exception):
    """A flow did not come up, or did not go on: nothing was measured."""


def main() -> None:
    """Run them, print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--canes", type=int, nargs="+", default=[1, 8], help="how many at once (default: 1, then 8)")
    parser.add_argument("--rounds", type=int, default=1, help="in each of which all layouts are measured (default: 1)")
    parser.add_argument("--seconds", type=float, default=30.0, help="s that are measured")
    parser.add_argument("--method", default="best", help="of the fusion (default: best)")
    options = parser.parse_args()
    for canes in options.canes:
        runs: dict[str, list[dict[str, Any]]] = {layout: [] for layout in LAYOUTS}
        for _ in range(options.rounds):
            for layout, found in runs.items():
                with tempfile.TemporaryDirectory() as folder:
                    text = graph(options.walk, options.method, layout)
                    found.append({"layout": layout, **measured(Path(folder), text, canes, options.seconds)})
                print(json.dumps(found[-1]), flush=True)
        for layout in list(LAYOUTS)[1:]:
            print(json.dumps({"canes": canes, "layout": layout, **ratios(runs[layout], runs["five processes"])}))


def ratios(runs: Sequence[dict[str, Any]], base: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """What a cane costs, of what it costs as five processes, round by round."""
    return {
        key: [round(ours[key] / theirs[key], 3) for ours, theirs in zip(runs, base, strict=True)]
        for key in ("cpu_of_a_cane_percent", "memory_of_a_cane_mb")
    }


def graph(walk: Path, method: str, layout: str = "five processes") -> str:
    """The file of a cane, whose number is still to be filled in."""
    filled = {"{method}": method, "{walk}": str(walk.resolve()), "{here}": str(HERE), "{process}": LAYOUTS[layout]}
    text = FLOW
    for gap, value in filled.items():
        text = text.replace(gap, value)
    return text


def measured(folder: Path, text: str, canes: int, seconds: float) -> dict[str, object]:
    """Losses, ages and cost of `canes` flows, of which `text` is the file."""
    with running(folder, text, canes) as launchers:
        wait_until_ready(folder, canes)
        time.sleep(WARM_UP)
        nodes = [pid for launcher in launchers for pid in nodes_of(launcher)]
        begin, before = time.time_ns(), cpu_ns(nodes)
        time.sleep(seconds)
        end, after = time.time_ns(), cpu_ns(nodes)
        memory = sum(map(memory_bytes, nodes))
    said = "".join(path.read_text() for path in folder.glob("*.log"))
    ages, missing, poses = [], 0, 0
    for path in folder.glob("*.mcap"):
        with Recording(path) as recording:
            found = [(s.seq, s.stamp, s.log_time) for s in recording.samples([("fusion", "pose")])]
        seqs = [seq for seq, _, _ in found]
        missing += seqs[-1] - seqs[0] + 1 - len(set(seqs)) if seqs else 1
        poses += len(seqs)
        ages += [(taken - stamp) * 1e-6 for _, stamp, taken in found if begin < stamp < end]
    p50, p99, worst = np.percentile(ages or [math.inf], (50, 99, 100)).round(2)
    return {
        "canes": canes,
        "poses": poses,
        "poses_missing": missing,
        "losses_said": re.findall(r"\d+ (?:lost|dropped|refused|late)", said),
        "stamp_to_recorded_pose_ms": {"p50": p50, "p99": p99, "max": worst},
        "cpu_of_a_cane_percent": round((after - before) / (end - begin) / canes * 100, 1),
        "memory_of_a_cane_mb": round(memory / canes / 1e6, 1),
    }


def wait_until_ready(folder: Path, canes: int) -> None:
    """Wait until all nodes of all canes are there: on a full machine that takes longer than the warm-up."""
    deadline = time.monotonic() + READY_PATIENCE
    while sum("ready: " in path.read_text() for path in folder.glob("*.log")) < canes:
        if time.monotonic() > deadline:
            raise EndedByItselfError(f"not ready after {READY_PATIENCE:g} s")
        time.sleep(0.1)


def nodes_of(launcher: int) -> list[int]:
    """The processes of a launcher's nodes."""
    return [each.pid for each in family(launcher)[1:] if not set(SERVERS) & set(each.cmdline())]


def memory_bytes(pid: int) -> int:
    """What a process takes, its part of what it shares: PSS."""
    found = re.search(r"^Pss: +(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
    return 1024 * int(found[1]) if found else 0


@contextmanager
def running(folder: Path, text: str, canes: int) -> Iterator[list[int]]:
    """The launchers' pids, while the flows run; ended in order afterwards."""
    started = []
    try:
        for number in range(canes):
            file = folder / f"cane_{number}.yaml"
            file.write_text(text.replace("{number}", str(number)))
            log = file.with_suffix(".log").open("w")
            command = [*CANEFLOW, "run", str(file), "--record", str(file.with_suffix(".mcap"))]
            started.append(subprocess.Popen(command, stdout=log, stderr=log))
        yield [each.pid for each in started]
    finally:
        for each in started:
            each.send_signal(signal.SIGINT)
        ends = {each.wait(60) for each in started}
    if ends != {130}:
        raise EndedByItselfError(f"a flow ended by itself: {ends}")


if __name__ == "__main__":
    main()
