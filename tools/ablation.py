"""`caneflow ablation`: what each measurement of the room tracker is worth, beside the paper's figures."""

import json
import math
import statistics
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from caneflow.algorithms.inertial.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from caneflow.algorithms.inertial.imu_sample import heading_of
from caneflow.algorithms.inertial.standing import StandingDetector, StandingSettings
from caneflow.algorithms.radar.doppler_line import DopplerLineSettings, LineFollower
from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum, DopplerSpectrumSettings, SlidingSpectrum
from caneflow.algorithms.room.room_calibration import CalibrationSettings, counting, hops_over, range_calibration, sight
from caneflow.algorithms.room.room_ekf import RoomEkf, RoomEkfSettings
from caneflow.algorithms.room.room_particles import HeadingParticleTracker, ParticleTracker, RoomParticleSettings
from caneflow.algorithms.room.room_sign_bank import RoomSignBank
from caneflow.algorithms.room.room_tracking import Echo, RoomStart, RoomTracker, StaticSensor
from caneflow.algorithms.rotations import rotate
from caneflow.errors import CaneflowError
from caneflow.messages.rig import Rig, read_rig
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.physics import GRAVITY
from caneflow.runtime.replays.workers import mapped
from caneflow.simulation.doppler_module import Kind
from caneflow.simulation.room_scenario import PARTS, Part, RoomRecording, World, room_settings, simulate_kinds

Floats = NDArray[np.float64]
Make: TypeAlias = Callable[[Mapping[str, StaticSensor], RoomStart], RoomTracker]
Spectra: TypeAlias = list[tuple[int, DopplerSpectrum]]  # each with the time that it belongs to, ns

KINDS: tuple[Kind, ...] = ("real", "iq")
KIND_NAMES = {"real": "real", "iq": "I/Q"}
CIRCLE = "circle"  # the paper's course, with four sensors as well
VARIED = ("random", "square", "figure_eight")
FIRST_SEED = 201  # no setting was chosen on it or a later one
SETTLED = 5.0  # s, "after initial convergence" (room.md row 17)
PERIOD_NS = 50_000_000  # between estimates
INSIDE = -2.0 * math.log(0.05)  # normalized error squared that 95 % of a plane's are below
WIDTH = 115  # characters of the page


def _particle(**chosen: bool) -> Make:
    settings = RoomParticleSettings(**chosen)  # type: ignore[arg-type]
    return lambda sensors, start: ParticleTracker(settings, sensors, start, np.random.default_rng(0))


def _heading_particle(sensors: Mapping[str, StaticSensor], start: RoomStart) -> RoomTracker:
    return HeadingParticleTracker(RoomParticleSettings(), sensors, start, np.random.default_rng(0))


def _filter(settings: RoomEkfSettings) -> Make:
    return lambda sensors, start: RoomEkf(settings, sensors, start)


def _bank(settings: RoomEkfSettings) -> Make:
    return lambda sensors, start: RoomSignBank(settings, sensors, start)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One method with some of its measurements."""

    title: str
    make: Make
    paper: str = ""  # mean and largest error, m: one person in one room


VARIANTS = {
    "range": Variant(title="range only", make=_particle(use_speed=False, use_heading=False), paper="erratic"),
    "velocity": Variant(title="velocity only", make=_particle(use_strength=False, use_heading=False), paper="drifts"),
    "both": Variant(title="velocity and range", make=_particle(use_heading=False), paper="0.7 / 1.3"),
    "everything": Variant(title="velocity, range, IMU: Algorithm 1", make=_particle(), paper="0.4 / 0.9"),
    "heading_particle": Variant(title="`heading_particle`, IMU", make=_heading_particle),
    "ekf": Variant(title="`ekf`, IMU", make=_filter(RoomEkfSettings(bias_error=0.0))),
    "best": Variant(title="`best`, IMU", make=_bank(RoomEkfSettings())),
    "best_alone": Variant(title="`best` without IMU", make=_bank(RoomEkfSettings(use_heading=False))),
}
FOUR = "best_four"  # `best` and IMU with four sensors
FOUR_TITLE = "`best`, IMU, four sensors"


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of one track, from SETTLED on."""

    mean: float  # m
    p95: float  # m
    largest: float  # m
    coverage: float  # share of the truth that is inside the 95 % ellipse


