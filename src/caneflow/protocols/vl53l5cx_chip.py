"""A VL53L5CX over its registers: given its firmware, set up, asked for readings. No I/O here."""

import struct
from collections.abc import Callable
from typing import Final

from caneflow.protocols import vl53l5cx
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import Link
from caneflow.protocols.vl53l5cx import NAME, Firmware, Reading

PIECE: Final = 1024  # bytes of a long write: Linux takes 8192 in one transfer
POLLS: Final = 200  # 10 ms each
POLL: Final = 0.01  # s

# Register and value, on page 0, before the firmware comes: what ST's driver writes to restart the chip and to wake it.
_RESTART: Final = (
    (0x09, 0x04), (0x0F, 0x40), (0x0A, 0x03), (0x0C, 0x01), (0x101, 0x00), (0x102, 0x00), (0x10A, 0x01),
    (0x4002, 0x01), (0x4002, 0x00), (0x10A, 0x03), (0x103, 0x01), (0x0C, 0x00), (0x0F, 0x43),
)  # fmt: skip
_POWER: Final = (
    (0x0C, 0x01), (0x101, 0x00), (0x102, 0x00), (0x10A, 0x01), (0x4002, 0x01), (0x4002, 0x00), (0x10A, 0x03),
    (0x103, 0x01), (0x400F, 0x00), (0x21A, 0x43), (0x21A, 0x03), (0x21A, 0x01), (0x21A, 0x00), (0x219, 0x00),
    (0x21B, 0x00), (0x0C, 0x00),
)  # fmt: skip
_BEGIN: Final = ((0x0C, 0x01), (0x114, 0x00), (0x115, 0x00), (0x116, 0x42), (0x117, 0x00), (0x0B, 0x00), (0x0C, 0x00))


