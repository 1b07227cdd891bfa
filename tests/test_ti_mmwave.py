"""TI mmWave radars: packets of every kind, Doppler by the chirps, the driver on made ports, raw dumps."""

import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caneflow.device_checks import ti_mmwave as check
from caneflow.errors import CaneflowError
from caneflow.messages import RadarPoints, decode, numbered, sample_key
from caneflow.messages.rig import Rig
from caneflow.protocols import ti_mmwave as radar
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.ti_mmwave_emulator import MmwaveRadar
from caneflow.recording import Recording, RecordingWriter
from caneflow.runtime import Context, Quiet
from caneflow.runtime.errors import DataflowError
from caneflow.serial_ports import made_port
from drivers.ti_mmwave import TiMmwave, TiMmwaveSettings
from tools.emulate_ti_mmwave import played, serve
from tools.import_mmwave import mmwave

CONFIG = """% the vendor's default of an AOP, the chirps shortened
sensorStop
flushCfg
profileCfg 0 60 80 7 58 0 0 70 1 256 5209 0 0 158
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 2
chirpCfg 2 2 0 0 0 0 0 4
frameCfg 0 2 45 0 20 1 0
clutterRemoval -1 0
sensorStart
"""


def packet(*parts: tuple[int, bytes], head: int = 40, frame: int = 7, counted: int = 0, version: int = 3) -> bytes:
    """As the firmware sends it, of its definition and not of `built`."""
    body = b"".join(struct.pack("<II", kind, len(value) + counted) + value for kind, value in parts)
    size = -(-(head + len(body)) // 32) * 32
    magic = bytes.fromhex("0201040306050807")
    if head == 52:
        words = struct.pack("<10I2H", version << 24, 0xA6843, 5, size, frame, 0, 0, 0, 0, 0, len(parts), 0)
    else:
        words = struct.pack("<8I", version << 24, size, 0xA6843, frame, 600, 1, len(parts), 0)[: head - 8]
    return (magic + words + body).ljust(size, b"\0")


ROW = struct.pack("<4f", 1.0, 2.0, 0.5, -0.25)  # 1 m right, 2 m ahead, 0.5 up, approaching
SIDE = struct.pack("<2h", 123, 456)


@pytest.mark.parametrize("size", [1, 13, 10_000])
def test_points_are_turned_and_come_in_any_pieces(size: int) -> None:
    first = packet((1, ROW), (7, SIDE), (6, bytes(24)), (99, b"unknown"))
    cut = packet((1, ROW * 3))[:50]
    data = b"noise" + first + cut + packet(frame=8) + packet(frame=9)
    reader = radar.Packets()
    pieces = [data[at : at + size] for at in range(0, len(data), size)]
    found = [each for piece in pieces for each in reader.feed(piece)]
    assert [each.frame for each in found] == [7, 8, 9]
    assert found[0].position.tolist() == [[2.0, -1.0, 0.5]]
    assert (found[0].doppler.tolist(), found[0].in_bins) == ([0.25], False)
    assert found[0].snr is not None and found[0].noise is not None
    assert (found[0].snr.tolist(), found[0].noise.tolist()) == (pytest.approx([12.3]), pytest.approx([45.6]))


def test_a_frame_without_points_is_a_frame() -> None:
    (found,) = radar.Packets().feed(packet())
    assert (found.position.shape, found.doppler.shape, found.snr) == ((0, 3), (0,), None)


@pytest.mark.parametrize(("head", "counted"), [(40, 0), (36, 0), (52, 0), (52, 8), (40, 8)])
def test_headers_of_other_firmware(head: int, counted: int) -> None:
    parts = ((1, ROW * 5), (7, SIDE * 5))
    (found,) = radar.Packets().feed(packet(*parts, head=head, counted=counted))
    assert (found.frame, len(found.doppler)) == (7, 5)
    assert found.position[4].tolist() == [2.0, -1.0, 0.5]


def test_polar_and_compressed_points() -> None:
    azimuth, elevation = 0.3, 0.1
    distance = 2.5
    right = distance * np.cos(elevation) * np.sin(azimuth)
    ahead = distance * np.cos(elevation) * np.cos(azimuth)
    up = distance * np.sin(elevation)
    polar = struct.pack("<4f", distance, azimuth, elevation, 0.5)
    squeezed = struct.pack("<5f", 0.01, 0.01, 0.1, 0.001, 0.5) + struct.pack("<bbhHH", 10, 30, 5, 2500, 31)
    low = struct.pack("<4f2H", 0.001, 0.1, 0.5, 0.25, 1, 0)
    low += struct.pack("<4h2B", round(1e3 * right), round(1e3 * ahead), round(1e3 * up), 5, 31, 8)
    for kind, value in ((1000, polar), (1020, squeezed), (301, low)):
        (found,) = radar.Packets().feed(packet((kind, value)))
        assert found.position[0].tolist() == pytest.approx([ahead, -right, up], abs=1e-3)
        assert found.doppler.tolist() == pytest.approx([-0.5])
        if kind != 1000:
            assert found.snr is not None and found.snr.tolist() == [15.5]
    indexed = struct.pack("<2H", 1, 8) + struct.pack("<HhHhhh", 4, -3, 100, 256, 512, 0)
    (found,) = radar.Packets().feed(packet((1, indexed), version=1))
    assert (found.position.tolist(), found.doppler.tolist(), found.in_bins) == ([[2.0, -1.0, 0.0]], [3.0], True)


def test_what_no_radar_measures_is_no_point() -> None:
    wild = [struct.pack("<4f", np.nan, 1, 1, 0), struct.pack("<4f", 1, 1e9, 1, 0), struct.pack("<4f", 1, 1, 1, np.inf)]
    (found,) = radar.Packets().feed(packet((1, b"".join(wild) + ROW), (7, SIDE * 4)))
    assert found.snr is not None
    assert (len(found.position), len(found.doppler), len(found.snr)) == (1, 1, 1)


def test_any_bytes_are_read_without_harm() -> None:
    random = np.random.default_rng(1)
    good = packet((1, ROW * 3), (7, SIDE * 3))
    for _ in range(300):
        bad = bytearray(good)
        for at in random.integers(0, len(bad), 4):
            bad[at] = int(random.integers(0, 256))
        list(radar.Packets().feed(bytes(bad) + good * 2))


# --- the configuration ------------------------------------------------------------------------------------------


def test_doppler_by_the_chirps() -> None:
    """The AOP's default (359 + 57.14 us, 3 TX, 16 loops) ends at 0.99 m/s; 138 us reach 3 m/s in 18.5 ms at 0.13."""
    slow = CONFIG.replace("80 7 58", "359 7 57.14").replace("0 2 45", "0 2 16")
    assert radar.chirps_of(radar.lines_of(slow)).doppler_limit == pytest.approx(0.99, abs=0.04)
    chirps = radar.chirps_of(radar.lines_of(CONFIG))
    assert chirps.doppler_limit == pytest.approx(3.0, rel=0.04)
    assert chirps.doppler_step == pytest.approx(0.13, abs=0.006)
    assert chirps.frame_time == pytest.approx(0.0185, rel=0.01)
    assert chirps.period == 0.02


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("clutterRemoval -1 0", "clutterRemoval -1 1", "it deletes what stands"),
        ("frameCfg", "% frameCfg", "no line frameCfg"),
        ("frameCfg 0 2 45", "frameCfg 0 2 x", "cannot be read"),
        ("frameCfg 0 2 45", "frameCfg 0 2 0", "cannot be read"),
    ],
)
def test_a_configuration_that_is_of_no_use(old: str, new: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ProtocolError, match=said):
        radar.chirps_of(radar.lines_of(CONFIG.replace(old, new)))
    path = tmp_path / "x.cfg"
    path.write_text(CONFIG.replace(old, new))
    with pytest.raises(DataflowError, match=f"radar: config .*x.cfg: .*{said}"):
        TiMmwave(TiMmwaveSettings(config=str(path)), context())
    (finding,) = check.examine(node_of(TiMmwaveSettings(config=str(path))))
    assert (finding.state, said in finding.text) == ("bad", True)


