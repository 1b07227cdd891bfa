"""Logs of a P440's raw packets: what is whole in them, and what is damaged."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from hashlib import blake2b
from typing import NamedTuple

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import SCAN_INFO_BYTES, RadarConfig, ReadyInfo, ScanInfo, parse
from caneflow.protocols.mrm_salvage import Damage, Log, assembled
from caneflow.protocols.mrm_scans import LOG_HEAD_BYTES, milliseconds_after
from caneflow.protocols.mrm_text_logs import is_text, parse_text_log

PACKET_BEGINS = ScanInfo.CODE.to_bytes(2, "big")
HEADER_BYTES = 52
SHAPE = ((0, 2), (4, 8), (28, 32), (32, 36), (36, 39), (44, 48), (50, 52))  # bytes of a header that all packets share
ALIKE = 5  # of them, in a packet of which one or two are damaged
HEAD_WINDOW = slice(4, 12)  # of a configuration block: start and stop of the scan
MOST_SHAPES = 8  # radars and windows of one log that are looked for after damage
DETECTION_LIST = 0x1201  # from the vendor's service
OTHER_MESSAGES = frozenset(  # between scans: confirmations, detections, and what the radar tells unasked
    code.to_bytes(2, "big") for code in (*range(0x1101, 0x1108), DETECTION_LIST, *range(0xF101, 0xF107), ReadyInfo.CODE)
)
OVERWRITTEN = 16  # packets, and fewer, that something else stands in place of, with the next one where it should be
CLOCK_LEAP = 2000  # ms: one packet alone that is farther from both its neighbours has a damaged stamp


class _At(NamedTuple):
    offset: int
    packet: ScanInfo


def parse_log(data: bytes) -> Log:
    """The log in `data`, with what is damaged left out: packets or lines of text.

    Packets are SCAN_INFO payloads of 1452 bytes each, behind a 32-byte configuration block or without it; after missing
    bytes the next whole one is looked for. Text is what the vendor's program writes, a line per scan.

    Raises:
        ProtocolError: nothing in it is whole; it names the first thing that is wrong.
    """
    return parse_text_log(data) if is_text(data) else _packet_log(data)


def _packet_log(data: bytes) -> Log:
    shapes = _shapes(data)
    config, begin = _head(data, shapes)
    damage: list[Damage] = []
    packets, end = _packets(data, begin, shapes, damage)
    packets = _without_strays(packets, shapes, damage)
    scans, counts = assembled(_without_copies(data, packets))
    counts.duplicate_packets += len(packets) - counts.packets
    damage.sort(key=lambda each: int(each.place.removeprefix("byte ")))
    if not scans and damage:
        raise ProtocolError(f"log, {damage[0].place}: {damage[0].reason}")
    return Log(config=config, scans=scans, counts=counts, bytes_left=len(data) - end, damage=tuple(damage))


def _shapes(data: bytes) -> Counter[bytes]:
    """The headers' common parts, and how many packets of the log have each."""
    found: Counter[bytes] = Counter()
    at = data.find(PACKET_BEGINS)
    while at >= 0:
        whole = _is_packet(data, at)
        if whole:
            found[_shape(data[at : at + HEADER_BYTES])] += 1
        at = data.find(PACKET_BEGINS, at + (HEADER_BYTES if whole else 1))
    return Counter(dict(found.most_common(MOST_SHAPES)))


def _shape(header: bytes) -> bytes:
    return b"".join(header[first:end] for first, end in SHAPE)


def _head(data: bytes, shapes: Iterable[bytes]) -> tuple[RadarConfig | None, int]:
    """The configuration block, where there is one, and where the packets begin."""
    if data.startswith(PACKET_BEGINS):
        return None, 0
    follows = data[LOG_HEAD_BYTES : LOG_HEAD_BYTES + 2] == PACKET_BEGINS
    if follows or not any(shapes) or _is_head(data, 0, shapes):
        return RadarConfig.from_bytes(data), LOG_HEAD_BYTES
    return None, 0


def _is_head(data: bytes, at: int, shapes: Iterable[bytes]) -> bool:
    """Whether a configuration block with the window of the packets stands there."""
    return data[at : at + LOG_HEAD_BYTES][HEAD_WINDOW] in {shape[6:14] for shape in shapes}


def _packets(data: bytes, begin: int, shapes: Counter[bytes], damage: list[Damage]) -> tuple[list[_At], int]:
    """The packets that are whole, and where they end; what is none goes to `damage`."""
    packets: list[_At] = []
    offset = begin
    while len(data) - offset >= SCAN_INFO_BYTES:
        try:
            packets.append(_At(offset, _packet_at(data, offset, shapes)))
        except ProtocolError as error:
            after = offset + _other(data, offset, shapes)
            if after == offset:
                after = _after_damage(data, offset, shapes)
                damage.append(_damage(offset, after - offset, str(error), shapes))
            offset = after
            continue
        offset += SCAN_INFO_BYTES
    return packets, min(offset, len(data))


