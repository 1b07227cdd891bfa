"""Canes side by side, live at 100 Hz: what reaches the recorder, how old each pose is there, what a cane costs.

Each cane is a flow of its own with five processes: a walk played as if its sensors were here, ground speed, fusion
and a recorder. Run it as `python -m benchmarks.canes WALK.mcap --canes 1 8`; prints one JSON object for each number.
"""

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.contenders import CANEFLOW, HERE
from benchmarks.measuring import cpu_ns
from caneflow.recording import Recording

WARM_UP = 6.0  # s: imports, and the radar's windows
FLOW = """
flow: cane_{number}
rig: {boresight: [0, 1, 0], hand_height: 0.95, aperture: 0.87, pivot: [0, -0.3, 0], step_length: 0.42}
nodes:
  walk: {run: {here}/walk_source.py, settings: {recording: {walk}}}
  ground_speed: {run: operators.ground_speed, inputs: {frame: walk/frame, imu: walk/imu}}
  fusion: {run: operators.fusion, inputs: {imu: walk/imu, speed: ground_speed/speed}, settings: {method: {method}}}
results: [fusion/pose]
"""


def main() -> None:
    """Run them, print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--canes", type=int, nargs="+", default=[1, 8], help="how many at once (default: 1, then 8)")
    parser.add_argument("--seconds", type=float, default=30.0, help="s that are measured")
    parser.add_argument("--method", default="best", help="of the fusion (default: best)")
    options = parser.parse_args()
    for canes in options.canes:
        with tempfile.TemporaryDirectory() as folder:
            text = graph(options.walk, options.method)
            print(json.dumps(measured(Path(folder), text, canes, options.seconds)))


def graph(walk: Path, method: str) -> str:
    """The file of a cane, whose number is still to be filled in."""
    return FLOW.replace("{method}", method).replace("{walk}", str(walk.resolve())).replace("{here}", str(HERE))


def measured(folder: Path, text: str, canes: int, seconds: float) -> dict[str, object]:
    """Losses, ages and cost of `canes` flows, of which `text` is the file."""
    with running(folder, text, canes) as launchers:
        time.sleep(WARM_UP)
        begin, before = time.time_ns(), cpu_ns(launchers)
        time.sleep(seconds)
        end, after = time.time_ns(), cpu_ns(launchers)
    said = "".join(path.read_text() for path in folder.glob("*.log"))
    ages, missing, poses = [], 0, 0
    for path in folder.glob("*.mcap"):
        with Recording(path) as recording:
            found = [(s.seq, s.stamp, s.log_time) for s in recording.samples([("fusion", "pose")])]
        seqs = [seq for seq, _, _ in found]
        missing += seqs[-1] - seqs[0] + 1 - len(set(seqs))
        poses += len(seqs)
        ages += [(taken - stamp) * 1e-6 for _, stamp, taken in found if begin < stamp < end]
    p50, p99, worst = np.percentile(ages, (50, 99, 100)).round(2)
    return {
        "canes": canes,
        "poses": poses,
        "poses_missing": missing,
        "losses_said": re.findall(r"\d+ (?:lost|dropped|refused|late)", said),
        "stamp_to_recorded_pose_ms": {"p50": p50, "p99": p99, "max": worst},
        "cpu_of_a_cane_percent": round((after - before) / (end - begin) / canes * 100, 1),
    }


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
        sys.exit(f"a flow ended by itself: {ends}")


if __name__ == "__main__":
    main()
