"""TI mmWave radars: packets of points on a UART, and what the lines of a configuration file mean for Doppler.

A packet is a header and TLVs: type, length, values, little-endian. Of a point x is right, y boresight, z up and a
positive Doppler recedes; ours are x boresight, y left, z up, and positive approaches. Facts from TI's SDK and demos.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.physics import SPEED_OF_LIGHT
from caneflow.protocols.errors import ProtocolError

Floats = NDArray[np.float32]

MAGIC: Final = bytes((2, 1, 4, 3, 6, 5, 8, 7))
LARGEST: Final = 65_536  # bytes of a packet
PADDING: Final = 32  # bytes, to a multiple of which a packet is filled up
HEAD: Final = struct.Struct("<8I")  # version, total, platform, frame, cycles, objects, TLVs, subframe
TLV: Final = struct.Struct("<2I")
COUNTING_HEAD: Final = 52  # bytes, of people-counting firmware of old
CLI_BAUD: Final = 115_200
DATA_BAUD: Final = 921_600
ENDS: Final = (b"Done", b"Error", b"not recognized")  # of an answer to a line
FARTHEST: Final = 1e3  # m, of a point that can be one
FASTEST: Final = 100.0  # m/s

POINTS, SIDE_INFO, POLAR, COMPRESSED_POLAR, COMPRESSED = 1, 7, 1000, 1020, 301
FAST_CYCLES: Final = 600e6  # Hz, of the xWR16's processor, whose packets were seen
CYCLES: Final = 200e6  # Hz, of the others by their data sheets


class Packet(NamedTuple):
    """One frame of points."""

    frame: int  # number, uint32
    platform: int  # 0xA6843
    cycles: int  # uint32, of the processor's clock
    size: int  # bytes
    position: Floats  # (n, 3) m, x boresight, y left, z up
    doppler: Floats  # (n,) m/s, positive approaching; in bins where `in_bins`
    snr: Floats | None  # (n,) dB
    noise: Floats | None
    in_bins: bool = False  # SDK 1


class Packets:
    """Takes bytes as they come, gives packets; what is none is skipped and counted."""

    def __init__(self) -> None:
        self._held = bytearray()
        self.skipped = 0  # bytes
        self.refused = 0  # packets

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Yield what is whole."""
        self._held += data
        while (found := self._next()) is not None:
            if isinstance(found, Packet):
                yield found

    def _next(self) -> Packet | bool | None:
        """A packet; False for one that was refused; None: more bytes are needed."""
        start = self._held.find(MAGIC)
        if start < 0:
            start = max(len(self._held) - len(MAGIC) + 1, 0)  # the magic may be half there
        self.skipped += start
        del self._held[:start]
        size = _size(self._held)
        if size is None or (36 <= size <= LARGEST and len(self._held) < size):
            return None
        try:
            if not 36 <= size <= LARGEST:
                raise ProtocolError(f"a packet of {size} bytes")
            if self._held.find(MAGIC, len(MAGIC), size) >= 0:
                raise ProtocolError("another packet begins within it: its end got lost")
            packet = parsed(bytes(self._held[:size]))
        except ProtocolError:
            self.refused += 1
            self.skipped += len(MAGIC)
            del self._held[: len(MAGIC)]
            return False
        del self._held[:size]
        return packet


def _size(held: bytearray) -> int | None:
    """Bytes of the packet that begins `held`; None as long as that is not known."""
    if len(held) < 24:
        return None
    usual, counting = struct.unpack_from("<I", held, 12)[0], struct.unpack_from("<I", held, 20)[0]
    return int(usual if usual <= LARGEST else counting)


def parsed(packet: bytes) -> Packet:
    """A whole packet, padding included; raises ProtocolError for one that does not add up."""
    if len(packet) < 36 or not packet.startswith(MAGIC):
        raise ProtocolError("no packet: it does not begin with the magic word")
    heads: tuple[int, ...] = (40, 36)
    if struct.unpack_from("<I", packet, 12)[0] > LARGEST:
        if len(packet) < COUNTING_HEAD:
            raise ProtocolError(f"a packet of {len(packet)} bytes; its header has {COUNTING_HEAD}")
        platform, cycles, _, frame = struct.unpack_from("<4I", packet, 12)
        count, heads, version = struct.unpack_from("<H", packet, 48)[0], (COUNTING_HEAD,), 2
    else:
        word, _, platform, frame, cycles, _, count = struct.unpack_from("<7I", packet, 8)
        version = word >> 24
    for head in heads:
        for counted in (0, TLV.size):
            parts = _parts(packet, head, count, counted)
            if parts is not None:
                position, doppler, snr, noise, in_bins = _points(parts, version)
                fit = _possible(position, doppler)
                return Packet(
                    frame,
                    platform,
                    cycles,
                    len(packet),
                    np.ascontiguousarray(position[fit]),
                    np.ascontiguousarray(doppler[fit]),
                    None if snr is None else np.ascontiguousarray(snr[fit]),
                    None if noise is None else np.ascontiguousarray(noise[fit]),
                    in_bins,
                )
    raise ProtocolError(f"a packet of {len(packet)} bytes and {count} parts, which do not fill it")


