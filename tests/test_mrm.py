"""MRM messages and serial frames: against hand-laid bytes, their own inverse, and noise."""

import binascii
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caneflow.protocols import mrm
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm_serial import SerialDeframer, framed

CONFIG = mrm.RadarConfig(
    node_id=7,
    scan_start_ps=-100,
    scan_stop_ps=39297,
    segment_sample_counts=(1, 2, 3, 4),
    segment_integrations=(5, 6, 7, 8),
    code_channel=3,
)
SCAN_INFO = mrm.ScanInfo(
    message_id=9,
    source_id=100,
    timestamp_ms=2_362_863,
    reserved=bytes(range(16)),
    scan_start_ps=23342,
    scan_stop_ps=81935,
    antenna_id=2,
    samples_total=960,
    message_index=2,
    messages_total=3,
    samples=np.arange(-130, 130, dtype=np.int32) * 70_001,
)
STATUS = mrm.GetStatusConfirm(
    message_id=4,
    application=(3, 1, 517),
    kernel=(2, 3, 4),
    fpga=(9, 0x16, 0x02, 0x29),
    serial_number=0x2105627,
    board=(1, 2, 3),
    self_test=0,
    temperature=-12.25,
    package="P440 MRM",
    status=1,
)
OTHERS: list[mrm.Message] = [
    mrm.SetConfigRequest(message_id=65535, config=CONFIG),
    mrm.SetConfigConfirm(message_id=1, status=3),
    mrm.GetConfigRequest(message_id=2),
    mrm.GetConfigConfirm(message_id=3, config=CONFIG, timestamp_ms=2**32 - 1, status=0),
    mrm.ControlRequest(message_id=4, scan_count=mrm.SCAN_COUNT_FOREVER, scan_interval_us=10_000),
    mrm.ControlConfirm(message_id=5),
    mrm.GetStatusRequest(message_id=6),
    STATUS,
    mrm.ReadyInfo(message_id=8),
]


@pytest.mark.parametrize("message", OTHERS, ids=lambda m: type(m).__name__)
def test_build_and_parse_are_inverse(message: mrm.Message) -> None:
    assert mrm.parse(mrm.build(message)) == message


@pytest.mark.parametrize(
    ("message", "size"),
    list(zip([*OTHERS, SCAN_INFO], [36, 8, 4, 44, 12, 8, 4, 64, 4, 1452], strict=True)),
    ids=lambda x: type(x).__name__,
)
def test_sizes_are_those_of_the_specification(message: mrm.Message, size: int) -> None:
    assert len(mrm.build(message)) == size


def test_scan_info_lies_where_the_specification_says() -> None:
    data = mrm.build(SCAN_INFO)
    assert struct.unpack_from(">HHII", data, 0) == (0xF201, 9, 100, 2_362_863)
    assert data[12:28] == bytes(range(16))
    assert struct.unpack_from(">iiHBxBB", data, 28) == (23342, 81935, 32, 1, 2, 1)
    assert struct.unpack_from(">HIHH", data, 42) == (260, 960, 2, 3)
    assert struct.unpack_from(">260i", data, 52) == tuple(SCAN_INFO.samples.tolist())
    assert not any(data[52 + 4 * 260 :])


def test_scan_info_comes_back_whole() -> None:
    back = mrm.parse(mrm.build(SCAN_INFO))
    assert isinstance(back, mrm.ScanInfo)
    assert back.samples.dtype == np.int32
    assert np.array_equal(back.samples, SCAN_INFO.samples)
    for name in ("message_id", "source_id", "timestamp_ms", "reserved", "scan_start_ps", "scan_stop_ps"):
        assert getattr(back, name) == getattr(SCAN_INFO, name)
    assert (back.antenna_id, back.samples_total, back.message_index, back.messages_total) == (2, 960, 2, 3)


def test_a_scan_info_as_long_as_its_samples_is_accepted() -> None:
    short = mrm.parse(mrm.build(SCAN_INFO)[: 52 + 4 * 260])
    assert isinstance(short, mrm.ScanInfo)
    assert np.array_equal(short.samples, SCAN_INFO.samples)


