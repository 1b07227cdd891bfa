"""Assembly of scans: any order, losses, copies, wrapping clocks; and logs that a real radar wrote."""

import itertools
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_logs import parse_log
from caneflow.protocols.mrm_scans import (
    Scan,
    ScanAssembler,
    milliseconds_after,
    range_start,
    range_step,
    split_scan,
)

DATA = Path(__file__).parents[1].parent / "shared" / "data"


def scan(number: int, *, samples: int = 960, source: int = 1, boot_ms: int = 0) -> Scan:
    return Scan(
        source_id=source,
        message_id=number % 2**16,
        timestamp_ms=(boot_ms + 10 * number) % 2**32,
        scan_start_ps=23342,
        scan_stop_ps=81935,
        scan_step_bins=32,
        scan_type=1,
        antenna_id=2,
        operation_mode=1,
        samples=np.random.default_rng(number).integers(-(10**6), 10**6, samples, dtype=np.int32),
    )


def assembled(packets: list[mrm.ScanInfo], assembler: ScanAssembler) -> list[Scan]:
    scans = [s for packet in packets for s in assembler.feed(packet)]
    return scans + list(assembler.finish())


def same(a: Scan, b: Scan) -> bool:
    return (a.source_id, a.message_id, a.timestamp_ms) == (
        b.source_id,
        b.message_id,
        b.timestamp_ms,
    ) and np.array_equal(a.samples, b.samples)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.integers(0, 1200))
def test_splitting_and_assembling_are_inverse(samples: int) -> None:
    whole = scan(3, samples=samples)
    packets = split_scan(whole)
    assert [len(p.samples) for p in packets[:-1]] == [350] * (len(packets) - 1)
    sent = [mrm.parse(mrm.build(p)) for p in packets]
    (got,) = assembled([p for p in sent if isinstance(p, mrm.ScanInfo)], ScanAssembler())
    assert same(got, whole)
    assert (got.scan_start_ps, got.scan_stop_ps, got.antenna_id) == (23342, 81935, 2)


@pytest.mark.parametrize("boot_ms", [0, 2**32 - 200])
def test_reordered_and_repeated_packets_of_neighbouring_scans(boot_ms: int) -> None:
    sent = [scan(65_520 + i, boot_ms=boot_ms - 655_200) for i in range(40)]  # message id wraps, clock too
    packets = [p for s in sent for p in split_scan(s)]
    places = np.arange(len(packets)) + np.random.default_rng(1).uniform(0, 4, len(packets))
    assembler = ScanAssembler()
    got = assembled([packets[i] for i in np.argsort(places) for _ in range(2)], assembler)
    assert len(got) == 40
    assert all(map(same, got, sent)), "in the order of the radar's clock"
    counts = assembler.counts
    assert (counts.scans, counts.incomplete_scans) == (40, 0)
    assert counts.duplicate_packets + counts.late_packets == len(packets)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.lists(st.integers(0, 59), max_size=30, unique=True), st.randoms(use_true_random=False))
