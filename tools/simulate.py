"""`caneflow simulate`: recordings of walks that nobody walked, with the truth beside them."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, TypeAlias

import typer
from rich.console import Console
from rich.progress import Progress

from caneflow.messages import DopplerBlock, Imu, Pose, RadarFrame, RadarPoints, Ranges, Sample, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import made_folder, require_free, whole
from caneflow.protocols import a121 as a121_chip
from caneflow.recording import TRUTH, RecordingWriter
from caneflow.simulation.a121 import A121Settings
from caneflow.simulation.doppler_module import Kind
from caneflow.simulation.guided_walk import RANGERS, GuidedWalk, simulate_guided_walk
from caneflow.simulation.mmwave import MmwaveSettings
from caneflow.simulation.obstacle_course import SceneKind, ThingKind
from caneflow.simulation.radar_walk import Floor, RadarWalk, simulate_a121_walk, simulate_mmwave_walk
from caneflow.simulation.ranger import Readings
from caneflow.simulation.room_cane import CaneInRoom, simulate_cane_in_room
from caneflow.simulation.room_course import RoomShape
from caneflow.simulation.room_scenario import PARTS, SENSORS, Part, RoomRecording, World, room_settings, simulate_room
from caneflow.simulation.scenario import SCENARIOS, Walk, WalkSettings, simulate_walk, walk_settings

SAY_PERIOD = 4.0  # s between two lines that say how far a simulation is, where there is no terminal
RECORDING = ".mcap"  # the end of a file's name; another output of `simulate room` is a folder
CANE, ROOM, CANE_IN_ROOM = "cane", "room", "cane_in_room"  # flows
CANE_A121, CANE_MMWAVE = "cane_a121", "cane_mmwave"  # likewise
REAL = "What recordings of real devices have"  # options under one heading of the help
IMU, RADAR, POINTS = ("imu", "imu"), ("radar", "frame"), ("radar", "points")

Samples: TypeAlias = Iterator[tuple[tuple[str, str], int, Sample]]  # node and port, number within the stream, sample


def walk(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    scenario: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"One of {', '.join(SCENARIOS)}; by default swing.")
    ] = None,
    scene: Annotated[
        SceneKind | None, typer.Option(help="Instead of a scenario: a place with things in the way, and range sensors.")
    ] = None,
    thing: Annotated[ThingKind | None, typer.Option(help="What the scene `approach` ends at.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers: the same seed is the same walk.")] = 1,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.1, help="s; by default until the course has been walked (swing: 53 s)."),
    ] = None,
    noise_rise: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            min=0,
            max=40,
            help="dB of the radar's noise in its band over the rest, the sum as it was. Recorded P440s: 8 to 12.",
            rich_help_panel=REAL,
        ),
    ] = None,
    glitches: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            min=0,
            max=100,
            help="Hz at which a reading of the IMU is any 16-bit value: an I2C bus that stretches its clock.",
            rich_help_panel=REAL,
        ),
    ] = None,
    holes: Annotated[
        float | None,
        typer.Option(
            metavar="N",
            min=0,
            max=1000,
            help="How many times a minute the IMU is silent, for 0.05 to 0.65 s: slow reads, resets of a BNO055.",
            rich_help_panel=REAL,
        ),
    ] = None,
    scan_loss: Annotated[
        float | None,
        typer.Option(
            metavar="PART",
            min=0,
            max=0.9,
            help="The part of the scans that is lost, in gaps of one to three. A recorded P440 by UDP: 0.09.",
            rich_help_panel=REAL,
        ),
    ] = None,
    carrier_off: Annotated[
        float | None,
        typer.Option(
            metavar="PART",
            min=-0.4,
            max=0.4,
            help="The part by which the stated carrier is over the true one. Recorded P440s: 0.05 to 0.075.",
            rich_help_panel=REAL,
        ),
    ] = None,
    equal_stamps: Annotated[
        float | None,
        typer.Option(
            metavar="PART",
            min=0,
            max=0.9,
            help="The part of the IMU's samples that got one stamp with the one before; spread as on import.",
            rich_help_panel=REAL,
        ),
    ] = None,
    rig_shift: Annotated[
        float | None,
        typer.Option(
            metavar="M", min=0, max=0.2, help="m by which each length of the stated rig is wrong.", rich_help_panel=REAL
        ),
    ] = None,
    rig_turn: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            min=0,
            max=45,
            help="deg between the stated boresight and the true one.",
            rich_help_panel=REAL,
        ),
    ] = None,
    field_turn: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            min=0,
            max=180,
            help="deg by which the magnetic field turns, once, 10 to 40 s after the beginning.",
            rich_help_panel=REAL,
        ),
    ] = None,
    field_wander: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            min=0,
            max=180,
            help="deg, sd, by which the field's direction wanders within 40 s.",
            rich_help_panel=REAL,
        ),
    ] = None,
    radar: Annotated[
        Literal["p440", "a121", "mmwave"],
        typer.Option(
            help="Another radar in the P440's place: an A121 low on the shaft, or a TI radar that looks ahead."
        ),
    ] = "p440",
    floor: Annotated[
        Floor | None,
        typer.Option(help="What the A121 looks at: -15, -20, -25, -30 dB of reflectivity; by default usual, -20."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate a walk with a white cane: IMU and radar at 100 Hz, and where the cane truly was.

    What recordings of real devices have besides goes with any scenario; `field` has all of it.

    With --scene also two range sensors at 15 Hz, and where everything stands (metadata record `scene`).

    Example: caneflow simulate walk --scenario stops --seed 3 -o stops_3.mcap

    Example: caneflow simulate walk --scene approach --thing pole --seed 3 -o pole_3.mcap

    Example: caneflow simulate walk --radar a121 --floor smooth --seed 3 -o smooth_3.mcap
    """
    faults = {
        "noise_rise": noise_rise,
        "glitches": glitches,
        "holes": holes,
        "scan_loss": scan_loss,
        "carrier_off": carrier_off,
        "equal_stamps": equal_stamps,
        "rig_shift": rig_shift,
        "rig_turn": None if rig_turn is None else math.radians(rig_turn),
        "field_turn": None if field_turn is None else math.radians(field_turn),
        "field_wander": None if field_wander is None else math.radians(field_wander),
    }
    asked = {name: value for name, value in faults.items() if value is not None}
    if floor is not None and radar != "a121":
        raise typer.BadParameter("goes with --radar a121: only its echoes have an absolute power", param_hint="--floor")
    if radar != "p440" and (asked or scene is not None):
        other = "scene" if scene is not None else next(iter(asked)).replace("_", "-")
        raise typer.BadParameter(f"goes with --radar p440 only, not {radar}", param_hint=f"--{other}")
    if scene is not None:
        if asked:
            raise typer.BadParameter("a scene has none of it", param_hint=f"--{next(iter(asked)).replace('_', '-')}")
        if scenario is not None:
            raise typer.BadParameter("a scene has a walk of its own; use one of the two", param_hint="--scenario")
        guided_walk(output, scene, thing, seed, duration, overwrite=overwrite)
        return
    if thing is not None:
        raise typer.BadParameter("goes with --scene approach", param_hint="--thing")
    scenario = scenario or "swing"
    if scenario not in SCENARIOS:
        raise typer.BadParameter(f"no walk {scenario!r}; there are {', '.join(SCENARIOS)}", param_hint="--scenario")
    if radar != "p440":
        other_radar_walk(output, scenario, seed, radar, floor or "usual", duration, overwrite=overwrite)
        return
    with whole(output, overwrite=overwrite) as recording:
        with progress_bar(f"{scenario}, seed {seed}") as progress:
            walked = simulate_walk(_with_faults(walk_settings(scenario, seed), asked), seed, duration, progress)
        written(recording, CANE, walked.rig, samples_of(walked))
    seconds = float(walked.stamps_ns[-1] - walked.stamps_ns[0]) / 1e9
    print(f"{output}: {scenario}, seed {seed}: {len(walked.stamps_ns)} samples a stream, {seconds:.2f} s")


