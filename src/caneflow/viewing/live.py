"""The samples of a running flow, gathered for the page: in batches what is new, and what was before.

Samples come on the node's thread, the page is served on another. Everything kept here is bounded.
"""

import math
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

from caneflow.algorithms.rotations import Vector
from caneflow.messages import Pose, RadarFrame, Sample
from caneflow.messages.control import FlowStatus
from caneflow.messages.rig import Rig
from caneflow.viewing import packets
from caneflow.viewing.columns import COLUMNS, Row, message_name, packed, row_of
from caneflow.viewing.radar_picture import RadarPicture, RadarWindow

HISTORY = 12_000  # samples of a stream that a page is sent which opens later: two minutes at 100 Hz
MOST_PENDING = 2_000  # samples of a stream in one batch; beyond, the oldest are left out and counted
PICTURE_PERIOD = 0.1  # s between two range-Doppler maps
TRAFFIC_PERIOD = 0.5  # s between two tables of rates
RATE_SPAN = 2.0  # s that a rate is counted over
KEPT_ARRIVALS = 4_000
FAR_AHEAD_NS = (
    3600_000_000_000  # a live sample that is stamped later is of no clock; another machine's may be set badly
)
STALE_CLOCK_NS = 60_000_000_000  # an older sample is a replay's: its stamp says nothing of its age


@dataclass
class _Stream:
    """What is known of one stream."""

    kind: type[Sample]
    named: str  # the message's name, e.g. Imu
    rows: deque[tuple[float, Row]] = field(default_factory=lambda: deque(maxlen=HISTORY))  # s since the origin
    pending: deque[tuple[float, Row]] = field(default_factory=lambda: deque(maxlen=MOST_PENDING))
    first_seq: int = 0  # of what is pending
    last_seq: int = -1
    count: int = 0
    gaps: int = 0  # numbers that never came
    left_out: int = 0  # did not fit into a batch
    arrivals: deque[tuple[float, float]] = field(
        default_factory=lambda: deque(maxlen=KEPT_ARRIVALS)
    )  # s monotonic, and s since the measurement (NaN in a replay)
    method: str = ""