def _packet_at(data: bytes, offset: int, shapes: Counter[bytes]) -> ScanInfo:
    """The packet at `offset`, which has to be followed by one, by another message, or by the end."""
    packet = parse(data[offset : offset + SCAN_INFO_BYTES])
    if not isinstance(packet, ScanInfo):
        raise ProtocolError(f"a {type(packet).__name__}, where a log has ScanInfo only")
    after = offset + SCAN_INFO_BYTES
    due = range(after, after + OVERWRITTEN * SCAN_INFO_BYTES, SCAN_INFO_BYTES)
    begins = data.startswith(PACKET_BEGINS, after) or any(_goes_on(data, at, shapes) for at in due)
    if not (begins or len(data) - after < HEADER_BYTES or _other(data, after, shapes)):
        raise ProtocolError("bytes are missing in this packet: none follows where it should end")
    return packet


def _other(data: bytes, at: int, shapes: Counter[bytes]) -> int:
    """How many bytes there are of something else that belongs into a log: a configuration block, a message; else 0."""
    if _is_head(data, at, shapes) and data.startswith(PACKET_BEGINS, at + LOG_HEAD_BYTES):
        return LOG_HEAD_BYTES
    if data[at : at + 2] in OTHER_MESSAGES:
        after = _next_packet(data, at + 4, shapes)
        return after - at if after < len(data) and after - at <= SCAN_INFO_BYTES else 0
    return 0


def _after_damage(data: bytes, offset: int, shapes: Counter[bytes]) -> int:
    """Where, after a packet that is damaged, the next one begins."""
    due = offset + SCAN_INFO_BYTES
    return due if _goes_on(data, due, shapes) else _next_packet(data, offset + 1, shapes)


def _next_packet(data: bytes, at: int, shapes: Counter[bytes]) -> int:
    """Where, at `at` or later, the next packet begins; the end of the log if none does."""
    at = data.find(PACKET_BEGINS, at)
    while at >= 0:
        if _goes_on(data, at, shapes):
            return at
        at = data.find(PACKET_BEGINS, at + 1)
    return len(data)


def _goes_on(data: bytes, at: int, shapes: Counter[bytes]) -> bool:
    """Whether a packet, perhaps with a damaged header, begins there."""
    header = data[at : at + HEADER_BYTES]
    return len(header) == HEADER_BYTES and any(_alike(shape, _shape(header)) >= ALIKE for shape in shapes)


def _alike(one: bytes, other: bytes) -> int:
    """How many parts of two shapes are equal."""
    ends, alike = 0, 0
    for first, end in SHAPE:
        part = slice(ends, ends + end - first)
        alike += one[part] == other[part]
        ends = part.stop
    return alike


def _is_packet(data: bytes, at: int) -> bool:
    try:
        return len(data) - at >= SCAN_INFO_BYTES and isinstance(parse(data[at : at + SCAN_INFO_BYTES]), ScanInfo)
    except ProtocolError:
        return False


def _damage(offset: int, size: int, reason: str, shapes: Counter[bytes]) -> Damage:
    usual = next(iter(shapes), b"\0\1")
    per_scan = max(int.from_bytes(usual[-2:], "big"), 1)
    return Damage(place=f"byte {offset}", size=size, reason=reason, scans=size / SCAN_INFO_BYTES / per_scan)


def _without_strays(packets: Sequence[_At], shapes: Counter[bytes], damage: list[Damage]) -> list[_At]:
    """The packets without those whose header a flipped bit made another valid one: of a shape, or at a time, alone."""
    several = max(shapes.values(), default=0) > 2
    by_source: dict[int, list[_At]] = {}
    for each in packets:
        by_source.setdefault(each.packet.source_id, []).append(each)
    astray = {at.offset for each in by_source.values() for at in _out_of_time(each)}
    headers = Counter(_packet_shape(each.packet) for each in packets)
    kept: list[_At] = []
    for each in packets:
        if several and headers[_packet_shape(each.packet)] == 1:
            damage.append(_damage(each.offset, SCAN_INFO_BYTES, "a header unlike all others in the log", shapes))
        elif each.offset in astray:
            reason = f"a stamp of {each.packet.timestamp_ms} ms, seconds from those before and after it"
            damage.append(_damage(each.offset, SCAN_INFO_BYTES, reason, shapes))
        else:
            kept.append(each)
    return kept


def _packet_shape(packet: ScanInfo) -> tuple[int, ...]:
    window = (packet.scan_start_ps, packet.scan_stop_ps, packet.scan_step_bins)
    return (packet.source_id, *window, packet.scan_type, packet.samples_total, packet.messages_total)


def _out_of_time(packets: Sequence[_At]) -> Iterator[_At]:
    """Those of one radar whose clock leaps and leaps back at the next packet."""

    def near(one: int, other: int) -> bool:
        stamps = packets[one].packet.timestamp_ms, packets[other].packet.timestamp_ms
        return abs(milliseconds_after(*stamps)) <= CLOCK_LEAP

    last = len(packets) - 1
    for i, each in enumerate(packets):
        if last < 2:
            return
        before, after = (1, 2) if i == 0 else (last - 2, last - 1) if i == last else (i - 1, i + 1)
        if near(before, after) and not near(i, before) and not near(i, after):
            yield each


def _without_copies(data: bytes, packets: Iterable[_At]) -> Iterator[ScanInfo]:
    """The packets without those that are there a second time, however much later."""
    seen: set[bytes] = set()
    for each in packets:
        digest = blake2b(data[each.offset : each.offset + SCAN_INFO_BYTES], digest_size=16).digest()
        if digest not in seen:
            seen.add(digest)
            yield each.packet
