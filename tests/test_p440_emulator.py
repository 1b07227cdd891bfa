"""The emulated P440: the protocol it speaks, the faults it has, and what it makes of recorded packets."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_emulator import Faults, Moment, RadarEmulator, moments_of_log
from caneflow.protocols.mrm_scans import Scan, split_scan

CONFIG = mrm.RadarConfig(node_id=9, scan_start_ps=9998, scan_stop_ps=39295)
LOGS = Path(__file__).parents[1].parent / "shared" / "data" / "p440-udp-loss"
START = mrm.ControlRequest(message_id=5, scan_count=mrm.SCAN_COUNT_FOREVER, scan_interval_us=10_000)
STOP = mrm.ControlRequest(message_id=6, scan_count=mrm.SCAN_COUNT_STOP)


def moments(count: int) -> Iterator[Moment]:
    """One scan of two packets every 10 ms."""
    for number in range(count):
        scan = Scan(
            source_id=9,
            message_id=number,
            timestamp_ms=10 * number,
            scan_start_ps=9998,
            scan_stop_ps=39295,
            scan_step_bins=32,
            scan_type=1,
            antenna_id=1,
            operation_mode=1,
            samples=np.full(480, number, np.int32),
        )
        yield Moment(0.01 * number, tuple(mrm.build(packet) for packet in split_scan(scan)))


def emulator(count: int = 100, *, seed: int = 1, **options: object) -> RadarEmulator:
    return RadarEmulator(moments(count), config=CONFIG, random=np.random.default_rng(seed), **options)  # type: ignore[arg-type]


def asked(radar: RadarEmulator, request: mrm.Message, now: float = 0.0) -> mrm.Message:
    (answer,) = radar.receive(mrm.build(request), now)
    return mrm.parse(answer)


def sent(radar: RadarEmulator, times: list[float]) -> list[mrm.ScanInfo]:
    packets = [mrm.parse(packet) for time in times for packet in radar.send_due(time)]
    return [packet for packet in packets if isinstance(packet, mrm.ScanInfo)]


def every_10_ms(start: float, stop: float) -> list[float]:
    return [start + 0.01 * i + 1e-6 for i in range(round((stop - start) / 0.01))]


@pytest.mark.parametrize(
    ("message", "data"),
    [
        (mrm.SetOperationModeRequest(message_id=2, mode=1), "f003 0002 00000001"),
        (mrm.SetOperationModeConfirm(message_id=2, mode=1, status=3), "f103 0002 00000001 00000003"),
        (mrm.SetSleepModeRequest(message_id=3, mode=4), "f005 0003 00000004"),
        (mrm.SetSleepModeConfirm(message_id=3, status=1), "f105 0003 00000001"),
    ],
)
def test_mode_messages_lie_where_the_specification_says(message: mrm.Message, data: str) -> None:
    assert mrm.build(message) == bytes.fromhex(data)
    assert mrm.parse(bytes.fromhex(data)) == message


def test_settings_are_taken_and_the_window_is_the_recordings() -> None:
    radar = emulator()
    wanted = replace(CONFIG, scan_start_ps=0, scan_stop_ps=5000, code_channel=3, transmit_gain=40)
    assert asked(radar, mrm.SetConfigRequest(message_id=1, config=wanted)) == mrm.SetConfigConfirm(message_id=1)
    got = asked(radar, mrm.GetConfigRequest(message_id=2))
    assert got == mrm.GetConfigConfirm(
        message_id=2, config=replace(CONFIG, code_channel=3, transmit_gain=40), timestamp_ms=0
    )


@pytest.mark.parametrize(
    "wrong",
    [{"node_id": 0}, {"base_integration_index": 16}, {"code_channel": 11}, {"scan_stop_ps": 0}, {"transmit_gain": 64}],
)
def test_settings_that_a_radar_does_not_support_change_nothing(wrong: dict[str, int]) -> None:
    radar = emulator()
    answer = asked(radar, mrm.SetConfigRequest(message_id=1, config=replace(CONFIG, **wrong)))  # type: ignore[arg-type]
    assert answer == mrm.SetConfigConfirm(message_id=1, status=mrm.STATUS_UNSUPPORTED)
    got = asked(radar, mrm.GetConfigRequest(message_id=2))
    assert isinstance(got, mrm.GetConfigConfirm)
    assert got.config == CONFIG


def test_it_scans_between_start_and_stop_and_the_world_goes_on_meanwhile() -> None:
    radar = emulator()
    assert not sent(radar, [0.0, 50.0])
    assert radar.next_due(50.0) is None
    assert asked(radar, START, 100.0) == mrm.ControlConfirm(message_id=5)
    assert [p.message_id for p in sent(radar, [100.0])] == [0, 0]
    assert radar.next_due(100.0) == pytest.approx(100.01)
    assert [p.message_id for p in sent(radar, [100.03])] == [1, 1, 2, 2, 3, 3]
    asked(radar, STOP, 100.031)
    assert not radar.scanning
    assert not sent(radar, every_10_ms(100.04, 100.5))
    asked(radar, START, 100.505)
    assert [p.message_id for p in sent(radar, [100.511])] == [51, 51]
    assert not radar.over
    sent(radar, [101.0])
    assert radar.over


def test_with_a_given_beginning_nothing_waits_for_the_start() -> None:
    radar = emulator(begin=7.0)
    asked(radar, START, 7.205)
    assert [p.message_id for p in sent(radar, [7.211])] == [21, 21]


def test_a_stop_may_go_unconfirmed() -> None:
    radar = emulator(confirms_stop=False)
    asked(radar, START)
    assert not radar.receive(mrm.build(STOP), 0.5)
    assert not radar.scanning


@pytest.mark.parametrize(
    ("options", "status"),
    [({"mode": 0}, mrm.STATUS_WRONG_MODE), ({"sleep": 2}, mrm.STATUS_ASLEEP), ({}, mrm.STATUS_OK)],
)
def test_asleep_or_in_another_mode_it_does_not_scan(options: dict[str, int], status: int) -> None:
    radar = emulator(**options)
    assert asked(radar, START) == mrm.ControlConfirm(message_id=5, status=status)
    assert radar.scanning is (status == mrm.STATUS_OK)
    asked(radar, mrm.SetSleepModeRequest(message_id=1, mode=mrm.SLEEP_ACTIVE))
    asked(radar, mrm.SetOperationModeRequest(message_id=1, mode=mrm.MODE_MRM))
    assert asked(radar, START) == mrm.ControlConfirm(message_id=5)


def test_faults_are_as_frequent_as_asked() -> None:
    radar = emulator(2500, faults=Faults(loss=0.02, reorder=0.1, duplicate=0.05))
    while not radar.scanning:  # the request itself may get lost
        radar.receive(mrm.build(START), 0.0)
    packets = sent(radar, every_10_ms(0.0, 25.1))
    counts = radar.counts
    assert counts.scans == 2500
    assert counts.reordered / 5000 == pytest.approx(0.1, abs=0.015)
    assert counts.duplicated / 5000 == pytest.approx(0.05 * 0.9, abs=0.012)
    assert counts.lost / 5000 == pytest.approx(0.02, abs=0.008)
    keys = [(p.message_id, p.message_index) for p in packets]
    assert len(keys) - len(set(keys)) == pytest.approx(counts.duplicated, rel=0.1)
    arrived = list(dict.fromkeys(keys))
    places = {key: place for place, key in enumerate(sorted(arrived))}
    assert 1 <= max(place - places[key] for place, key in enumerate(arrived)) <= 6, "overtaken by a few, not by many"


def test_it_freezes_once_until_it_is_started_anew() -> None:
    radar = emulator(faults=Faults(freezes=((0.3, math.inf),)))
    asked(radar, START)
    assert max(p.message_id for p in sent(radar, every_10_ms(0.0, 0.5))) == 29
    assert not radar.scanning
    asked(radar, START, 0.505)
    assert [p.message_id for p in sent(radar, every_10_ms(0.5, 0.53))] == [51, 51, 52, 52]


def test_a_freeze_may_end_by_itself_and_come_again() -> None:
    radar = emulator(faults=Faults(freezes=((0.6, 0.1), (0.3, 0.1))))
    asked(radar, START)
    seen = sorted({p.message_id for p in sent(radar, every_10_ms(0.0, 0.8))})
    assert seen == [*range(30), *range(40, 60), *range(70, seen[-1] + 1)]
    assert seen[-1] >= 78


def test_power_may_fail_more_than_once() -> None:
    radar = emulator(faults=Faults(unplugs=((0.1, 0.1), (0.4, 0.1))))
    asked(radar, START)
    ready = []
    for now in every_10_ms(0.0, 0.7):
        said = [mrm.parse(message) for message in radar.send_due(now)]
        ready += [now for message in said if isinstance(message, mrm.ReadyInfo)]
    assert ready == pytest.approx([0.2, 0.5], abs=0.015)


def test_without_power_it_is_silent_and_then_it_has_booted() -> None:
    radar = emulator(faults=Faults(unplugs=((0.3, 0.2),)))
    asked(radar, START)
    assert max(p.message_id for p in sent(radar, every_10_ms(0.0, 0.4))) == 29
    assert not radar.receive(mrm.build(START), 0.41)
    assert radar.next_due(0.41) == pytest.approx(0.41, abs=0.2)
    (ready,) = radar.send_due(0.501)
    assert isinstance(mrm.parse(ready), mrm.ReadyInfo)
    assert not radar.scanning
    asked(radar, START, 0.505)
    packets = sent(radar, every_10_ms(0.5, 0.53))
    assert [(p.message_id, p.timestamp_ms) for p in packets] == [(51, 9), (51, 9), (52, 19), (52, 19)]


@settings(deadline=None)  # a busy machine is not a failure
@given(st.lists(st.binary(max_size=60), max_size=20), st.sampled_from([b"", b"\x10\x01", b"\x10\x03", b"\xf0\x05"]))
def test_no_request_upsets_it(requests: list[bytes], head: bytes) -> None:
    radar = emulator(10)
    for number, request in enumerate(requests):
        for answer in radar.receive(head + request, 0.01 * number):
            mrm.parse(answer)
        radar.send_due(0.01 * number)
    assert radar.counts.requests == len(requests)


@pytest.mark.parametrize("name", ["test_scan2.txt", "test_scan711_1000.txt"])
def test_logs_are_played_byte_for_byte_at_their_own_pace(name: str) -> None:
    if not (LOGS / name).exists():
        pytest.skip("the recorded packets are not here")
    data = (LOGS / name).read_bytes()
    config, played = moments_of_log(data)
    listed = list(played)
    assert b"".join([config.to_bytes(), *(m.packets[0] for m in listed)]) == data[: 32 + 1452 * len(listed)]
    times = [m.time for m in listed]
    assert times == sorted(times)
    stamps = [int.from_bytes(m.packets[0][8:12]) for m in listed]
    assert times[-1] == pytest.approx((stamps[-1] - stamps[0]) / 1e3)


def test_a_log_of_something_else_is_refused() -> None:
    with pytest.raises(ProtocolError, match="0 bytes, at least 32"):
        moments_of_log(b"")
    _, played = moments_of_log(CONFIG.to_bytes() + mrm.build(START).ljust(1452, b"\0"))
    with pytest.raises(ProtocolError, match="byte 32: a ControlRequest"):
        list(played)
