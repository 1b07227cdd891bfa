"""From the command to the first sample: the cane's graph with its recorder, five processes, on a walk.

Run it as `python benchmarks/start_up.py WALK.mcap`; prints one JSON object.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader

CANEFLOW = [sys.executable, "-m", "caneflow.command"]


def main() -> None:
    """Print the times (s), their median and extremes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("walk", type=Path)
    parser.add_argument("--dataflow", type=Path, default=Path(__file__).parents[1] / "dataflow.yaml")
    parser.add_argument("--runs", type=int, default=9)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        times = [start_up(options.dataflow, options.walk, Path(folder) / "out.mcap") for _ in range(options.runs)]
    print(json.dumps({"median": statistics.median(times), "min": min(times), "max": max(times), "runs": times}))


def start_up(dataflow: Path, walk: Path, out: Path) -> float:
    """S from the command to the moment at which the recorder wrote the first sample."""
    command = [*CANEFLOW, "run", str(dataflow), "--replay", str(walk), "--duration", "0.5"]
    command += ["--record", str(out), "--overwrite"]
    begun = time.time_ns()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with out.open("rb") as file:
        first = min(message.log_time for _, _, message in make_reader(file).iter_messages())
    return (first - begun) * 1e-9


if __name__ == "__main__":
    main()