def _parts(packet: bytes, head: int, count: int, counted: int) -> list[tuple[int, bytes]] | None:
    """The TLVs of a packet whose lengths count `counted` bytes of their own heads; None when they do not fit."""
    parts, at = [], head
    for _ in range(count):
        if at + TLV.size > len(packet):
            return None
        kind, length = TLV.unpack_from(packet, at)
        length -= counted
        at += TLV.size
        if length < 0 or at + length > len(packet):
            return None
        parts.append((kind, packet[at : at + length]))
        at += length
    return parts if 0 <= len(packet) - at < PADDING else None


class _Found(NamedTuple):
    position: Floats
    doppler: Floats
    snr: Floats | None = None
    noise: Floats | None = None
    in_bins: bool = False


def _points(parts: Sequence[tuple[int, bytes]], version: int) -> _Found:
    found, side = _Found(np.zeros((0, 3), np.float32), np.zeros(0, np.float32)), b""
    for kind, value in parts:
        if kind == POINTS:
            found = _indexed(value) if version == 1 else _cartesian(_table(value, "<f4", 4))
        elif kind == POLAR:
            found = _polar(_table(value, "<f4", 4))
        elif kind == COMPRESSED_POLAR:
            found = _compressed_polar(value)
        elif kind == COMPRESSED:
            found = _compressed(value)
        elif kind == SIDE_INFO:
            side = value
    if side and len(side) == 4 * len(found.doppler):
        levels = 0.1 * np.frombuffer(side, "<i2").reshape(-1, 2).astype(np.float32)
        found = found._replace(snr=levels[:, 0], noise=levels[:, 1])
    return found


def _table(value: bytes, kind: str, columns: int) -> Floats:
    if len(value) % (columns * np.dtype(kind).itemsize):
        raise ProtocolError(f"points of {len(value)} bytes, which is not a whole number of rows")
    return np.frombuffer(value, kind).reshape(-1, columns).astype(np.float32)


def _cartesian(rows: Floats) -> _Found:
    """Of x right, y boresight, z up, Doppler receding."""
    return _Found(np.stack([rows[:, 1], -rows[:, 0], rows[:, 2]], axis=1), -rows[:, 3])


def _polar(rows: Floats) -> _Found:
    """Of range, azimuth to the right, elevation, Doppler receding."""
    distance, azimuth, elevation, doppler = rows.T
    flat = distance * np.cos(elevation)
    x, y, z = flat * np.sin(azimuth), flat * np.cos(azimuth), distance * np.sin(elevation)
    return _cartesian(np.stack([x, y, z, doppler], axis=1))


def _compressed_polar(value: bytes) -> _Found:
    row = np.dtype([("elevation", "i1"), ("azimuth", "i1"), ("doppler", "<i2"), ("range", "<u2"), ("snr", "<u2")])
    units, rows = _units(value, 5, row, 0)
    elevation, azimuth, doppler, distance, snr = units
    table = np.stack(
        [rows["range"] * distance, rows["azimuth"] * azimuth, rows["elevation"] * elevation, rows["doppler"] * doppler],
        axis=1,
    )
    return _polar(table.astype(np.float32))._replace(snr=(rows["snr"] * snr).astype(np.float32))


def _compressed(value: bytes) -> _Found:
    row = np.dtype([("x", "<i2"), ("y", "<i2"), ("z", "<i2"), ("doppler", "<i2"), ("snr", "u1"), ("noise", "u1")])
    (length, doppler, snr, noise), rows = _units(value, 4, row, 4)
    table = np.stack([rows[axis] * length for axis in "xyz"] + [rows["doppler"] * doppler], axis=1)
    levels = [(rows[name] * unit).astype(np.float32) for name, unit in (("snr", snr), ("noise", noise))]
    return _cartesian(table.astype(np.float32))._replace(snr=levels[0], noise=levels[1])


def _units(value: bytes, count: int, row: np.dtype, between: int) -> tuple[list[float], NDArray[np.void]]:
    """The units in front of compressed points, and the points behind `between` more bytes."""
    head = 4 * count + between
    if len(value) < head or (len(value) - head) % row.itemsize:
        raise ProtocolError(f"compressed points of {len(value)} bytes, which is not a whole number of rows")
    return list(struct.unpack_from(f"<{count}f", value)), np.frombuffer(value, row, offset=head)


def _indexed(value: bytes) -> _Found:
    """Of SDK 1: integers, the Doppler a bin."""
    row = np.dtype([("range", "<u2"), ("doppler", "<i2"), ("peak", "<u2"), ("x", "<i2"), ("y", "<i2"), ("z", "<i2")])
    if len(value) < 4:
        raise ProtocolError("points without their count")
    count, binary_point = struct.unpack_from("<2H", value)
    if len(value) < 4 + count * row.itemsize or binary_point > 15:
        raise ProtocolError(f"{count} points in {len(value)} bytes")
    rows = np.frombuffer(value, row, count, 4)
    table = np.stack([rows[axis] / 2.0**binary_point for axis in "xyz"] + [rows["doppler"]], axis=1)
    return _cartesian(table.astype(np.float32))._replace(in_bins=True)


