"""Damaged logs of a P440: what is whole before and after the damage is kept, and the damage named."""

from dataclasses import replace

import numpy as np
import pytest

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_salvage import missing_scans
from caneflow.protocols.mrm_scans import Scan, split_scan
from caneflow.protocols.mrm_text_logs import COLUMNS

HEAD, PACKET, COUNT = 32, 1452, 30


def scan(number: int) -> Scan:
    random = np.random.default_rng(number)
    return Scan(
        source_id=101,
        message_id=number,
        timestamp_ms=5000 + 17 * number,
        scan_start_ps=23342,
        scan_stop_ps=81935,
        scan_step_bins=32,
        scan_type=1,
        antenna_id=3,
        operation_mode=1,
        samples=random.integers(-100_000, 100_000, 480, dtype=np.int32),
    )


def log() -> bytes:
    config = mrm.RadarConfig(node_id=1, scan_start_ps=23342, scan_stop_ps=81935)
    return config.to_bytes() + b"".join(mrm.build(p) for n in range(COUNT) for p in split_scan(scan(n)))


def numbers(data: bytes) -> list[int]:
    """Of the scans that are saved; each has to be what it was."""
    found = parse_log(data).scans
    for one in found:
        np.testing.assert_array_equal(one.samples, scan(one.message_id).samples)
    return [one.message_id for one in found]


@pytest.mark.parametrize("byte", [0, 1, 43, 45, 49, 51])
@pytest.mark.parametrize("packet", [0, 11, 2 * COUNT - 1])
def test_a_flipped_byte_costs_one_scan(byte: int, packet: int) -> None:
    data = bytearray(log())
    data[HEAD + packet * PACKET + byte] ^= 0xFF
    assert len(numbers(bytes(data))) >= COUNT - 1
    damage = parse_log(bytes(data)).damage
    if damage:
        assert damage[0].place == f"byte {HEAD + packet * PACKET}"


@pytest.mark.parametrize("missing", [1, 100, 1000, 1451, 5000])
@pytest.mark.parametrize("within", [0, 3, 333, 1400])
def test_missing_bytes_cost_what_they_cut(missing: int, within: int) -> None:
    whole, at = log(), HEAD + 21 * PACKET + within
    data = whole[:at] + whole[at + missing :]
    saved = numbers(data)
    assert len(saved) >= COUNT - 2 - missing // PACKET
    assert saved[:10] == list(range(10))
    assert saved[-10:] == list(range(COUNT - 10, COUNT))