# --- the driver -------------------------------------------------------------------------------------------------


def context() -> Context:
    return Context(node="radar", rig=Rig(), ports={"points": RadarPoints}, random=np.random.default_rng(1))


def node_of(settings: TiMmwaveSettings) -> Any:
    """As much of a node as an examination looks at."""
    return SimpleNamespace(name="radar", run="drivers.ti_mmwave", settings=settings)


def frames(count: int) -> list[RadarPoints]:
    random = np.random.default_rng(2)
    return [
        RadarPoints(
            stamp=1_000_000_000 + 20_000_000 * number,
            position=random.uniform(-5, 5, (points, 3)).astype(np.float32),
            doppler=(0.125 * random.integers(-8, 9, points)).astype(np.float32),
            snr=(0.1 * random.integers(50, 300, points)).astype(np.float32),
            noise=np.full(points, 40.0, np.float32),
            frame_time=0.018,
            doppler_step=0.125,
            doppler_limit=3.0,
        )
        for number, points in enumerate(random.integers(0, 60, count))
    ]


def recorded(path: Path, samples: list[RadarPoints]) -> Path:
    with RecordingWriter(path, flow="desk", source="simulated", rig={}) as writer:
        for seq, sample in enumerate(samples):
            key = sample_key("desk", "radar", "points")
            payload = numbered(sample, seq)
            writer.write(key, RadarPoints, payload, stamp=sample.stamp, seq=seq, log_time=sample.stamp)
    return path


