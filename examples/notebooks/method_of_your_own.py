"""
A method of your own
====================

An operator in a file of yours takes the place of ``fusion``; the graph around it stays as it is. Then it is compared
with the shipped methods by the figures of the paper's Table I.
"""

# %%
# The method: the radar's speed along the boresight's heading, summed. No observer, no filter: what every estimator has
# to beat. It takes messages and yields messages, so it runs in every host, live and on recordings.
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

folder = Path(tempfile.mkdtemp())
METHOD = '''
"""in imu: Imu, in speed: GroundSpeed, out pose: Pose. Speed times heading, summed."""

import math

from caneflow.algorithms.rotations import rotate, yaw_of
from caneflow.messages import GroundSpeed, Imu, Pose
from caneflow.runtime import Operator, Refused


class SpeedAlongHeading(Operator):
    inputs = {"imu": Imu, "speed": GroundSpeed}
    outputs = {"pose": Pose}

    def __init__(self, settings, context):
        self._boresight = context.rig.boresight
        self._x = self._y = self._speed = 0.0
        self._last_ns = None

    def handle(self, port, message):
        if port == "speed":
            self._speed = message.speed if message.valid else 0.0
            return
        if message.orientation is None:
            raise Refused("the IMU sample has no orientation")
        heading = yaw_of(rotate(message.orientation, self._boresight))
        elapsed = 0.0 if self._last_ns is None else (message.stamp - self._last_ns) * 1e-9  # s
        self._last_ns = message.stamp
        velocity = (self._speed * math.cos(heading), self._speed * math.sin(heading), 0.0)
        self._x += elapsed * velocity[0]
        self._y += elapsed * velocity[1]
        yield "pose", Pose(
            stamp=message.stamp,
            position=(self._x, self._y, 0.0),
            velocity=velocity,
            orientation=message.orientation,
            method="speed along heading",
        )
'''
(folder / "along.py").write_text(METHOD)


# %%
# The shipped flow, with that file in the place of ``operators.fusion``; ``caneflow check`` reads it as a run would.
def caneflow(*words: object) -> None:
    """The command, as in a terminal."""
    command = [sys.executable, "-m", "caneflow.command", *map(str, words)]
    print(subprocess.run(command, check=True, cwd=folder, capture_output=True, text=True).stdout, end="")


caneflow("new", "flow", "cane")
flow = (folder / "cane.yaml").read_text()
begin = flow.index("    settings: { method: best }")
end = flow.index("\n", begin)
own = (flow[:begin] + flow[end + 1 :]).replace("run: operators.fusion", "run: ./along.py")
(folder / "own.yaml").write_text(own)
caneflow("check", "own.yaml")

# %%
# One walk of a closed loop, as in the paper: 53 s, 22 m. Every method on the same bytes.
from caneflow.algorithms.judging.track_errors import Track, track_errors
from caneflow.evaluation import evaluate, run_flow, table

caneflow("simulate", "walk", "--seed", 1, "-o", "walk.mcap")
walk = folder / "walk.mcap"
shipped = evaluate(folder / "cane.yaml", [walk], ["best", "luenberger", "naive_ins"])[0]
poses = table(run_flow(folder / "own.yaml", walk, streams=["fusion/pose"])["fusion/pose"])
track = Track(stamps=poses["stamp"], positions=poses["position"], orientations=poses["orientation"])
assert shipped.truth is not None
errors = track_errors(track, shipped.truth)

# %%
# Table I has the distance from the end to the start of a closed walk, and how fast it grows.
rows = {method: (figures["final_distance"], figures["growth_rate"]) for method, figures in shipped.figures.items()}
rows["your own"] = (errors.final_distance, errors.growth_rate)
print(f"{'method':14}{'end to start':>14}{'growth':>14}")
for method, (distance, growth) in sorted(rows.items(), key=lambda row: row[1]):
    print(f"{method:14}{distance:12.2f} m{growth:10.4f} m/s")

# %%
# The tracks as each method has them; the errors above are those after a track is laid on the truth at its start.
figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
axes.plot(*shipped.truth.positions[:, :2].T, color="#b0b0b0", linewidth=4, label="truth")
for name, each, colour in (("best", shipped.tracks["best"], "#0072b2"), ("your own", track, "#d55e00")):
    axes.plot(*each.positions[:, :2].T, color=colour, label=name)
axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
axes.legend(frameon=False)
