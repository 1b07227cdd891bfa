"""Scans of a P440: put together from packets, taken apart into packets, with their range axis."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols.mrm import SAMPLES_PER_PACKET, ScanInfo

BIN_SECONDS = 1e-9 / (512 * 1.024)  # s, the radar's finest step of delay
ANTENNA_DELAY_PS = 10_000  # ps, path from the module to the stock antennas and back
LOG_HEAD_BYTES = 32
CLOCK_SPAN = 1 << 32  # ms, where the radar's clock wraps
ID_SPAN = 1 << 16
STEPS_REMEMBERED = 32  # between scans: the shortest of them is their period
GAP = 1.5  # periods between two scans, and more: there was one in between


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scan:
    """One complete scan as the radar sent it."""

    source_id: int
    message_id: int
    timestamp_ms: int  # ms since the radar's boot, wraps after 49.7 days
    scan_start_ps: int  # ps of delay of sample 0, antenna path included
    scan_stop_ps: int  # ps
    scan_step_bins: int  # bins of 1.907 ps between samples
    scan_type: int
    antenna_id: int
    operation_mode: int
    samples: NDArray[np.int32]  # shape (n,)

    @property
    def range_step(self) -> float:
        """Metres between samples."""
        return range_step(self.scan_step_bins)

    def range_start(self, antenna_delay_ps: float = ANTENNA_DELAY_PS) -> float:
        """Range (m) of sample 0, counted from the antenna."""
        return range_start(self.scan_start_ps, antenna_delay_ps)


def range_step(scan_step_bins: int = 32) -> float:
    """Metres of range between samples that lie `scan_step_bins` bins of delay apart."""
    return scan_step_bins * BIN_SECONDS * SPEED_OF_LIGHT / 2


def range_start(scan_start_ps: float, antenna_delay_ps: float = ANTENNA_DELAY_PS) -> float:
    """Range (m) of sample 0, counted from the antenna: the path to it is `antenna_delay_ps` long, both ways."""
    return (scan_start_ps - antenna_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2


def milliseconds_after(later_ms: int, earlier_ms: int) -> int:
    """`later_ms - earlier_ms` (ms) on the radar's wrapping clock, in -2^31..2^31-1."""
    return _wrapped_difference(later_ms, earlier_ms, CLOCK_SPAN)


def split_scan(scan: Scan) -> tuple[ScanInfo, ...]:
    """The packets in which a radar sends `scan`: the inverse of assembling them."""
    starts = range(0, max(len(scan.samples), 1), SAMPLES_PER_PACKET)
    return tuple(
        ScanInfo(
            message_id=scan.message_id,
            source_id=scan.source_id,
            timestamp_ms=scan.timestamp_ms,
            scan_start_ps=scan.scan_start_ps,
            scan_stop_ps=scan.scan_stop_ps,
            scan_step_bins=scan.scan_step_bins,
            scan_type=scan.scan_type,
            antenna_id=scan.antenna_id,
            operation_mode=scan.operation_mode,
            samples_total=len(scan.samples),
            message_index=index,
            messages_total=len(starts),
            samples=scan.samples[start : start + SAMPLES_PER_PACKET],
        )
        for index, start in enumerate(starts)
    )


@dataclass(kw_only=True, slots=True)
class AssemblyCounts:
    """What an assembler saw, and what it gave up."""

    packets: int = 0
    scans: int = 0  # complete ones, handed on
    incomplete_scans: int = 0  # given up because packets of theirs never came
    duplicate_packets: int = 0
    late_packets: int = 0  # of scans that were already handed on or given up
    contradicting_packets: int = 0  # of another shape than their scan's other packets
    restarts: int = 0  # clock went back: the radar was switched off and on


ScanKey: TypeAlias = tuple[int, int]  # timestamp_ms, message_id


@dataclass(slots=True)
class _Partial:
    first: ScanInfo
    pieces: dict[int, NDArray[np.int32]] = field(default_factory=dict)

    def agrees_with(self, packet: ScanInfo) -> bool:
        first = self.first
        return (first.samples_total, first.messages_total) == (packet.samples_total, packet.messages_total)

    def is_complete(self) -> bool:
        return len(self.pieces) == self.first.messages_total

    def scan(self) -> Scan | None:
        """The whole scan; None when the packets do not add up to the number of samples they announce."""
        first = self.first
        samples = np.concatenate([self.pieces[i] for i in range(first.messages_total)])
        if len(samples) != first.samples_total:
            return None
        return Scan(
            source_id=first.source_id,
            message_id=first.message_id,
            timestamp_ms=first.timestamp_ms,
            scan_start_ps=first.scan_start_ps,
            scan_stop_ps=first.scan_stop_ps,
            scan_step_bins=first.scan_step_bins,
            scan_type=first.scan_type,
            antenna_id=first.antenna_id,
            operation_mode=first.operation_mode,
            samples=samples,
        )