Start = Callable[..., TiMmwaveSettings]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts an emulated radar of 30 frames; the settings of a driver for it."""
    threads: list[threading.Thread] = []
    path = recorded(tmp_path / "given.mcap", frames(30))

    def start(*, one_port: bool, config: str = CONFIG) -> TiMmwaveSettings:
        times, packets = played(path)
        emulated = MmwaveRadar(times, packets, random=np.random.default_rng(1))
        made = threading.Event()

        def serving() -> None:
            with made_port(tmp_path / "cli") as cli, made_port(tmp_path / "data") as data:
                made.set()
                serve(emulated, cli, cli if one_port else data)

        threads.append(threading.Thread(target=serving))
        threads[-1].start()
        assert made.wait(10)
        (tmp_path / "x.cfg").write_text(config)
        ports: dict[str, Any] = {"cli": str(tmp_path / "cli"), "data": None if one_port else str(tmp_path / "data")}
        return TiMmwaveSettings(config=str(tmp_path / "x.cfg"), **ports)

    yield start
    for thread in threads:
        thread.join(timeout=30)


def brought(settings: TiMmwaveSettings, count: int) -> list[RadarPoints]:
    found: list[RadarPoints] = []
    with closing(TiMmwave(settings, context()).samples()) as items:
        for item in items:
            if not isinstance(item, Quiet):
                assert isinstance(item[1], RadarPoints)
                found.append(item[1])
            if len(found) == count:
                break
    return found


@pytest.mark.parametrize("one_port", [False, True])
def test_the_driver_sends_its_configuration_and_brings_the_points(start: Start, one_port: bool) -> None:
    settings = start(one_port=one_port)
    (finding, *_) = check.examine(node_of(settings))
    assert (finding.state, "up to 2.9" in finding.text) == ("ok", True)
    found = brought(settings, 28)
    given = frames(30)
    for one, other in zip(found, given, strict=False):
        assert np.array_equal(one.position, other.position)
        assert np.array_equal(one.doppler, other.doppler)
        assert one.snr is not None and other.snr is not None
        assert np.allclose(one.snr, other.snr, atol=1e-4)
    steps = [later.stamp - earlier.stamp for earlier, later in pairwise(found)]
    assert min(steps) > 0
    assert found[0].doppler_limit == pytest.approx(2.9, abs=0.1)


def test_a_line_that_the_radar_refuses_is_named(start: Start, tmp_path: Path) -> None:
    settings = start(one_port=False, config=CONFIG.replace("sensorStart", "wrongWord 1\nsensorStart"))
    with pytest.raises(DataflowError, match=r"the radar refuses 'wrongWord 1': .*not recognized"):
        brought(settings, 1)
    (tmp_path / "x.cfg").write_text(CONFIG)
    assert brought(settings, 1)  # so that the emulated recording runs out


# --- raw dumps --------------------------------------------------------------------------------------------------


def test_a_dump_becomes_a_recording(tmp_path: Path) -> None:
    given = frames(20)
    dump = tmp_path / "dump.bin"
    made = [
        radar.built(number + 1, each.position, each.doppler, each.snr, each.noise) for number, each in enumerate(given)
    ]
    dump.write_bytes(b"".join([*made[:10], made[11][:30], *made[12:]]))  # two are missing
    config = tmp_path / "x.cfg"
    config.write_text(CONFIG)
    mmwave(dump, tmp_path / "x.mcap", config=config)
    with Recording(tmp_path / "x.mcap") as recording:
        found = [decode(sample.payload, RadarPoints) for sample in recording.samples()]
    kept = [each for number, each in enumerate(given) if number not in (10, 11)]
    assert [each.stamp // 20_000_000 for each in found] == [*range(10), *range(12, 20)]
    assert all(np.array_equal(one.doppler, other.doppler) for one, other in zip(found, kept, strict=True))
    with pytest.raises(CaneflowError, match="cycles go on"):
        mmwave(dump, tmp_path / "y.mcap")  # those packets have no cycles
    with pytest.raises(CaneflowError, match="no packet of a TI mmWave radar"):
        mmwave(config, tmp_path / "y.mcap")


def test_without_a_configuration_the_points_tell(tmp_path: Path) -> None:
    """Doppler steps by the values, the period by the processor's cycles: 60.0 M apart at 600 MHz are 100 ms."""
    dump = bytearray()
    for number in range(5):
        rows = b"".join(struct.pack("<4f", 0.0, 3.0, 0.0, 0.125 * step) for step in (1, 3, -8))
        one = bytearray(packet((1, rows), frame=number + 1))
        struct.pack_into("<I", one, 16, 0xA1642)
        struct.pack_into("<I", one, 24, (4_200_000_000 + 60_000_000 * number) % 2**32)
        dump += one
    (tmp_path / "x.bin").write_bytes(dump)
    mmwave(tmp_path / "x.bin", tmp_path / "x.mcap")
    with Recording(tmp_path / "x.mcap") as recording:
        found = [decode(sample.payload, RadarPoints) for sample in recording.samples()]
    assert [each.stamp for each in found] == [number * 100_000_000 for number in range(5)]
    assert (found[0].doppler_step, found[0].doppler_limit) == (0.125, 1.0)
