"""Frames on a serial line: published vectors, round trips, and what a disturbed line does to them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.uart_frames import (
    LONGEST_BODY,
    LONGEST_CODED,
    Deframer,
    Frame,
    Kind,
    decoded,
    encoded,
    framed,
    pose_answer,
    refusal,
    reset,
    status,
)

# Of the paper's construction, as listed in the article "Consistent Overhead Byte Stuffing" of Wikipedia.
COBS = [
    ("", "01"),
    ("00", "0101"),
    ("0000", "010101"),
    ("001100", "01021101"),
    ("11220033", "0311220233"),
    ("11223344", "0511223344"),
    ("11000000", "0211010101"),
    (bytes(range(1, 255)).hex(), "ff" + bytes(range(1, 255)).hex()),
    (bytes(range(255)).hex(), "01ff" + bytes(range(1, 255)).hex()),
    (bytes(range(1, 256)).hex(), "ff" + bytes(range(1, 255)).hex() + "02ff"),
    (bytes([*range(2, 256), 0]).hex(), "ff" + bytes(range(2, 256)).hex() + "0101"),
    (bytes([*range(3, 256), 0, 1]).hex(), "fe" + bytes(range(3, 256)).hex() + "0201"),
]
GOOD = Frame(Kind.IMU, 7, b"\x00the next one\x00\xff")


@pytest.mark.parametrize(("content", "coded"), COBS)
def test_cobs_agrees_with_the_published_examples(content: str, coded: str) -> None:
    assert encoded(bytes.fromhex(content)).hex() == coded
    assert decoded(bytes.fromhex(coded)).hex() == content


@given(content=st.binary(max_size=600) | st.integers(0, 800).map(lambda size: b"\x01" * size))
def test_cobs_gives_back_what_it_took_without_a_zero(content: bytes) -> None:
    coded = encoded(content)
    assert 0 not in coded
    assert len(coded) <= len(content) + len(content) // 254 + 1
    assert decoded(coded) == content


@given(coded=st.binary(max_size=50))
def test_what_is_decoded_was_encoded(coded: bytes) -> None:
    try:
        content = decoded(coded)
    except ProtocolError:
        return
    # a full block at the end may be written in two ways
    assert encoded(content) == coded or encoded(content) + b"\x01" == coded or coded == b""


@given(kind=st.integers(0, 255), number=st.integers(0, 65535), body=st.binary(max_size=LONGEST_BODY))
def test_a_frame_comes_back_in_pieces_of_any_size(kind: int, number: int, body: bytes) -> None:
    frame = framed(kind, number, body)
    assert len(frame) <= LONGEST_CODED + 2
    deframer = Deframer()
    pieces = [frame[i : i + 7] for i in range(0, len(frame), 7)]
    assert [each for piece in pieces for each in deframer.feed(piece)] == [Frame(kind, number, body)]
    assert deframer.bad == 0


def test_the_checksum_is_crc_16_xmodem() -> None:
    """Its published check value: 0x31c3 for the characters 1 to 9."""
    assert framed(ord("1"), 0x3233, b"456789") == b"\x00\x0c123456789\x31\xc3\x00"


def test_a_body_that_no_firmware_takes_is_refused() -> None:
    with pytest.raises(ProtocolError, match="a body of 513 bytes; a frame takes 512"):
        framed(Kind.IMU, 0, bytes(513))


@given(noise=st.binary(max_size=2000), size=st.integers(1, 300))
def test_the_next_good_frame_is_taken_whatever_came_before(noise: bytes, size: int) -> None:
    deframer = Deframer()
    stream = noise + framed(*GOOD)
    got = [each for at in range(0, len(stream), size) for each in deframer.feed(stream[at : at + size])]
    assert got[-1] == GOOD


def test_no_damage_of_up_to_16_bits_in_a_row_goes_unnoticed() -> None:
    """What a checksum of 16 bits promises for bursts, here for each place in the content."""
    rng = np.random.default_rng(1)
    frame = framed(Kind.IMU, 300, bytes(rng.integers(1, 256, 60, dtype=np.uint8)))
    content = decoded(frame[1:-1])
    for bit in range(8 * len(content) - 16):
        burst = int(rng.integers(1, 1 << 16)) | 1
        damaged = int.from_bytes(content, "big") ^ burst << bit
        deframer = Deframer()
        wire = b"\0" + encoded(damaged.to_bytes(len(content), "big")) + b"\0"
        assert list(deframer.feed(wire)) == []
        assert deframer.bad == 1


def test_a_stretch_that_is_too_long_is_dropped_and_held_in_bounded_memory() -> None:
    deframer = Deframer()
    for _ in range(100):
        assert list(deframer.feed(b"\x01" * 1000)) == []
        assert len(deframer._coded) <= LONGEST_CODED
    assert list(deframer.feed(framed(*GOOD))) == [GOOD]
    assert deframer.bad == 1


def test_what_frames_say_is_read() -> None:
    body = bytes([1]) + b"".join(value.to_bytes(4, "big") for value in (9, 0xDC2B1AC9, 25_000_000, 5, 4, 3, 2))
    said = status(body)
    assert (said.session, said.digest, said.ticks_per_second) == (9, 0xDC2B1AC9, 25_000_000)
    assert (said.clock, said.busy, said.bad_frames, said.lost_bytes) == (5, 4, 3, 2)
    with pytest.raises(ProtocolError, match="says version 2; version 1 has 29"):
        status(b"\x02" + body[1:])
    with pytest.raises(ProtocolError, match="says nothing"):
        status(b"")
    answer = pose_answer(b"\x02\x00\x00\x00\x64\x00\x00\x01\x00pose")
    assert (answer.saturated, answer.gap, answer.ticks, answer.clock) == (False, True, 100, 256)
    assert answer.payload == b"pose"
    with pytest.raises(ProtocolError, match="a pose of 3 bytes"):
        pose_answer(b"abc")
    assert refusal(b"\x02") == "it has no orientation"
    assert refusal(b"\xee") == "reason ee"
    assert list(Deframer().feed(reset(0x01020304))) == [Frame(Kind.RESET, 0, b"\1\2\3\4")]
