"""Ranges of a recording over time: what emulated range sensors see."""

from pathlib import Path

from caneflow.messages import Ranges
from caneflow.protocols.maxbotix_emulator import Echoes
from caneflow.recording.errors import RecordingError
from caneflow.recording.reader import Recording


def readings_of(recording: Path, stream: str | None) -> tuple[int, list[Ranges]]:
    """Stamp (ns) of the recording's first sample, and the ranges of `stream` (NODE/PORT; None: the only one).

    Raises RecordingError where there is no such stream, or several to choose from.
    """
    with Recording(recording) as opened:
        there = {f"{found.node}/{found.port}": (found.node, found.port) for found in opened.streams_of(Ranges)}
        if stream is None and len(there) == 1:
            (stream,) = there
        if stream not in there:
            asked = f"no ranges {stream}" if stream else "choose one stream of ranges with --stream"
            raise RecordingError(f"{recording}: {asked}; there are {', '.join(there) or 'none'}")
        span = opened.span()
        assert span is not None  # the stream has a sample
        samples = [found.decoded() for found in opened.samples([there[stream]])]
    return span[0], [each for each in samples if isinstance(each, Ranges)]


def echoes_of(recording: Path, stream: str | None) -> Echoes:
    """The nearest target over time of a stream of ranges, from the recording's first sample on."""
    begin, readings = readings_of(recording, stream)
    return Echoes([(each.stamp - begin) * 1e-9 for each in readings], [nearest_of(each) for each in readings])


def nearest_of(reading: Ranges) -> float | None:
    """The nearest target (m) of all zones; None: there is none."""
    seen = reading.ranges[(reading.status == 0) & (reading.ranges > 0)]
    return float(seen.min()) if len(seen) else None
