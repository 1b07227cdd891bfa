"""The sonar: words and bytes as the data sheets have them, an emulated chip, and the driver on its socket."""

import errno
import os
import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caneflow.i2c_bus import serve_client
from caneflow.messages import Ranges
from caneflow.messages.rig import Rig
from caneflow.protocols import i2c_socket, maxbotix
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.maxbotix import SerialWords, said, taken
from caneflow.protocols.maxbotix_emulator import Echoes, I2cSonar, SerialSonar
from caneflow.recording.ranges_over_time import nearest_of
from caneflow.runtime import Context, Quiet
from drivers.sonar import Sonar, SonarSettings, ranges_of

ECHOES = Echoes([0.0, 1.0, 2.0], [1.23, 2.5, None])


class Bench:
    """A clock that goes on only when someone waits."""

    def __init__(self, chip: I2cSonar, time: float = 0.0) -> None:
        self.chip, self.time = chip, time

    def pause(self, seconds: float) -> None:
        self.time += seconds

    def transfer(self, written: bytes, length: int) -> bytes:
        return self.chip.transfer(written, length, self.time)


def test_an_mb12xx_is_asked_and_read_as_its_data_sheet_says() -> None:
    written = []

    def transfer(data: bytes, length: int) -> bytes:
        written.append((data, length))
        return b"\x01\x02"[:length]  # 258 cm, high byte first

    assert taken(transfer, lambda _: None) == pytest.approx(2.58)
    assert written == [(b"\x51", 0), (b"", 2)]


@pytest.mark.parametrize(("time", "distance"), [(0.0, 1.23), (1.5, 2.5), (2.5, 7.65)])
def test_the_emulated_chip_says_what_it_hears(time: float, distance: float) -> None:
    bench = Bench(I2cSonar(ECHOES), time)
    assert taken(bench.transfer, bench.pause) == pytest.approx(distance)
    assert bench.time - time >= maxbotix.READING_TIME


def test_a_chip_that_measures_does_not_acknowledge() -> None:
    chip = I2cSonar(ECHOES)
    chip.transfer(b"\x51", 0, 0.0)
    with pytest.raises(OSError, match="Remote"):
        chip.transfer(b"", 2, 0.05)
    assert chip.transfer(b"", 2, 0.1) == b"\x00\x7b"


@pytest.mark.parametrize(("answer", "says"), [(b"\x00", "1 bytes"), (b"\x00\x00", "0 cm"), (b"\xff\xff", "65535 cm")])
def test_what_is_no_reading_is_an_error(answer: bytes, says: str) -> None:
    with pytest.raises(ProtocolError, match=says):
        taken(lambda data, length: answer if length else b"", lambda _: None)


def test_a_bus_that_never_acknowledges_is_an_error() -> None:
    def transfer(data: bytes, length: int) -> bytes:
        raise OSError(errno.EREMOTEIO, "Remote I/O error")

    with pytest.raises(ProtocolError, match="no acknowledge"):
        taken(transfer, lambda _: None)


@given(st.lists(st.floats(0.2, 6.0), min_size=1, max_size=8), st.integers(1, 7), st.sampled_from(["inch", "cm", "mm"]))
def test_words_come_out_of_any_pieces(distances: list[float], size: int, unit: maxbotix.Unit) -> None:
    stream = b"".join(said(each, unit, 6.45) for each in distances)
    words, found = SerialWords(unit), []
    for at in range(0, len(stream), size):
        found += words.feed(stream[at : at + size])
    np.testing.assert_allclose(found, distances, atol=0.51 * maxbotix.METRES[unit])
    assert words.garbled == 0


@given(st.binary(max_size=200))
def test_no_bytes_make_the_line_grow_or_fail(noise: bytes) -> None:
    words = SerialWords("inch")
    words.feed(noise)
    assert words.feed(b"xxxxxxR042\r")[-1:] == [pytest.approx(42 * 0.0254)]
    assert len(words._rest) < maxbotix.LONGEST_WORD


def test_a_serial_sonar_speaks_twenty_times_a_second() -> None:
    sonar = SerialSonar(ECHOES)
    words = SerialWords("inch").feed(sonar.due(0.99))
    assert len(words) == 20
    np.testing.assert_allclose(words, 1.23, atol=0.0128)


@pytest.mark.parametrize(("distance", "status"), [(0.2, 2), (0.21, 0), (5.99, 0), (6.0, 1), (7.65, 1)])
def test_the_ends_of_the_reach_are_no_ranges(distance: float, status: int) -> None:
    reading = ranges_of(1, distance, (0.2, 6.0), 0.1)
    assert reading.status.tolist() == [status]
    assert (reading.ranges[0] > 0) == (status == 0)


def test_a_sonar_hears_the_nearest_of_many_zones() -> None:
    reading = Ranges(
        stamp=1, ranges=np.array([2.0, 0.0, 1.5, 0.9], np.float32), status=np.array([0, 1, 0, 3], np.uint8)
    )
    assert nearest_of(reading) == pytest.approx(1.5)
    assert nearest_of(Ranges(stamp=1, ranges=np.zeros(1, np.float32), status=np.ones(1, np.uint8))) is None


def test_the_driver_reads_an_emulated_chip_over_its_socket(tmp_path: Path) -> None:
    path = tmp_path / "bus"
    chip = I2cSonar(Echoes([0.0], [1.23]))
    clock = iter(range(10_000))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def transfer(address: int, written: bytes, length: int, time: float) -> bytes:
            assert address == maxbotix.ADDRESS
            return chip.transfer(written, length, time)

        # One second goes by with each transfer: nobody waits for the chip.
        thread = threading.Thread(target=lambda: serve_client(server.accept()[0], transfer, lambda: next(clock)))
        thread.start()
        settings = SonarSettings(bus=str(path))
        context = Context(node="sonar", rig=Rig(), ports={"ranges": Ranges}, random=np.random.default_rng(1))
        samples = Sonar(settings, context).samples()
        brought: Any = next(samples)
        port, reading = brought
        samples.close()
        thread.join(timeout=60)
    assert port == "ranges"
    assert isinstance(reading, Ranges)
    assert reading.ranges[0] == pytest.approx(1.23)
    assert reading.delay is not None
    assert reading.delay >= maxbotix.READING_TIME
    assert not thread.is_alive()


def test_a_clock_that_was_set_back_is_said_to_bring_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    context = Context(node="sonar", rig=Rig(), ports={"ranges": Ranges}, random=np.random.default_rng(1))
    sonar = Sonar(SonarSettings(), context)
    monkeypatch.setattr("time.time_ns", iter([2_000, 1_000, 3_000]).__next__)
    brought: list[Any] = [item for _ in range(3) for item in sonar._reading(1.0, delay=0.1)]
    assert [item[1].stamp for item in (brought[0], brought[2])] == [2_000, 3_000]
    assert brought[1] == Quiet(2_000), "its process can end, and nobody waits"


def test_a_bus_that_refuses_says_why_over_the_socket() -> None:
    mine, other = socket.socketpair()
    with mine, other:
        chip = I2cSonar(ECHOES)
        thread = threading.Thread(
            target=lambda: serve_client(other, lambda _, *rest: chip.transfer(*rest), lambda: 0.0)
        )
        thread.start()
        mine.sendall(i2c_socket.Request(0x70, b"\x00", 0).packed())
        assert i2c_socket.ANSWER.unpack(mine.recv(3)) == (errno.EREMOTEIO, 0)
        assert os.strerror(errno.EREMOTEIO)
        mine.shutdown(socket.SHUT_WR)
        thread.join(timeout=60)
    assert not thread.is_alive()
