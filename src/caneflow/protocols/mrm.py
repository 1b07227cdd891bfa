"""Messages of the Time Domain P440 in monostatic radar mode (MRM): bytes in, records out, and back.

All integers are big-endian. One message per UDP datagram; on serial links see mrm_serial. Samples of one scan are
spread over several `ScanInfo` messages: mrm_scans puts them together.
"""

import struct
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.errors import ProtocolError

UDP_PORT = 21210
SAMPLES_PER_PACKET = 350  # int32 slots of every SCAN_INFO, used or not
SCAN_INFO_BYTES = 52 + 4 * SAMPLES_PER_PACKET
LONGEST_SCAN = 16_416  # samples of the widest window the radar accepts, -499998..499998 ps, in whole quanta of 96
SCAN_COUNT_STOP = 0
SCAN_COUNT_FOREVER = 65535
STATUS_OK = 0
STATUS_FAILURE = 1
STATUS_WRONG_MODE = 2
STATUS_UNSUPPORTED = 3
STATUS_ASLEEP = 4
STATUS_NAMES = {
    STATUS_OK: "ok",
    STATUS_FAILURE: "failure",
    STATUS_WRONG_MODE: "wrong operation mode",
    STATUS_UNSUPPORTED: "unsupported value",
    STATUS_ASLEEP: "invalid during sleep",
}
MODE_MRM = 1  # operation mode: monostatic radar
SLEEP_ACTIVE = 0  # sleep mode: awake

_TYPE_AND_ID = struct.Struct(">HH")
_CONFIG = struct.Struct(">IiiHH4H4BBBBB")
_CONFIG_TAIL = struct.Struct(">II")
_CONTROL = struct.Struct(">HHI")
_STATUS = struct.Struct(">I")
_MODE = struct.Struct(">I")
_MODE_AND_STATUS = struct.Struct(">II")
_SCAN = struct.Struct(">II16siiHBxBBHIHH")
_INFO = struct.Struct(">BBHBBHBBBBIBBBBi")
_PACKAGE = struct.Struct(">32s")