def _with_faults(settings: WalkSettings, asked: Mapping[str, float]) -> WalkSettings:
    """The settings with what was asked for, each in the part that has a setting of this name."""
    for part in ("radar", "imu", "faults"):
        before = getattr(settings, part)
        own = {name: value for name, value in asked.items() if hasattr(before, name)}
        settings = replace(settings, **{part: replace(before, **own)})
    return settings


def other_radar_walk(
    output: Path,
    scenario: str,
    seed: int,
    radar: Literal["a121", "mmwave"],
    floor: Floor,
    duration: float | None,
    *,
    overwrite: bool,
) -> None:
    """Write a walk with another radar than the P440."""
    settings = walk_settings(scenario, seed)
    shown = f"{scenario}, {radar}, seed {seed}"
    with whole(output, overwrite=overwrite) as recording, progress_bar(shown) as progress:
        if radar == "a121":
            walked = simulate_a121_walk(settings, seed, floor, duration=duration, progress=progress)
            written(recording, CANE_A121, walked.rig, a121_samples(walked))
        else:
            walked = simulate_mmwave_walk(settings, seed, duration=duration)
            written(recording, CANE_MMWAVE, walked.rig, mmwave_samples(walked))
    seconds = float(walked.stamps_ns[-1] - walked.stamps_ns[0]) / 1e9
    frames = len(walked.points) if walked.sweeps is None else len(walked.sweeps[0])
    print(f"{output}: {scenario}, {radar}, seed {seed}: {frames} frames, {seconds:.2f} s")


