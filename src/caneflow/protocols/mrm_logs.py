"""Logs of a P440, as raw packets or as the vendor's program writes them: what is whole in them, and what is damaged."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import LONGEST_SCAN, SCAN_INFO_BYTES, RadarConfig, ScanInfo, parse
from caneflow.protocols.mrm_scans import LOG_HEAD_BYTES, AssemblyCounts, Scan, ScanAssembler

PACKET_BEGINS = ScanInfo.CODE.to_bytes(2, "big")
SHAPE = ((0, 2), (4, 8), (28, 32), (32, 36), (36, 39), (44, 48), (50, 52))  # bytes of a header that all packets share
ALIKE = 5  # of them, in a packet of which one or two are damaged
SCAN_LINE, CONFIG_LINE = "MrmFullScanInfo", "Config"
COLUMNS = (  # of a SCAN_LINE where no line names them
    "Timestamp, MrmFullScanInfo, MessageId, SourceId, EmbeddedTimestamp, Reserved, Reserved, Reserved, Reserved, "
    "ScanStartPs, ScanStopPs, ScanStepBins, Filtering, AntennaId, Reserved, NumSamplesTotal, ScanData"
)


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


def parse_log(data: bytes) -> Log:
    """The log in `data`, with what is damaged left out: packets or lines of text.

    Packets are SCAN_INFO payloads of 1452 bytes each, behind a 32-byte configuration block or without it; after missing
    bytes the next whole one is looked for. Text is what the vendor's program writes, a line per scan.

    Raises:
        ProtocolError: nothing in it is whole; it names the first thing that is wrong.
    """
    return _text_log(data) if _is_text(data) else _packet_log(data)


def _packet_log(data: bytes) -> Log:
    begin = 0 if data.startswith(PACKET_BEGINS) else LOG_HEAD_BYTES
    config = RadarConfig.from_bytes(data) if begin else None
    assembler = ScanAssembler()
    scans: list[Scan] = []
    damage: list[Damage] = []
    offset, reference = begin, _reference(data, begin)
    while len(data) - offset >= SCAN_INFO_BYTES:
        try:
            packet = _packet_at(data, offset, reference)
        except ProtocolError as error:
            after = _next_packet(data, offset, reference)
            lost = (after - offset) / SCAN_INFO_BYTES / _packets_per_scan(reference)
            damage.append(Damage(place=f"byte {offset}", size=after - offset, reason=str(error), scans=lost))
            offset = after
            continue
        scans += assembler.feed(packet)
        offset += SCAN_INFO_BYTES
    scans += assembler.finish()
    if not scans and damage:
        raise ProtocolError(f"log, {damage[0].place}: {damage[0].reason}")
    left = max(len(data) - offset, 0)
    return Log(config=config, scans=tuple(scans), counts=assembler.counts, bytes_left=left, damage=tuple(damage))


def _reference(data: bytes, begin: int) -> bytes:
    """The header of a packet whose neighbours are like it: what the others are compared with; empty: there is none."""
    at = data.find(PACKET_BEGINS, begin)
    while 0 <= at <= len(data) - SCAN_INFO_BYTES:
        header, following = data[at : at + 52], data[at + SCAN_INFO_BYTES : at + SCAN_INFO_BYTES + 52]
        if _is_packet(data, at) and (len(following) < 52 or _alike(header, following) == len(SHAPE)):
            return header
        at = data.find(PACKET_BEGINS, at + 1)
    return b""


def _packet_at(data: bytes, offset: int, reference: bytes) -> ScanInfo:
    """The packet at `offset`, which has to be like the others and to be followed by one, or by the end."""
    packet = parse(data[offset : offset + SCAN_INFO_BYTES])
    if not isinstance(packet, ScanInfo):
        raise ProtocolError(f"a {type(packet).__name__}, where a log has ScanInfo only")
    following = data[offset + SCAN_INFO_BYTES : offset + SCAN_INFO_BYTES + 52]
    if len(following) == 52 and not (following.startswith(PACKET_BEGINS) or _alike(reference, following) >= ALIKE):
        raise ProtocolError("bytes are missing in this packet: none follows where it should end")
    return packet


def _next_packet(data: bytes, offset: int, reference: bytes) -> int:
    """Where, after something damaged at `offset`, the next packet begins; the end of the log if none does."""
    if _goes_on(data, offset + SCAN_INFO_BYTES, reference):
        return offset + SCAN_INFO_BYTES
    at = data.find(PACKET_BEGINS, offset + 1)
    while at >= 0:
        if _goes_on(data, at, reference):
            return at
        at = data.find(PACKET_BEGINS, at + 1)
    return len(data)


def _goes_on(data: bytes, at: int, reference: bytes) -> bool:
    return at + 52 <= len(data) and _alike(reference, data[at : at + 52]) >= ALIKE


def _is_packet(data: bytes, at: int) -> bool:
    try:
        return isinstance(parse(data[at : at + SCAN_INFO_BYTES]), ScanInfo)
    except ProtocolError:
        return False


def _alike(one: bytes, other: bytes) -> int:
    """How many parts of two headers are equal."""
    return sum(bool(one) and one[first:end] == other[first:end] for first, end in SHAPE)


def _packets_per_scan(reference: bytes) -> int:
    return max(int.from_bytes(reference[50:52], "big"), 1)


def _is_text(data: bytes) -> bool:
    head = data[:4096]
    return b"Mrm" in data[:65536] and not any(byte < 9 or 13 < byte < 32 for byte in head)


def _text_log(data: bytes) -> Log:
    scans: list[Scan] = []
    damage: list[Damage] = []
    columns = _columns(COLUMNS)
    config: RadarConfig | None = None
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        cells = [cell.strip() for cell in line.split(",")]
        kind = cells[1] if len(cells) > 1 else ""
        named = not cells[0].replace(".", "", 1).replace("-", "", 1).isdigit()
        if kind == SCAN_LINE and named:
            columns = _columns(line)
        elif kind == SCAN_LINE:
            try:
                scans.append(_scan_of(cells, columns))
            except (ValueError, KeyError, IndexError, OverflowError) as error:
                damage.append(Damage(place=f"line {number}", size=len(line) + 1, reason=str(error), scans=1.0))
        elif kind == CONFIG_LINE and not named and config is None:
            config = _config_of(cells)
    if not scans:
        reason = f"{damage[0].place}: {damage[0].reason}" if damage else f"no line with {SCAN_LINE}"
        raise ProtocolError(f"log, {reason}")
    counts = AssemblyCounts(packets=len(scans), scans=len(scans))
    return Log(config=config, scans=tuple(_in_order(scans)), counts=counts, bytes_left=0, damage=tuple(damage))


def _columns(line: str) -> dict[str, int]:
    """Where the cells of a scan's line are, by name."""
    return {cell.strip(): index for index, cell in reversed(list(enumerate(line.split(","))))}


