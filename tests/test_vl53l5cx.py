"""The VL53L5CX: bytes as ST's driver exchanges them, an emulated chip, and the driver on its socket."""

import errno
import math
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caneflow.errors import CaneflowError
from caneflow.i2c_bus import serve_client
from caneflow.messages import Ranges
from caneflow.messages.rig import Rig
from caneflow.protocols import vl53l5cx
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink
from caneflow.protocols.vl53l5cx import Firmware
from caneflow.protocols.vl53l5cx_chip import Chip
from caneflow.protocols.vl53l5cx_emulator import Emulator, Scene, as_c_source, pretended_firmware
from caneflow.runtime import Context
from caneflow.runtime.errors import DataflowError
from drivers.vl53l5cx import Vl53l5cx, Vl53l5cxSettings, opened, ranges_of, read_firmware
from tools.emulate_vl53l5cx import firmware_of

FIRMWARE = pretended_firmware()


def scene(readings: int = 3) -> Scene:
    """A wall at 2 m perpendicular distance but one post at the left of the top row, 1 m away; one zone sees nothing."""
    ranges = np.tile((2.0 * vl53l5cx.tilt_factors()).astype(np.float32), (readings, 1))
    ranges[:, 0] = 1.0
    status = np.zeros((readings, 64), np.uint8)
    ranges[:, 63], status[:, 63] = 0.0, 1
    status[:, 62] = 3
    return Scene([i / 15 for i in range(readings)], ranges, status)