@dataclass(slots=True)
class _Source:
    """One radar's scans under way, oldest first, and the newest that is settled."""

    pending: dict[ScanKey, _Partial] = field(default_factory=dict)
    settled: ScanKey | None = None
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS_REMEMBERED))  # ms between settled scans

    def settle(self, key: ScanKey) -> None:
        """Note that the scan `key` is done with; it leaves what is pending."""
        if self.settled is not None:
            self.steps.append(max(milliseconds_after(key[0], self.settled[0]), 1))
        self.settled = key

    def unseen_for_ms(self, oldest: ScanKey, newest: ScanKey) -> float | None:
        """How long (ms) ago, at `newest`, a scan was due of which nothing has come.

        It would lie between the settled ones and `oldest`; None when no scan is missing there, as far as is known.
        """
        if self.settled is None:  # who knows with which scan it begins
            return milliseconds_after(newest[0], oldest[0])
        period = min(self.steps)
        if milliseconds_after(oldest[0], self.settled[0]) <= GAP * period:
            return None
        return milliseconds_after(newest[0], self.settled[0]) - period


class ScanAssembler:
    """Puts scans together from packets by (source, timestamp, message id, message index), never by count.

    Scans leave in the order of the radar's clock. A scan that lacks a packet holds the younger ones back until the
    clock of newer packets is `patience_ms` ahead of it, or `most_pending` scans wait; then it is given up and
    counted. Both bound the memory, with `most_sources` radars remembered at a time.

    With `period_ms`, a scan of which nothing has come yet is waited for likewise: where a scan is one packet,
    nothing else lets packets that changed places on the way come out in order.
    """

    def __init__(
        self,
        *,
        patience_ms: int = 25,  # ms of the radar's clock
        most_pending: int = 16,  # scans per radar
        most_sources: int = 8,
        restart_ms: int = 2000,  # ms: a clock that goes back further was started again
        period_ms: float | None = None,  # ms between scans, a guess until some have come; inf: no idea
    ) -> None:
        self.counts = AssemblyCounts()
        self._patience_ms = patience_ms
        self._most_pending = most_pending
        self._most_sources = most_sources
        self._restart_ms = restart_ms
        self._period_ms = period_ms
        self._sources: dict[int, _Source] = {}

    def feed(self, packet: ScanInfo) -> Iterator[Scan]:
        """Yield the scans that are settled by `packet`; it is taken even if nothing is drawn from the iterator."""
        self.counts.packets += 1
        settled: list[Scan] = []
        source = self._source(packet.source_id, settled)
        key = (packet.timestamp_ms, packet.message_id)
        if source.settled is not None and milliseconds_after(source.settled[0], key[0]) > self._restart_ms:
            self.counts.restarts += 1
            settled += self._release(source, everything=True)
            source.settled = None
        self._take(source, key, packet)
        settled += self._release(source)
        return iter(settled)

    def finish(self) -> Iterator[Scan]:
        """Yield the complete scans that still wait behind incomplete ones; the latter are given up."""
        settled = [scan for source in self._sources.values() for scan in self._release(source, everything=True)]
        return iter(settled)

    def _source(self, source_id: int, settled: list[Scan]) -> _Source:
        source = self._sources.pop(source_id, None) or _Source()
        if not source.steps and self._period_ms is not None:
            source.steps.append(self._period_ms)
        if len(self._sources) >= self._most_sources:
            longest_silent = next(iter(self._sources))
            settled += self._release(self._sources.pop(longest_silent), everything=True)
        self._sources[source_id] = source  # at the end: the radar that spoke last
        return source

    def _take(self, source: _Source, key: ScanKey, packet: ScanInfo) -> None:
        partial = source.pending.get(key)
        if partial is None:
            if source.settled is not None and not _is_after(key, source.settled):
                self.counts.late_packets += 1
                return
            partial = source.pending[key] = _Partial(packet)
        if not partial.agrees_with(packet):
            self.counts.contradicting_packets += 1
        elif packet.message_index in partial.pieces:
            self.counts.duplicate_packets += 1
        else:
            partial.pieces[packet.message_index] = packet.samples

    def _release(self, source: _Source, *, everything: bool = False) -> Iterator[Scan]:
        """Yield what is complete, oldest first, up to the first scan that is worth waiting for."""
        pending = source.pending
        while pending:
            oldest, newest = _oldest_and_newest(pending)
            too_many = len(pending) > self._most_pending
            overdue = milliseconds_after(newest[0], oldest[0]) > self._patience_ms or too_many
            unseen_ms = None if self._period_ms is None else source.unseen_for_ms(oldest, newest)
            waits = unseen_ms is not None and unseen_ms <= self._patience_ms and not too_many
            ready = not waits and (pending[oldest].is_complete() or overdue)
            if not (ready or everything):
                return
            partial = pending.pop(oldest)
            source.settle(oldest)
            scan = partial.scan() if partial.is_complete() else None
            if scan is None:
                self.counts.incomplete_scans += 1
            else:
                self.counts.scans += 1
                yield scan


def _oldest_and_newest(pending: Iterable[ScanKey]) -> tuple[ScanKey, ScanKey]:
    keys = iter(pending)
    oldest = newest = next(keys)
    for key in keys:
        if _is_after(oldest, key):
            oldest = key
        if _is_after(key, newest):
            newest = key
    return oldest, newest


def _is_after(key: ScanKey, other: ScanKey) -> bool:
    later_ms = milliseconds_after(key[0], other[0])
    if later_ms:
        return later_ms > 0
    return _wrapped_difference(key[1], other[1], ID_SPAN) > 0


def _wrapped_difference(later: int, earlier: int, span: int) -> int:
    return (later - earlier + span // 2) % span - span // 2