@dataclass(frozen=True, kw_only=True)
class Case:
    """One installation with its person on one course."""

    seed: int
    course: str
    world: World = "nominal"
    sensors: int = 2  # with 4, all variants but one look through the first two


Results: TypeAlias = Mapping[Case, Mapping[Kind, Mapping[str, Errors]]]


def command(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Page to write.")] = Path(
        "docs/results_room.md"
    ),
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="Installations on the circle.")] = 10,
    others: Annotated[
        int, typer.Option(metavar="N", min=0, help="Of them on other courses, with hard walls, with four sensors.")
    ] = 2,
    first: Annotated[int, typer.Option(metavar="SEED", min=0, help="The first installation.")] = FIRST_SEED,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="How many cases at a time.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the errors of every case; write no page.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Simulate installations, calibrate them as `calibrate room` does, and leave out one measurement after another.

    Range only, velocity only, both, both with the IMU, and our methods; modules of one mixer and I/Q apart; ten
    revolutions of a circle with U-turns, and the varied courses. The same sources write the same page again. A case
    takes about half a minute.

    Example: caneflow ablation --seeds 10 --jobs 2 --overwrite
    """
    cases = chosen_cases(first, seeds, others)
    with whole(None if as_json else output, overwrite=overwrite) as path:
        console = Console(stderr=True)
        found = track(
            mapped(evaluated, cases, jobs),
            "installations",
            len(cases),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        results = dict(zip(cases, found, strict=True))
        if path is None:
            print(json.dumps(described(results), indent=2))
            return
        made_by = f"caneflow ablation --seeds {seeds} --others {others} --first {first}"
        path.write_text("\n".join(page(results, made_by)) + "\n", encoding="utf-8")
    print(f"{output}: {len(cases)} cases")


def chosen_cases(first: int, seeds: int, others: int) -> list[Case]:
    """The circle for all installations; other courses, hard walls and four sensors for the first `others` of them."""
    cases = [Case(seed=first + n, course=CIRCLE, sensors=4 if n < others else 2) for n in range(seeds)]
    for seed in range(first, first + others):
        cases += [Case(seed=seed, course=course) for course in VARIED]
        cases.append(Case(seed=seed, course=CIRCLE, world="harsh"))
    return cases


def evaluated(case: Case) -> Mapping[Kind, Mapping[str, Errors]]:
    """The errors of every variant on one case, by kind of module."""
    settings = room_settings(case.course, sensors=case.sensors, world=case.world)
    parts = {part: simulate_kinds(settings, part, case.seed, KINDS) for part in PARTS}
    return {kind: _errors(case, {part: made[kind] for part, made in parts.items()}) for kind in KINDS}


def _errors(case: Case, parts: Mapping[Part, RoomRecording]) -> Mapping[str, Errors]:
    course = parts["course"]
    rig = read_rig(course.rig)
    sensors = {name: calibrated(name, rig, parts) for name in rig.sensors}
    headings = headings_of(course)
    echoes = {name: echoes_of(course, name) for name in sensors}
    two = dict(list(sensors.items())[:2])
    errors = {name: _tracked(each.make, two, course, rig, headings, echoes) for name, each in VARIANTS.items()}
    if len(sensors) == 4:
        errors[FOUR] = _tracked(VARIANTS["best"].make, sensors, course, rig, headings, echoes)
    return errors


def spectra_of(recording: RoomRecording, sensor: str) -> Spectra:
    """What the front end makes of one module's samples."""
    sliding = SlidingSpectrum(DopplerSpectrumSettings())
    delay = round(sliding.delay * 1e9)
    found: Spectra = []
    for stamp, block in zip(recording.block_stamps_ns.tolist(), recording.blocks[sensor], strict=True):
        spectrum = sliding.update(stamp, block, recording.sample_rate, recording.carrier)
        if spectrum is not None:
            found.append((stamp - delay, spectrum))
    return found