def test_old_status_without_a_package_name() -> None:
    new = mrm.build(STATUS)
    old = mrm.parse(new[:28] + new[60:])
    assert old == replace(STATUS, package="")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\xf2", r"message: 1 bytes, at least 4 are needed"),
        (b"\x12\x01\x00\x00", r"type 0x1201 is not known; known are 0x1001, .*0xF202"),
        (b"\x10\x03\x00\x00\x00", r"ControlRequest: 5 bytes, at least 12 are needed"),
        (mrm.build(SCAN_INFO)[:1000], r"ScanInfo: 260 samples in 1000 bytes"),
    ],
)
def test_an_error_says_what_was_found(data: bytes, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        mrm.parse(data)


@pytest.mark.parametrize(
    ("at", "field", "says"),
    [
        (42, b"\x01\x5f", r"351 samples in 1452 bytes; at most 350 fit"),
        (44, b"\x00\x00\x01\x03", r"260 of 259 samples"),
        (44, b"\x7f\xff\xff\xff", r"260 of 2147483647 samples; .* at most 16416"),
        (48, b"\x00\x03", r"packet 3 of 3"),
        (50, b"\x00\x00", r"packet 2 of 0"),
        (50, b"\xff\xff", r"packet 2 of 65535 for 960 samples"),
    ],
)
def test_counts_that_contradict_are_refused(at: int, field: bytes, says: str) -> None:
    data = bytearray(mrm.build(SCAN_INFO))
    data[at : at + len(field)] = field
    with pytest.raises(ProtocolError, match=says):
        mrm.parse(bytes(data))


def test_a_value_that_does_not_fit_is_refused_when_building() -> None:
    with pytest.raises(ProtocolError, match=r"ControlRequest: a value does not fit"):
        mrm.build(mrm.ControlRequest(message_id=0, scan_count=65536))
    with pytest.raises(ProtocolError, match=r"ScanInfo: 351 samples"):
        mrm.build(replace(SCAN_INFO, samples=np.zeros(351, np.int32)))


KNOWN_TYPES = [0x1001, 0x1101, 0x1002, 0x1102, 0x1003, 0x1103, 0xF001, 0xF101, 0xF201, 0xF202]


@settings(deadline=None)  # a busy machine is not a failure
@given(st.sampled_from([b"", *(code.to_bytes(2) for code in KNOWN_TYPES)]), st.binary(max_size=2000))
def test_no_bytes_raise_anything_but_a_protocol_error(head: bytes, tail: bytes) -> None:
    try:
        message = mrm.parse(head + tail)
    except ProtocolError as error:
        assert "\n" not in str(error)
    else:
        assert int.from_bytes((head + tail)[:2]) == message.CODE


def test_status_names() -> None:
    assert mrm.status_name(2) == "wrong operation mode"
    assert mrm.status_name(77) == "unknown status 77"


def test_the_checksum_is_crc16_xmodem() -> None:
    assert framed(b"123456789", crc=True) == b"\xa5\xa5\x00\x09123456789\x31\xc3"
    assert binascii.crc_hqx(b"123456789", 0) == 0x31C3


@settings(deadline=None)  # a busy machine is not a failure
@given(
    st.lists(st.binary(min_size=4, max_size=60), max_size=8),
    st.booleans(),
    st.integers(min_value=1, max_value=70),
)
def test_frames_survive_any_cutting(messages: list[bytes], crc: bool, cut: int) -> None:
    stream = b"".join(framed(message, crc=crc) for message in messages)
    deframer = SerialDeframer(crc=crc)
    got = [m for at in range(0, len(stream), cut) for m in deframer.feed(stream[at : at + cut])]
    assert got == messages
    assert deframer.skipped_bytes == deframer.bad_checksums == 0


def test_frames_are_found_again_after_noise_and_damage() -> None:
    good = framed(mrm.build(OTHERS[3]), crc=True)
    damaged = bytearray(good)
    damaged[20] ^= 1
    absurd_length = b"\xa5\xa5\xff\xff"
    deframer = SerialDeframer(crc=True)
    stream = b"noise\xa5" + good + bytes(damaged) + absurd_length + good + good[:10]
    assert [mrm.parse(m) for m in deframer.feed(stream)] == [OTHERS[3], OTHERS[3]]
    assert deframer.bad_checksums == 1
    assert deframer.skipped_bytes == len(b"noise\xa5") + len(damaged) + len(absurd_length)
    assert list(deframer.feed(good[10:])) == [mrm.build(OTHERS[3])], "the cut frame is completed"


@settings(deadline=None)  # a busy machine is not a failure
@given(st.lists(st.binary(max_size=400), max_size=10), st.booleans())
def test_a_deframer_never_raises_and_holds_less_than_a_frame(chunks: list[bytes], crc: bool) -> None:
    deframer = SerialDeframer(crc=crc)
    taken = sum(len(m) + 4 + 2 * crc for chunk in chunks for m in deframer.feed(chunk))
    assert 0 <= sum(map(len, chunks)) - taken - deframer.skipped_bytes < 4 + 1452 + 2


@pytest.mark.parametrize("size", [3, 1453])
def test_a_message_that_no_receiver_takes_is_not_framed(size: int) -> None:
    with pytest.raises(ProtocolError, match=f"{size} bytes cannot be framed; 4..1452 can"):
        framed(bytes(size), crc=False)
