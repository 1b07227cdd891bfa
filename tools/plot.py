"""`caneflow plot`: a recording as a picture: where one was, how fast, how far from the truth."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import numpy as np
import typer
from numpy.typing import NDArray

from caneflow.algorithms.judging.track_errors import START_NS, Track, boresight_yaws, track_errors
from caneflow.algorithms.radar.analytic_signal import AnalyticSignal
from caneflow.algorithms.radar.range_doppler import hann, range_doppler_map, speed_limit
from caneflow.algorithms.rotations import Vector
from caneflow.errors import CaneflowError
from caneflow.messages import GroundSpeed, Pose, RadarFrame
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.printable import printable
from caneflow.recording import TRUTH, Recording, RecordingError, Stream

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats: TypeAlias = NDArray[np.float64]
Panel: TypeAlias = Callable[["Axes"], None]

SUFFIXES = (".png", ".svg", ".pdf")
INK, FAINT = "#333333", "#b0b0b0"
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
)  # told apart by the colour-blind too (Okabe, Ito)
UNOBSERVED = 1e5  # m^2/s^2: a velocity with this variance was not measured (wire: 1e6)

MOST_TRACKS = 20  # more cannot be told apart

SLOW_TIME = 64  # scans of one spectrum: 0.64 s of a cane
SPECTRUM = 256  # lines of one spectrum
MOST_COLUMNS = 800  # spectra side by side: more than there are pixels
DYNAMIC_RANGE = 35.0  # dB


@dataclass
class Picture:
    """What there is to draw. Times in s since the first sample."""

    title: str
    origin: int  # ns
    boresight: Vector
    sensors: dict[str, tuple[float, float]]  # m, of a room; with them positions are absolute: nothing is aligned
    tracks: dict[str, Track] = field(default_factory=dict)  # by node/port and method
    truth: Track | None = None
    truth_speed: Floats | None = None  # (n,) m/s, along the boresight's projection; a room has no boresight
    speeds: dict[str, Floats] = field(default_factory=dict)  # by node/port: (n, 3) of time, speed, quality
    doppler: tuple[Floats, Floats, Floats] | None = None  # times (n,), radial speeds (m,), power (m, n) in dB

    def seconds(self, track: Track) -> Floats:
        """Times (s) of a track's poses."""
        since: Floats = (track.stamps - self.origin).astype(np.float64) * 1e-9
        return since

    def aligned(self, track: Track) -> Floats:
        """Positions (n, 2) m of a track laid on the truth: at its start and by its yaw there, as errors are."""
        if self.truth is None or self.sensors:
            return track.positions[:, :2]
        count = int(np.searchsorted(track.stamps, track.stamps[0] + START_NS))
        first = int(np.searchsorted(self.truth.stamps, track.stamps[0]))
        true_yaws = boresight_yaws(self.truth.orientations[first : first + count], self.boresight)
        yaws = boresight_yaws(track.orientations[: len(true_yaws)], self.boresight)
        turn = float(np.angle(np.mean(np.exp(1j * (true_yaws - yaws)))))
        x, y = (track.positions[:, :2] - track.positions[0, :2]).T
        turned = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y], axis=1)
        moved: Floats = turned + self.true_positions(track)[0]
        return moved

    def true_positions(self, track: Track) -> Floats:
        """Where the truth was (n, 2) m at the times of a track."""
        assert self.truth is not None
        at, times = self.seconds(track), self.seconds(self.truth)
        return np.stack([np.interp(at, times, self.truth.positions[:, axis]) for axis in (0, 1)], axis=1)

    def errors(self, track: Track) -> Floats:
        """Distance (n,) m to the truth."""
        difference = self.aligned(track) - self.true_positions(track)
        distance: Floats = np.hypot(difference[:, 0], difference[:, 1])
        return distance


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to draw.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help=f"{', '.join(SUFFIXES)} to write.")],
    overwrite: Overwrite = False,
) -> None:
    """Draw a recording's track against the truth, its speed, its error over time and the radar's Doppler.

    A track is laid on the truth at its start, by position and yaw only, and its errors are printed: the last one,
    the root mean square (ATE), and the paper's distance from end to start. A picture of the same format is replaced;
    any other file only with --overwrite.

    Example: caneflow plot track.mcap -o track.png
    """
    if output.suffix not in SUFFIXES:
        raise CaneflowError(f"{output}: a picture is one of {', '.join(SUFFIXES)}")
    form = output.suffix[1:]
    with whole(output, inputs=[recording], overwrite=overwrite, picture=form) as path:
        picture = read_picture(recording)
        draw(picture).savefig(path, dpi=150, format=form)
    for line in summary(picture):
        print(line)