def calibrated(name: str, rig: Rig, parts: Mapping[Part, RoomRecording]) -> StaticSensor:
    """A sensor with the k that the walks along the axes say; the truth is used here, as in an installer's walk."""
    sensor = StaticSensor(position=rig.sensors[name].position[:2], azimuth=rig.sensors[name].azimuth)
    settings = CalibrationSettings()
    floor = np.mean([each.power for _, each in spectra_of(parts["empty"], name)], axis=0)
    amplitudes, ranges = [np.empty(0)], [np.empty(0)]
    for part in ("axial_x", "axial_y"):
        walk = parts[part]
        hops = hops_over(spectra_of(walk, name), floor)
        there = [np.interp(hops.stamps, walk.stamps_ns, walk.position[:, axis]) for axis in (0, 1)]
        distance, off = sight(sensor, np.stack(there, axis=1))
        counts = counting(hops, off, settings)
        amplitudes.append(hops.amplitudes[counts])
        ranges.append(distance[counts])
    found = range_calibration(np.concatenate(amplitudes), np.concatenate(ranges), settings)
    if found is None:
        raise CaneflowError(f"the walks along the axes do not calibrate {name}")
    return StaticSensor(position=sensor.position, azimuth=sensor.azimuth, k=found.k)


def headings_of(recording: RoomRecording) -> list[tuple[int, float, bool]]:
    """Stamp, yaw (rad) and whether the wearer stands, of every IMU sample."""
    attitude = AttitudeFilter(AttitudeFilterSettings())
    steps = StandingDetector(StandingSettings(window=0.5, largest_turn_rate=math.tau, largest_acceleration=0.2))
    found = []
    imu = recording.imu
    samples = zip(recording.stamps_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), imu.mag.tolist(), strict=True)
    for stamp, gyro, accel, mag in samples:
        orientation = attitude.update(stamp, tuple(gyro), tuple(accel), tuple(mag)).orientation
        cosine, sine = heading_of(orientation, (1.0, 0.0, 0.0))
        x, y, z = rotate(orientation, tuple(accel))
        found.append((stamp, math.atan2(sine, cosine), steps.update(stamp, tuple(gyro), (x, y, z - GRAVITY))))
    return found


def echoes_of(recording: RoomRecording, sensor: str) -> list[Echo]:
    """What one module sees of the person, with the noise floor that the front end learns by itself."""
    follower = LineFollower(DopplerLineSettings())
    found = []
    for stamp, spectrum in spectra_of(recording, sensor):
        line = follower.update(spectrum)
        strength = 20.0 * math.log10(line.amplitude) if line.amplitude > 0.0 else None
        found.append(
            Echo(
                stamp_ns=stamp,
                valid=line.valid,
                range_rate=line.range_rate,
                signed=spectrum.signed,
                strength=strength,
            )
        )
    return found


def _tracked(
    make: Make,
    sensors: Mapping[str, StaticSensor],
    recording: RoomRecording,
    rig: Rig,
    headings: Sequence[tuple[int, float, bool]],
    echoes: Mapping[str, Sequence[Echo]],
) -> Errors:
    """Everything told in the order in which it is known, and an estimate every PERIOD_NS."""
    assert rig.start is not None
    tracker = make(sensors, RoomStart(guess=rig.start.position, error=rig.start.sd, area=rig.area))
    delay = round(DopplerSpectrumSettings().window * 0.5e9)
    known: list[tuple[int, str, Echo | tuple[float, bool]]] = [(at, "", (yaw, still)) for at, yaw, still in headings]
    for name in sensors:
        known += [(echo.stamp_ns + delay, name, echo) for echo in echoes[name]]
    due, stamps, places, covariances = 0, [], [], []
    for stamp, name, told in sorted(known, key=lambda each: each[:2]):
        if isinstance(told, Echo):
            tracker.echo(name, told)
        else:
            tracker.heading(stamp, *told)
        if stamp >= due:
            estimate = tracker.estimate(stamp)
            stamps.append(stamp)
            places.append(estimate.position)
            covariances.append(estimate.covariance[:2, :2])
            due = stamp + PERIOD_NS
    return errors_of(np.array(stamps), np.array(places), np.array(covariances), recording)


