"""`caneflow import`: a recording of a device's own log."""

from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import typer

from caneflow.algorithms.radar.received_carrier import WINDOW, ReceivedCarrier, centroid_carrier, received_carrier
from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, RadarFrame, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_salvage import Log, missing_scans
from caneflow.protocols.mrm_scans import Scan, milliseconds_after
from caneflow.recording import RecordingWriter

MILLISECOND = 1_000_000  # ns
RAW = 1  # scan type: neither filtered nor detected
NOMINAL_CARRIER = 4.3e9  # Hz, the middle of what a P440 transmits
MEASURED_WINDOWS = 200  # of scans, at most, that the carrier is measured in
MOST_LOST = 0.01  # of the scans, with status 0
LONGEST_GAP = 10  # periods: how many scans a longer gap lacks is a guess, so it says nothing of the period


def p440(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log of raw MRM packets.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane",
    stream: Annotated[str, typer.Option(metavar="NODE/PORT", help="The radar's node and port.")] = "radar/frame",
    carrier: Annotated[
        float | None,
        typer.Option(
            min=1,
            metavar="HZ",
            help="Hz, effective centre of the received band. Default: measured from echoes that move in the log.",
            show_default=False,
        ),
    ] = None,
    bandwidth: Annotated[float, typer.Option(min=1, metavar="HZ", help="Hz, of the pulse at -10 dB.")] = 1.7e9,
    antenna_delay: Annotated[
        float,
        typer.Option(metavar="NS", help="ns, from the module to its antennas and back; taken off the range."),
    ] = 10.0,
    source_id: Annotated[
        int | None, typer.Option("--source", metavar="ID", help="Which radar, where several are in the log.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a recording of a P440's log: MRM_SCAN_INFO packets as they came by UDP, or the vendor's lines of text.

    Stamps are the radar's own time, 0 at the first scan. Scans that lack a packet are left out, and counted, as are
    those that never came into the log, by the numbers of their neighbours. What is damaged is left out and named; the
    status is 1 when more than 1 % of the scans are lost with it.

    Example: caneflow import p440 scan_2105627.txt -o rail.mcap
    """
    key = _key(flow, stream)
    with whole(output, inputs=[log], overwrite=overwrite) as recording:
        parsed = _parsed(log)
        scans = _scans_of_one_radar(log, parsed, source_id)
        stamps = stamps_of([scan.timestamp_ms for scan in scans])
        period = scan_period(stamps)
        measured = None if carrier else _measured_carrier(scans, stamps)
        with RecordingWriter(recording, flow=flow, source="imported", rig={}) as writer:
            for seq, (stamp, scan) in enumerate(zip(stamps, scans, strict=True)):
                frame = RadarFrame(
                    stamp=stamp,
                    scans=scan.samples[None, :],
                    scan_period=period,
                    range_start=scan.range_start(1000.0 * antenna_delay),
                    range_step=scan.range_step,
                    carrier=carrier or (measured.carrier if measured else NOMINAL_CARRIER),
                    bandwidth=bandwidth,
                )
                writer.write(key, RadarFrame, numbered(frame, seq), stamp=stamp, seq=seq, log_time=stamp)
    if not carrier:
        print(_carrier_line(measured))
    if parsed.damage:
        first = parsed.damage[0]
        print(f"{log}: damaged in {len(parsed.damage)} places, first at {first.place}: {first.reason}")
    found = f"{len(scans)} scans of {len(scans[0].samples)} samples, {1 / period:.2f} Hz"
    print(f"{output}: {found}, {_losses(parsed, scans)}")
    if parsed.damaged_scans > MOST_LOST * (len(parsed.scans) + parsed.damaged_scans):
        raise typer.Exit(1)


def stamps_of(timestamps_ms: Sequence[int]) -> list[int]:
    """Stamps (ns, strictly increasing, from 0) of scans by the radar's clock, which shows whole milliseconds.

    Scans of one millisecond share it evenly. When the clock begins again, time goes on one millisecond later: how
    long the radar was off is not in the log.
    """
    stamps: list[int] = []
    elapsed_ms, last = 0, None
    for timestamp, same in groupby(timestamps_ms):
        if last is not None:
            elapsed_ms += max(milliseconds_after(timestamp, last), 1)
        last = timestamp
        count = len(list(same))
        stamps += [elapsed_ms * MILLISECOND + index * MILLISECOND // count for index in range(count)]
    return stamps


def scan_period(stamps: Sequence[int]) -> float:
    """Seconds between scans, finer than the clock of 1 ms, with scans missing; needs two stamps (ns) or more.

    The median says how many periods each interval holds; their sum over that of the intervals is the mean period.
    """
    intervals = [later - earlier for earlier, later in pairwise(stamps)]
    middle = median(intervals)
    held = [(interval, round(interval / middle)) for interval in intervals if interval < LONGEST_GAP * middle]
    return sum(interval for interval, _ in held) / sum(count for _, count in held) / 1e9


def _measured_carrier(scans: Sequence[Scan], stamps: Sequence[int]) -> ReceivedCarrier | None:
    """From the scans that have the shape of the first: by phase where that settles; None where nothing moves enough."""
    shape = (scans[0].scan_start_ps, len(scans[0].samples))
    alike = [index for index, scan in enumerate(scans) if (scan.scan_start_ps, len(scan.samples)) == shape]
    samples = np.stack([scans[index].samples for index in alike]).astype(np.float32)
    times = np.array([stamps[index] for index in alike]) / 1e9
    hop = max(len(alike) // MEASURED_WINDOWS, WINDOW // 4)
    by_phase = received_carrier(samples, times, scans[0].range_step, hop=hop)
    if by_phase is not None and by_phase.settled:
        return by_phase
    return centroid_carrier(samples, scans[0].range_step, hop=hop) or by_phase


def _carrier_line(measured: ReceivedCarrier | None) -> str:
    if measured is None:
        return f"carrier: {NOMINAL_CARRIER / 1e9:g} GHz, the nominal one: too little moves to measure it; see --carrier"
    giga = [value / 1e9 for value in (measured.carrier, measured.error, measured.spread)]
    if measured.by_centroid:
        return (
            f"carrier: {giga[0]:.3f} +- {giga[1]:.3f} GHz, centroid of what changes: no single echoes to measure it on"
        )
    return (
        f"carrier: {giga[0]:.3f} +- {giga[1]:.3f} GHz, measured on {measured.echoes} moving echoes (sd {giga[2]:.3f})"
    )


def _parsed(log: Path) -> Log:
    try:
        return parse_log(log.read_bytes())
    except ProtocolError as error:
        raise CaneflowError(f"{log}: {error}") from error


def _key(flow: str, stream: str) -> str:
    node, _, port = stream.partition("/")
    for name in (flow, node, port):
        if not NAME.fullmatch(name):
            raise CaneflowError(f"{flow}/{stream}: {name!r} not a valid name; expected {NAME_RULE}")
    return sample_key(flow, node, port)


def _scans_of_one_radar(log: Path, parsed: Log, source_id: int | None) -> list[Scan]:
    scans = [scan for scan in parsed.scans if scan.scan_type == RAW and source_id in (None, scan.source_id)]
    radars = sorted({scan.source_id for scan in scans})
    if len(radars) > 1:
        raise CaneflowError(
            f"{log}: scans of {len(radars)} radars; choose one with --source: {', '.join(map(str, radars))}"
        )
    if len(scans) < 2:
        raise CaneflowError(f"{log}: {len(scans)} complete raw scans; a period takes 2")
    return scans


def _losses(parsed: Log, scans: Sequence[Scan]) -> str:
    counts = parsed.counts
    parts = [f"{counts.incomplete_scans} incomplete ones left out"]
    never_came = missing_scans(scans) - counts.incomplete_scans - parsed.damaged_scans
    if never_came > 0:
        parts.append(f"{never_came} never came by their numbers")
    if counts.duplicate_packets:
        parts.append(f"{counts.duplicate_packets} packets came twice")
    if counts.restarts:
        parts.append(f"{counts.restarts} restarts of the radar's clock")
    if parsed.damage:
        size = sum(each.size for each in parsed.damage)
        parts.append(f"{parsed.damaged_scans} lost with {size} damaged bytes")
    if parsed.bytes_left:
        parts.append(f"{parsed.bytes_left} bytes of a cut packet at the end")
    return ", ".join(parts)


commands = {
    "p440": p440,
    "a121": "import_a121",
    "mmwave": "import_mmwave",
    "imu-csv": "import_imu_csv",
    "wav": "import_wav",
    "rosbag": "import_rosbag",
}