def summary(picture: Picture) -> Iterator[str]:
    """A line per track: its errors against the truth, if there is one."""
    for name, track in picture.tracks.items():
        if picture.truth is None:
            yield f"{name}: {len(track.stamps)} poses; no ground truth to compare with"
        elif picture.sensors:
            errors = picture.errors(track)
            yield f"{name}: error mean {errors.mean():.2f} m, max {errors.max():.2f} m, final {errors[-1]:.2f} m"
        else:
            yield f"{name}: {_errors_of_a_walk(track, picture.truth, picture)}"


def _errors_of_a_walk(track: Track, truth: Track, picture: Picture) -> str:
    try:
        e = track_errors(track, truth, boresight=picture.boresight)
    except ValueError:  # only a part of the walk was run
        seconds = picture.seconds(track)
        return f"error {picture.errors(track)[-1]:.2f} m after {seconds[-1] - seconds[0]:.1f} s of the walk"
    drift = "" if e.drift_percent is None else f", drift {e.drift_percent:.1f} % of {e.length:.1f} m"
    return f"final error {e.final_error:.2f} m, ATE {e.ate:.2f} m, end to start {e.final_distance:.2f} m{drift}"


def read_picture(path: Path) -> Picture:
    """What there is to draw in the recording at `path`; raises RecordingError when nobody's position is in it."""
    with Recording(path) as recording:
        poses = [stream for stream in recording.streams_of(Pose) if stream.count > 1][:MOST_TRACKS]
        truth = recording.streams.get(TRUTH)
        truth = truth if truth and truth.count > 1 else None
        span = recording.span()
        if span is None or not (poses or truth):
            raise RecordingError(
                f"{path}: no track to draw, there are no poses in it; "
                f"`caneflow run dataflow.yaml --replay {path} --record track.mcap` makes some"
            )
        rig = recording.validated_rig()
        picture = Picture(
            title=f"{printable(path.name)}   {recording.flow}, {recording.metadata.get('source', '')}",
            origin=span[0],
            boresight=rig.boresight,
            sensors={printable(name): (each.position[0], each.position[1]) for name, each in rig.sensors.items()},
        )
        for stream in poses:
            track, _, method = _track(recording, stream)
            picture.tracks[f"{stream.node}/{stream.port} {printable(method)}"] = track
        if truth:
            picture.truth, velocities, _ = _track(recording, truth)
            picture.truth_speed = None if picture.sensors else _along_boresight(picture, velocities)
        for stream in recording.streams_of(GroundSpeed)[:MOST_TRACKS]:
            picture.speeds[f"{stream.node}/{stream.port}"] = _speeds(recording, stream, span[0])
        for stream in recording.streams_of(RadarFrame)[:1]:
            picture.doppler = _doppler(recording, stream, span[0])
    return picture


def _track(recording: Recording, stream: Stream) -> tuple[Track, Floats, str]:
    """The track, its velocities (n, 3) m/s in R0, and the method of its first pose."""
    poses = [cast(Pose, sample.decoded()) for sample in recording.samples([(stream.node, stream.port)])]
    track = Track(
        stamps=np.array([pose.stamp for pose in poses], dtype=np.int64),
        positions=np.array([pose.position for pose in poses], dtype=np.float64),
        orientations=np.array([pose.orientation for pose in poses], dtype=np.float64),
    )
    return track, np.array([pose.velocity for pose in poses], dtype=np.float64), poses[0].method