def errors_of(stamps: NDArray[np.int64], places: Floats, covariances: Floats, recording: RoomRecording) -> Errors:
    """Of a track: stamps (T,) ns, places (T, 2) m, covariances (T, 2, 2) m^2."""
    truth = [np.interp(stamps, recording.stamps_ns, recording.position[:, axis]) for axis in (0, 1)]
    settled = stamps - recording.stamps_ns[0] > SETTLED * 1e9
    off = (places - np.stack(truth, axis=1))[settled]
    error = np.hypot(off[:, 0], off[:, 1])
    normalized = np.einsum("ti,tij,tj->t", off, np.linalg.inv(covariances[settled]), off)
    return Errors(
        mean=float(error.mean()),
        p95=float(np.percentile(error, 95.0)),
        largest=float(error.max()),
        coverage=float(np.mean(normalized < INSIDE)),
    )


def described(results: Results) -> list[Mapping[str, object]]:
    """What `--json` prints; errors in m."""
    return [
        {
            "seed": case.seed,
            "course": case.course,
            "world": case.world,
            "modules": kind,
            "method": name,
            "mean": errors.mean,
            "p95": errors.p95,
            "max": errors.largest,
            "coverage": errors.coverage,
        }
        for case, by_kind in results.items()
        for kind, by_name in by_kind.items()
        for name, errors in by_name.items()
    ]


def page(results: Results, made_by: str) -> Iterator[str]:
    """The results, line by line."""
    yield from ("# Results: the room tracker", "", f"Written by `{made_by}`; see [the method](methods/room.md).", "")
    yield from _paragraphs(ABOUT)
    groups = {
        "Ten revolutions of a circle, with U-turns": [each for each in results if _is(each, CIRCLE)],
        "The same, with hard walls (`harsh`)": [each for each in results if _is(each, CIRCLE, "harsh")],
        "Varied courses: random, square, figure eight, with stops": [each for each in results if each.course in VARIED],
    }
    for title, cases in groups.items():
        if cases:
            yield from _group(title, cases, results)
    yield from _order(groups, results)
    yield from _by_course(results)
    yield from _case_by_case(results)


ABOUT = (
    "Nobody walked here. Rooms, modules, persons and IMUs are models (`src/caneflow/simulation`); every installation "
    "is mounted by hand, has modules of its own gain and noise, walls, a magnetic field and a person, and is "
    "calibrated by the walks along its axes as `caneflow calibrate room` does it. No number of the simulator was "
    f"fitted to a result. The methods were set on seeds below {FIRST_SEED}, and on none of these.",
    "The paper's figures are one person in one room, measured in a way that it does not describe. They are printed "
    "beside ours because there are no others, not because they are the same quantity: a model of a room with other "
    "walls gives other figures, and so would another person in theirs. That ours are larger for Algorithm 1 may be the "
    "simulator's, our reading of the algorithm's, or that one room's; it cannot be told from here. That range alone is "
    "erratic, that velocity alone drifts, and that the IMU helps, is what the paper says and what is found here.",
    "Errors are horizontal distances to the truth from 5 s on, in m: per case the mean, the 95th percentile and the "
    "largest, and of each the median over the cases. *mean of means* is their mean, which a single lost track spoils. "
    "*coverage* is the share of the truth inside the method's own 95 % ellipse, the mean over the cases: 0.95 if the "
    "method knows how well it knows. Two sensors unless said otherwise.",
)


