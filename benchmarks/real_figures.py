"""The figures of benchmarks.real: each recording imported by the command, run through a flow, and judged."""

import csv
import math
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from benchmarks.handheld_loop import recorded
from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.background import Background
from caneflow.algorithms.radar.range_doppler import bin_of_range, hann, range_doppler_map, speed_of_bin
from caneflow.evaluation import run_flow
from caneflow.messages import DopplerTarget, Imu, Pose, RadarFrame, numbered
from caneflow.physics import GRAVITY, SPEED_OF_LIGHT
from caneflow.recording import Recording, RecordingWriter
from caneflow.runtime.dataflow.loading import load

Floats: TypeAlias = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
IMU_FLOW = ROOT / "dataflows" / "imu.yaml"
DOPPLER_FLOW = """\
flow: room
nodes:
  south: { run: drivers.doppler_adc, settings: { channel: 0 } }
  line: { run: operators.doppler, inputs: { block: south/block } }
results: [line/target]
"""

# The rail: what comes with the recording, not fitted here.
REFLECTORS = ((2.204, 0.038, -3.874), (2.329, 0.040, 1.038))  # m, x y z of the optical frame, y up
CLOCK_SHIFT = 9.18  # s, optical time less radar time, both from their first sample
RANGE_BIAS = 0.46  # m, beyond the 10 ns of the antenna path
WINDOW, STRIDE, TRANSFORM = 32, 8, 512  # scans, scans, Doppler bins
MOVING = 0.1  # m/s of range rate
ASTRAY = 0.2  # m/s: a gate may hold something stronger than the reflector

TORSO = 0.6  # m/s, above which a walker's line is the torso
PLATEAU = (4.9, 5.5)  # m/s of the car that passes nearly along the beam
WALKED = (16.0, 5.0)  # s after its beginning and before its end, between which the hand-held sensor is carried
SOUNDS = (".wav", ".flac")


class Row(NamedTuple):
    """One figure, in words."""

    recording: str
    truth: str
    measured: str
    here: str
    published: str


def rail(source: Path, folder: Path) -> Sequence[Row]:
    """The P440 on a rail: Doppler of two reflectors against optical tracking, with the carrier of the import."""
    out = folder / "rail.mcap"
    caneflow("import", "p440", source / "scan_2105627.txt", "-o", out)
    frames = [cast(RadarFrame, sample) for sample in samples_of(out, "radar/frame")]
    measured, expected = reflector_rates(frames, source / "group6_trial_008.csv")
    errors = measured - expected
    near = np.abs(errors) < ASTRAY
    slope = float(measured[near] @ expected[near] / (expected[near] @ expected[near]))
    carrier = frames[0].carrier / 1e9
    name, truth = "P440 on a rail, 10 s", "optical tracking, two reflectors; clocks and range bias fitted by others"
    return (
        Row(name, truth, "scans imported", f"{len(frames)} of 607", "607 of 607 and one unfinished (data page)"),
        Row(
            name,
            truth,
            f"speed by Doppler over speed by optics, carrier as imported ({carrier:.3f} GHz)",
            f"{slope:.3f}",
            "0.955 by 4.3 GHz nominal, 1.006 by 4.05 GHz",
        ),
        Row(
            name,
            truth,
            f"range rate, {len(errors)} windows of {WINDOW} scans: median error, robust sigma",
            f"{100 * np.median(errors):+.1f} cm/s, {100 * spread(errors):.1f} cm/s",
            "0.9 cm/s, 3.1 cm/s (54 windows, 4.07 GHz)",
        ),
    )


def packet_loss(source: Path, folder: Path) -> Sequence[Row]:
    """The P440 over a link that loses packets: complete scans against the counts by others."""
    rows = []
    for name, there in (("test_scan711_1000.txt", "427 of 500"), ("test_scan2.txt", "100 of 100")):
        out = folder / f"{name}.mcap"
        said = caneflow("import", "p440", source / name, "-o", out)
        count = len(list(samples_of(out, "radar/frame")))
        wrong = "" if said.returncode == 0 else f", status {said.returncode}"
        rows.append(Row(f"P440, UDP, {name}", "counts of packets", "complete scans", f"{count}{wrong}", there))
    return rows


