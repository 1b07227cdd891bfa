"""The A121: the protocol's lines, the emulated server, the driver on TCP and on a port, the vendor's own client."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caneflow.device_checks import a121 as check
from caneflow.messages import RadarFrame, numbered, sample_key
from caneflow.messages.rig import Rig
from caneflow.protocols import a121, a121_messages
from caneflow.protocols.a121_emulator import A121Server, Played
from caneflow.protocols.errors import ProtocolError
from caneflow.recording import RecordingWriter
from caneflow.runtime import Context, Quiet
from caneflow.runtime.errors import DataflowError
from drivers.a121 import A121, A121Settings
from tools.emulate_a121 import on_serial_port, played

SHARED = Path(__file__).parents[1].parent / "shared" / "data" / "a121-flow"
SETTINGS = A121Settings(host="127.0.0.1", start=0.3, end=1.3, sweeps=4)  # 17 points
POINTS, SWEEPS = 17, 4
STREAM = {"cmd": "start_streaming"}


def recorded_frames(count: int) -> list[RadarFrame]:
    random = np.random.default_rng(3)
    shape = (count, SWEEPS, POINTS)
    scans = random.integers(-2000, 2000, shape) + 1j * random.integers(-2000, 2000, shape)
    axis = a121.range_axis(SETTINGS.setup.start_point, SETTINGS.setup.step_length)
    return [
        RadarFrame(
            stamp=1_000_000_000 + number * 2_000_000,
            scans=each.astype(np.complex64),
            scan_period=1 / 2000,
            range_start=axis.start,
            range_step=axis.step,
            carrier=a121.CARRIER,
            bandwidth=a121.bandwidth_of(3),
        )
        for number, each in enumerate(scans)
    ]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mcap"
    with RecordingWriter(path, flow="desk", source="simulated", rig={}) as writer:
        for seq, frame in enumerate(recorded_frames(60)):
            key = sample_key("desk", "radar", "frame")
            writer.write(key, RadarFrame, numbered(frame, seq), stamp=frame.stamp, seq=seq, log_time=frame.stamp)
    return path


@pytest.fixture
def emulator(recording: Path) -> Iterator[int]:
    """The TCP port of `caneflow emulate a121`."""
    command = [sys.executable, "-m", "caneflow.command", "emulate", "a121", str(recording), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield int(process.stdout.readline().rsplit(maxsplit=1)[-1])
        process.terminate()
        process.communicate(timeout=30)


@pytest.fixture
def serial_port(recording: Path, tmp_path: Path) -> Iterator[Path]:
    """A serial port at whose other end an A121 is, served by a thread of this process until its recording is over."""
    radar = A121Server(played(recording), ticks_per_second=1000, random=np.random.default_rng(1))
    port = tmp_path / "a121"
    serving = threading.Thread(target=on_serial_port, args=(radar, recording, port))
    serving.start()
    while not port.is_symlink():
        assert serving.is_alive()
    yield port
    serving.join(timeout=30)


def brought(settings: A121Settings, count: int) -> list[RadarFrame]:
    context = Context(node="radar", rig=Rig(), ports={"frame": RadarFrame}, random=np.random.default_rng(1))
    frames: list[RadarFrame] = []
    with closing(A121(settings, context).samples()) as items:
        for item in items:
            if not isinstance(item, Quiet):
                assert isinstance(item[1], RadarFrame)
                frames.append(item[1])
            if len(frames) == count:
                break
    return frames


# --- the protocol -----------------------------------------------------------------------------------------------


def test_lines_and_samples_come_in_any_pieces() -> None:
    said = a121_messages.frame_line(7, 4, 25, {"frame_delayed": True}) + b"\x01\x00\xff\xff"
    said += a121_messages.line({"status": "stop"})
    for size in (1, 3, len(said)):
        lines = a121_messages.Lines()
        pieces = [said[first : first + size] for first in range(0, len(said), size)]
        found = [answer for piece in pieces for answer in lines.feed(piece)]
        assert [answer.payload for answer in found] == [b"\x01\x00\xff\xff", b""]
    one = a121.SweepSetup(start_point=0, points=1, step_length=1, sweeps=1)
    frame = a121_messages.frame_of(found[0], one)
    assert (frame.tick, frame.delayed, frame.saturated, frame.samples.tolist()) == (7, True, False, [[[1, -1]]])


@pytest.mark.parametrize(
    "data", [b"\xff\x00garbage\n", b"[1]\n", b'{"payload_size":-1}\n', b'{"payload_size":1e9}\n', b"x" * 70_000]
)
def test_noise_on_the_line_is_no_answer(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        list(a121_messages.Lines().feed(data))


def server(frames: int = 3, **options: Any) -> A121Server:
    samples = np.arange(frames * SWEEPS * POINTS * 2).astype(np.int16).reshape(frames, SWEEPS, POINTS, 2)
    recorded = Played(
        setups=[SETTINGS.setup],
        times=[5.0 + 0.002 * number for number in range(frames)],
        frames=list(samples),
        flags=[{}] * frames,
    )
    return A121Server(recorded, ticks_per_second=1000, random=np.random.default_rng(1), **options)


def answers(data: bytes) -> list[dict[str, Any]]:
    return [answer.said for answer in a121_messages.Lines().feed(data)]


def test_an_emulated_server_plays_only_what_was_recorded() -> None:
    radar = server()
    ask = a121_messages.setup_request(A121Settings(host="x", end=1.0, sweeps=4).setup)
    (refused,) = answers(radar.receive(a121_messages.line(ask), 0.0))
    assert refused["status"] == "error"
    assert "4 sweeps of 17 points from 120 every 24; asked for 4 of 12 points" in refused["message"]
    assert answers(radar.receive(b'{"cmd":"start_streaming"}\nnonsense\n', 0.0))[0]["status"] == "error"
    asked = a121_messages.line(a121_messages.setup_request(SETTINGS.setup)) + a121_messages.line(STREAM)
    set_up, started = answers(radar.receive(asked, 10.0))
    assert a121_messages.metadata_of(set_up)[:2] == (SWEEPS * POINTS, POINTS)
    assert started["status"] == "start"
    ticks = [said["result_info"][0][0]["tick"] for said in answers(radar.send_due(10.0021))]
    assert ticks == [5000, 5002]
    assert radar.next_due() == pytest.approx(10.004)
    assert not radar.over


def test_a_client_that_does_not_read_loses_frames_and_is_told() -> None:
    radar = server()
    radar.receive(a121_messages.line(a121_messages.setup_request(SETTINGS.setup)) + a121_messages.line(STREAM), 0.0)
    assert radar.send_due(0.0, unsent=1 << 21) == b""
    (said,) = answers(radar.send_due(0.0021))
    assert said["result_info"][0][0]["frame_delayed"]
    assert (radar.counts.sent, radar.counts.lost) == (1, 1)


# --- settings ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"end": 2.1, "hwaas": 8}, r"30 points at 2000 Hz are 240 kB/s; a UART of 2000000 bit/s carries 185 kB/s"),
        ({"hwaas": 60}, r"sweep_rate is 2000 Hz; 17 points of profile 3 and hwaas 60 take 1.\d+ ms, \d+ Hz at most"),
        (
            {"host": "x", "end": 6.0, "sweep_rate": 100.0},
            r"end is 5.\d+ m; at prf 15_6_MHz the radar measures to 5.1 m",
        ),
        ({"sweeps": 300}, r"17 points x 300 sweeps are 5100; the radar's buffer holds 4095"),
        ({"prf": "19_5_MHz"}, r"it needs profile 1"),
        ({"end": 0.2}, r"end is 0.2 m"),
    ],
)
def test_what_the_radar_cannot_do_is_said_before_it_is_opened(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        A121Settings(**wrong)


# --- the driver -------------------------------------------------------------------------------------------------


def require_given(found: list[RadarFrame]) -> None:
    given = recorded_frames(60)
    assert all(np.array_equal(one.scans, other.scans) for one, other in zip(found, given, strict=False))
    assert (found[0].range_start, found[0].range_step) == pytest.approx((given[0].range_start, given[0].range_step))
    assert found[0].bandwidth == pytest.approx(given[0].bandwidth)
    assert all(earlier.stamp < later.stamp for earlier, later in pairwise(found))


def test_the_driver_brings_the_recorded_frames_over_a_serial_port(serial_port: Path) -> None:
    settings = A121Settings(port=str(serial_port), end=1.3, sweeps=SWEEPS)
    require_given(brought(settings, 50))


def test_the_driver_and_the_doctor_on_tcp(emulator: int) -> None:
    settings = A121Settings(host="127.0.0.1", tcp_port=emulator, end=1.3, sweeps=SWEEPS)
    (finding,) = check.examine(node_of(settings))
    assert (finding.state, "caneflow emulator at 127.0.0.1" in finding.text) == ("ok", True)
    found = brought(settings, 50)
    require_given(found)
    (finding,) = check.examine(node_of(A121Settings(host="127.0.0.1", tcp_port=1)))
    assert (finding.state, "no A121 at 127.0.0.1, TCP port 1" in finding.text) == ("bad", True)


def node_of(settings: A121Settings) -> Any:
    """As much of a node as an examination looks at."""
    return SimpleNamespace(name="radar", settings=settings)


def test_a_radar_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataflowError, match=r"radar: A121 at .*: no frame within 0.1 s: .*doctor --devices"):
        brought(A121Settings(port=str(tmp_path / "none"), start_timeout_s=0.1), 1)


# --- the vendor's own client ------------------------------------------------------------------------------------


def test_the_vendors_client_reads_the_emulator_sample_for_sample(recording: Path) -> None:
    pytest.importorskip("acconeer.exptool", reason="acconeer-exptool is not installed: it takes rich back in time")
    from acconeer.exptool import a121 as vendor

    for path in (recording, SHARED / "surface_velocity_4_dist.h5"):
        if not path.exists():
            continue  # of the shared recordings; the one made here is always read
        given = played(path)
        read_by_vendor(vendor, path, given)


def read_by_vendor(vendor: Any, path: Path, given: Played) -> None:
    command = [sys.executable, "-m", "caneflow.command", "emulate", "a121", str(path), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline().rsplit(maxsplit=1)[-1])
        drained = threading.Thread(target=process.stdout.read)
        drained.start()
        first = given.setups[0]
        config = vendor.SensorConfig(
            sweeps_per_frame=first.sweeps,
            sweep_rate=first.sweep_rate,
            start_point=first.start_point,
            num_points=first.points,
            step_length=first.step_length,
            continuous_sweep_mode=True,
            double_buffering=True,
            inter_frame_idle_state=vendor.IdleState.READY,
            inter_sweep_idle_state=vendor.IdleState.READY,
        )
        client = vendor.Client.open(ip_address="127.0.0.1", tcp_port=port)
        try:
            client.setup_session(config)
            client.start_session()
            for wanted in given.frames[:30]:
                found = client.get_next().frame
                assert np.array_equal(found, wanted[..., 0] + 1j * wanted[..., 1])
            client.stop_session()
        finally:
            client.close()
            process.terminate()
            drained.join(timeout=30)
