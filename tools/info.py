"""`caneflow info`: what is in a recording."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from caneflow.recording import Recording, Stream

EARLIEST_DATE = 10**18  # ns, 2001-09-09: stamps before it are a device's own time, which has no date


@dataclass
class Numbering:
    """How the numbers of one stream go on: gaps are losses; jumps back are a source that began anew."""

    last_seq: int = -1
    last_stamp: int = -1
    missing: int = 0
    restarts: int = 0
    stamps_back: int = 0  # samples whose stamp does not lie after that of the one before

    def take(self, seq: int, stamp: int) -> None:
        """Note the next sample."""
        if seq <= self.last_seq:
            self.restarts += 1
        elif self.last_seq >= 0:
            self.missing += seq - self.last_seq - 1
        self.stamps_back += stamp <= self.last_stamp
        self.last_seq, self.last_stamp = seq, stamp


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to look into.", show_default=False)],
    full: Annotated[
        bool, typer.Option("--full", help="Read every sample: finds numbers that begin anew, stamps that go back.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; stamps in ns, spans in s, rates in Hz.")
    ] = False,
) -> None:
    """Say what is in a recording: where it comes from, how long it is, its streams and what they lost.

    It reads the file's index and the ends of each stream, so a file of hours takes no longer than one of seconds.
    Lost is what is missing between a stream's first and last number.

    Example: caneflow info walk.mcap
    """
    about = describe(recording, full=full)
    print(json.dumps(about, indent=2) if as_json else "\n".join(_lines(about)))


def describe(path: Path, *, full: bool = False) -> dict[str, Any]:
    """What `info --json` prints. Times in s, stamps in ns, sizes in bytes."""
    with Recording(path) as recording:
        faults = _all_faults(recording) if full else {s.key: _faults(s) for s in recording.streams.values()}
        span = recording.span()
        return {
            "path": str(path),
            "size": path.stat().st_size,
            "complete": recording.complete,
            **{key: recording.metadata.get(key) for key in ("flow", "source", "run", "version", "part")},
            "platform": str(recording.platform) if recording.platform else None,
            "start": span[0] if span else None,
            "duration": (span[1] - span[0]) / 1e9 if span else 0.0,
            "rig": recording.rig,
            "streams": [
                {
                    "stream": f"{stream.node}/{stream.port}",
                    "key": stream.key,
                    "schema": stream.schema,
                    "count": stream.count,
                    "rate": _rate(stream.count, stream.first_stamp, stream.last_stamp),
                    **faults[stream.key],
                }
                for stream in recording.streams.values()
            ],
            "control": recording.control,
        }


def _faults(stream: Stream) -> dict[str, int | None]:
    """What the ends of a stream tell of its faults; None: that takes reading all of it."""
    missing = None
    if stream.first_seq is not None and stream.last_seq is not None:
        missing = stream.last_seq - stream.first_seq + 1 - stream.count
    return {"missing": missing if missing is None or missing >= 0 else None, "restarts": None, "stamps_back": None}


def _all_faults(recording: Recording) -> dict[str, dict[str, int | None]]:
    numbering = {stream.key: Numbering() for stream in recording.streams.values()}
    for name, stream in recording.streams.items():
        for sample in recording.samples([name]):
            numbering[stream.key].take(sample.seq, sample.stamp)
    return {
        key: {"missing": each.missing, "restarts": each.restarts, "stamps_back": each.stamps_back}
        for key, each in numbering.items()
    }


def _rate(count: int, first: int | None, last: int | None) -> float | None:
    """Samples per second; None for fewer than two."""
    if first is None or last is None or last <= first:
        return None
    return (count - 1) * 1e9 / (last - first)


def _lines(about: dict[str, Any]) -> Iterator[str]:
    state = "complete" if about["complete"] else "cut short; `caneflow recover` makes it sound"
    yield f"file      {about['path']}, {_size(about['size'])}, {state}"
    yield f"flow      {about['flow']}, {about['source']}, run {about['run']}"
    yield f"start     {_date(about['start'])}"
    yield f"duration  {about['duration']:.3f} s"
    if about["platform"] is not None:
        yield f"platform  {about['platform']}"
    if about["part"] is not None:
        yield f"part      {about['part']} of the run, as --rotate or --record-last made it"
    yield f"rig       {', '.join(about['rig']) or 'nothing known'}"
    if about["control"]:
        yield f"control   {sum(about['control'].values())} messages on {len(about['control'])} keys"
    rows = [("stream", "schema", "count", "rate", "lost")]
    rows += [(s["stream"], s["schema"], str(s["count"]), _hertz(s["rate"]), _loss(s)) for s in about["streams"]]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    yield ""
    for stream, schema, count, rate, lost in rows:
        yield f"{stream:{widths[0]}}  {schema:{widths[1]}}  {count:>{widths[2]}}  {rate:>{widths[3]}}  {lost}"


def _loss(stream: dict[str, Any]) -> str:
    if stream["missing"] is None:
        return "-" if not stream["count"] else "numbers began anew; --full counts"
    faults = [str(stream["missing"])]
    if stream["restarts"]:
        faults.append(f"numbers began anew {stream['restarts']} x")
    if stream["stamps_back"]:
        faults.append(f"stamps do not increase {stream['stamps_back']} x")
    return ", ".join(faults)


def _hertz(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.2f} Hz"


def _date(stamp: int | None) -> str:
    if stamp is None:
        return "no samples"
    if stamp < EARLIEST_DATE:
        return f"{stamp / 1e9:.3f} s of the device's own time"
    return datetime.fromtimestamp(stamp / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")


def _size(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e6 else f"{size / 1e3:.1f} kB"