def _is(case: Case, course: str, world: World = "nominal") -> bool:
    return case.course == course and case.world == world


def _paragraphs(texts: Sequence[str]) -> Iterator[str]:
    for text in texts:
        yield from (textwrap.fill(text, WIDTH), "")


def _group(title: str, cases: Sequence[Case], results: Results) -> Iterator[str]:
    yield from (f"## {title}", "")
    seeds = sorted({case.seed for case in cases})
    yield f"{len(cases)} cases, seeds {seeds[0]} to {seeds[-1]}."
    for kind in KINDS:
        modules = "One mixer (real)" if kind == "real" else "Two mixers (I/Q)"
        yield from ("", f"**{modules}**", "")
        yield "| measurements | mean | p95 | max | mean of means | coverage | paper: mean / max |"
        yield "|---|---:|---:|---:|---:|---:|---:|"
        for name, variant in VARIANTS.items():
            paper = variant.paper if title.startswith("Ten") else ""
            yield _row(variant.title, [results[case][kind][name] for case in cases], paper)
        four = [results[case][kind][FOUR] for case in cases if FOUR in results[case][kind]]
        if four:
            yield _row(f"{FOUR_TITLE} ({len(four)} cases)", four, "")
    yield ""


def _row(title: str, errors: Sequence[Errors], paper: str) -> str:
    middle = [
        statistics.median(values)
        for values in ([e.mean for e in errors], [e.p95 for e in errors], [e.largest for e in errors])
    ]
    means = statistics.fmean(e.mean for e in errors)
    coverage = statistics.fmean(e.coverage for e in errors)
    figures = " | ".join(f"{value:.2f}" for value in (*middle, means, coverage))
    return f"| {title} | {figures} | {paper} |"


def _order(groups: Mapping[str, Sequence[Case]], results: Results) -> Iterator[str]:
    yield from ("## The order of the ablation", "")
    yield "In how many cases range only and velocity only are each worse than everything together (Algorithm 1):"
    yield from ("", "| course | real | I/Q |", "|---|---:|---:|")
    for title, cases in ((title, cases) for title, cases in groups.items() if cases):
        counts = [sum(in_order(results[case][kind]) for case in cases) for kind in KINDS]
        yield f"| {title} | {counts[0]} of {len(cases)} | {counts[1]} of {len(cases)} |"
    yield ""


def in_order(errors: Mapping[str, Errors]) -> bool:
    """Whether everything together is better than range only and than velocity only."""
    return errors["everything"].mean < min(errors["range"].mean, errors["velocity"].mean)


def _by_course(results: Results) -> Iterator[str]:
    yield from ("## By course", "", "Mean over the cases of the mean error, m.", "")
    courses = list(dict.fromkeys((case.course, case.world) for case in results))
    named = " | ".join(course if world == "nominal" else f"{course}, hard" for course, world in courses)
    yield f"| method | modules | {named} |"
    yield f"|---|---|{'---:|' * len(courses)}"
    for name, variant in VARIANTS.items():
        for kind in KINDS:
            means = [
                statistics.fmean(results[case][kind][name].mean for case in results if _is(case, course, world))
                for course, world in courses
            ]
            yield f"| {variant.title} | {KIND_NAMES[kind]} | {' | '.join(f'{mean:.2f}' for mean in means)} |"
    yield ""


def _case_by_case(results: Results) -> Iterator[str]:
    yield from ("## Case by case", "", "Mean error, m.", "")
    yield f"| seed | course | modules | {' | '.join(each.title for each in VARIANTS.values())} |"
    yield f"|---:|---|---|{'---:|' * len(VARIANTS)}"
    for case, by_kind in results.items():
        for kind in KINDS:
            means = " | ".join(f"{by_kind[kind][name].mean:.2f}" for name in VARIANTS)
            hard = "" if case.world == "nominal" else ", hard"
            yield f"| {case.seed} | {case.course}{hard} | {KIND_NAMES[kind]} | {means} |"