def guided_walk(
    output: Path, scene: SceneKind, thing: ThingKind | None, seed: int, duration: float | None, *, overwrite: bool
) -> None:
    """Write a walk through a scene."""
    if (thing is None) == (scene == "approach"):
        said = "--scene approach needs one" if thing is None else f"a {scene} has things of its own"
        raise typer.BadParameter(f"{said}; pole, box, table, sign, person or stairs", param_hint="--thing")
    with whole(output, overwrite=overwrite) as recording:
        with progress_bar(f"{scene}, seed {seed}") as progress:
            walked = simulate_guided_walk(scene, seed, thing, duration, progress)
        records = {"scene": walked.scene}
        written(recording, CANE, walked.walk.rig, guided_samples(walked), records)
    seconds = float(walked.walk.stamps_ns[-1] - walked.walk.stamps_ns[0]) / 1e9
    samples = len(walked.walk.stamps_ns)
    print(f"{output}: {walked.scene['kind']}, seed {seed}: {samples} samples a stream, {seconds:.2f} s")


def room(
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|REC",
            help="Folder, or REC.mcap for the course; the other parts are named after it: REC_empty.mcap ...",
        ),
    ],
    seed: Annotated[int, typer.Option(min=0, help="Of the installation: mounting, modules, walls, field.")] = 1,
    person: Annotated[
        int | None, typer.Option(min=0, help="Seed of the person: body, gait, belt; by default the same number.")
    ] = None,
    course: Annotated[RoomShape, typer.Option(help="Where the person walks.")] = "circle",
    modules: Annotated[Kind, typer.Option(help="One mixer (int16) or two (complex64).")] = "real",
    sensors: Annotated[int, typer.Option(min=2, max=len(SENSORS), help=f"The first of {', '.join(SENSORS)}.")] = 2,
    world: Annotated[
        World,
        typer.Option(help="How strongly floor and walls reflect; `field`: nominal, with the noise of real amplifiers."),
    ] = "nominal",
    part: Annotated[
        Literal[Part, "all"], typer.Option(help="The empty room, a calibration walk along an axis, or the course.")
    ] = "all",
    stops: Annotated[
        int | None, typer.Option(min=0, help="How often the person stands still; by default as fits the course.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate an installation of Doppler modules and a person in it, who wears an IMU.

    Example: caneflow simulate room --seed 3 --course random --modules iq -o rooms/
    """
    settings = room_settings(course, modules=modules, sensors=sensors, world=world, stops=stops)
    names = room_names(output, f"{world}_{modules}{sensors}_{course}_{seed}", part)
    with made_folder(output) if output.suffix != RECORDING else nullcontext():
        for path in names.values():
            require_free(path, overwrite=overwrite)
        for one, path in names.items():
            with whole(path, overwrite=overwrite) as recording, progress_bar(f"{one}, seed {seed}") as progress:
                recorded = simulate_room(settings, one, seed, person, progress)
                written(recording, ROOM, recorded.rig, room_samples(recorded))
            blocks = len(recorded.block_stamps_ns)
            print(f"{path}: {one}, seed {seed}: {blocks} blocks a module, {len(recorded.stamps_ns) / 100:.2f} s")


def cane_in_room(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Of installation, person, cane and walk.")] = 1,
    modules: Annotated[Kind, typer.Option(help="One mixer (int16) or two (complex64).")] = "real",
    sensors: Annotated[int, typer.Option(min=2, max=len(SENSORS), help=f"The first of {', '.join(SENSORS)}.")] = 2,
    world: Annotated[
        World,
        typer.Option(help="How strongly floor and walls reflect; `field`: nominal, with the noise of real amplifiers."),
    ] = "nominal",
    overwrite: Overwrite = False,
) -> None:
    """Simulate someone with a white cane in a room of Doppler modules: both sensor sets, and where the person was.

    The installation is that of `simulate room` with the same seed, whose empty room and walks calibrate it.

    Example: caneflow simulate cane_in_room --seed 3 -o cane_3.mcap
    """
    settings = room_settings(modules=modules, sensors=sensors, world=world)
    with whole(output, overwrite=overwrite) as recording:
        with progress_bar(f"cane in room, seed {seed}") as progress:
            walked = simulate_cane_in_room(settings, seed, progress=progress)
        written(recording, CANE_IN_ROOM, walked.rig, cane_in_room_samples(walked))
    print(f"{output}: cane in room, seed {seed}: {len(walked.room.stamps_ns) / 100:.2f} s")


def room_names(output: Path, name: str, part: Literal[Part, "all"]) -> dict[Part, Path]:
    """The file of each part that is asked for, in the folder `output` or named after the file; one part as it is."""
    base = output
    if output.suffix != RECORDING:
        base = output / f"{name}{RECORDING}"
    elif part != "all":
        return {part: output}
    paths = {one: base if one == "course" else base.with_stem(f"{base.stem}_{one}") for one in PARTS}
    return paths if part == "all" else {part: paths[part]}


def written(
    output: Path,
    flow: str,
    rig: Mapping[str, object],
    samples: Samples,
    records: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Write a recording of samples that come in the order of their stamps, with more metadata `records` by name."""
    with RecordingWriter(output, flow=flow, source="simulated", rig=dict(rig), records=records) as writer:
        for name, seq, sample in samples:
            payload, stamp = numbered(sample, seq), sample.stamp
            writer.write(sample_key(flow, *name), type(sample), payload, stamp=stamp, seq=seq, log_time=stamp)


def samples_of(walked: Walk) -> Samples:
    """What came from the IMU and the radar, numbered as it came, and the truth, in the order of the stamps."""
    numbers = dict.fromkeys((IMU, RADAR), 0)
    waiting: list[tuple[tuple[str, str], int, Sample]] = []  # stamped later than they are
    for i, now in enumerate(walked.stamps_ns.tolist()):
        for name, _, sample in cane_samples(walked, i):
            if came(walked, name, i):
                waiting.append((name, numbers[name], sample))
                numbers[name] += 1
        waiting.append((TRUTH, i, true_pose(walked, i)))
        waiting.sort(key=lambda each: each[2].stamp)
        while waiting and waiting[0][2].stamp <= now:
            yield waiting.pop(0)
    yield from waiting


def guided_samples(walked: GuidedWalk) -> Samples:
    """What the cane and its range sensors say, and the truth, in the order of the stamps."""
    begin, readings = int(walked.walk.stamps_ns[0]), walked.readings
    due = sorted((begin + round(t * 1e9), name, i) for name, each in readings.items() for i, t in enumerate(each.time))
    for i, stamp in enumerate(walked.walk.stamps_ns.tolist()):
        while due and due[0][0] < stamp:
            yield _reading(readings, *due.pop(0))
        yield from cane_samples(walked.walk, i)
        yield TRUTH, i, true_pose(walked.walk, i)
    for each in due:
        yield _reading(readings, *each)


def _reading(readings: Mapping[str, Readings], stamp: int, name: str, i: int) -> tuple[tuple[str, str], int, Sample]:
    each, period = readings[name], RANGERS[name].period
    reading = Ranges(
        stamp=stamp,
        ranges=each.ranges[i],
        status=each.status[i],
        sigma=each.sigma[i],
        exposure=period,
        delay=0.5 * period,
    )
    return (name, "ranges"), i, reading


def came(walked: Walk, name: tuple[str, str], i: int) -> bool:
    """Whether the sample of instant `i` came through."""
    if walked.received is None:
        return True
    return bool((walked.received.imu_kept if name == IMU else walked.received.scan_kept)[i])


def cane_samples(walked: Walk, i: int) -> Samples:
    """What the cane's IMU and radar say at instant `i`."""
    stamp = int(walked.stamps_ns[i])
    imu_stamp = stamp if walked.received is None else int(walked.received.imu_stamps_ns[i])
    yield IMU, i, imu_sample(walked, i, imu_stamp)
    yield (
        RADAR,
        i,
        RadarFrame(
            stamp=stamp,
            scans=walked.scans[i : i + 1],
            scan_period=walked.scan_period,
            range_start=walked.range_start,
            range_step=walked.range_step,
            carrier=walked.carrier,
            bandwidth=walked.bandwidth,
        ),
    )


def imu_sample(walked: Walk | RadarWalk, i: int, stamp: int) -> Imu:
    """What the cane's IMU says at instant `i`."""
    imu = walked.imu
    return Imu(
        stamp=stamp,
        gyro=tuple(imu.gyro[i].tolist()),
        accel=tuple(imu.accel[i].tolist()),
        mag=tuple(imu.mag[i].tolist()),
        orientation=tuple(imu.orientation[i].tolist()),
        linear_accel=tuple(imu.linear_accel[i].tolist()),
        calibration=tuple(imu.calibration[i].tolist()),
    )


def a121_samples(walked: RadarWalk) -> Samples:
    """What the IMU and an A121 say, and the truth, in the order of the stamps."""
    assert walked.sweeps is not None
    times, frames = walked.sweeps
    settings = A121Settings()
    axis = a121_chip.range_axis(settings.setup.start_point, settings.setup.step_length)
    begin = int(walked.stamps_ns[0])
    radar: list[Sample] = [
        RadarFrame(
            stamp=begin + round(1e9 * time),
            scans=scans,
            scan_period=1.0 / settings.setup.sweep_rate,
            range_start=axis.start,
            range_step=axis.step,
            carrier=a121_chip.CARRIER,
            bandwidth=a121_chip.bandwidth_of(settings.setup.profile),
        )
        for time, scans in zip(times.tolist(), frames, strict=True)
    ]
    yield from _beside(walked, RADAR, radar)


def mmwave_samples(walked: RadarWalk) -> Samples:
    """What the IMU and a TI radar say, and the truth, in the order of the stamps."""
    settings, begin = MmwaveSettings(), int(walked.stamps_ns[0])
    radar: list[Sample] = [
        RadarPoints(
            stamp=begin + round(1e9 * frame.time),
            position=frame.position.astype("float32"),
            doppler=frame.doppler.astype("float32"),
            snr=frame.snr.astype("float32"),
            frame_time=settings.frame_time,
            doppler_step=settings.doppler_step,
            doppler_limit=settings.doppler_limit,
        )
        for frame in walked.points
    ]
    yield from _beside(walked, POINTS, radar)


def _beside(walked: RadarWalk, name: tuple[str, str], radar: Sequence[Sample]) -> Samples:
    """A radar's samples among those of the IMU and the truth."""
    next_one = 0
    for i, stamp in enumerate(walked.stamps_ns.tolist()):
        while next_one < len(radar) and radar[next_one].stamp < stamp:
            yield name, next_one, radar[next_one]
            next_one += 1
        yield IMU, i, imu_sample(walked, i, stamp)
        yield TRUTH, i, true_pose(walked, i)


def cane_in_room_samples(walked: CaneInRoom) -> Samples:
    """What the cane and the modules say, and where the person truly was, in the order of the stamps."""
    seen, block = walked.room, 0
    for i, stamp in enumerate(seen.stamps_ns.tolist()):
        while block < len(seen.block_stamps_ns) and seen.block_stamps_ns[block] < stamp:
            yield from module_samples(seen, block)
            block += 1
        yield from cane_samples(walked.cane, i)
        yield TRUTH, i, true_pose(seen, i)
    for last in range(block, len(seen.block_stamps_ns)):
        yield from module_samples(seen, last)


def room_samples(recorded: RoomRecording) -> Samples:
    """What IMU and modules say, and the truth, in the order of the stamps."""
    imu, block = recorded.imu, 0
    for i, stamp in enumerate(recorded.stamps_ns.tolist()):
        while block < len(recorded.block_stamps_ns) and recorded.block_stamps_ns[block] < stamp:
            yield from module_samples(recorded, block)
            block += 1
        yield (
            IMU,
            i,
            Imu(
                stamp=stamp,
                gyro=tuple(imu.gyro[i].tolist()),
                accel=tuple(imu.accel[i].tolist()),
                mag=tuple(imu.mag[i].tolist()),
            ),
        )
        yield TRUTH, i, true_pose(recorded, i)
    for last in range(block, len(recorded.block_stamps_ns)):
        yield from module_samples(recorded, last)


def module_samples(recorded: RoomRecording, block: int) -> Samples:
    """One block of every module."""
    stamp = int(recorded.block_stamps_ns[block])
    for name, samples in recorded.blocks.items():
        yield (
            (name, "block"),
            block,
            DopplerBlock(
                stamp=stamp, samples=samples[block], sample_rate=recorded.sample_rate, carrier=recorded.carrier
            ),
        )


def true_pose(simulated: Walk | RadarWalk | RoomRecording, i: int) -> Pose:
    """Where it truly was at instant `i`."""
    return Pose(
        stamp=int(simulated.stamps_ns[i]),
        position=tuple(simulated.position[i].tolist()),
        velocity=tuple(simulated.velocity[i].tolist()),
        orientation=tuple(simulated.orientation[i].tolist()),
        method="truth",
    )


@contextmanager
def progress_bar(text: str) -> Iterator[Callable[[float], None]]:
    """A function that is told the part done, 0..1: a bar on a terminal, elsewhere a line now and then."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines_of_progress(text)
        return
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(text, total=1.0)
        yield lambda done: bar.update(task, completed=done)


def _lines_of_progress(text: str) -> Callable[[float], None]:
    said_at = time.monotonic()

    def tell(done: float) -> None:
        nonlocal said_at
        if time.monotonic() - said_at >= SAY_PERIOD:
            said_at = time.monotonic()
            print(f"{text}: {done:.0%}", file=sys.stderr, flush=True)

    return tell


commands = {"walk": walk, "room": room, "cane_in_room": cane_in_room}
