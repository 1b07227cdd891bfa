"""`caneflow import`: a recording of a device's own log."""

from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path
from statistics import median
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE, RadarFrame, numbered, sample_key
from caneflow.options import Overwrite
from caneflow.outputs import whole
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_scans import Log, Scan, milliseconds_after, parse_log
from caneflow.recording import RecordingWriter

MILLISECOND = 1_000_000  # ns
RAW = 1  # scan type: neither filtered nor detected
LONGEST_GAP = 10  # periods: how many scans a longer gap lacks is a guess, so it says nothing of the period


def p440(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log of raw MRM packets.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="REC", help="Recording to write.")],
    flow: Annotated[str, typer.Option(help="Flow under whose name it is recorded.")] = "cane",
    stream: Annotated[str, typer.Option(metavar="NODE/PORT", help="The radar's node and port.")] = "radar/frame",
    carrier: Annotated[float, typer.Option(min=1, metavar="HZ", help="Hz, centre of the received band.")] = 4.3e9,
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
    """Make a recording of a P440's log: its configuration, then MRM_SCAN_INFO packets as they came by UDP.

    Stamps are the radar's own time, 0 at the first scan. Scans that lack a packet are left out, and counted.

    Example: caneflow import p440 scan_2105627.txt -o rail.mcap
    """
    key = _key(flow, stream)
    with whole(output, inputs=[log], overwrite=overwrite) as recording:
        parsed = _parsed(log)
        scans = _scans_of_one_radar(log, parsed, source_id)
        stamps = stamps_of([scan.timestamp_ms for scan in scans])
        period = scan_period(stamps)
        with RecordingWriter(recording, flow=flow, source="imported", rig={}) as writer:
            for seq, (stamp, scan) in enumerate(zip(stamps, scans, strict=True)):
                frame = RadarFrame(
                    stamp=stamp,
                    scans=scan.samples[None, :],
                    scan_period=period,
                    range_start=scan.range_start(1000.0 * antenna_delay),
                    range_step=scan.range_step,
                    carrier=carrier,
                    bandwidth=bandwidth,
                )
                writer.write(key, RadarFrame, numbered(frame, seq), stamp=stamp, seq=seq, log_time=stamp)
    print(f"{output}: {len(scans)} scans of {len(scans[0].samples)} samples, {1 / period:.2f} Hz, {_losses(parsed)}")


def stamps_of(timestamps_ms: Sequence[int]) -> list[int]:
    """Stamps (ns, strictly increasing, from 0) of scans by the radar's clock, which shows whole milliseconds.

    Scans of one millisecond share it evenly. When the clock begins anew, time goes on one millisecond later: how
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


def _parsed(log: Path) -> Log:
    try:
        return parse_log(log.read_bytes())
    except ProtocolError as error:
        raise CaneflowError(f"{log}: {error}") from error


def _key(flow: str, stream: str) -> str:
    node, _, port = stream.partition("/")
    for name in (flow, node, port):
        if not NAME.fullmatch(name):
            raise CaneflowError(f"{flow}/{stream}: {name!r} is no name; that is {NAME_RULE}")
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


def _losses(parsed: Log) -> str:
    counts = parsed.counts
    parts = [f"{counts.incomplete_scans} incomplete ones left out"]
    if counts.restarts:
        parts.append(f"{counts.restarts} restarts of the radar's clock")
    if parsed.bytes_left:
        parts.append(f"{parsed.bytes_left} bytes of a cut packet at the end")
    return ", ".join(parts)


commands = {"p440": p440, "imu-csv": "import_imu_csv", "wav": "import_wav", "rosbag": "import_rosbag"}
