"""What replays cost in two checkouts: processor time, alternated run by run, the least of many.

    python -m benchmarks.replay_cost BEFORE RECORDING [--method best] [--repeats 9]

BEFORE is another checkout with an environment of its own in .venv (`git worktree add`). A replay as fast as it goes, by
a process per node and in one process; user and system time of the command and of all that it starts. The
least of the runs is what the code costs; what is beyond it is the machine's.
"""

import argparse
import json
import os
import statistics
import subprocess
from pathlib import Path

HERE = Path(__file__).parents[1]
HOSTS = {"processes": ["--speed", "max"], "in_process": ["--in-process"]}


def main() -> None:
    """Print a JSON object for each host: seconds of processor time before and after, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--method", default="best")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--hosts", nargs="+", choices=HOSTS, default=list(HOSTS))
    options = parser.parse_args()
    trees = {"before": options.before.resolve(), "after": HERE}
    for host in options.hosts:
        costs: dict[str, list[float]] = {name: [] for name in trees}
        for _ in range(options.repeats):
            for name, tree in trees.items():
                costs[name].append(cost(tree, options.recording.resolve(), options.method, host))
        least = {name: min(each) for name, each in costs.items()}
        spread = {name: (min(each), statistics.median(each), max(each)) for name, each in costs.items()}
        figures = {"ratio": least["after"] / least["before"], "least_median_most": spread}
        print(json.dumps({host: figures}), flush=True)


def cost(tree: Path, recording: Path, method: str, host: str) -> float:
    """S of processor time of one replay in a checkout."""
    command = [str(tree / ".venv/bin/python"), "-m", "caneflow.command", "run", str(tree / "dataflow.yaml")]
    command += ["--replay", str(recording), "--set", f"fusion.method={method}", *HOSTS[host]]
    begun = os.times()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    ended = os.times()
    return ended.children_user + ended.children_system - begun.children_user - begun.children_system


if __name__ == "__main__":
    main()