def doppler_modules(source: Path, folder: Path) -> Sequence[Row]:
    """24 GHz modules: the line of a walking person, and of a car beyond the walker's band."""
    walk = lines_of(source / "RadarHumanData_WalkingData.wav", folder)
    late = [target for target in walk[60:] if target.valid]
    torso = [target.range_rate for target in late if target.range_rate > TORSO]
    car = lines_of(source / "FirthRoad_20kmV1.wav", folder, "line.spectrum.highest=1600")
    plateau = [t.range_rate for t in car if t.valid and PLATEAU[0] < t.range_rate < PLATEAU[1]]
    shut = lines_of(source / "FirthRoad_20kmV1.wav", folder)
    fast = [target for target in shut if target.valid]
    nominal = "nominal speed only"
    return (
        Row(
            "24 GHz module, a person walking, 14.5 s",
            nominal,
            "valid frames after 3 s; of those the torso's; its median speed",
            f"{len(late)} of {len(walk) - 60}; {len(torso)}; {median(torso):.2f} m/s",
            "none; 1.0 to 1.3 m/s in its spectrogram, by eye",
        ),
        Row(
            "24 GHz module, a car",
            "20 km/h = 5.6 m/s nominal, less the angle",
            f"median of what lies in {PLATEAU[0]} to {PLATEAU[1]} m/s, band to 1600 Hz",
            f"{median(plateau):.2f} m/s in {len(plateau)} frames",
            "none",
        ),
        Row(
            "24 GHz module, a car",
            "beyond the walker's band (3.5 m/s) but for its first 2.4 s and while it passes, by its spectrogram",
            "frames called valid with the default band",
            f"{len(fast)} of {len(shut)}",
            "none",
        ),
    )


def foot(source: Path, folder: Path) -> Sequence[Row]:
    """The foot's walk that ends where it starts, by zero-velocity updates."""
    out, columns = folder / "foot.mcap", ["time=Time"]
    for axis in "xyz":
        columns += [f"gyro_{axis}=Gyroscope {axis.upper()}", f"accel_{axis}=Accelerometer {axis.upper()}"]
    caneflow("import", "imu-csv", source / "short_walk.csv", "-o", out, "--columns", ",".join(columns))
    name, truth = "IMU on a foot, closed walk of about 25 m", "ends where it starts"
    if "zero_velocity" not in methods(IMU_FLOW):
        missing = "not measured: fusion has no method zero_velocity"
        return (Row(name, truth, "distance from end to start", missing, "0.082 m"),)
    poses = [cast(Pose, p) for p in run_flow(IMU_FLOW, out, ["fusion.method=zero_velocity"])["fusion/pose"]]
    track = np.array([pose.position for pose in poses])
    end, length = track[-1] - track[0], float(np.linalg.norm(np.diff(track[::10], axis=0), axis=1).sum())
    here = f"{np.linalg.norm(end):.3f} m ({math.hypot(end[0], end[1]):.3f} m horizontal) after {length:.1f} m"
    return (Row(name, truth, "distance from end to start, zero-velocity updates", here, "0.082 m (Gait-Tracking)"),)


