"""`caneflow calibrate`: fits the rig to recordings made for that."""

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from caneflow.algorithms.radar.doppler_spectrum import DopplerSpectrum, DopplerSpectrumSettings, SlidingSpectrum
from caneflow.algorithms.room.room_calibration import (
    CalibrationSettings,
    Hops,
    RangeCalibration,
    counting,
    hops_over,
    integrated_ranges,
    range_calibration,
    sight,
)
from caneflow.algorithms.room.room_tracking import StaticSensor
from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, Pose
from caneflow.messages.rig import Rig
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.printable import printable
from caneflow.recording import TRUTH, Recording

BLOCK = "block"  # the port of a Doppler module

Floats = NDArray[np.float64]


class CalibrationError(CaneflowError):
    """Recordings that do not tell what is asked of them."""


def room(
    empty: Annotated[Path, typer.Argument(metavar="EMPTY", help="Recording of the empty room.", show_default=False)],
    walks: Annotated[
        list[Path],
        typer.Argument(metavar="WALK...", help="Recordings of walks to and fro along the sensors' axes."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="YAML", help="Rig to write, for `run --rig`.")],
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y",
            help="m, where a walk starts, for walks without truth: once for all, or once for each in their order.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Find how strong an echo is at which range: k of every Doppler module of a room.

    The noise floor is the empty room's. k is the median of power times range to the fourth between 3 and 10 m, over
    what the walks show within 15 degrees of a sensor's axis.

    Example: caneflow calibrate room empty.mcap south.mcap west.mcap --start 4,0.5 --start 0.5,4 -o rig.yaml
    """
    with whole(output, inputs=[empty, *walks], overwrite=overwrite) as path:
        rig = room_rig(empty)
        floors = {name: noise_floor(empty, name) for name in rig.sensors}
        starts = starts_of(start or [], len(walks))
        found = {name: calibrated(name, rig, floors[name], walks, starts) for name in rig.sensors}
        path.write_text(rig_yaml(rig, {name: each.k for name, each in found.items()}), encoding="utf-8")
    print(f"{'sensor':10}{'k':>10}{'spread':>10}{'exponent':>10}{'hops':>7}{'floor':>10}")
    for sensor, each in found.items():
        name = printable(sensor)
        floor = 10.0 * math.log10(float(np.median(floors[sensor])))
        print(f"{name:10}{each.k:10.4g}{each.spread:7.1f} dB{each.exponent:10.1f}{each.hops:7}{floor:7.1f} dB")
    print(f"{output}: for `caneflow run --rig {output}`; the floor is that of one line, full scale = 0 dB")


def room_rig(recording: Path) -> Rig:
    """The rig in a recording; raises CalibrationError when it knows of no sensor."""
    with Recording(recording) as opened:
        rig = opened.validated_rig()
    if not rig.sensors:
        raise CalibrationError(f"{recording}: its rig has no sensors; record with a dataflow that has rig.sensors")
    return rig


def starts_of(given: Sequence[str], walks: int) -> list[tuple[float, float] | None]:
    """One start for each walk; None for those that must have truth."""
    if not given:
        return [None] * walks
    if len(given) not in (1, walks):
        raise CalibrationError(f"--start: {len(given)} are given for {walks} walks; give one for all, or one for each")
    parsed = [_pair(text) for text in given]
    return list(parsed) if len(parsed) == walks else [parsed[0]] * walks


def noise_floor(empty: Path, sensor: str) -> Floats:
    """Mean power per bin, shape (B,), of one sensor in the empty room."""
    found = spectra_of(empty, sensor)
    spectra = [spectrum.power for _, spectrum in found if not spectrum.silent]
    if 2 * len(spectra) < len(found):
        silent = f"is silent in {len(found) - len(spectra)} of {len(found)} windows"
        raise CalibrationError(
            f"{empty}: {sensor} {silent}; the noise of an empty room is something: is it plugged in?"
        )
    if len(spectra) < 20:
        raise CalibrationError(f"{empty}: {sensor} has {len(spectra)} windows of the empty room; it takes 20, or 1.3 s")
    return np.asarray(np.mean(spectra, axis=0), dtype=np.float64)


def spectra_of(recording: Path, sensor: str) -> list[tuple[int, DopplerSpectrum]]:
    """The spectra of one sensor, each with the time that it belongs to, ns."""
    spectrum = SlidingSpectrum(DopplerSpectrumSettings())
    delay = round(spectrum.delay * 1e9)
    found, left_out = [], []
    with Recording(recording) as opened:
        for sample in opened.samples([(sensor, BLOCK)]):
            block = sample.decoded()
            assert isinstance(block, DopplerBlock)
            try:
                one = spectrum.update(block.stamp, block.samples, block.sample_rate, block.carrier)
            except ValueError as error:
                left_out.append(str(error))
                continue
            if one is not None:
                found.append((block.stamp - delay, one))
    if left_out:
        print(f"{recording}: {sensor}: {len(left_out)} blocks left out: {left_out[0]}", file=sys.stderr)
    return found


def hops_of(recording: Path, sensor: str, floor: Floats) -> Hops:
    """What the front end sees of one sensor, over the empty room's floor."""
    spectra = spectra_of(recording, sensor)
    if not spectra:
        raise CalibrationError(f"{recording}: {sensor}/{BLOCK} has not a single window")
    if spectra[0][1].power.shape != floor.shape:
        raise CalibrationError(f"{recording}: {sensor} was sampled otherwise than in the empty room")
    return hops_over(spectra, floor)


def calibrated(
    name: str, rig: Rig, floor: Floats, walks: Sequence[Path], starts: Sequence[tuple[float, float] | None]
) -> RangeCalibration:
    """One sensor's calibration over all walks; raises CalibrationError when none goes along its axis."""
    settings = CalibrationSettings()
    sensor = StaticSensor(position=rig.sensors[name].position[:2], azimuth=rig.sensors[name].azimuth)
    amplitudes, ranges = [np.empty(0)], [np.empty(0)]
    for walk, start in zip(walks, starts, strict=True):
        hops = hops_of(walk, name, floor)
        distance, off = _sight(walk, sensor, hops, start, settings)
        counts = counting(hops, off, settings)
        amplitudes.append(hops.amplitudes[counts])
        ranges.append(distance[counts])
    found = range_calibration(np.concatenate(amplitudes), np.concatenate(ranges), settings)
    if found is None:
        raise CalibrationError(
            f"{name}: fewer than {settings.least_hops} valid hops between {settings.nearest:g} and "
            f"{settings.farthest:g} m within {math.degrees(settings.off_axis):.0f} degrees of its axis; "
            "give a WALK to and fro in front of it"
        )
    return found


def _sight(
    walk: Path,
    sensor: StaticSensor,
    hops: Hops,
    start: tuple[float, float] | None,
    settings: CalibrationSettings,
) -> tuple[Floats, Floats]:
    """Distance and angle off the axis by hop, both shape (H,): from truth, else from the start and the Doppler."""
    truth = _truth(walk)
    if truth is not None:
        stamps, positions = truth
        there = np.stack([np.interp(hops.stamps, stamps, positions[:, axis]) for axis in (0, 1)], axis=1)
        return sight(sensor, there)
    if start is None:
        raise CalibrationError(f"{walk}: holds no truth; say with --start X,Y where the walk starts, in m")
    distance, off = sight(sensor, np.array([start]))
    ranges = integrated_ranges(
        (hops.stamps - hops.stamps[0]) * 1e-9,
        hops.range_rates,
        hops.valid,
        float(distance[0]),
        settings,
        signed=hops.signed,
    )
    return ranges, np.full(len(ranges), float(off[0]))


def _truth(recording: Path) -> tuple[NDArray[np.int64], Floats] | None:
    """Stamps (T,) and positions (T, 3) of the ground truth, where there is any."""
    with Recording(recording) as opened:
        if TRUTH not in opened.streams:
            return None
        poses = [sample.decoded() for sample in opened.samples([TRUTH])]
    known = [pose for pose in poses if isinstance(pose, Pose)]
    return np.array([pose.stamp for pose in known], dtype=np.int64), np.array([pose.position for pose in known])


def _pair(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise CalibrationError(f"--start {text}: not a position; expected X,Y in m, e.g. 4,0.5") from None
    return x, y


def rig_yaml(rig: Rig, ks: Mapping[str, float]) -> str:
    """The rig's room with the calibrated `ks`, as `run --rig` reads it."""
    lines = ["# Written by `caneflow calibrate room`."]
    if rig.area is not None:
        lines.append(f"area: {_flow(rig.area)}")
    lines.append("sensors:")
    for name, sensor in rig.sensors.items():
        position = _flow(sensor.position)
        lines.append(f"  {name}: {{ position: {position}, azimuth: {sensor.azimuth!r}, k: {ks[name]:.5g} }}")
    return "\n".join(lines) + "\n"


def _flow(values: Sequence[Any]) -> str:
    return f"[{', '.join(repr(value) for value in values)}]"


commands = {"room": room}