class Chip:
    """One chip. Page 2 is chosen between calls."""

    def __init__(self, link: Link, pause: Callable[[float], None]) -> None:
        self.link = link
        self._pause = pause
        self._stream = 255  # of the last reading

    def require(self) -> None:
        """Raise ProtocolError unless this is a VL53L5CX."""
        self._page(0)
        said = self.link.read(0x00, 2).data
        self._page(2)
        if said != vl53l5cx.IDENTITY:
            raise ProtocolError(f"not a {NAME}: it says {said.hex()}; expected {vl53l5cx.IDENTITY.hex()}")

    def move(self, address: int) -> None:
        """Give it another address on the bus, at which it answers from now on."""
        self._page(0)
        self.link.write(0x04, bytes((address,)))

    def boot(self, firmware: Firmware) -> None:
        """Restart the chip and give it its firmware and tables: about 85 kB, some 2 s at 400 kHz."""
        self._page(0)
        self._write_all(_RESTART)
        self._pause(0.001)
        self._write_all(((0x0F, 0x40), (0x0A, 0x01)))
        self._pause(0.1)
        self._page(0)
        self._wait("its start", lambda: self.link.read(0x06, 1).data == b"\x01")
        self.link.write(0x0E, b"\x01")
        self._open_firmware()
        self._write_all(_POWER)
        self._page(1)
        self._write_all(((0x20, 0x07), (0x20, 0x06)))
        at = 0
        for page, size in vl53l5cx.FIRMWARE_PAGES:
            self._page(page)
            self._write_long(0, firmware.program[at : at + size])
            at += size
        self._open_firmware()
        self._write_all(_BEGIN)
        self.link.write(0x0B, b"\x01")
        self._wait("its firmware's start", self._runs)
        self._page(2)
        self._write_long(vl53l5cx.STORED_AT, firmware.ask_stored)
        self._wait("its stored offsets", lambda: self._status()[0] == 2)
        self._stored = self.link.read(vl53l5cx.COMMAND_START, vl53l5cx.STORED_SIZE).data
        self._send_tables(firmware, whole=False)
        self._command(vl53l5cx.CONFIGURATION_AT, firmware.configuration)
        self._write_block(vl53l5cx.PIPE_CONTROL, b"\x01\0\x01\0")
        self._write_block(vl53l5cx.SINGLE_RANGE, b"\x01\0\0\0")
        self._change_block(vl53l5cx.GLARE_FILTER, 40, {0x25: 1, 0x26: 1})

    def set_up(self, firmware: Firmware, rate: int) -> None:
        """8 x 8 zones, continuous, `rate` readings a second."""
        self._change_block(vl53l5cx.SPAD_CONFIG, 16, {4: 16, 6: 16, 9: 1})
        self._change_block(vl53l5cx.ZONE_CONFIG, 8, {0: 8, 1: 8, 4: 4, 5: 4})
        self._send_tables(firmware, whole=True)
        self._change_block(vl53l5cx.RANGING_MODE, 8, {1: 1, 3: 3})
        self._write_block(vl53l5cx.SINGLE_RANGE, bytes(4))
        self._change_block(vl53l5cx.RATE, 4, {1: rate})

    def start(self) -> None:
        """Let it measure; raises ProtocolError when its readings have another size than expected."""
        outputs = vl53l5cx.OUTPUTS
        self._write_block(vl53l5cx.OUTPUT_LIST, struct.pack(f"<{len(outputs)}I", *outputs))
        size = vl53l5cx.reading_size()
        self._write_block(vl53l5cx.OUTPUT_CONFIG, struct.pack("<II", size, len(outputs) + 1))
        self._write_block(vl53l5cx.OUTPUT_ENABLES, struct.pack("<4I", *vl53l5cx.ENABLED))
        self._page(0)
        self.link.write(0x09, b"\x05")
        self._page(2)
        self._command(vl53l5cx.COMMAND_END - 3, b"\0\x03\0\0")
        its = struct.unpack_from("<H", self._read_block(vl53l5cx.STREAM, 12), 8)[0]
        if its != size:
            raise ProtocolError(f"its readings have {its} bytes; expected {size}")
        self._stream = 255

    def is_ready(self) -> bool:
        """Whether there is a reading that was not read; raises ProtocolError when the firmware has failed."""
        stream, kind, state, more = self.link.read(0x00, 4).data
        if more & 0x80:
            raise ProtocolError(f"its firmware has stopped, error 0x{state:02X}")
        return stream not in (255, self._stream) and kind == 0x05 and state & 0x05 == 0x05 and more & 0x10 == 0x10

    def read(self) -> Reading:
        """The reading that is there; raises ProtocolError for one that is torn."""
        reading = vl53l5cx.parsed(self.link.read(0x00, vl53l5cx.reading_size()).data)
        self._stream = reading.stream
        return reading

    # --- what it is made of -------------------------------------------------------------------------------------

    def _page(self, page: int) -> None:
        self.link.write(vl53l5cx.PAGE, bytes((page,)))

    def _write_all(self, values: tuple[tuple[int, int], ...]) -> None:
        for register, value in values:
            self.link.write(register, bytes((value,)))

    def _write_long(self, register: int, data: bytes) -> None:
        for at in range(0, len(data), PIECE):
            self.link.write(register + at, data[at : at + PIECE])

    def _open_firmware(self) -> None:
        """Let the host reach the firmware's memory; leaves page 0."""
        self._page(2)
        self.link.write(0x03, b"\x0d")
        self._page(1)
        self._wait("its memory", lambda: bool(self.link.read(0x21, 1).data[0] & 0x10))
        self._page(0)

    def _runs(self) -> bool:
        state = self.link.read(0x06, 1).data[0]
        if state & 0x80 and (error := self.link.read(0x07, 1).data[0]):
            raise ProtocolError(f"its firmware does not start, error 0x{error:02X}: is it whole?")
        return bool(state & 0x81)

    def _wait(self, what: str, has_come: Callable[[], bool]) -> None:
        for _ in range(POLLS):
            if has_come():
                return
            self._pause(POLL)
        raise ProtocolError(f"waited {POLLS * POLL:g} s for {what} in vain")

    def _status(self) -> bytes:
        said = self.link.read(vl53l5cx.COMMAND_STATUS, 4).data
        if said[2] >= vl53l5cx.FAILED:
            raise ProtocolError(f"its firmware refuses a command: {said.hex()}")
        return said

    def _command(self, register: int, data: bytes) -> None:
        self._write_long(register, data)
        self._wait("an answer of its firmware", lambda: self._status()[1] == vl53l5cx.DONE)

    def _write_block(self, index: int, data: bytes) -> None:
        self._command(*vl53l5cx.write_command(index, data))

    def _read_block(self, index: int, size: int) -> bytes:
        self._command(*vl53l5cx.read_command(index, size))
        return vl53l5cx.answered(self.link.read(vl53l5cx.COMMAND_START, size + 12).data, size)

    def _change_block(self, index: int, size: int, values: dict[int, int]) -> None:
        data = bytearray(self._read_block(index, size))
        for at, value in values.items():
            data[at] = value
        self._write_block(index, bytes(data))

    def _send_tables(self, firmware: Firmware, *, whole: bool) -> None:
        self._command(vl53l5cx.OFFSETS_AT, vl53l5cx.offsets(self._stored, whole=whole))
        self._command(vl53l5cx.CROSSTALK_AT, vl53l5cx.crosstalk(firmware.crosstalk, whole=whole))