def attitude(source: Path, folder: Path) -> Sequence[Row]:
    """BROAD's trial by operators.attitude, and by vqf where that is installed: BROAD's own metric."""
    content = loadmat(source / "21_undisturbed_fast_combined.mat", squeeze_me=True)
    stamps = np.round(np.arange(len(content["imu_gyr"])) / content["sampling_rate"] * 1e9).astype(np.int64)
    gyro, accel, mag = (content[f"imu_{name}"] for name in ("gyr", "acc", "mag"))
    out = folder / "broad.mcap"
    write_imu(out, stamps, gyro, accel, mag)
    found = [cast(Imu, s) for s in run_flow(IMU_FLOW, out, streams=["attitude/imu"])["attitude/imu"]]
    estimates = np.array([sample.orientation or (np.nan,) * 4 for sample in found])
    moving, truth = content["movement"].astype(bool), content["opt_quat"]
    ours = orientation_errors(estimates, truth, moving)
    theirs = vqf_orientations(gyro, accel, mag, float(content["sampling_rate"]))
    others = "vqf not installed" if theirs is None else named_errors(orientation_errors(theirs, truth, moving))
    return (
        Row(
            "BROAD trial 21, hand-moved fast, 188 s",
            "optical orientation",
            "error, RMS over the moving samples: total, heading, inclination",
            named_errors(ours),
            f"vqf 2.1.2, offline from its first sample, on the same samples: {others}",
        ),
    )


def handheld(source: Path, folder: Path) -> Sequence[Row]:
    """The hand-held loop: where gravity is at the end, against where the accelerometer at rest says."""
    content = np.load(source / "handheld_loop.npz")
    out = folder / "handheld.mcap"
    write_imu(out, content["imu_stamp"], content["gyro"], content["accel"], None)
    found = [cast(Imu, s) for s in run_flow(IMU_FLOW, out, streams=["attitude/imu"])["attitude/imu"]]
    seconds = np.array([sample.stamp - found[0].stamp for sample in found]) * 1e-9
    walked = (seconds > WALKED[0]) & (seconds < seconds[-1] - WALKED[1])
    force = np.array([sample.accel or (np.nan,) * 3 for sample in found])
    world = rotated(np.array([sample.orientation or (np.nan,) * 4 for sample in found]), force)
    mean = world[walked].mean(axis=0)
    tilt = math.degrees(math.atan2(math.hypot(mean[0], mean[1]), mean[2]))
    loop = walked(*recorded(source / "handheld_loop.npz"), seed=0)
    return (
        Row(
            "TI IWR6843 and IMU in the hand, loop of 23 m",
            "begins and ends at one place",
            "points to velocity, along the gyro's heading, summed: end to start, horizontal; path",
            f"{loop.end_to_start:.2f} m; {loop.path:.1f} m",
            "none for this loop",
        ),
        Row(
            "IMU of a hand-held radar, walk of 23 m, 40 s",
            "no truth; a walk at even speed has no mean acceleration",
            "mean specific force over the walk, in the world: off the vertical, magnitude over gravity",
            f"{tilt:.2f} deg, {np.linalg.norm(mean) / GRAVITY:.4f}",
            "none",
        ),
    )


def water(source: Path, folder: Path) -> Sequence[Row]:
    """Water that flows away below an A121 at 45 degrees."""
    found = []
    for name in ("surface_velocity_1_dist", "surface_velocity_4_dist"):
        out = folder / f"{name}.mcap"
        caneflow("import", "a121", source / f"{name}.h5", "-o", out)
        with Recording(out) as recording:
            frames = [cast(RadarFrame, each.decoded()) for each in recording.samples([("radar", "frame")])]
        found.append(np.mean([_mean_speed(frame) for frame in frames]))
    return (
        Row(
            "A121 over flowing water, one and four ranges",
            "not known; 1.5 to 1.6 m/s away by an independent script",
            "mean radial speed of the frames (approaching is positive)",
            ", ".join(f"{each:.2f}" for each in found) + " m/s",
            "none",
        ),
    )


def _mean_speed(frame: RadarFrame) -> float:
    """Radial speed (m/s) of what moves in a frame, by the pulse pair over all its ranges."""
    moving = frame.scans - frame.scans.mean(axis=0)
    phase = float(np.angle((moving[1:] * moving[:-1].conj()).sum()))
    return phase * SPEED_OF_LIGHT / (4.0 * math.pi * frame.carrier * frame.scan_period)


