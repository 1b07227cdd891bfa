"""`caneflow plot`: a recording as a picture: the track, its speed and errors, or what a single sensor shows."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias, cast

import numpy as np
import typer
from numpy.typing import NDArray

from caneflow.algorithms.judging.track_errors import START_NS, Track, boresight_yaws, track_errors
from caneflow.algorithms.rotations import Vector
from caneflow.errors import CaneflowError, not_installed
from caneflow.messages import DopplerBlock, Grid, GroundSpeed, Imu, Pose, RadarFrame
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.printable import printable
from caneflow.recording import TRUTH, Recording, RecordingError, Stream
from caneflow.viewing.sensor_pictures import (
    DopplerPicture,
    ImuPicture,
    RadarPictures,
    doppler_picture,
    imu_picture,
    radar_pictures,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats: TypeAlias = NDArray[np.float64]
Panel: TypeAlias = Callable[["Axes"], None]

SUFFIXES = (".png", ".svg", ".pdf")
INK, FAINT = "#333333", "#b0b0b0"
BRIGHT = "#40ffd0"  # on a dark picture
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
)  # told apart by the colour-blind too (Okabe, Ito)
UNOBSERVED = 1e5  # m^2/s^2: a velocity with this variance was not measured (wire: 1e6)

MOST_TRACKS = 20  # more cannot be told apart

MOST_MODULES = 4  # Doppler modules below each other
DYNAMIC_RANGE = 35.0  # dB
LIKELY = 1.25  # nat, from which a cell of a grid counts as occupied: two hits
MOST_CELLS = 200_000
DOPPLER = "Doppler, m/s (approaching)"


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
    radar: RadarPictures | None = None
    modules: dict[str, DopplerPicture] = field(default_factory=dict)  # by node/port
    imu: ImuPicture | None = None  # only where nothing else is
    occupied: Floats | None = (
        None  # (n, 2) m: cells in which a grid of the recording has something, in its poses' frame
    )
    floor_missing: Floats | None = None  # (n, 2) m likewise

    def seconds(self, track: Track) -> Floats:
        """Times (s) of a track's poses."""
        since: Floats = (track.stamps - self.origin).astype(np.float64) * 1e-9
        return since

    def aligned(self, track: Track) -> Floats:
        """Positions (n, 2) m of a track laid on the truth: at its start and by its yaw there, as errors are."""
        return self.laid(track.positions[:, :2], track)

    def laid(self, points: Floats, track: Track) -> Floats:
        """Points (n, 2) m in the frame of a track, moved as the track is."""
        if self.truth is None or self.sensors:
            return points
        count = int(np.searchsorted(track.stamps, track.stamps[0] + START_NS))
        first = int(np.searchsorted(self.truth.stamps, track.stamps[0]))
        true_yaws = boresight_yaws(self.truth.orientations[first : first + count], self.boresight)
        yaws = boresight_yaws(track.orientations[: len(true_yaws)], self.boresight)
        turn = float(np.angle(np.mean(np.exp(1j * (true_yaws - yaws)))))
        x, y = (points - track.positions[0, :2]).T
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

    Of a recording without positions it draws what its sensors show: a radar's ranges and speeds over time, a Doppler
    module's spectrum with the line in it, an IMU's readings with the attitude.

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
        for line in (*summary(picture), *shown(picture)):
            print(line, flush=True)  # to draw takes a few seconds more
        draw(picture).savefig(path, dpi=150, format=form)


def shown(picture: Picture) -> Iterator[str]:
    """A line per sensor that is drawn because there are no positions."""
    if picture.tracks or picture.truth:
        return
    if radar := picture.radar:
        yield f"radar: {radar.ranges[0]:.1f} to {radar.ranges[-1]:.1f} m, +-{-radar.speeds[0]:.2f} m/s"
    for name, module in picture.modules.items():
        known = module.line[np.isfinite(module.line)]
        speeds = f", median {np.median(np.abs(known)):.2f} m/s" if len(known) else ""
        yield f"{name}: a line in {len(known)} of {len(module.line)} spectra{speeds}"
    if imu := picture.imu:
        rate = (len(imu.times) - 1) / (imu.times[-1] - imu.times[0])
        yield f"imu: {len(imu.times)} samples, {rate:.1f} Hz" + (f"; {imu.source}" if imu.attitude is not None else "")


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
    """What there is to draw in the recording at `path`; raises RecordingError when there is nothing."""
    with Recording(path) as recording:
        poses = _by_name(stream for stream in recording.streams_of(Pose) if stream.count > 1)
        truth = recording.streams.get(TRUTH)
        truth = truth if truth and truth.count > 1 else None
        span = recording.span()
        if span is None:
            raise RecordingError(f"{path}: nothing to draw, it holds no sample")
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
        for stream in _by_name(recording.streams_of(GroundSpeed)):
            picture.speeds[f"{stream.node}/{stream.port}"] = _speeds(recording, stream, span[0])
        for stream in recording.streams_of(Grid)[:1] if poses else ():
            picture.occupied, picture.floor_missing = _grid_cells(recording, stream)
        for stream in recording.streams_of(RadarFrame)[:1]:
            picture.radar = _radar(recording, stream, span[0])
        if not (poses or truth):
            _add_single_sensors(picture, recording)
    if not (poses or truth or picture.radar or picture.modules or picture.imu or picture.speeds):
        raise RecordingError(
            f"{path}: nothing to draw; expected 2 poses or IMU samples, 8 radar scans, or 0.3 s of a Doppler module"
        )
    return picture


