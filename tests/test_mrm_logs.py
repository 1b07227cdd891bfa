"""Damaged logs of a P440: what is whole before and after the damage is kept, and the damage named."""

import numpy as np
import pytest

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_logs import COLUMNS, parse_log
from caneflow.protocols.mrm_scans import Scan, split_scan

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


def test_bytes_too_many_are_skipped() -> None:
    whole, at = log(), HEAD + 21 * PACKET + 700
    saved = parse_log(whole[:at] + bytes(range(200)) + whole[at:])
    assert len(saved.scans) == COUNT - 1
    assert saved.damage[0].place == f"byte {HEAD + 21 * PACKET}"
    assert saved.damaged_scans == 1


def test_a_log_without_a_head_is_read() -> None:
    assert numbers(log()[HEAD:]) == list(range(COUNT))
    assert parse_log(log()[HEAD:]).config is None


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
