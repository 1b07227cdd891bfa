"""`caneflow import mmwave`: a recording of a raw dump of a TI mmWave radar's data port."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import typer

from caneflow.algorithms.radar.doppler_bins import doppler_bins
from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, RadarPoints, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols import ti_mmwave
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.ti_mmwave import Chirps, Packet, Packets
from caneflow.recording import RecordingWriter

SPAN = 1 << 32
CARRIERS = {0xA16: 77e9, 0xA18: 77e9, 0xA14: 77e9, 0xA68: 60.25e9}  # Hz, by the platform without its last digits
CARRIER = 60.25e9  # Hz, of another platform


def mmwave(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Raw bytes of the data port.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="CFG", help="The radar's configuration; without it Doppler steps are told from the points."
        ),
    ] = None,
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane_mmwave",
    stream: Annotated[str, typer.Option(metavar="NODE/PORT", help="The radar's node and port.")] = "radar/points",
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a TI mmWave radar's points: one sample per frame, positive Doppler approaching.

    Stamps are the frames' numbers times their period, 0 at the first: that of the configuration, or by the processor's
    cycles (200 MHz; 600 on an xWR16). Frames that are missing are gaps. What is not a packet is skipped and counted.

    Example: caneflow import mmwave dump.bin -o walk.mcap --config profile.cfg
    """
    node, _, port = stream.partition("/")
    for name in (flow, node, port):
        if not NAME.fullmatch(name):
            raise CaneflowError(f"{flow}/{stream}: {name!r} is not a name; that is {NAME_RULE}")
    key = sample_key(flow, node, port)
    with whole(output, inputs=[file, config], overwrite=overwrite) as recording:
        packets, reader = _packets(file)
        chirps = _configured(config) if config else _told(file, packets)
        numbers = _numbers(packets)
        with RecordingWriter(recording, flow=flow, source="imported", rig={}) as writer:
            for seq, (number, packet) in enumerate(zip(numbers, packets, strict=True)):
                stamp = round(number * chirps.period * 1e9)
                doppler = packet.doppler * np.float32(chirps.doppler_step if packet.in_bins else 1.0)
                sample = RadarPoints(
                    stamp=stamp,
                    position=packet.position,
                    doppler=doppler,
                    snr=packet.snr,
                    noise=packet.noise,
                    frame_time=chirps.frame_time,
                    doppler_step=chirps.doppler_step,
                    doppler_limit=chirps.doppler_limit,
                )
                writer.write(key, RadarPoints, numbered(sample, seq), stamp=stamp, seq=seq, log_time=stamp)
    missing = numbers[-1] + 1 - len(numbers)
    told = "" if config else ", told from the points"
    print(
        f"{output}: {len(packets)} frames every {1e3 * chirps.period:.1f} ms, {sum(len(p.doppler) for p in packets)} "
        f"points, Doppler steps of {chirps.doppler_step:.3f} to {chirps.doppler_limit:.2f} m/s{told}; {missing} frames "
        f"missing, {reader.refused} damaged, {reader.skipped} bytes skipped"
    )


def _packets(file: Path) -> tuple[list[Packet], Packets]:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise CaneflowError(f"{file}: {error.strerror or error}") from error
    reader = Packets()
    packets = list(reader.feed(data))
    if not packets:
        raise CaneflowError(f"{file}: no packet of a TI mmWave radar in {len(data)} bytes")
    return packets, reader


def _configured(path: Path) -> Chirps:
    try:
        return ti_mmwave.chirps_of(ti_mmwave.lines_of(path.read_text(encoding="utf-8", errors="replace")))
    except OSError as error:
        raise CaneflowError(f"{path}: {error.strerror or error}") from error
    except ProtocolError as error:
        raise CaneflowError(f"{path}: {error}") from error


def _told(file: Path, packets: Sequence[Packet]) -> Chirps:
    """What the points themselves say: Dopplers are whole steps, and bins a power of two."""
    if any(packet.in_bins for packet in packets):
        raise CaneflowError(
            f"{file}: of SDK 1, whose Dopplers are numbers of bins: give its configuration, --config CFG"
        )
    bins = doppler_bins(np.concatenate([packet.doppler for packet in packets]))
    if bins is None:
        raise CaneflowError(f"{file}: nothing in it moves, so that its Doppler steps are not known: --config CFG")
    carrier = CARRIERS.get(packets[0].platform >> 8, CARRIER)
    return Chirps(bins.limit, bins.step, SPEED_OF_LIGHT / carrier / (2.0 * bins.step), _period(file, packets))


def _period(file: Path, packets: Sequence[Packet]) -> float:
    """Seconds between frames, by the processor's cycles between neighbours."""
    rate = ti_mmwave.FAST_CYCLES if packets[0].platform >> 8 == 0xA16 else ti_mmwave.CYCLES
    steps = [
        (later.cycles - earlier.cycles) % SPAN / rate
        for earlier, later in pairwise(packets)
        if (later.frame - earlier.frame) % SPAN == 1
    ]
    if not steps or not (period := median(steps)) > 0:
        raise CaneflowError(f"{file}: no two frames in a row whose cycles go on: give its configuration, --config CFG")
    return float(period)


def _numbers(packets: Sequence[Packet]) -> list[int]:
    """Of the frames, from 0; one that is not later than the last, as after a new start, follows it by 1."""
    numbers = [0]
    for earlier, later in pairwise(packets):
        step = (later.frame - earlier.frame) % SPAN
        numbers.append(numbers[-1] + (step if 0 < step < SPAN // 2 else 1))
    return numbers


command = mmwave
