"""`caneflow info`: what is in a recording."""

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from caneflow.printable import printable
from caneflow.recording import Recording, Stream
from caneflow.recording.continuity import Continuity

MOST_STREAMS = 50  # that are listed
LONGEST = 200  # characters of a list or a name
EARLIEST_DATE = 10**18  # ns, 2001-09-09: stamps before it are a device's own time, which has no date


def command(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="Recording to look into.", show_default=False)],
    full: Annotated[
        bool,
        typer.Option("--full", help="Read every sample: finds each restart of the numbers and each wrong stamp."),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object; stamps in ns, spans in s, rates in Hz.")
    ] = False,
) -> None:
    """Say what is in a recording: where it comes from, how long it is, its streams and what they lost.

    It reads the file's index, the ends of each stream and 64 chunks in between, spread evenly, so a file of hours takes
    no longer than one of a minute. Lost is what is missing between a stream's first and last number.

    Example: caneflow info walk.mcap
    """
    about = describe(recording, full=full)
    print(json.dumps(about, indent=2) if as_json else "\n".join(_lines(about)))


def describe(path: Path, *, full: bool = False) -> dict[str, Any]:
    """What `info --json` prints. Times in s, stamps in ns, sizes in bytes."""
    with Recording(path) as recording:
        found = {each.key: each for each in recording.examined(glance=not full).values()}
        streams = list(recording.streams.values())
        ends = {stream.key: _ends(stream, found[stream.key]) for stream in streams}
        first = min((first for first, _ in ends.values() if first is not None), default=None)
        last = max((last for _, last in ends.values() if last is not None), default=None)
        return {
            "path": str(path),
            "size": path.stat().st_size,
            "complete": recording.complete,
            **{key: recording.metadata.get(key) for key in ("flow", "source", "run", "version", "part")},
            "platform": str(recording.platform) if recording.platform else None,
            "start": first,
            "duration": 0.0 if first is None or last is None else (last - first) / 1e9,
            "rig": recording.rig,
            "streams": [
                {
                    "stream": f"{stream.node}/{stream.port}",
                    "key": stream.key,
                    "schema": stream.schema,
                    "count": stream.count,
                    "rate": _rate(stream.count, *ends[stream.key]),
                    **(_all_faults(found[stream.key]) if full else _faults(stream, found[stream.key])),
                }
                for stream in streams
            ],
            "control": recording.control,
            "faults": [each.fault for each in found.values() if each.fault],
        }


def _ends(stream: Stream, found: Continuity) -> tuple[int | None, int | None]:
    """The smallest and the largest stamp (ns) that is known: where stamps go back, they are not at the ends."""
    known = [s for s in (stream.first_stamp, stream.last_stamp, found.smallest, found.largest) if s is not None]
    return (min(known), max(known)) if known else (None, None)


def _faults(stream: Stream, found: Continuity) -> dict[str, int | None]:
    """What the ends of a stream and a glance between them tell of its faults; None: that takes reading all of it."""
    missing = None
    if stream.first_seq is not None and stream.last_seq is not None:
        missing = stream.last_seq - stream.first_seq + 1 - stream.count
    return {
        "missing": missing if missing is None or missing >= 0 else None,
        "restarts": None,
        "stamps_back": found.stamps_back or None,
        "stamps_unlike": found.stamps_unlike or None,
    }


def _all_faults(found: Continuity) -> dict[str, int | None]:
    return {
        "missing": found.missing,
        "restarts": found.restarts,
        "stamps_back": found.stamps_back,
        "stamps_unlike": found.stamps_unlike,
    }


def _rate(count: int, first: int | None, last: int | None) -> float | None:
    """Samples per second; None for fewer than two."""
    if first is None or last is None or last <= first:
        return None
    return (count - 1) * 1e9 / (last - first)


def _lines(about: dict[str, Any]) -> Iterator[str]:
    state = "complete" if about["complete"] else "cut short; `caneflow recover` makes it sound"
    yield f"file      {printable(about['path'])}, {_size(about['size'])}, {state}"
    yield f"flow      {_short(about['flow'])}, {_short(about['source'])}, run {_short(about['run'])}"
    yield f"start     {_date(about['start'])}"
    yield f"duration  {about['duration']:.3f} s"
    if about["platform"] is not None:
        yield f"platform  {about['platform']}"
    if about["part"] is not None:
        yield f"part      {_short(about['part'])} of the run, as --rotate or --record-last made it"
    yield f"rig       {_short(', '.join(about['rig'])) or 'nothing known'}"
    if about["control"]:
        yield f"control   {sum(about['control'].values())} messages on {len(about['control'])} keys"
    rows = [("stream", "schema", "count", "rate", "lost")]
    rows += [
        (s["stream"], s["schema"], str(s["count"]), _hertz(s["rate"]), _loss(s))
        for s in about["streams"][:MOST_STREAMS]
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    yield ""
    for stream, schema, count, rate, lost in rows:
        yield f"{stream:{widths[0]}}  {schema:{widths[1]}}  {count:>{widths[2]}}  {rate:>{widths[3]}}  {lost}"
    if (more := len(about["streams"]) - MOST_STREAMS) > 0:
        yield f"and {more} more streams"
    if about["faults"]:
        yield ""
        yield from about["faults"][:MOST_STREAMS]


def _loss(stream: dict[str, Any]) -> str:
    if stream["missing"] is None:
        faults = ["-" if not stream["count"] else "numbers began again; --full counts"]
    else:
        faults = [str(stream["missing"])]
    if stream["restarts"]:
        faults.append(f"numbers began again {stream['restarts']} x")
    if stream["stamps_back"]:
        faults.append(f"stamps do not increase {stream['stamps_back']} x")
    if stream["stamps_unlike"]:
        faults.append(f"publish_time is not the stamp {stream['stamps_unlike']} x")
    return ", ".join(faults)


def _short(text: object) -> str:
    """`text` as a terminal can show it, on a line."""
    shown = printable(str(text)[: LONGEST + 1])
    return shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}..."


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
