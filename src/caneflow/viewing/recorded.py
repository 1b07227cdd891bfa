"""A recording, for the page: its series once, thinned where they are long, and what lay at any instant when asked."""

import math
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from caneflow.algorithms.rotations import Vector
from caneflow.messages import Pose, RadarFrame
from caneflow.recording import TRUTH, Recorded, Recording, RecordingError, Stream
from caneflow.viewing import packets
from caneflow.viewing.columns import COLUMNS, Row, message_name, packed, row_of
from caneflow.viewing.radar_picture import SCANS, RadarWindow

MOST_POINTS = 20_000  # of a stream; of a longer one every so many samples are shown
CHUNK = 2_000  # samples in one packet
LOOK_BACK_NS = 1_000_000_000  # for the samples at an instant, and for the scans of a map


class RecordedStreams:
    """Reads a recording; gives packets to the page's server, on another thread. A context manager."""

    lossless = True  # the packets lie ready: a slow page is given all of them

    def __init__(self, path: Path) -> None:
        """Raises RecordingError for a file that is not a recording, or that holds no sample."""
        self._path = path
        with Recording(path) as recording:
            span = recording.span()
            if span is None:
                raise RecordingError(f"{path}: holds no sample; there is nothing to see")
            self._flow = recording.flow
            self._rig = recording.validated_rig()
            self._streams = dict(recording.streams)
            self._origin, self._end = span
        self._ready: list[bytes] = []  # packets
        self._given = 0  # packets that every open page has
        self._asking = threading.Lock()
        self._recording = Recording(path)  # for answers only
        self.problem = ""

    def __enter__(self) -> "RecordedStreams":
        return self

    def __exit__(self, *_: object) -> None:
        with self._asking:
            self._recording.close()

    def read(self) -> None:
        """Read everything; what is read lies ready at once."""
        try:
            with Recording(self._path) as recording:
                for (node, port), stream in sorted(self._streams.items(), key=lambda each: each[0] == TRUTH):
                    if stream.count:
                        self._read(recording, f"{node}/{port}", stream)
        except RecordingError as error:
            self.problem = str(error)
        self._ready.append(packets.packet("read", problem=self.problem))

    def hello(self) -> bytes:
        """What a page is told first."""
        if any(stream.schema == Pose.schema and stream.count for stream in self._streams.values()):
            note = ""
        else:
            note = (
                "There is no position in this recording. caneflow run dataflow.yaml --replay "
                f"{self._path.name} --record track.mcap makes a recording with one."
            )
        span_s = (self._end - self._origin) * 1e-9
        return packets.hello(
            flow=f"{self._path.name} ({self._flow})", source="recording", rig=self._rig, span_s=span_s, note=note
        )

    def so_far(self) -> list[bytes]:
        """What has been read and was given to the pages that are open already."""
        return self._ready[: self._given]

    def batch(self, *, watched: bool = True) -> bytes | None:
        """What has been read since."""
        if self._given == len(self._ready) or not watched:
            return None
        self._given += 1
        return self._ready[self._given - 1]

    def picture(self) -> bytes | None:
        """A map is only made for an instant that is asked for."""
        return None

    def answer(self, request: dict[str, Any]) -> bytes | None:
        """The samples at or before an instant, and the map there: for {"at": s since the recording's start}."""
        at = request.get("at")
        if not isinstance(at, (int, float)) or not math.isfinite(at):
            return None
        stamp = self._origin + round(at * 1e9)
        with self._asking:  # a recording is read by one thread at a time
            values = {name: shown for name, stream in self._shown() if (shown := self._at(stream, stamp))}
            pictures = [
                packets.picture(name, made, self._origin)
                for name, stream in self._shown(RadarFrame.schema)
                if (made := self._picture(stream, stamp))
            ]
        return packets.packet("at", at=at, values=values, pictures=pictures)

    def _shown(self, schema: str | None = None) -> Iterator[tuple[str, Stream]]:
        for (node, port), stream in self._streams.items():
            if stream.count and (stream.schema == schema if schema else stream.schema != RadarFrame.schema):
                yield f"{node}/{port}", stream

    def _before(self, stream: Stream, stamp: int) -> Iterator[Recorded]:
        names = [(stream.node, stream.port)]
        return self._recording.samples(names, start_ns=stamp - LOOK_BACK_NS, end_ns=stamp + 1)

    def _at(self, stream: Stream, stamp: int) -> Any:
        last = next(iter(deque(self._before(stream, stamp), maxlen=1)), None)
        if last is None or last.kind not in COLUMNS:
            return None
        row = row_of(last.decoded(), self._rig.boresight)
        return {"time": (last.stamp - self._origin) * 1e-9, "seq": last.seq, "row": packed([row])}

    def _picture(self, stream: Stream, stamp: int) -> Any:
        window = RadarWindow()
        for sample in list(self._before(stream, stamp))[-SCANS:]:
            frame = sample.decoded()
            assert isinstance(frame, RadarFrame)
            window.take(frame)
        return window.picture()

    def _read(self, recording: Recording, name: str, stream: Stream) -> None:
        part = _Part(kind=message_name(stream.schema), every=max(1, -(-stream.count // MOST_POINTS)), of=stream.count)
        for number, sample in enumerate(recording.samples([(stream.node, stream.port)])):
            part.count(sample.seq)
            if number % part.every == 0:
                part.add(sample, self._origin, self._rig.boresight)
                if len(part.rows) == CHUNK:
                    self._give(name, part)
        self._give(name, part)

    def _give(self, name: str, part: "_Part") -> None:
        self._ready.append(packets.packet("batch", origin=self._origin * 1e-9, streams={name: part.packed()}))
        part.rows.clear()


@dataclass
class _Part:
    """Samples of one stream, on their way to the page."""

    kind: str
    every: int  # of so many samples one is shown
    of: int  # samples in the recording
    columns: tuple[str, ...] = ()
    rows: list[tuple[float, Row]] = field(default_factory=list)  # s since the origin
    first_seq: int = 0  # of the rows
    last_seq: int = -1
    gaps: int = 0
    method: str = ""

    def count(self, seq: int) -> None:
        if 0 <= self.last_seq < seq:
            self.gaps += seq - self.last_seq - 1
        self.last_seq = seq

    def add(self, sample: Recorded, origin: int, boresight: Vector) -> None:
        if not self.rows:
            self.first_seq = sample.seq
        row: Row = ()
        if sample.kind in COLUMNS:
            message = sample.decoded()
            self.columns = COLUMNS[type(message)]
            row = row_of(message, boresight)
            self.method = message.method if isinstance(message, Pose) else ""
        self.rows.append(((sample.stamp - origin) * 1e-9, row))

    def packed(self) -> dict[str, Any]:
        sent = packets.stream(
            kind=self.kind,
            columns=self.columns,
            times=packed([(time_s,) for time_s, _ in self.rows]),
            rows=packed([row for _, row in self.rows]),
            first_seq=self.first_seq,
            gaps=self.gaps,
            method=self.method,
        )
        return {**sent, "every": self.every, "of": self.of}