def _scan_of(cells: list[str], columns: dict[str, int]) -> Scan:
    """The scan of a line; raises ValueError and others for a damaged one."""

    def value(name: str, lowest: int, highest: int) -> int:
        found = int(cells[columns[name]])
        if not lowest <= found <= highest:
            raise ValueError(f"{name} is {found}; expected {lowest} to {highest}")
        return found

    total = value("NumSamplesTotal", 1, LONGEST_SCAN)
    samples = [cell for cell in cells[columns["ScanData"] :] if cell]
    if len(samples) != total:
        raise ValueError(f"{len(samples)} samples of {total}")
    return Scan(
        source_id=value("SourceId", 0, 2**32 - 1),
        message_id=value("MessageId", 0, 2**32 - 1) % 2**16,
        timestamp_ms=value("EmbeddedTimestamp", 0, 2**32 - 1),
        scan_start_ps=value("ScanStartPs", -(2**31), 2**31 - 1),
        scan_stop_ps=value("ScanStopPs", -(2**31), 2**31 - 1),
        scan_step_bins=value("ScanStepBins", 1, 2**16 - 1),
        scan_type=value("Filtering", 0, 255),
        antenna_id=value("AntennaId", 0, 255),
        operation_mode=1,
        samples=np.array([int(cell) for cell in samples], dtype=np.int32),
    )


def _config_of(cells: list[str]) -> RadarConfig | None:
    """Node, window and integration of a `Config` line; None where it is not made of numbers."""
    try:
        node, start, stop, resolution, index = (int(cell) for cell in cells[2:7])
        return RadarConfig(
            node_id=node,
            scan_start_ps=start,
            scan_stop_ps=stop,
            scan_resolution_bins=resolution,
            base_integration_index=index,
        )
    except (ValueError, TypeError):
        return None


def _in_order(scans: list[Scan]) -> Iterator[Scan]:
    """The scans without those that are there twice, by time and kind."""
    seen: set[tuple[int, int, int, int]] = set()
    for scan in scans:
        key = (scan.source_id, scan.scan_type, scan.timestamp_ms, scan.message_id)
        if key not in seen:
            seen.add(key)
            yield scan