class LiveStreams:
    """Takes samples on one thread; gives batches on another."""

    lossless = False  # a page that is slow misses batches

    def __init__(self, *, flow: str, rig: Rig, live: bool | None = None, note: str = "") -> None:
        """`live`: False for a replay; None: found out from the first stamps."""
        self._flow = flow
        self._rig = rig
        self._live = live
        self._note = note
        self._boresight: Vector = rig.boresight
        self._lock = threading.Lock()
        self._origin: int | None = None  # ns: the first stamp
        self._streams: dict[str, _Stream] = {}
        self._radars: dict[str, RadarWindow] = {}
        self._drawn: dict[str, int] = {}  # stamp of the map sent last
        self._next_picture = self._next_traffic = 0.0  # s monotonic
        self._status: FlowStatus | None = None
        self._unheard = 0
        self._ended = False

    def take(self, name: str, message: Sample, received: int, schema: str = "") -> None:
        """Take a sample of the stream `name` (node/port), received at `received` ns.

        schema: of a message whose type is not known here, so that it is a bare Sample.
        """
        if self._live and message.stamp - received > FAR_AHEAD_NS:
            return  # it would be drawn where nothing else comes forever; its number counts as missing
        row = row_of(message, self._boresight)
        with self._lock:
            if self._origin is None:
                self._origin = message.stamp
                if self._live is None:
                    self._live = abs(received - message.stamp) < STALE_CLOCK_NS
            stream = self._streams.get(name)
            if stream is None:
                stream = self._streams[name] = _Stream(
                    type(message), message_name(message.schema or schema), last_seq=message.seq - 1
                )
            self._note_number(stream, message.seq)
            stream.left_out += len(stream.pending) == MOST_PENDING
            if not stream.pending:
                stream.first_seq = message.seq
            stream.pending.append(((message.stamp - self._origin) * 1e-9, row))
            age = (received - message.stamp) * 1e-9 if self._live else math.nan
            stream.arrivals.append((time.monotonic(), age))
            if isinstance(message, Pose):
                stream.method = message.method
            elif isinstance(message, RadarFrame):
                self._radars.setdefault(name, RadarWindow()).take(message)

    def tell(self, status: FlowStatus | None, unheard: int = 0) -> None:
        """What the launcher says of nodes and edges; `unheard`: samples that this process was too slow for."""
        with self._lock:
            self._status, self._unheard = status, unheard

    def end(self) -> None:
        """Note that the flow has ended."""
        self._ended = True

    def hello(self) -> bytes:
        """What a page is told first."""
        source = "replay" if self._live is False else "live"
        return packets.hello(flow=self._flow, source=source, rig=self._rig, note=self._note)

    def so_far(self) -> list[bytes]:
        """What came before the next batch; for a page that has just been opened."""
        with self._lock:
            streams = {
                name: _packed(stream, list(stream.rows), stream.last_seq - len(stream.pending) - len(stream.rows) + 1)
                for name, stream in self._streams.items()
            }
            return [packets.packet("batch", origin=self._origin_s(), streams=streams)] if streams else []

    def batch(self, *, watched: bool = True) -> bytes:
        """What is new but the map, whether someone watches or not."""
        now = time.monotonic()
        values: dict[str, Any] = {"ended": self._ended}
        with self._lock:
            values["origin"] = self._origin_s()
            values["streams"] = {name: self._moved(s) for name, s in self._streams.items() if s.pending}
            if now >= self._next_traffic:
                self._next_traffic = now + TRAFFIC_PERIOD
                values["traffic"] = {name: _traffic(stream, now) for name, stream in self._streams.items()}
                values["unheard"] = self._unheard
                if self._status is not None:
                    values["status"] = packets.status(self._status.nodes, self._status.edges)
        return packets.packet("batch", **values)

    def picture(self) -> bytes | None:
        """The maps, when it is time for new ones; samples can be taken meanwhile."""
        now = time.monotonic()
        if now < self._next_picture:
            return None
        self._next_picture = now + PICTURE_PERIOD
        with self._lock:
            origin = self._origin or 0
            windows = {name: window.copy() for name, window in self._radars.items()}
        made = {name: self._picture(name, window) for name, window in windows.items()}
        pictures = [packets.picture(name, drawn, origin) for name, drawn in made.items() if drawn]
        return packets.packet("pictures", pictures=pictures) if pictures else None

    def answer(self, request: dict[str, Any]) -> bytes | None:
        """A running flow has no answers: the page keeps what it was sent."""

    def _origin_s(self) -> float:
        return (self._origin or 0) * 1e-9

    def _note_number(self, stream: _Stream, seq: int) -> None:
        if seq > stream.last_seq:  # else: a source that began again
            stream.gaps += seq - stream.last_seq - 1
        stream.last_seq = seq
        stream.count += 1

    def _moved(self, stream: _Stream) -> Any:
        """What is pending, as sent; from now on it was before."""
        rows = list(stream.pending)
        stream.pending.clear()
        stream.rows.extend(rows)
        return _packed(stream, rows, stream.first_seq)

    def _picture(self, name: str, window: RadarWindow) -> RadarPicture | None:
        made = window.picture()
        if made is None or self._drawn.get(name) == made.stamp:
            return None
        self._drawn[name] = made.stamp
        return made


def _packed(stream: _Stream, rows: list[tuple[float, Row]], first_seq: int) -> Any:
    return packets.stream(
        kind=stream.named,
        columns=COLUMNS.get(stream.kind, ()),
        times=packed([(time_s,) for time_s, _ in rows]),
        rows=packed([row for _, row in rows]),
        first_seq=first_seq,
        gaps=stream.gaps,
        method=stream.method,
    )


def _traffic(stream: _Stream, now: float) -> dict[str, Any]:
    """Rate and age as seen here, over the last RATE_SPAN."""
    recent = list(takewhile(lambda arrival: now - arrival[0] <= RATE_SPAN, reversed(stream.arrivals)))
    ages = sorted(age for _, age in recent if not math.isnan(age))
    return {
        "type": stream.named,
        "count": stream.count,
        "rate": len(recent) / RATE_SPAN,
        "silent": now - stream.arrivals[-1][0] if stream.arrivals else None,
        "gaps": stream.gaps,
        "left_out": stream.left_out,
        "age_p50": ages[len(ages) // 2] if ages else None,
        "age_p99": ages[min(len(ages) - 1, math.ceil(0.99 * len(ages)))] if ages else None,
    }