def of_folder(mine: Path, folder: Path) -> Iterator[Row]:
    """What can be said of the files of a user's folder, of which no truth is known unless they hold it."""
    for number, path in enumerate(sorted(each for each in mine.iterdir() if each.is_file())):
        out = folder / f"{number}.mcap"
        truth, published = "not known", ""
        if path.suffix.lower() in SOUNDS:
            done = caneflow("import", "wav", path, "-o", out)
        elif path.suffix == ".mcap":
            out, done = path, caneflow("info", path)
        elif (columns := path.with_suffix(".columns")).is_file() and path != columns:
            done = caneflow("import", "imu-csv", path, "-o", out, "--columns", columns.read_text().strip())
        elif path.suffix != ".columns":
            done = caneflow("import", "p440", path, "-o", out)
        else:
            continue
        if not out.exists():
            yield Row(path.name, truth, "import", f"status {done.returncode}: {last_line(done)}", published)
            continue
        if path.suffix != ".mcap":
            yield Row(path.name, truth, "import", last_line(done).replace(f"{out}: ", ""), published)
        plotted = caneflow("plot", out, "-o", folder / f"{number}.png")
        yield Row(path.name, truth, "plot", last_line(plotted), published)


def caneflow(*arguments: object) -> "subprocess.CompletedProcess[str]":
    """Run the command, as a user does."""
    return subprocess.run(
        [*CANEFLOW, *map(str, arguments)], capture_output=True, text=True, check=False, cwd=ROOT, timeout=600
    )


def samples_of(path: Path, stream: str) -> Iterator[Any]:
    """The samples of a stream of a recording."""
    node, _, port = stream.partition("/")
    with Recording(path) as recording:
        for sample in recording.samples([(node, port)]):
            yield sample.decoded()


def write_imu(path: Path, stamps: NDArray[np.int64], gyro: Floats, accel: Floats, mag: Floats | None) -> None:
    """A recording of an IMU: stamps (n,) ns, vectors (n, 3) in SI units and uT."""
    with RecordingWriter(path, flow="imu", source="imported", rig={}) as writer:
        for seq, stamp in enumerate((stamps - stamps[0]).tolist()):
            field = None if mag is None else tuple(mag[seq].tolist())
            sample = Imu(stamp=stamp, gyro=tuple(gyro[seq].tolist()), accel=tuple(accel[seq].tolist()), mag=field)
            writer.write("imu/imu/imu", Imu, numbered(sample, seq), stamp=stamp, seq=seq, log_time=stamp)


def lines_of(sound: Path, folder: Path, *overrides: str) -> list[DopplerTarget]:
    """What operators.doppler says of a sound file."""
    flow, out = folder / "doppler.yaml", folder / f"{sound.stem}.mcap"
    flow.write_text(DOPPLER_FLOW)
    if not out.exists():
        caneflow("import", "wav", sound, "-o", out)
    return [cast(DopplerTarget, target) for target in run_flow(flow, out, overrides)["line/target"]]


def methods(flow: Path) -> tuple[str, ...]:
    """The methods that the flow's fusion offers."""
    program = load(flow).nodes["fusion"].program
    assert program is not None
    return get_args(get_type_hints(program.Settings)["method"])


def reflector_rates(frames: Sequence[RadarFrame], tracking: Path) -> tuple[Floats, Floats]:
    """Range rates (m/s, approaching) of the rail's reflectors by Doppler and by optics, a pair per moving window."""
    times = np.array([frame.stamp for frame in frames]) * 1e-9
    first = frames[0]
    analytic = AnalyticSignal(
        bins=first.scans.shape[1], range_step=first.range_step, carrier=first.carrier, bandwidth=first.bandwidth
    )
    returns = analytic(np.concatenate([frame.scans for frame in frames]))
    background = Background(0.5)
    for scan, elapsed in zip(returns, np.diff(times, prepend=times[0]), strict=True):
        background.remove(scan, elapsed)
    pairs = []
    for ranges in tracked_ranges(tracking, times):
        for start in range(0, len(times) - WINDOW, STRIDE):
            window = slice(start, start + WINDOW)
            approach = -float(np.polyfit(times[window], ranges[window], 1)[0])
            gate = int(bin_of_range(ranges[window].mean() + RANGE_BIAS, start=first.range_start, step=first.range_step))
            if abs(approach) >= MOVING and 0 <= gate < returns.shape[1]:
                spectrum = np.abs(range_doppler_map(returns[None, window, gate], hann(WINDOW), TRANSFORM))[0]
                period = float(np.ptp(times[window])) / (WINDOW - 1)
                rate = speed_of_bin(
                    int(spectrum.argmax()), scan_period=period, carrier=first.carrier, transform=TRANSFORM
                )
                pairs.append((float(rate), approach))
    measured, expected = np.array(pairs).T
    return measured, expected