def _by_name(streams: Iterable[Stream]) -> list[Stream]:
    """As many as can be told apart, each always in the same colour, whichever sample was recorded first."""
    return sorted(streams, key=lambda stream: (stream.node, stream.port))[:MOST_TRACKS]


def _add_single_sensors(picture: Picture, recording: Recording) -> None:
    """What Doppler modules and an IMU show, where no position is known."""
    for stream in recording.streams_of(DopplerBlock)[:MOST_MODULES]:
        blocks = [cast(DopplerBlock, sample.decoded()) for sample in recording.samples([(stream.node, stream.port)])]
        if module := doppler_picture(blocks, origin=picture.origin):
            picture.modules[f"{stream.node}/{stream.port}"] = module
    for stream in recording.streams_of(Imu)[:1]:
        samples = [cast(Imu, sample.decoded()) for sample in recording.samples([(stream.node, stream.port)])]
        picture.imu = imu_picture(samples, origin=picture.origin)


def _grid_cells(recording: Recording, stream: Stream) -> tuple[Floats, Floats]:
    """Middles (n, 2) m of the cells that any grid of a stream has as occupied, and as without a floor."""
    found: tuple[set[tuple[int, int]], set[tuple[int, int]]] = (set(), set())
    cell = 0.1
    for sample in recording.samples([(stream.node, stream.port)]):
        grid = cast(Grid, sample.decoded())
        planes = (grid.occupancy.max(axis=0), grid.floor_missing)
        cell = grid.cell
        for cells, plane in zip(found, planes, strict=True):
            if plane is not None:
                likely = np.argwhere((plane.astype(float) - 128.0) * grid.unit >= LIKELY) + np.array(grid.origin)
                cells.update((int(i), int(j)) for i, j in likely[:MOST_CELLS])
        if sum(map(len, found)) > MOST_CELLS:
            break
    occupied, missing = ((np.array(sorted(cells), np.float64).reshape(-1, 2) + 0.5) * cell for cells in found)
    return occupied, missing


def _radar(recording: Recording, stream: Stream, origin: int) -> RadarPictures | None:
    """The pictures of a radar; None for too few scans, or a pulse that they cannot hold."""
    keys = [(stream.node, stream.port)]
    first = next((cast(RadarFrame, sample.decoded()) for sample in recording.samples(keys)), None)
    if first is None:
        return None
    frames = (cast(RadarFrame, sample.decoded()) for sample in recording.samples(keys))
    return radar_pictures(frames, scans=stream.count * len(first.scans), origin=origin)


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


def draw(picture: Picture) -> "Figure":
    """The figure: the track on the left, time series on the right, as many as there are data for."""
    try:
        from matplotlib import rcParams
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise CaneflowError(not_installed(str(error.name), "plot")) from error

    rcParams["text.parse_math"] = False  # a name with a $ is a name
    panels = list(_panels(picture))
    figure = Figure(figsize=(14, 7.5), layout="constrained", facecolor="white")
    figure.suptitle(picture.title, x=0.01, ha="left", color=INK, fontsize=12)
    aside = _aside(picture)
    widths = (1.1 if aside else 1e-3, 1 if panels else 1e-3)
    grid = figure.add_gridspec(max(len(panels), 1), 2, width_ratios=widths)
    if aside:
        aside(figure.add_subplot(grid[:, 0]))
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


def _aside(picture: Picture) -> Panel | None:
    """What stands on the left, without time: the track, else a radar's map."""
    if picture.tracks or picture.truth is not None:
        return lambda axes: _draw_track(axes, picture)
    if (radar := picture.radar) is not None:
        return lambda axes: _draw_range_speed(axes, radar)
    return None