@dataclass(frozen=True, kw_only=True, slots=True)
class RadarConfig:
    """What a P440 is set to: the block of SET_CONFIG, of GET_CONFIG's answer and of a log's head."""

    node_id: int
    scan_start_ps: int  # ps of delay, antenna path included
    scan_stop_ps: int  # ps; the radar rounds the window up to whole quanta of 96 samples
    scan_resolution_bins: int = 32  # bins of 1.907 ps per sample
    base_integration_index: int = 11  # 2^index pulses per sample: 6..15
    segment_sample_counts: tuple[int, int, int, int] = (0, 0, 0, 0)
    segment_integrations: tuple[int, int, int, int] = (0, 0, 0, 0)
    antenna_mode: int = 2  # 0 A/A, 1 B/B, 2 transmit A receive B, 3 transmit B receive A
    transmit_gain: int = 63  # 0..63
    code_channel: int = 0  # 0..10
    persist: int = 0  # 0 not at all, 1 all to flash, 2 this message, 3 later

    @classmethod
    def from_bytes(cls, data: bytes, offset: int = 0) -> Self:
        """The 32-byte block at `offset`; raises ProtocolError when `data` ends before it does."""
        block = _unpack(_CONFIG, data, offset, "configuration block")
        return cls(
            node_id=block[0],
            scan_start_ps=block[1],
            scan_stop_ps=block[2],
            scan_resolution_bins=block[3],
            base_integration_index=block[4],
            segment_sample_counts=block[5:9],
            segment_integrations=block[9:13],
            antenna_mode=block[13],
            transmit_gain=block[14],
            code_channel=block[15],
            persist=block[16],
        )

    def to_bytes(self) -> bytes:
        """The 32-byte block; raises ProtocolError for a value that its field cannot hold."""
        return _pack(
            _CONFIG,
            "configuration block",
            self.node_id,
            self.scan_start_ps,
            self.scan_stop_ps,
            self.scan_resolution_bins,
            self.base_integration_index,
            *self.segment_sample_counts,
            *self.segment_integrations,
            self.antenna_mode,
            self.transmit_gain,
            self.code_channel,
            self.persist,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Bare:
    """A message of its type and id alone."""

    message_id: int

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        return cls(message_id=message_id)

    def body(self) -> bytes:
        return b""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Confirm:
    """An answer that is a status."""

    message_id: int
    status: int = STATUS_OK

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        (status,) = _unpack(_STATUS, data, 4, cls.__name__)
        return cls(message_id=message_id, status=status)

    def body(self) -> bytes:
        return _pack(_STATUS, type(self).__name__, self.status)


@dataclass(frozen=True, kw_only=True, slots=True)
class _ModeRequest:
    """Asks for a mode."""

    message_id: int
    mode: int

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        (mode,) = _unpack(_MODE, data, 4, cls.__name__)
        return cls(message_id=message_id, mode=mode)

    def body(self) -> bytes:
        return _pack(_MODE, type(self).__name__, self.mode)


@dataclass(frozen=True, kw_only=True, slots=True)
class SetConfigRequest:
    """Asks the radar to take a configuration; it rounds some values, so read it back."""

    CODE: ClassVar[int] = 0x1001

    message_id: int
    config: RadarConfig

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The request in `data`."""
        return cls(message_id=message_id, config=RadarConfig.from_bytes(data, 4))

    def body(self) -> bytes:
        """What follows type and id."""
        return self.config.to_bytes()


@dataclass(frozen=True, kw_only=True, slots=True)
class SetConfigConfirm(_Confirm):
    """Whether the radar took the configuration."""

    CODE: ClassVar[int] = 0x1101


@dataclass(frozen=True, kw_only=True, slots=True)
class GetConfigRequest(_Bare):
    """Asks for the configuration in force."""

    CODE: ClassVar[int] = 0x1002


@dataclass(frozen=True, kw_only=True, slots=True)
class GetConfigConfirm:
    """The configuration in force, after the radar's own rounding."""

    CODE: ClassVar[int] = 0x1102

    message_id: int
    config: RadarConfig
    timestamp_ms: int  # ms since the radar's boot
    status: int = STATUS_OK

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The answer in `data`."""
        config = RadarConfig.from_bytes(data, 4)
        timestamp_ms, status = _unpack(_CONFIG_TAIL, data, 36, cls.__name__)
        return cls(message_id=message_id, config=config, timestamp_ms=timestamp_ms, status=status)

    def body(self) -> bytes:
        """What follows type and id."""
        tail = _pack(_CONFIG_TAIL, type(self).__name__, self.timestamp_ms, self.status)
        return self.config.to_bytes() + tail


@dataclass(frozen=True, kw_only=True, slots=True)
class ControlRequest:
    """Starts or stops scanning. A stop need not be confirmed: some radars keep silent."""

    CODE: ClassVar[int] = 0x1003

    message_id: int
    scan_count: int  # SCAN_COUNT_STOP, 1..65534, or SCAN_COUNT_FOREVER
    scan_interval_us: int = 0  # us between scan starts; 0: back to back

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The request in `data`."""
        count, _, interval = _unpack(_CONTROL, data, 4, cls.__name__)
        return cls(message_id=message_id, scan_count=count, scan_interval_us=interval)

    def body(self) -> bytes:
        """What follows type and id."""
        return _pack(_CONTROL, type(self).__name__, self.scan_count, 0, self.scan_interval_us)


@dataclass(frozen=True, kw_only=True, slots=True)
class ControlConfirm(_Confirm):
    """Whether scanning was started."""

    CODE: ClassVar[int] = 0x1103


@dataclass(frozen=True, kw_only=True, slots=True)
class GetStatusRequest(_Bare):
    """Asks who is there: versions, serial number, temperature."""

    CODE: ClassVar[int] = 0xF001


@dataclass(frozen=True, kw_only=True, slots=True)
class GetStatusConfirm:
    """Versions, serial number, self test and temperature of a radar."""

    CODE: ClassVar[int] = 0xF101

    message_id: int
    application: tuple[int, int, int] = (0, 0, 0)  # major, minor, build
    kernel: tuple[int, int, int] = (0, 0, 0)
    fpga: tuple[int, int, int, int] = (0, 0, 0, 0)  # version, year, month, day, as the radar codes them
    serial_number: int = 0
    board: tuple[int, int, int] = (0, 0, 0)  # revision, type, transmitter configuration
    self_test: int = 0  # 0 is good
    temperature: float = 0.0  # degC, in steps of 1/4
    package: str = ""  # name of the firmware package; "" from old firmware, which does not send it
    status: int = STATUS_OK

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The answer in `data`: 64 bytes, or 32 from old firmware, which sends no package name."""
        f = _unpack(_INFO, data, 4, cls.__name__)
        package, at = "", 28
        if len(data) >= 64:
            (raw,) = _unpack(_PACKAGE, data, 28, cls.__name__)
            package, at = raw.split(b"\0")[0].decode("ascii", "replace"), 60
        (status,) = _unpack(_STATUS, data, at, cls.__name__)
        return cls(
            message_id=message_id,
            application=f[0:3],
            kernel=f[3:6],
            fpga=f[6:10],
            serial_number=f[10],
            board=(f[11], f[13], f[14]),
            self_test=f[12],
            temperature=f[15] / 4,
            package=package,
            status=status,
        )

    def body(self) -> bytes:
        """What follows type and id, in the 64-byte form."""
        name = type(self).__name__
        revision, kind, transmitter = self.board
        numbers = (*self.application, *self.kernel, *self.fpga, self.serial_number)
        quarters = round(self.temperature * 4)
        info = _pack(_INFO, name, *numbers, revision, self.self_test, kind, transmitter, quarters)
        package = _pack(_PACKAGE, name, self.package.encode("ascii", "replace"))
        return info + package + _pack(_STATUS, name, self.status)


@dataclass(frozen=True, kw_only=True, slots=True)
class SetOperationModeRequest(_ModeRequest):
    """Asks the radar to become another kind of device: MODE_MRM, or a ranging radio."""

    CODE: ClassVar[int] = 0xF003


@dataclass(frozen=True, kw_only=True, slots=True)
class SetOperationModeConfirm:
    """The operation mode in force, and whether it is the one that was asked for."""

    CODE: ClassVar[int] = 0xF103

    message_id: int
    mode: int
    status: int = STATUS_OK

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The answer in `data`."""
        mode, status = _unpack(_MODE_AND_STATUS, data, 4, cls.__name__)
        return cls(message_id=message_id, mode=mode, status=status)

    def body(self) -> bytes:
        """What follows type and id."""
        return _pack(_MODE_AND_STATUS, type(self).__name__, self.mode, self.status)


@dataclass(frozen=True, kw_only=True, slots=True)
class SetSleepModeRequest(_ModeRequest):
    """Asks the radar to wake (SLEEP_ACTIVE) or to sleep in one of four depths."""

    CODE: ClassVar[int] = 0xF005


@dataclass(frozen=True, kw_only=True, slots=True)
class SetSleepModeConfirm(_Confirm):
    """Whether the radar woke, or fell asleep."""

    CODE: ClassVar[int] = 0xF105


@dataclass(frozen=True, kw_only=True, slots=True)
class ReadyInfo(_Bare):
    """Sent unasked after power-up, reboot or waking: the radar has forgotten that it was scanning."""

    CODE: ClassVar[int] = 0xF202


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ScanInfo:
    """One packet of a scan: up to 350 of its samples."""

    CODE: ClassVar[int] = 0xF201

    message_id: int  # of the scan in recorded packets, of the control request by the wording: rely on neither
    source_id: int
    timestamp_ms: int  # ms since the radar's boot, u32
    reserved: bytes = bytes(16)  # firmwares disagree on these: kept as they are, never read
    scan_start_ps: int
    scan_stop_ps: int
    scan_step_bins: int = 32
    scan_type: int = 1  # 1 raw, 2 fast-time filtered, 4 motion filtered
    antenna_id: int = 0
    operation_mode: int = 1
    samples_total: int  # of the whole scan
    message_index: int  # 0-based
    messages_total: int
    samples: NDArray[np.int32]  # shape (n,), n <= 350

    @classmethod
    def read(cls, message_id: int, data: bytes) -> Self:
        """The packet in `data`; raises ProtocolError for counts that contradict each other or the length."""
        (
            source_id,
            timestamp_ms,
            reserved,
            start,
            stop,
            step_bins,
            scan_type,
            antenna_id,
            operation_mode,
            count,
            total,
            index,
            messages,
        ) = _unpack(_SCAN, data, 4, cls.__name__)
        _check_counts(len(data), count, total, index, messages)
        return cls(
            message_id=message_id,
            source_id=source_id,
            timestamp_ms=timestamp_ms,
            reserved=reserved,
            scan_start_ps=start,
            scan_stop_ps=stop,
            scan_step_bins=step_bins,
            scan_type=scan_type,
            antenna_id=antenna_id,
            operation_mode=operation_mode,
            samples_total=total,
            message_index=index,
            messages_total=messages,
            samples=np.frombuffer(data, ">i4", count, 52).astype(np.int32),
        )

    def body(self) -> bytes:
        """What follows type and id: always 1448 bytes, unused sample slots are 0."""
        size = 52 + 4 * len(self.samples)
        _check_counts(size, len(self.samples), self.samples_total, self.message_index, self.messages_total)
        head = _pack(
            _SCAN,
            type(self).__name__,
            self.source_id,
            self.timestamp_ms,
            self.reserved,
            self.scan_start_ps,
            self.scan_stop_ps,
            self.scan_step_bins,
            self.scan_type,
            self.antenna_id,
            self.operation_mode,
            len(self.samples),
            self.samples_total,
            self.message_index,
            self.messages_total,
        )
        return (head + self.samples.astype(">i4").tobytes()).ljust(SCAN_INFO_BYTES - 4, b"\0")


Message: TypeAlias = (
    SetConfigRequest
    | SetConfigConfirm
    | GetConfigRequest
    | GetConfigConfirm
    | ControlRequest
    | ControlConfirm
    | GetStatusRequest
    | GetStatusConfirm
    | SetOperationModeRequest
    | SetOperationModeConfirm
    | SetSleepModeRequest
    | SetSleepModeConfirm
    | ReadyInfo
    | ScanInfo
)
_BY_CODE: dict[int, type[Message]] = {kind.CODE: kind for kind in get_args(Message)}


def parse(data: bytes) -> Message:
    """The message in `data`; bytes after its end are ignored, as old and new firmwares pad differently.

    Raises:
        ProtocolError: too short, of a type that is not in this module, or with counts that contradict.
    """
    code, message_id = _unpack(_TYPE_AND_ID, data, 0, "message")
    kind = _BY_CODE.get(code)
    if kind is None:
        known = ", ".join(f"0x{known:04X}" for known in sorted(_BY_CODE))
        raise ProtocolError(f"message type 0x{code:04X} is not known; known are {known}")
    return kind.read(message_id, data)


def build(message: Message) -> bytes:
    """The bytes of `message`; raises ProtocolError for a value that its field cannot hold."""
    return _pack(_TYPE_AND_ID, "message", message.CODE, message.message_id) + message.body()


def status_name(status: int) -> str:
    """What a confirm's `status` means."""
    return STATUS_NAMES.get(status, f"unknown status {status}")


def _check_counts(size: int, count: int, total: int, index: int, messages: int) -> None:
    if count > SAMPLES_PER_PACKET or size < 52 + 4 * count:
        raise ProtocolError(
            f"ScanInfo: {count} samples in {size} bytes; at most {SAMPLES_PER_PACKET} fit, in 52 + 4 x samples"
        )
    if not count <= total <= LONGEST_SCAN:
        raise ProtocolError(
            f"ScanInfo: {count} of {total} samples; a scan has those of its packet and at most {LONGEST_SCAN}"
        )
    if not index < messages <= max(total, 1):
        raise ProtocolError(
            f"ScanInfo: packet {index} of {messages} for {total} samples; packets count from 0, none is empty"
        )


def _unpack(layout: struct.Struct, data: bytes, offset: int, what: str) -> tuple[Any, ...]:
    if len(data) < offset + layout.size:
        raise ProtocolError(f"{what}: {len(data)} bytes, at least {offset + layout.size} are needed")
    return layout.unpack_from(data, offset)


def _pack(layout: struct.Struct, what: str, *values: object) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise ProtocolError(f"{what}: a value does not fit its field: {error} in {values}") from error