def tracked_ranges(tracking: Path, times: Floats) -> Floats:
    """Optical ranges (2, n) m of the reflectors at radar times (n,) s."""
    with tracking.open(newline="") as file:
        rows = [row for row in csv.reader(file) if row and row[0].isdigit() and all(row[5:9])]
    optical = np.array([[float(row[1]), *map(float, row[6:9])] for row in rows])
    at = times - times[0] + CLOCK_SHIFT
    radar = np.stack([np.interp(at, optical[:, 0], optical[:, 1 + axis]) for axis in range(3)], axis=1)
    return np.stack([np.linalg.norm(radar - reflector, axis=1) for reflector in REFLECTORS])


def orientation_errors(estimates: Floats, truth: Floats, moving: NDArray[np.bool_]) -> tuple[float, float, float]:
    """BROAD's metric, RMS in degrees: total, heading, inclination of estimates (n, 4) against truth (n, 4)."""
    w, x, y, z = estimates.T
    a, b, c, d = truth.T
    error_w, error_z = a * w + b * x + c * y + d * z, a * z - d * w - c * x + b * y
    seen = moving & np.isfinite(error_w)
    norm = np.linalg.norm(truth[seen], axis=1)
    error_w, error_z = error_w[seen] / norm, error_z[seen] / norm

    def rms(angles: Floats) -> float:
        return math.degrees(math.sqrt(float(np.mean(np.square(angles)))))

    return (
        rms(2.0 * np.arccos(np.clip(np.abs(error_w), 0, 1))),
        rms(2.0 * np.arctan(error_z / error_w)),
        rms(2.0 * np.arccos(np.clip(np.hypot(error_w, error_z), 0, 1))),
    )


def vqf_orientations(gyro: Floats, accel: Floats, mag: Floats, rate: float) -> Floats | None:
    """The orientations (n, 4) by vqf of the extra `oracle`; None where that is not installed."""
    try:
        from vqf import VQF  # type: ignore[import-untyped]  # it has no types
    except ImportError:
        return None
    contiguous = (np.ascontiguousarray(each, dtype=np.float64) for each in (gyro, accel, mag))
    found: Floats = VQF(1.0 / rate).updateBatch(*contiguous)["quat9D"]
    return found


def named_errors(errors: tuple[float, float, float]) -> str:
    """Errors in degrees as words."""
    return ", ".join(f"{error:.2f}" for error in errors) + " deg"


def rotated(orientations: Floats, vectors: Floats) -> Floats:
    """Vectors (n, 3) of the body in the world, by orientations (n, 4), w x y z."""
    w, axis = orientations[:, :1], orientations[:, 1:]
    twice = 2.0 * np.cross(axis, vectors)
    turned: Floats = vectors + w * twice + np.cross(axis, twice)
    return turned


def spread(errors: Floats) -> float:
    """The standard deviation by the median of the absolute deviations."""
    return float(1.4826 * np.median(np.abs(errors - np.median(errors))))


def median(values: Iterable[float]) -> float:
    """The median; NaN for none."""
    known = list(values)
    return float(np.median(known)) if known else math.nan


def last_line(done: "subprocess.CompletedProcess[str]") -> str:
    """The last line that a command said."""
    lines = (done.stdout + done.stderr).strip().splitlines()
    return lines[-1] if lines else "nothing said"
