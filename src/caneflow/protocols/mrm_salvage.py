"""What could be saved of a P440's log, what was damaged, and how many scans are missing in between."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from statistics import median

from caneflow.protocols.mrm import RadarConfig, ScanInfo
from caneflow.protocols.mrm_scans import ID_SPAN, AssemblyCounts, Scan, ScanAssembler, milliseconds_after

LOG_PATIENCE = 1000  # ms of the radar's clock: in a file nothing is gained by giving a scan up soon
LOG_PENDING = 64  # scans
COUNTING = 0.5  # of the steps of a message id, and more, are alike: it counts scans


@dataclass(frozen=True, kw_only=True, slots=True)
class Damage:
    """A part of a log that could not be used."""

    place: str  # "byte 1016432" or "line 17"
    size: int  # bytes
    reason: str
    scans: float  # that are lost with it, by its size


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Log:
    """A recorded log: how the radar was set, its complete scans, and what was lost."""

    config: RadarConfig | None  # None: the log does not say
    scans: tuple[Scan, ...]
    counts: AssemblyCounts
    bytes_left: int  # of a last packet that was cut off
    damage: tuple[Damage, ...] = ()

    @property
    def damaged_scans(self) -> int:
        """How many scans are lost with the damage, rounded up."""
        return math.ceil(sum(each.scans for each in self.damage))


def assembled(packets: Iterable[ScanInfo]) -> tuple[tuple[Scan, ...], AssemblyCounts]:
    """The scans of a log's packets in the order of each radar's clock, and what was given up.

    Packets may be out of order by up to a second. Raw and filtered scans bear the same numbers and are kept apart.
    """
    assemblers: dict[int, ScanAssembler] = {}
    scans: list[Scan] = []
    for packet in packets:
        assembler = assemblers.get(packet.scan_type)
        if assembler is None:
            assembler = ScanAssembler(patience_ms=LOG_PATIENCE, most_pending=LOG_PENDING, period_ms=math.inf)
            assemblers[packet.scan_type] = assembler
        scans += assembler.feed(packet)
    for assembler in assemblers.values():
        scans += assembler.finish()
    return tuple(scans), _sum_of([each.counts for each in assemblers.values()])


def missing_scans(scans: Sequence[Scan]) -> int:
    """How many are missing between the scans of one radar and kind, by message ids that count scans; else 0.

    Where the id leaps farther than the clock leaves room for, it was set again, and the clock says how many.
    """
    ids = [(later.message_id - earlier.message_id) % ID_SPAN for earlier, later in pairwise(scans)]
    times = [milliseconds_after(later.timestamp_ms, earlier.timestamp_ms) for earlier, later in pairwise(scans)]
    usual, seen = Counter(ids).most_common(1)[0] if ids else (0, 0)
    if not usual or seen < COUNTING * len(ids):
        return 0
    period = median(time for time, step in zip(times, ids, strict=True) if step == usual)
    missing = 0
    for time, step in zip(times, ids, strict=True):
        room = math.ceil((time + 1) / max(period, 1)) - 2  # stamps are whole milliseconds
        missing += max(min(step // usual - 1, room), 0)
    return missing


def _sum_of(counts: Iterable[AssemblyCounts]) -> AssemblyCounts:
    total = AssemblyCounts()
    for each in counts:
        for field in fields(AssemblyCounts):
            setattr(total, field.name, getattr(total, field.name) + getattr(each, field.name))
    return total
