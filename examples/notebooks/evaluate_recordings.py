"""
Evaluate your own recordings
============================

All methods on the same data, against the ground truth. Here the recordings are simulated; with your own, the first cell
is ``recordings = sorted(Path("my_walks").glob("*.mcap"))``. ``caneflow import`` makes recordings of the files you have.
"""

# %%
# Three walks of 15 s. A recording needs no ground truth to be run, but to be judged.
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from caneflow.evaluation import evaluate

folder = Path(tempfile.mkdtemp())


def caneflow(*words: object) -> None:
    """The command, as in a terminal."""
    command = [sys.executable, "-m", "caneflow.command", *map(str, words)]
    print(subprocess.run(command, check=True, cwd=folder, capture_output=True, text=True).stdout, end="")


caneflow("new", "flow", "cane")
for seed in (1, 2, 3):
    caneflow("simulate", "walk", "--seed", seed, "--duration", 15, "-o", f"walk_{seed}.mcap")
recordings = sorted(folder.glob("walk_*.mcap"))

# %%
# The flow says which programs run and how the cane is built (``rig``); the methods are those of its node ``fusion``.
methods = ["best", "luenberger", "kalman", "naive_ins"]
walks = evaluate(folder / "cane.yaml", recordings, methods)

print(f"{'':14}{'final error':>14}{'ATE':>10}")
for walk in walks:
    for method in methods:
        figures = walk.figures[method]
        print(f"{walk.recording.stem:8}{method:>12}{figures['final_error']:10.2f} m{figures['ate']:8.2f} m")

# %%
# The tracks of the first walk, each as the method has it: a cane knows only its own start.
first = walks[0]
assert first.truth is not None
figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
axes.plot(*first.truth.positions[:, :2].T, color="#b0b0b0", linewidth=4, label="truth")
for method, colour in zip(methods[:3], ("#0072b2", "#d55e00", "#009e73"), strict=True):
    axes.plot(*first.tracks[method].positions[:, :2].T, color=colour, label=method)
axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
axes.legend(frameon=False)

# %%
# Means over three walks say little: final errors differ by tens of centimetres from seed to seed. The results page has
# ten walks of each kind, with their spread.
for method in methods:
    errors = [walk.figures[method]["final_error"] or 0.0 for walk in walks]
    print(f"{method:12} {np.mean(errors):6.2f} m, {min(errors):.2f} to {max(errors):.2f}")