@pytest.mark.parametrize("count", [1, 2, 3, 10])
def test_packets_that_were_overwritten_cost_no_others(count: int) -> None:
    whole, at = bytearray(log()), HEAD + 20 * PACKET
    whole[at : at + count * PACKET] = bytes(count * PACKET)
    assert numbers(bytes(whole)) == [n for n in range(COUNT) if not 10 <= n < 10 + (count + 1) // 2]


def test_bytes_too_many_are_skipped() -> None:
    whole, at = log(), HEAD + 21 * PACKET + 700
    saved = parse_log(whole[:at] + bytes(range(200)) + whole[at:])
    assert len(saved.scans) == COUNT - 1
    assert saved.damage[0].place == f"byte {HEAD + 21 * PACKET}"
    assert saved.damaged_scans == 1


def test_a_log_without_a_head_is_read() -> None:
    assert numbers(log()[HEAD:]) == list(range(COUNT))
    assert parse_log(log()[HEAD:]).config is None


def packets(count: int = COUNT) -> list[bytes]:
    return [mrm.build(packet) for number in range(count) for packet in split_scan(scan(number))]


def single(number: int) -> bytes:
    """A scan of one packet."""
    return mrm.build(split_scan(replace(scan(number), samples=scan(number).samples[:300]))[0])


@pytest.mark.parametrize("cut", [1, 31, 32, 33, 52, 700, PACKET - 1, PACKET, PACKET + 1, PACKET + 100])
def test_a_log_that_begins_or_ends_anywhere_is_read_from_there_and_up_to_there(cut: int) -> None:
    whole = log()
    lost = 1 + (cut - HEAD) // (2 * PACKET) if cut > HEAD else 0
    assert numbers(whole[cut:]) == list(range(lost, COUNT))
    assert numbers(whole[: len(whole) - cut]) == list(range(COUNT - 1))


@pytest.mark.parametrize("times", [2, 3])
def test_a_log_that_repeats_is_there_once(times: int) -> None:
    assert numbers(log() * times) == list(range(COUNT))
    twice = parse_log(log()[:HEAD] + b"".join(each * times for each in packets()))
    assert [each.message_id for each in twice.scans] == list(range(COUNT))
    assert (twice.counts.duplicate_packets, twice.counts.restarts) == (2 * COUNT * (times - 1), 0)
    late = packets() + packets()[10:40]
    assert numbers(b"".join(late)) == list(range(COUNT))


@pytest.mark.parametrize("group", [2, 4, 6, 14])
def test_packets_out_of_order_come_into_order(group: int) -> None:
    each = packets()
    backwards = [packet for i in range(0, len(each), group) for packet in reversed(each[i : i + group])]
    interleaved = [packet for i in range(0, len(each), group) for k in (0, 1) for packet in each[i + k : i + group : 2]]
    for order in (backwards, interleaved):
        assert numbers(log()[:HEAD] + b"".join(order)) == list(range(COUNT))
    alone = [single(number) for number in range(COUNT)]
    swapped = [packet for i in range(0, COUNT, group) for packet in reversed(alone[i : i + group])]
    assert [s.message_id for s in parse_log(b"".join(swapped)).scans] == list(range(COUNT))


@pytest.mark.parametrize("at", [0, 1, 15, COUNT - 2, COUNT - 1])
@pytest.mark.parametrize("byte", [4, 8, 28, 36, 46])
def test_a_flipped_byte_that_makes_another_valid_header_costs_its_packet(at: int, byte: int) -> None:
    data = bytearray(b"".join(single(number) for number in range(COUNT)))
    data[at * PACKET + byte] ^= 0x21
    found = parse_log(bytes(data))
    assert [s.message_id for s in found.scans] == [number for number in range(COUNT) if number != at]
    assert [each.place for each in found.damage] == [f"byte {at * PACKET}"]
    assert found.counts.restarts == 0


def test_messages_of_other_kinds_between_scans_are_no_damage() -> None:
    each = packets()
    confirm = mrm.build(mrm.ControlConfirm(message_id=1, status=0))
    detections = bytes.fromhex("12010001 0002 0000") + bytes(1400)
    data = log()[:HEAD] + b"".join(
        [*each[:9], confirm, *each[9:31], detections, *each[31:40], log()[:HEAD], *each[40:]]
    )
    assert numbers(data) == list(range(COUNT))
    assert parse_log(data).damage == ()


def test_radars_and_filters_share_a_log() -> None:
    every = []
    for number in range(COUNT):
        raw = scan(number)
        filtered = replace(raw, scan_type=4, samples=-raw.samples)
        other = replace(raw, source_id=102, scan_start_ps=0, scan_stop_ps=50000, message_id=7 * number)
        every += [packet for trio in zip(*map(split_scan, (filtered, raw, other)), strict=True) for packet in trio]
    found = parse_log(b"".join(map(mrm.build, every))).scans
    of = [[s for s in found if (s.source_id, s.scan_type) == kind] for kind in ((101, 1), (101, 4), (102, 1))]
    assert [len(each) for each in of] == [COUNT] * 3
    for number, (raw, filtered) in enumerate(zip(of[0], of[1], strict=True)):
        np.testing.assert_array_equal(raw.samples, scan(number).samples)
        np.testing.assert_array_equal(filtered.samples, -raw.samples)


def test_scans_that_never_came_are_counted_by_number_and_clock() -> None:
    every = [scan(number) for number in range(COUNT)]
    assert missing_scans(every) == 0
    assert missing_scans([each for each in every if each.message_id not in (3, 7, 8, 20)]) == 4
    assert missing_scans([replace(each, message_id=5) for each in every if each.message_id != 3]) == 0
    assert missing_scans([replace(each, message_id=2 * each.message_id) for each in every if each.message_id != 3]) == 1
    wrapped = [replace(each, message_id=(each.message_id + 2**16 - 9) % 2**16) for each in every]
    assert missing_scans(wrapped[:5] + wrapped[12:]) == 7
    again = every[:10] + [replace(each, message_id=each.message_id + 500) for each in every[10:]]
    assert missing_scans(again) == 0
    later = every[:10] + [replace(each, timestamp_ms=each.timestamp_ms + 10**6) for each in every[10:]]
    assert missing_scans(later) == 0
    assert missing_scans(every[:1]) == missing_scans([]) == 0


def text_log() -> list[str]:
    """As the vendor's program writes it."""
    lines = ["Timestamp, Config, NodeId, ScanStartPs, ScanStopPs, ScanResolutionBins, BaseIntegrationIndex"]
    lines += ["10.1, Config, 101, 23342, 81935, 32, 11", COLUMNS]
    for number in range(COUNT):
        one = scan(number)
        head = [10.2 + 0.017 * number, "MrmFullScanInfo", number, 101, one.timestamp_ms, 0, 0, 0, 0, 23342, 81935]
        lines.append(", ".join(map(str, [*head, 32, 1, 3, 0, len(one.samples), *one.samples])))
    return lines


def test_the_vendors_text_is_read() -> None:
    data = "\n".join(text_log()).encode()
    assert numbers(data) == list(range(COUNT))
    config = parse_log(data).config
    assert config is not None
    assert (config.scan_stop_ps, config.base_integration_index) == (81935, 11)
    assert numbers("\r\n".join(text_log()[3:]).encode()) == list(range(COUNT))  # no line that names the columns


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
def test_text_as_editors_and_spreadsheets_save_it(end: str, encoding: str) -> None:
    bom = "\ufeff" if encoding == "utf-16-be" else ""
    for lines in (text_log(), text_log()[3:]):
        gaps = [gap for line in lines for gap in (line, "", "# a remark")]
        for variant in (lines, gaps, [line.replace(", ", ";") for line in lines], [line + ",,," for line in lines]):
            assert numbers((bom + end.join(variant) + end).encode(encoding)) == list(range(COUNT))


def test_lines_of_text_out_of_order_and_twice() -> None:
    lines = text_log()
    mixed = lines[:3] + [line for pair in zip(lines[4::2], lines[3::2], strict=True) for line in (*pair, pair[0])]
    found = parse_log("\n".join(mixed).encode())
    assert [one.message_id for one in found.scans] == list(range(COUNT))


def test_two_lines_that_became_one_are_two_scans() -> None:
    lines = text_log()
    lines[10:12] = [lines[10] + lines[11]]
    found = parse_log("\n".join(lines).encode())
    assert (len(found.scans), found.damaged_scans) == (COUNT - 2, 2)


def test_a_damaged_line_of_text_is_named() -> None:
    lines = text_log()
    lines[10] = lines[10][:500]
    lines[12] = lines[12].replace("81935", "x1935")
    found = parse_log("\n".join(lines).encode())
    assert len(found.scans) == COUNT - 2
    assert [each.place for each in found.damage] == ["line 11", "line 13"]


@pytest.mark.parametrize("content", [b"Timestamp, MrmDetectionListInfo\n1, MrmDetectionListInfo, 3\n"])
def test_text_without_scans_is_refused(content: bytes) -> None:
    with pytest.raises(ProtocolError, match="no line with MrmFullScanInfo"):
        parse_log(content)
