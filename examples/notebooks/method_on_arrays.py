"""
A method on arrays
==================

The algorithms take arrays and return arrays, so they can be tried without a flow. Here: the speed at which the ground
approaches the radar, from the scans of a simulated walk, in ten lines.
"""

# %%
# A walk of 8 s: IMU, radar and ground truth in one recording.
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.range_doppler import hann, range_doppler_map, speed_of_bin, speed_per_bin
from caneflow.recording import Recording

folder = Path(tempfile.mkdtemp())


def caneflow(*words: object) -> None:
    """The command, as in a terminal."""
    command = [sys.executable, "-m", "caneflow.command", *map(str, words)]
    print(subprocess.run(command, check=True, cwd=folder, capture_output=True, text=True).stdout, end="")


caneflow("simulate", "walk", "--seed", 1, "--duration", 8, "-o", "walk.mcap")

with Recording(folder / "walk.mcap") as recording:
    frames = recording.array("radar/frame")
    truth = recording.array("truth/pose")
scans, first = frames["scans"], frames[0]
print(scans.shape, "scans x range bins, every", first["scan_period"], "s")

# %%
# The scans are real; the method wants the analytic signal, whose phase turns by :math:`4\pi v T/\lambda` from scan to
# scan. What stands still relative to the radar (the antenna's own coupling) is the mean over a window, and goes.
to_analytic = AnalyticSignal(
    bins=scans.shape[1], range_step=first["range_step"], carrier=first["carrier"], bandwidth=first["bandwidth"]
)
signal = to_analytic(scans)
wavelength = 299_792_458 / first["carrier"]

WINDOW = 32  # scans
starts = range(0, len(signal) - WINDOW, 8)
speeds, times = [], []
for start in starts:
    window = signal[start : start + WINDOW] - signal[start : start + WINDOW].mean(axis=0)
    pair = np.vdot(window[:-1], window[1:])  # the pulse pair: the mean turn of the phase, weighted by power
    speeds.append(np.angle(pair) * wavelength / (4 * np.pi * first["scan_period"]))
    times.append((frames["stamp"][start + WINDOW // 2] - frames["stamp"][0]) * 1e-9)

# %%
# Beside it the walking speed of the ground truth. The radar looks down at the ground ahead, so what it sees is that
# speed times the cosine of the angle to the ground, and the swing of the cane: it is below the truth, and follows it.
# In the first second and a half nobody walks: without the mean only noise is left, whose angle is anything. A front
# end has to tell that from a speed, and say that it saw none.
walking = np.hypot(*truth["velocity"][:, :2].T)
since = (truth["stamp"] - truth["stamp"][0]) * 1e-9

figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
axes.plot(since, walking, color="#b0b0b0", linewidth=3, label="truth: speed of the cane")
axes.plot(times, speeds, color="#0072b2", label="pulse pair: radial speed")
axes.set(xlabel="s", ylabel="m/s")
axes.legend(frameon=False)

# %%
# The spectrum behind it: the range-Doppler map of 64 scans.
middle = len(signal) // 2
window = signal[middle : middle + 64] - signal[middle : middle + 64].mean(axis=0)
power = np.abs(range_doppler_map(np.ascontiguousarray(window.T), hann(64), 256)) ** 2
speed = speed_of_bin(np.arange(256), scan_period=first["scan_period"], carrier=first["carrier"], transform=256)
order = np.argsort(speed)
ranges = first["range_start"] + first["range_step"] * np.arange(scans.shape[1])

figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
decibels = 10 * np.log10(power[:, order] / power.max() + 1e-6)
picture = axes.pcolormesh(speed[order], ranges, decibels, vmin=-35, vmax=0, cmap="cividis", rasterized=True)
axes.set(xlabel="radial speed, m/s (approaching)", ylabel="range, m")
figure.colorbar(picture, label="dB")
print(f"one column is {speed_per_bin(scan_period=0.01, carrier=4.3e9, transform=256):.3f} m/s")

# %%
# The product's own front ends are ``caneflow.algorithms.radar.paper_speed`` (the paper's superior edge) and
# ``ground_velocity`` (pulse pairs per cell of range, with the attitude of the cane): the methods' pages have the
# equations.
