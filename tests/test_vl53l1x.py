"""The VL53L1X: bytes as ST's driver exchanges them, an emulated chip, and the driver on its socket."""

import socket
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caneflow.device_checks import tof
from caneflow.i2c_bus import serve_client
from caneflow.messages import Ranges
from caneflow.messages.rig import Rig
from caneflow.protocols import vl53l1x
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.maxbotix_emulator import Echoes
from caneflow.protocols.register_link import I2cLink
from caneflow.protocols.vl53l1x import Chip, Reading
from caneflow.protocols.vl53l1x_emulator import Emulator, as_c_source, pretended_table
from caneflow.runtime import Context
from caneflow.runtime.errors import DataflowError
from drivers.vl53l1x import Vl53l1x, Vl53l1xSettings, ranges_of, read_table

TABLE = pretended_table()
ECHOES = Echoes([0.0, 0.5, 1.0], [1.234, None, 0.5])


class Bench:
    """A bus whose time goes on only when somebody waits."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator, self.time = emulator, 0.0
        link = I2cLink(self.transfer, self.pause, lambda: round(self.time * 1e9), device="VL53L1X", register_bytes=2)
        self.chip = Chip(link, self.pause)

    def transfer(self, written: bytes, length: int) -> bytes:
        return self.emulator.transfer(vl53l1x.ADDRESS, written, length, self.time)

    def pause(self, seconds: float) -> None:
        self.time += seconds


def test_a_chip_that_was_set_up_measures_once_every_period() -> None:
    bench = Bench(Emulator(ECHOES))
    bench.chip.require()
    bench.chip.set_up(TABLE, 50, 55)
    began, found = bench.time, []
    while bench.time < began + 1.2:
        bench.pause(0.001)
        if bench.chip.is_ready():
            found.append((bench.time - began, bench.chip.read()))
            assert not bench.chip.is_ready(), "each reading once"
    times, readings = zip(*found, strict=True)
    assert np.diff(times) == pytest.approx(0.055, abs=0.0011)
    assert readings[0] == Reading(1.234, vl53l1x.TARGET, 160.0, 16.0)
    assert {each.status for time, each in found if 0.51 < time < 0.99} == {vl53l1x.NO_TARGET}
    assert readings[-1].distance == pytest.approx(0.5)


def test_a_result_is_where_the_data_sheet_has_it() -> None:
    data = bytearray(17)
    data[0] = 0xE9  # valid, with bits that do not count
    data[7:9], data[13:15], data[15:17] = b"\x00\x02", b"\x04\xd2", b"\x00\x64"
    assert vl53l1x.parsed(bytes(data)) == Reading(1.234, vl53l1x.TARGET, 800.0, 16.0)
    data[0] = 4
    assert vl53l1x.parsed(bytes(data)).status == vl53l1x.NO_TARGET
    data[0] = 6
    assert vl53l1x.parsed(bytes(data)).status == vl53l1x.NOT_TRUSTED


@pytest.mark.parametrize(
    ("distance", "status", "expected"),
    [(0.03, 0, (0.0, 2)), (1.0, 0, (1.0, 0)), (4.0, 0, (0.0, 1)), (1.0, 3, (1.0, 3))],
)
def test_the_ends_of_the_reach_are_no_ranges(distance: float, status: int, expected: tuple[float, int]) -> None:
    ranges = ranges_of(1, Reading(distance, status, 1.0, 1.0), vl53l1x.REACH, 0.05)
    assert (ranges.ranges[0], ranges.status[0]) == expected
    assert ranges.delay == pytest.approx(0.025)


def test_another_device_is_no_vl53l1x() -> None:
    bench = Bench(Emulator(ECHOES))
    bench.emulator._registers[vl53l1x.MODEL] = 0xF0
    with pytest.raises(ProtocolError, match="not a VL53L1X: it says f0cc"):
        bench.chip.require()


def test_the_table_is_read_from_the_vendors_source(tmp_path: Path) -> None:
    path = tmp_path / "VL53L1X_api.c"
    path.write_text(as_c_source(TABLE))
    assert read_table(path) == TABLE
    path.write_text(as_c_source(TABLE[:-1]))
    with pytest.raises(DataflowError, match="holds 90 bytes; expected 91"):
        read_table(path)
    path.write_text("int main;")
    with pytest.raises(DataflowError, match="VL51L1X_DEFAULT_CONFIGURATION is not there"):
        read_table(path)


def context() -> Context:
    return Context(node="tof", rig=Rig(), ports={"ranges": Ranges}, random=np.random.default_rng(1))


def test_a_driver_without_the_table_says_what_is_missing() -> None:
    with pytest.raises(DataflowError, match=r"tof: settings.table is missing"):
        Vl53l1x(Vl53l1xSettings(), context())


@pytest.mark.parametrize(
    ("table", "says"),
    [
        (None, ["settings.table is missing", "bus: no emulator has made this socket"]),
        ("none.c", ["none.c: No such file or directory", "no emulator has made this socket"]),
        ("table.c", ["table.c is whole", "no emulator has made this socket"]),
    ],
)
def test_doctor_says_whether_the_table_and_the_bus_are_there(
    table: str | None, says: list[str], tmp_path: Path
) -> None:
    (tmp_path / "table.c").write_text(as_c_source(TABLE))
    settings = Vl53l1xSettings(bus=str(tmp_path / "bus"), table=table and str(tmp_path / table))
    node: Any = SimpleNamespace(name="tof", settings=settings)
    found = list(tof.examine(tof.VL53L1X, node))
    assert [said in finding.text for said, finding in zip(says, found, strict=True)] == [True, True], found
    assert found[1].state == "bad"


def test_the_driver_reads_an_emulated_chip_over_its_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, table = tmp_path / "bus", tmp_path / "table.c"
    table.write_text(as_c_source(TABLE))
    monkeypatch.setattr("drivers.vl53l1x.time.sleep", lambda _: None)
    chip, clock = Emulator(Echoes([0.0], [1.234])), iter(range(10_000_000))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        # Ten milliseconds go by with each transfer: nobody waits for the chip.
        thread = threading.Thread(
            target=lambda: serve_client(server.accept()[0], chip.transfer, lambda: next(clock) * 0.01)
        )
        thread.start()
        samples = Vl53l1x(Vl53l1xSettings(bus=str(path), table=str(table), address=0x2A), context()).samples()
        brought: Any = [next(samples) for _ in range(2)]
        samples.close()
        thread.join(timeout=60)
    assert [port for port, _ in brought] == ["ranges", "ranges"]
    assert brought[0][1].ranges[0] == pytest.approx(1.234)
    assert brought[1][1].stamp > brought[0][1].stamp
    assert chip.address == 0x2A
    assert not thread.is_alive()
