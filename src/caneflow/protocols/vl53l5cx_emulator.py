"""A VL53L5CX that is not there: its registers, its firmware's commands, and readings of given ranges over time.

Pure: what is written, and the time (s), in; what is read out. A bus that does not acknowledge raises OSError.
"""

import errno
import math
import os
import struct
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols import vl53l5cx
from caneflow.protocols.vl53l5cx import Firmware, Reading

CODES: Final = np.array([5, 255, 4, 9, 0], np.uint8)  # what the chip says, by Ranges.status
START: Final = b"\0\x03\0\0"


@dataclass(frozen=True, eq=False)
class Scene:
    """n readings: times (s), ranges along the zones' rays (n, 64) m, status as in Ranges, sigma (n, 64) m."""

    times: Sequence[float]
    ranges: NDArray[np.float32]
    status: NDArray[np.uint8]
    sigma: NDArray[np.float32] | None = None

    @property
    def end(self) -> float:
        """Time (s) of the last reading."""
        return self.times[-1]


class Emulator:
    """One chip, powered on; it takes only the firmware that it is told of."""

    def __init__(self, scene: Scene, firmware: Firmware) -> None:
        self.readings = 0  # that were read
        self.address = vl53l5cx.ADDRESS
        self._scene, self._firmware = scene, firmware
        self._across = (1.0 / vl53l5cx.tilt_factors()).astype(np.float32)
        self._page = 0
        self._pages = {page: bytearray(0x8000) for page in (0, 1, 2, 9, 10, 11)}
        self._pages[0][:2] = vl53l5cx.IDENTITY
        self._pages[1][0x21] = 0x10
        self._blocks: dict[int, bytes] = {vl53l5cx.ZONE_CONFIG: bytes((4, 4, 0, 0, 8, 8, 0, 0))}
        self._runs = False
        self._begun: float | None = None  # s, when it began to measure

    def transfer(self, address: int, written: bytes, length: int, time: float) -> bytes:
        """Write register and data, then read `length` bytes; raises OSError when nobody acknowledges."""
        if address != self.address or len(written) < 2:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        register = int.from_bytes(written[:2], "big")
        if data := written[2:]:
            self._write(register, data, time)
        if not length:
            return b""
        if self._page == 2 and register == 0 and self._begun is not None:
            self._measure(time)
            self.readings += length > 4
        memory = self._pages.get(self._page, bytearray())
        return bytes(memory[register : register + length]).ljust(length, b"\0")

    def _write(self, register: int, data: bytes, time: float) -> None:
        if register == vl53l5cx.PAGE:
            self._page = data[0]
            return
        memory = self._pages.setdefault(self._page, bytearray(0x8000))
        memory[register : register + len(data)] = data
        if self._page == 0:
            self._control(register, data[0])
        elif self._page == 2 and register + len(data) == vl53l5cx.COMMAND_END + 1:
            self._obey(register, data, time)

    def _control(self, register: int, value: int) -> None:
        memory = self._pages[0]
        if register == 0x04:
            self.address = value
        elif (register, value) == (0x0A, 0x01):  # restarted: the firmware is gone
            self._runs, self._begun = False, None
            memory[0x06] = 1
        elif (register, value) == (0x0B, 0x01):
            given = b"".join(bytes(self._pages[page][:size]) for page, size in vl53l5cx.FIRMWARE_PAGES)
            self._runs = given == self._firmware.program
            memory[0x06:0x08] = b"\x01\0" if self._runs else b"\x80\x42"

    def _obey(self, register: int, data: bytes, time: float) -> None:
        """A command of the firmware ends with the last register."""
        memory = self._pages[2]
        if not self._runs:
            return
        status = b"\0\x03\0\0"
        if register == vl53l5cx.STORED_AT and data == self._firmware.ask_stored:
            status = b"\x02\x03\0\0"
            memory[vl53l5cx.COMMAND_START : vl53l5cx.COMMAND_START + vl53l5cx.STORED_SIZE] = STORED
        elif data == START:
            self._begin(time)
        elif data[-4:-2] == b"\0\x02":
            index, size = _head(data)
            self._answer(index, size)
        elif data[-4:-2] == b"\x05\x01":
            index, size = _head(data)
            self._blocks[index] = vl53l5cx.swapped(data[4 : 4 + size])
        memory[vl53l5cx.COMMAND_STATUS : vl53l5cx.COMMAND_STATUS + 4] = status

    def _answer(self, index: int, size: int) -> None:
        data = self._blocks.get(index, b"").ljust(size, b"\0")[:size]
        answer = bytes(4) + vl53l5cx.swapped(data) + bytes(8)
        self._pages[2][vl53l5cx.COMMAND_START : vl53l5cx.COMMAND_START + len(answer)] = answer

    def _begin(self, time: float) -> None:
        size = struct.unpack_from("<I", self._blocks.get(vl53l5cx.OUTPUT_CONFIG, bytes(8)))[0]
        self._blocks[vl53l5cx.STREAM] = bytes(8) + struct.pack("<HH", size, 0)
        is_whole = self._blocks[vl53l5cx.ZONE_CONFIG][:2] == b"\x08\x08"
        self._begun = time if is_whole else None
        self._rate = max(self._blocks.get(vl53l5cx.RATE, bytes(4))[1], 1)

    def _measure(self, time: float) -> None:
        """Bring the registers of the reading up to date."""
        assert self._begun is not None
        count = math.floor((time - self._begun) * self._rate)
        if count == 0:
            self._pages[2][0] = 255
            return
        at = max(bisect_right(self._scene.times, count / self._rate) - 1, 0)
        status = self._scene.status[at]
        sigma = self._scene.sigma
        reading = Reading(
            stream=(count - 1) % 255,
            temperature=30,
            distance=np.where(status == 0, self._scene.ranges[at] * self._across, 0.0).astype(np.float32),
            status=status,
            sigma=np.full(vl53l5cx.ZONES, 0.01, np.float32) if sigma is None else sigma[at],
            signal=np.full(vl53l5cx.ZONES, 20.0, np.float32),
            ambient=np.full(vl53l5cx.ZONES, 2.0, np.float32),
        )
        data = vl53l5cx.built(reading, CODES[status])
        self._pages[2][: len(data)] = data


STORED: Final = bytes(range(256)) + bytes(range(vl53l5cx.STORED_SIZE - 256))  # offsets of no real chip


def _head(data: bytes) -> tuple[int, int]:
    """Block and size of a command."""
    index, high, low = struct.unpack_from(">HBB", data)
    return index, high << 4 | low >> 4


def pretended_firmware() -> Firmware:
    """What has the sizes of ST's firmware and runs on no chip: for tests and for an emulator without ST's file."""
    program = bytes(n * 7 & 0xFF for n in range(256)) * (vl53l5cx.FIRMWARE_SIZE // 256)
    return Firmware(program, bytes(972), bytes(vl53l5cx.CROSSTALK_SIZE), bytes(40))


def as_c_source(firmware: Firmware) -> str:
    """A source as ST hands it out, of any firmware."""
    names = ("FIRMWARE", "DEFAULT_CONFIGURATION", "DEFAULT_XTALK", "GET_NVM_CMD")
    parts = (firmware.program, firmware.configuration, firmware.crosstalk, firmware.ask_stored)
    arrays = zip(names, parts, strict=True)
    return "\n".join(
        f"const uint8_t VL53L5CX_{name}[] = {{ {', '.join(f'0x{byte:02X}' for byte in data)} }};"
        for name, data in arrays
    )