def _along_boresight(picture: Picture, velocities: Floats) -> Floats:
    """The component (n,) m/s of the true velocities that the radar can see."""
    assert picture.truth is not None
    yaw = boresight_yaws(picture.truth.orientations, picture.boresight)
    along: Floats = velocities[:, 0] * np.cos(yaw) + velocities[:, 1] * np.sin(yaw)
    return along


def _speeds(recording: Recording, stream: Stream, origin: int) -> Floats:
    """Rows of time, speed, quality, NaN where not valid; the time is that of the window's middle."""
    rows = []
    for sample in recording.samples([(stream.node, stream.port)]):
        speed = cast(GroundSpeed, sample.decoded())
        time = (speed.stamp - origin) * 1e-9 - (speed.delay or 0.0)
        rows.append((time, speed.speed, speed.quality) if speed.valid else (time, np.nan, np.nan))
    return np.array(rows, dtype=np.float64)


def _doppler(recording: Recording, stream: Stream, origin: int) -> tuple[Floats, Floats, Floats] | None:
    """Power over radial speed and time, all ranges together, without what stands still; None for too few scans."""
    window: deque[NDArray[Any]] = deque(maxlen=SLOW_TIME)
    times: list[float] = []
    columns: list[Floats] = []
    period, carrier = 0.0, 0.0
    every = max(SLOW_TIME // 8, stream.count // MOST_COLUMNS)
    for number, sample in enumerate(recording.samples([(stream.node, stream.port)])):
        frame = cast(RadarFrame, sample.decoded())
        if window and window[-1].shape != frame.scans[-1].shape:
            window.clear()
        window.extend(frame.scans)
        if number % every == 0 and len(window) == SLOW_TIME:
            times.append((frame.stamp - origin) * 1e-9 - 0.5 * SLOW_TIME * frame.scan_period)
            columns.append(_spectrum(np.array(window), frame))
            period, carrier = frame.scan_period, frame.carrier
    if not columns:
        return None
    limit = speed_limit(scan_period=period, carrier=carrier)
    power = 10.0 * np.log10(np.stack(columns, axis=1) + 1e-12)
    return np.array(times), np.linspace(-limit, limit, SPECTRUM, endpoint=False), power


def _spectrum(scans: NDArray[Any], frame: RadarFrame) -> Floats:
    """Power of `scans` (n, bins) over radial speed, shape (SPECTRUM,), from the lowest to the highest."""
    if not np.iscomplexobj(scans):
        signal = AnalyticSignal(
            bins=scans.shape[1], range_step=frame.range_step, carrier=frame.carrier, bandwidth=frame.bandwidth
        )
        scans = signal(scans)
    moving = (scans - scans.mean(axis=0)).T.astype(np.complex64)
    power = np.abs(range_doppler_map(moving, hann(len(scans)), SPECTRUM)) ** 2
    summed: Floats = np.fft.fftshift(power.sum(axis=0)).astype(np.float64)
    return summed


def draw(picture: Picture) -> "Figure":
    """The figure: the track on the left, time series on the right, as many as there are data for."""
    try:
        from matplotlib import rcParams
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise CaneflowError(f"no {error.name} here; `pip install 'caneflow[plot]'` brings it") from error

    rcParams["text.parse_math"] = False  # a name with a $ is a name
    panels = list(_panels(picture))
    figure = Figure(figsize=(14, 7.5), layout="constrained", facecolor="white")
    figure.suptitle(picture.title, x=0.01, ha="left", color=INK, fontsize=12)
    grid = figure.add_gridspec(max(len(panels), 1), 2, width_ratios=(1.1, 1 if panels else 1e-3))
    _draw_track(figure.add_subplot(grid[:, 0]), picture)
    first = None
    for row, panel in enumerate(panels):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        panel(axes)
        _plain(axes)
        axes.tick_params(labelbottom=row == len(panels) - 1)
        if row == len(panels) - 1:
            axes.set_xlabel("s")
    return figure


def _panels(picture: Picture) -> Iterator[Panel]:
    if picture.speeds or picture.truth_speed is not None:
        yield lambda axes: _draw_speeds(axes, picture)
    if picture.truth is not None and picture.tracks:
        yield lambda axes: _draw_errors(axes, picture)
    if picture.doppler is not None:
        yield lambda axes: _draw_doppler(axes, picture)


def _draw_track(axes: "Axes", picture: Picture) -> None:
    if picture.truth is not None:
        x, y = picture.truth.positions[:, :2].T
        axes.plot(x, y, color=FAINT, linewidth=4, solid_capstyle="round", label="truth")
        axes.plot(x[0], y[0], "o", color=INK, markersize=9, markerfacecolor="white", label="start", zorder=5)
    for (name, track), colour in zip(picture.tracks.items(), COLOURS * len(picture.tracks), strict=False):
        x, y = picture.aligned(track).T
        axes.plot(x, y, color=colour, linewidth=1.6, label=name)
        axes.plot(x[-1], y[-1], "s", color=colour, markersize=7, zorder=6)
        if picture.truth is not None:
            axes.plot(*zip((x[-1], y[-1]), picture.true_positions(track)[-1], strict=True), ":", color=colour)
    for name, (x, y) in picture.sensors.items():
        axes.plot(x, y, "^", color=INK, markersize=9)
        axes.annotate(f"  {name}", (x, y), color=INK, va="center")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x0, m")
    axes.set_ylabel("y0, m")
    axes.grid(color="#eeeeee")
    _plain(axes)
    axes.legend(loc="best", frameon=False, labelcolor=INK)
    text = "\n".join(line.replace(": ", "\n", 1) for line in summary(picture)) if picture.truth else ""
    axes.set_title(text, loc="left", fontsize=10, color=INK)


def _draw_speeds(axes: "Axes", picture: Picture) -> None:
    if picture.truth is not None and picture.truth_speed is not None:
        axes.plot(
            picture.seconds(picture.truth),
            picture.truth_speed,
            color=FAINT,
            linewidth=2,
            label="truth, along boresight",
        )
    for (name, rows), colour in zip(picture.speeds.items(), COLOURS * len(picture.speeds), strict=False):
        time, speed, quality = rows.T
        spread = np.where(np.isfinite(quality), quality, np.nan)
        axes.fill_between(time, speed - spread, speed + spread, color=colour, alpha=0.25, linewidth=0)
        axes.plot(time, speed, color=colour, linewidth=1, label=f"{name}, band: quality")
    axes.set_ylabel("speed, m/s")
    axes.grid(color="#eeeeee")
    axes.legend(loc="upper right", frameon=False, ncols=3, fontsize=9, labelcolor=INK)


def _draw_errors(axes: "Axes", picture: Picture) -> None:
    for track, colour in zip(picture.tracks.values(), COLOURS * len(picture.tracks), strict=False):
        axes.plot(picture.seconds(track), picture.errors(track), color=colour, linewidth=1.4)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("error, m")
    axes.grid(color="#eeeeee")


def _draw_doppler(axes: "Axes", picture: Picture) -> None:
    assert picture.doppler is not None
    times, speeds, power = picture.doppler
    relative = power - np.percentile(power, 99.8)  # the very loudest lines are few
    mesh = axes.pcolormesh(times, speeds, relative, cmap="magma", vmin=-DYNAMIC_RANGE, vmax=0, rasterized=True)
    axes.set_ylabel("Doppler, m/s (approaching)")
    axes.figure.colorbar(mesh, ax=axes, label="dB", pad=0.01)


def _plain(axes: "Axes") -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)