def _panels(picture: Picture) -> Iterator[Panel]:
    if picture.speeds or picture.truth_speed is not None:
        yield lambda axes: _draw_speeds(axes, picture)
    if picture.truth is not None and picture.tracks:
        yield lambda axes: _draw_errors(axes, picture)
    if (radar := picture.radar) is not None:
        if not (picture.tracks or picture.truth):
            yield lambda axes: _draw_power(axes, radar.times, radar.ranges, radar.range_time, "range, m")
        yield lambda axes: _draw_power(axes, radar.times, radar.speeds, radar.speed_time, DOPPLER)
    for name, module in picture.modules.items():
        yield partial(_draw_module, name=name, module=module)
    if (imu := picture.imu) is not None:
        yield lambda axes: _draw_vectors(axes, imu.times, np.degrees(imu.gyro), "gyro, deg/s", "xyz")
        if (accel := imu.accel) is not None:
            yield lambda axes: _draw_vectors(axes, imu.times, accel, "accel, m/s\N{SUPERSCRIPT TWO}", "xyz")
        if (attitude := imu.attitude) is not None:
            label = f"attitude, deg\n{imu.source}"
            yield lambda axes: _draw_vectors(axes, imu.times, attitude, label, ("roll", "pitch", "yaw"))


def _draw_track(axes: "Axes", picture: Picture) -> None:
    if picture.truth is not None:
        x, y = picture.truth.positions[:, :2].T
        axes.plot(x, y, color=FAINT, linewidth=4, solid_capstyle="round", label="truth")
        axes.plot(x[0], y[0], "o", color=INK, markersize=9, markerfacecolor="white", label="start", zorder=5)
    _draw_grid(axes, picture)
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


def _draw_grid(axes: "Axes", picture: Picture) -> None:
    """What the grids had: squares where something stands, crosses where the floor is missing."""
    if not picture.tracks:
        return
    track = next(iter(picture.tracks.values()))
    for cells, marker, label in ((picture.occupied, "s", "occupied"), (picture.floor_missing, "x", "floor missing")):
        if cells is not None and len(cells):
            x, y = picture.laid(cells, track).T
            axes.plot(x, y, marker, color=INK if marker == "x" else "#777777", markersize=2.5, label=label, zorder=1)


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


def _draw_power(axes: "Axes", x: Floats, y: Floats, power: Floats, label: str) -> None:
    """Power (y, x) in dB below its strongest, of which the very loudest few are left out."""
    relative = power - np.percentile(power, 99.8)
    mesh = axes.pcolormesh(x, y, relative, cmap="magma", vmin=-DYNAMIC_RANGE, vmax=0, rasterized=True)
    axes.set_ylabel(label)
    axes.figure.colorbar(mesh, ax=axes, label="dB", pad=0.01)


def _draw_range_speed(axes: "Axes", radar: RadarPictures) -> None:
    _draw_power(axes, radar.ranges, radar.speeds, radar.range_speed, DOPPLER)
    axes.set_xlabel("range, m")
    axes.set_title("what moves, over the whole recording", loc="left", fontsize=10, color=INK)
    _plain(axes)


def _draw_module(axes: "Axes", *, name: str, module: DopplerPicture) -> None:
    mesh = axes.pcolormesh(
        module.times, module.speeds, module.power, cmap="magma", vmin=0, vmax=DYNAMIC_RANGE + 5.0, rasterized=True
    )
    axes.plot(module.times, module.line, ".", color=BRIGHT, markersize=4, label=module.source)
    axes.set_ylabel(f"{name}\n{'away' if module.signed else 'speed'}, m/s")
    axes.legend(loc="upper right", frameon=False, fontsize=9, labelcolor="white")
    axes.figure.colorbar(mesh, ax=axes, label="dB over the median", pad=0.01)


def _draw_vectors(axes: "Axes", times: Floats, vectors: Floats, label: str, names: Sequence[str]) -> None:
    for vector, name, colour in zip(vectors.T, names, COLOURS, strict=False):
        axes.plot(times, vector, color=colour, linewidth=0.8, label=name)
    axes.set_ylabel(label)
    axes.grid(color="#eeeeee")
    axes.legend(
        loc="lower right",  # of the legend, at the axes' upper right: above, where nothing is drawn
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.0,
        frameon=False,
        ncols=3,
        fontsize=9,
        labelcolor=INK,
    )


def _plain(axes: "Axes") -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)