def _possible(position: Floats, doppler: Floats) -> NDArray[np.bool_]:
    """Which points are numbers that a radar could have measured."""
    with np.errstate(invalid="ignore"):
        there = np.abs(position).max(axis=1, initial=0.0) < FARTHEST
        return np.asarray(there & (np.abs(doppler) < FASTEST) & np.isfinite(position).all(axis=1))


def built(frame: int, position: Floats, doppler: Floats, snr: Floats | None, noise: Floats | None) -> bytes:
    """A packet of an IWR6843 as SDK 3 sends it: points, and their side info where `snr` is known; padded."""
    rows = np.column_stack([-position[:, 1], position[:, 0], position[:, 2], -doppler]).astype("<f4")
    parts = [(POINTS, rows.tobytes())]
    if snr is not None:
        side = np.zeros((len(snr), 2)) if noise is None else np.stack([np.zeros(len(snr)), noise], axis=1)
        side[:, 0] = snr
        parts.append((SIDE_INFO, np.clip(np.rint(10.0 * side), -32768, 32767).astype("<i2").tobytes()))
    body = b"".join(TLV.pack(kind, len(value)) + value for kind, value in parts)
    size = len(MAGIC) + HEAD.size + len(body)
    padded = -(-size // PADDING) * PADDING
    head = HEAD.pack(0x03060000, padded, 0xA6843, frame % 2**32, 0, len(position), len(parts), 0)
    return MAGIC + head + body + bytes(padded - size)


# --- the configuration ------------------------------------------------------------------------------------------


class Chirps(NamedTuple):
    """What a configuration means for a frame."""

    doppler_limit: float  # m/s
    doppler_step: float  # m/s
    frame_time: float  # s, from the first chirp to the last
    period: float  # s, from frame to frame


def lines_of(text: str) -> list[str]:
    """The lines of a configuration that are sent."""
    lines = (" ".join(line.split()) for line in text.splitlines())
    return [line for line in lines if line and not line.startswith(("%", "#", "//"))]


def chirps_of(lines: Sequence[str]) -> Chirps:
    """Doppler limits of a configuration; raises ProtocolError for one that cannot be used for ego-velocity.

    v_max = lambda / (4 T n), step = lambda / (2 T n loops), of n transmitters that take turns.
    """
    words = {line.split()[0]: line.split()[1:] for line in lines}
    if any(value == "1" for value in words.get("clutterRemoval", ())[-1:]):
        raise ProtocolError("clutterRemoval is on: it deletes what stands, by which the own velocity is seen; set it 0")
    try:
        if "chirpTimingCfg" in words:
            return _low_power(words)
        return _classic(words)
    except KeyError as error:
        raise ProtocolError(f"no line {error.args[0]} in the configuration") from error
    except (IndexError, ValueError, ZeroDivisionError) as error:
        raise ProtocolError(f"profileCfg, chirpCfg or frameCfg that cannot be read: {error}") from error


def _classic(words: dict[str, list[str]]) -> Chirps:
    """SDK 1 to 3: profileCfg id GHz idle adc ramp ..., frameCfg first last loops frames ms ..."""
    if "advFrameCfg" in words:
        raise ProtocolError("advFrameCfg: frames of several kinds are not read; use frameCfg")
    profile, frame = words["profileCfg"], words["frameCfg"]
    start, idle, ramp, slope = (float(profile[at]) for at in (1, 2, 4, 7))
    first, last, loops, period = int(frame[0]), int(frame[1]), int(frame[2]), float(frame[4])
    wavelength = SPEED_OF_LIGHT / (1e9 * start + 0.5 * 1e12 * slope * 1e-6 * ramp)  # of the ramp's middle
    return _chirps(wavelength, 1e-6 * (idle + ramp), last - first + 1, loops, 1e-3 * period)


def _low_power(words: dict[str, list[str]]) -> Chirps:
    """Low-power SDK: bursts that repeat, one chirp of each transmitter in a burst."""
    timing, frame = words["chirpTimingCfg"], words["frameCfg"]
    start = float(timing[4])
    burst, bursts, period = 1e-6 * float(frame[2]), int(frame[3]), 1e-3 * float(frame[4])
    return _chirps(SPEED_OF_LIGHT / (1e9 * start), burst, 1, bursts, period)


def _chirps(wavelength: float, chirp: float, transmitters: int, loops: int, period: float) -> Chirps:
    repeated = chirp * transmitters
    if min(repeated, loops, period) <= 0:
        raise ValueError("times and counts are above 0")
    return Chirps(
        wavelength / (4.0 * repeated),
        wavelength / (2.0 * repeated * loops),
        repeated * loops - chirp,
        period,
    )