class Bench:
    """A bus whose time goes on only when somebody waits."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator, self.time = emulator, 0.0

    def pause(self, seconds: float) -> None:
        self.time += seconds

    def chip(self, address: int = vl53l5cx.ADDRESS) -> Chip:
        def transfer(written: bytes, length: int) -> bytes:
            return self.emulator.transfer(address, written, length, self.time)

        link = I2cLink(transfer, self.pause, lambda: round(self.time * 1e9), device="VL53L5CX", register_bytes=2)
        return Chip(link, self.pause)


def started(emulator: Emulator, rate: int = 15) -> tuple[Bench, Chip]:
    bench = Bench(emulator)
    chip = bench.chip()
    chip.require()
    chip.boot(FIRMWARE)
    chip.set_up(FIRMWARE, rate)
    chip.start()
    return bench, chip


def test_a_chip_that_was_given_its_firmware_measures_along_the_rays() -> None:
    seen = scene()
    bench, chip = started(Emulator(seen, FIRMWARE))
    assert not chip.is_ready(), "the first exposure takes 1/15 s"
    bench.pause(1 / 15 + 1e-6)
    assert chip.is_ready()
    ranges = ranges_of(1, chip.read(), (0.02, 4.0), 1 / 15)
    assert not chip.is_ready(), "each reading once"
    usable = ranges.status == 0
    np.testing.assert_allclose(ranges.ranges[usable], seen.ranges[0][usable], atol=2e-4 * math.sqrt(2))
    assert ranges.status.tolist() == seen.status[0].tolist()
    assert ranges.ranges[63] == 0.0
    assert ranges.delay == pytest.approx(1 / 30)


def test_a_post_at_the_left_of_the_top_row_is_in_the_chips_eighth_zone() -> None:
    # The lens turns the picture: zone 0 sees the top right (DS13754, 5.1.3); ours go from left to right.
    bench, chip = started(Emulator(scene(), FIRMWARE))
    bench.pause(0.1)
    words = vl53l5cx.swapped(chip.link.read(0, vl53l5cx.reading_size()).data)
    header = words.index(struct.pack("<I", vl53l5cx.Output.DISTANCE))
    distances = np.frombuffer(words[header + 4 : header + 132], "<i2") / 4000
    assert distances.argmin() in (7, 56)  # 56: the zone that sees nothing says 0
    assert distances[7] == pytest.approx(1.0 / vl53l5cx.tilt_factors()[0], abs=3e-4), "perpendicular to the chip"
    np.testing.assert_allclose(distances[8:56], 2.0, atol=3e-4)


def test_the_corner_of_the_picture_is_farther_along_its_ray_by_the_angles_cosines() -> None:
    factors = vl53l5cx.tilt_factors().reshape(8, 8)
    edge = math.cos(math.radians(45) * 3.5 / 8)
    assert factors[0, 0] == pytest.approx(1 / edge**2)
    assert factors[3, 0] == pytest.approx(1 / (edge * math.cos(math.radians(45) * 0.5 / 8)))
    assert (factors == factors[::-1, ::-1]).all()


@pytest.mark.parametrize(("code", "status"), [(5, 0), (255, 1), (0, 4), (9, 3), (10, 3), (6, 3), (4, 3), (77, 3)])
def test_only_what_st_calls_certain_is_a_target(code: int, status: int) -> None:
    said = vl53l5cx.Reading(
        stream=3,
        temperature=-5,
        distance=np.ones(64, np.float32),
        status=np.zeros(64, np.uint8),
        sigma=np.full(64, 0.02, np.float32),
        signal=np.ones(64, np.float32),
        ambient=np.ones(64, np.float32),
    )
    reading = vl53l5cx.parsed(vl53l5cx.built(said, np.full(64, code, np.uint8)))
    assert set(reading.status.tolist()) == {status}
    assert (reading.stream, reading.temperature) == (3, -5)
    assert reading.sigma[0] == pytest.approx(0.02, abs=1e-5)


def test_a_reading_that_is_torn_is_refused() -> None:
    bench, chip = started(Emulator(scene(), FIRMWARE))
    bench.pause(0.1)
    data = bytearray(chip.link.read(0, vl53l5cx.reading_size()).data)
    data[-2] ^= 1  # in the number at the end
    with pytest.raises(ProtocolError, match="belongs to another"):
        vl53l5cx.parsed(bytes(data))
    with pytest.raises(ProtocolError, match="968 bytes; expected 972"):
        vl53l5cx.parsed(bytes(data[:-4]))


def test_commands_are_as_the_vendors_driver_sends_them() -> None:
    register, data = vl53l5cx.write_command(vl53l5cx.RATE, b"\x01\x0f\x00\x00")
    assert register + len(data) == 0x3000
    assert data.hex() == "54580040" + "00000f01" + "0000000f0501000c"
    register, data = vl53l5cx.read_command(vl53l5cx.ZONE_CONFIG, 8)
    assert (register, data.hex()) == (0x2FF4, "54500080" + "0000000f00020008")


def test_tables_for_4_x_4_zones_hold_means_of_four() -> None:
    words = bytearray(488)
    words[0x3C : 0x3C + 256] = np.arange(64, dtype="<u4").tobytes()
    sent = vl53l5cx.offsets(vl53l5cx.swapped(bytes(words)) + bytes(4), whole=False)
    assert len(sent) == 488
    back = vl53l5cx.swapped(bytes(8) + sent[:-8])
    assert np.frombuffer(back[0x3C : 0x3C + 16], "<u4").tolist() == [4, 6, 8, 10]  # (0 + 1 + 8 + 9) / 4 ...
    assert vl53l5cx.crosstalk(bytes(776), whole=True) == bytes(776)


def test_another_firmware_does_not_run() -> None:
    bench = Bench(Emulator(scene(), FIRMWARE))
    other = Firmware(bytes(vl53l5cx.FIRMWARE_SIZE), *(FIRMWARE.configuration, FIRMWARE.crosstalk, FIRMWARE.ask_stored))
    with pytest.raises(ProtocolError, match=r"does not start, error 0x42"):
        bench.chip().boot(other)


def test_a_chip_at_another_address_is_moved_there_and_another_device_is_no_chip() -> None:
    emulator = Emulator(scene(), FIRMWARE)
    bench = Bench(emulator)
    bench.chip().move(0x30)
    bench.chip(0x30).require()
    with pytest.raises(ProtocolError, match="Remote I/O error"):
        bench.chip().require()
    emulator._pages[0][0] = 0xEA
    with pytest.raises(ProtocolError, match="not a VL53L5CX: it says ea02"):
        bench.chip(0x30).require()


def test_the_firmware_is_read_from_the_vendors_source(tmp_path: Path) -> None:
    path = tmp_path / "vl53l5cx_buffers.h"
    path.write_text("/* const uint8_t A[] = {1}; */\n" + as_c_source(FIRMWARE) + " // (uint8_t) 7")
    assert read_firmware(path) == FIRMWARE
    path.write_text("const uint8_t VL53L5CX_FIRMWARE[] = {0x01, 2, (uint8_t) 3U};")
    assert byte_arrays(path.read_text()) == {"VL53L5CX_FIRMWARE": b"\x01\x02\x03"}
    with pytest.raises(DataflowError, match=r"VL53L5CX_FIRMWARE holds 3 bytes; expected 86016 bytes"):
        read_firmware(path)
    path.write_text("const uint8_t VL53L5CX_FIRMWARE[] = {0x01, 300};")
    with pytest.raises(DataflowError, match=r"element 1 is '300'; expected a byte"):
        read_firmware(path)
    with pytest.raises(DataflowError, match="No such file"):
        read_firmware(tmp_path / "none.h")


def context() -> Context:
    return Context(node="tof", rig=Rig(), ports={"ranges": Ranges}, random=np.random.default_rng(1))


def test_a_driver_without_firmware_says_what_is_missing() -> None:
    with pytest.raises(DataflowError, match=r"tof: settings.firmware is missing"):
        Vl53l5cx(Vl53l5cxSettings(), context())


def test_the_driver_reads_an_emulated_chip_over_its_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, firmware = tmp_path / "bus", tmp_path / "firmware.h"
    firmware.write_text(as_c_source(FIRMWARE))
    monkeypatch.setattr("drivers.vl53l5cx.time.sleep", lambda _: None)
    chip, clock = Emulator(scene(), FIRMWARE), iter(range(10_000_000))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        # One hundredth of a second goes by with each transfer: nobody waits for the chip.
        arguments = (lambda: next(clock) * 0.01,)
        thread = threading.Thread(target=lambda: serve_client(server.accept()[0], chip.transfer, *arguments))
        thread.start()
        settings = Vl53l5cxSettings(bus=str(path), firmware=str(firmware), address=0x31)
        samples = Vl53l5cx(settings, context()).samples()
        brought: Any = [next(samples) for _ in range(2)]
        samples.close()
        thread.join(timeout=60)
    assert [port for port, _ in brought] == ["ranges", "ranges"]
    assert brought[0][1].status[0] == 0
    assert brought[0][1].ranges[0] == pytest.approx(1.0, abs=1e-3)
    assert brought[1][1].stamp > brought[0][1].stamp
    assert chip.address == 0x31
    assert not thread.is_alive()


def test_a_bus_that_is_not_there_is_an_error() -> None:
    with pytest.raises(OSError) as error, opened(Vl53l5cxSettings(bus="/nowhere/bus", firmware="x")):
        pass
    assert error.value.errno == errno.ENOENT


def test_the_pretended_firmware_takes_the_place_of_no_other_file(tmp_path: Path) -> None:
    pretended = tmp_path / "bus.h"
    assert firmware_of(None, pretended) == firmware_of(None, pretended)  # its own may be there already
    pretended.write_text("a header")
    with pytest.raises(CaneflowError, match="already exists"):
        firmware_of(None, pretended)
    assert pretended.read_text() == "a header"