def test_a_scan_comes_out_exactly_if_all_its_packets_went_in(lost: list[int], rng: random.Random) -> None:
    sent = [scan(i) for i in range(20)]  # three packets each
    packets = [(i, p) for i, p in enumerate(p for s in sent for p in split_scan(s)) if i not in lost]
    packets.sort(key=lambda p: p[0] + rng.uniform(0, 3))
    assembler = ScanAssembler()
    got = assembled([p for _, p in packets], assembler)
    complete = [s for i, s in enumerate(sent) if not {3 * i, 3 * i + 1, 3 * i + 2} & set(lost)]
    assert len(got) == len(complete)
    assert all(map(same, got, complete))
    seen = {i // 3 for i, _ in packets}
    assert assembler.counts.incomplete_scans == len(seen) - len(complete)


def test_an_incomplete_scan_holds_the_next_ones_back_only_so_long() -> None:
    first, *rest = (scan(i) for i in range(5))  # 10 ms apart
    assembler = ScanAssembler(patience_ms=25)
    assert not list(assembler.feed(split_scan(first)[0]))
    out = [[s.message_id for p in split_scan(s) for s in assembler.feed(p)] for s in rest]
    assert out == [[], [], [1, 2, 3], [4]]
    late = list(assembler.feed(split_scan(first)[1]))
    assert not late
    assert assembler.counts.late_packets == 1


def test_two_radars_do_not_mix() -> None:
    a, b = [[scan(i, source=s) for i in range(10)] for s in (1, 2)]
    packets = [p for pair in zip(a, b, strict=True) for ps in zip(*map(split_scan, pair), strict=True) for p in ps]
    got = assembled(packets, ScanAssembler())
    assert [s.message_id for s in got if s.source_id == 1] == list(range(10))
    assert [s.message_id for s in got if s.source_id == 2] == list(range(10))


def test_a_radar_that_is_switched_off_and_on_is_heard_again() -> None:
    before = [scan(i, boot_ms=100_000) for i in range(3)]
    after = [scan(i) for i in range(3)]
    assembler = ScanAssembler()
    got = assembled([p for s in before + after for p in split_scan(s)], assembler)
    assert len(got) == 6
    assert assembler.counts.restarts == 1


def test_packets_that_contradict_their_scan_are_left_out() -> None:
    good, other = scan(1), scan(1, samples=1152)
    assembler = ScanAssembler()
    packets = [split_scan(good)[0], split_scan(other)[3], *split_scan(good)[1:]]
    (got,) = assembled(packets, assembler)
    assert same(got, good)
    assert assembler.counts.contradicting_packets == 1


def test_packets_that_do_not_add_up_give_no_scan() -> None:
    a, b, c = split_scan(scan(1))
    short = replace(c, samples=c.samples[:-1])
    assembler = ScanAssembler()
    assert not assembled([a, b, short], assembler)
    assert assembler.counts.incomplete_scans == 1


def test_memory_stays_bounded_whatever_comes() -> None:
    rng = np.random.default_rng(5)
    assembler = ScanAssembler(most_pending=4, most_sources=3)
    for _ in range(3000):
        one = scan(int(rng.integers(10**6)), samples=700, source=int(rng.integers(50)))
        list(assembler.feed(split_scan(one)[rng.integers(2)]))
    held = [len(source.pending) for source in assembler._sources.values()]
    assert len(held) <= 3
    assert max(held) <= 4


@settings(deadline=None)  # a busy machine is not a failure
@given(st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1))
def test_the_clock_wraps(earlier: int, elapsed: int) -> None:
    assert milliseconds_after((earlier + elapsed) % 2**32, earlier) == elapsed


def test_range_axis_is_that_of_the_data_sheet() -> None:
    assert range_step(32) == pytest.approx(9.149e-3, abs=5e-7)
    assert range_start(10_000) == 0
    assert range_start(23_342) == pytest.approx(2.0, abs=1e-3)
    # 480 samples are 5 quanta of 96, 4.391 m (vendor's client)
    assert 480 * range_step() == pytest.approx(4.391, abs=5e-4)


def log_bytes(scans: list[Scan]) -> bytes:
    config = mrm.RadarConfig(node_id=1, scan_start_ps=23342, scan_stop_ps=81935)
    return config.to_bytes() + b"".join(mrm.build(p) for s in scans for p in split_scan(s))


def test_a_log_that_was_cut_off() -> None:
    scans = [scan(i) for i in range(4)]
    log = parse_log(log_bytes(scans)[:-100])
    assert log.config is not None
    assert log.config.scan_stop_ps == 81935
    assert [s.message_id for s in log.scans] == [0, 1, 2]
    assert log.bytes_left == 1352
    assert log.counts.incomplete_scans == 1


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"short", r"configuration block: 5 bytes, at least 32 are needed"),
        (bytes(32 + 1452), r"log, byte 32: message type 0x0000 is not known"),
        (bytes(32) + mrm.build(mrm.ReadyInfo(message_id=1)).ljust(1452, b"\0"), r"byte 32: a ReadyInfo, where"),
    ],
)
def test_what_is_no_log_is_named(data: bytes, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        parse_log(data)


@settings(deadline=None)  # a busy machine is not a failure
@given(st.binary(max_size=3000))
def test_no_log_raises_anything_but_a_protocol_error(data: bytes) -> None:
    try:
        log = parse_log(data)
    except ProtocolError:
        return
    assert not log.scans or len(data) >= 32 + 1452


@pytest.mark.parametrize(
    ("name", "scans", "samples", "incomplete"),
    [
        ("p440-rail-mocap/scan_2105627.txt", 607, 960, 1),
        ("p440-udp-loss/test_scan711_1000.txt", 427, 1152, 32),
        ("p440-udp-loss/test_scan2.txt", 100, 1152, 0),
    ],
)
def test_recorded_logs(name: str, scans: int, samples: int, incomplete: int) -> None:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the recording {name} is not here")
    log = parse_log(path.read_bytes())
    assert [s.samples.shape for s in log.scans] == [(samples,)] * scans
    assert log.counts.incomplete_scans == incomplete
    assert log.bytes_left == 0
    assert log.config is not None
    assert log.damage == ()
    assert {s.scan_start_ps for s in log.scans} == {log.config.scan_start_ps}
    # Every packet is accounted for: a scan has as many as its samples fill.
    in_scans = scans * -(-samples // 350)
    assert log.counts.packets - in_scans <= incomplete * 3
    stamps = [s.timestamp_ms for s in log.scans]
    assert all(b > a for a, b in itertools.pairwise(stamps))
