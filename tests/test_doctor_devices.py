"""`caneflow doctor --devices` against emulated devices, and where there are none: a radar, a belt, Doppler modules."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
import wave
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from caneflow.device_checks import mpu9250, p440, ports
from caneflow.protocols import mrm
from caneflow.protocols.mpu9250_emulator import Emulator, Faults, Motion
from caneflow.protocols.mrm_emulator import Moment, RadarEmulator
from caneflow.protocols.mrm_scans import Scan, split_scan
from tools import doctor

FLOW = """
flow: doctored
nodes:
  {node}
results: [{result}]
"""
Look = Callable[..., tuple[list[dict[str, Any]], int]]


@pytest.fixture
def look(tmp_path: Path) -> Look:
    """Runs the command on one node; its findings and the exit status."""

    def run(node: str, result: str, *options: str) -> tuple[list[dict[str, Any]], int]:
        file = tmp_path / "flow.yaml"
        file.write_text(FLOW.format(node=node, result=result))
        app = typer.Typer()
        app.command()(doctor.command)
        said = CliRunner().invoke(app, [str(file), "--devices", "--json", "--seconds", "0.5", *options])
        return json.loads(said.output), said.exit_code

    return run


def texts(findings: list[dict[str, Any]]) -> str:
    return "\n".join(f"{finding['state']} {finding['text']}" for finding in findings)


def attempts(findings: list[dict[str, Any]]) -> str:
    return "\n".join(attempt for finding in findings for attempt in finding["attempts"])


# --- P440 -------------------------------------------------------------------------------------------------------


@pytest.fixture
def radar() -> Iterator[int]:
    """The UDP port of a radar that scans every 10 ms."""

    def scan(number: int) -> Scan:
        return Scan(
            source_id=1,
            message_id=number,
            timestamp_ms=10 * number,
            scan_start_ps=10_000,
            scan_stop_ps=27_578,
            scan_step_bins=32,
            scan_type=1,
            antenna_id=1,
            operation_mode=1,
            samples=np.full(288, number, dtype=np.int32),
        )

    moments = (Moment(0.01 * n, tuple(mrm.build(p) for p in split_scan(scan(n)))) for n in range(3000))
    config = mrm.RadarConfig(node_id=1, scan_start_ps=10_000, scan_stop_ps=27_578)
    emulated = RadarEmulator(moments, config=config, random=np.random.default_rng(0))
    ends = threading.Event()

    def serve() -> None:
        client = None
        while not ends.is_set():
            try:
                message, client = udp.recvfrom(2000)
                out = emulated.receive(message, time.monotonic())
            except TimeoutError:
                out = []
            out += emulated.send_due(time.monotonic())
            for packet in out:
                assert client is not None  # a radar that nobody has started says nothing
                udp.sendto(packet, client)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(0.002)
        server = threading.Thread(target=serve, daemon=True)
        server.start()
        yield udp.getsockname()[1]
        ends.set()
        server.join(timeout=60.0)


def test_a_radar_that_answers(look: Look, radar: int) -> None:
    node = f"radar: {{run: drivers.p440, settings: {{host: 127.0.0.1, port: {radar}, scan_stop_ps: 27578}}}}"
    findings, status = look(node, "radar/frame")
    said = texts(findings)
    assert status == 0, said
    assert f"ok P440 at 127.0.0.1, UDP port {radar}, number 58432" in said
    assert " Hz, jitter " in said
    assert "ok 288 range bins, 0.00 to 2.63 m" in said


def test_a_network_without_a_way(look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(p440, "ANSWER_TIME", 0.02)
    monkeypatch.setattr(p440, "_own_address", lambda host: "10.1.2.3")
    findings, status = look("radar: {run: drivers.p440, settings: {host: 192.0.2.7}}", "radar/frame")
    assert status == 1
    (finding,) = findings
    assert finding["attempts"][0].startswith("this host would ask from 10.1.2.3: give it an address beside it")
    assert "sudo ufw allow proto udp from 192.0.2.7 port 21210" in finding["attempts"][-1]


def test_a_firewall_that_is_on_is_the_first_suspect(
    look: Look, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "ufw.conf").write_text("ENABLED=yes\n")
    monkeypatch.setattr(p440, "FIREWALL", tmp_path / "ufw.conf")
    monkeypatch.setattr(p440, "ANSWER_TIME", 0.02)
    monkeypatch.setattr(p440, "_own_address", lambda host: "192.0.2.10")
    (finding,), _ = look("radar: {run: drivers.p440, settings: {host: 192.0.2.7}}", "radar/frame")
    assert "sudo ufw allow" in finding["attempts"][0]


def test_a_radar_on_usb_that_is_not_there(look: Look) -> None:
    (finding,), status = look("radar: {run: drivers.p440, settings: {link: usb, device: /dev/nix}}", "radar/frame")
    assert (status, finding["text"]) == (1, "/dev/nix is not there")
    assert "--set radar.device=" in finding["attempts"][-1]


# --- ports and buses --------------------------------------------------------------------------------------------


def test_a_port_that_is_the_systems_console(look: Look, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ends = os.openpty()
    port = os.ttyname(ends[1])
    (tmp_path / "cmdline").write_text(f"root=/dev/sda console={port.removeprefix('/dev/')},115200 console=tty1\n")
    monkeypatch.setattr(ports, "KERNEL_OPTIONS", tmp_path / "cmdline")
    findings, _ = look(f"imu: {{run: drivers.bno055, settings: {{port: {port}}}}}", "imu/imu")
    for end in ends:
        os.close(end)
    assert findings[0]["state"] == "look"
    assert "is the system's console as well" in findings[0]["text"]
    assert "sudo systemctl disable --now serial-getty@" in findings[0]["attempts"][0]
    assert "console=serial0" in findings[0]["attempts"][1]
    assert findings[1]["text"].startswith("no BNO055")


def test_a_raspberry_pis_own_bus(look: Look, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "i2c-1").mkdir()
    (tmp_path / "i2c-1" / "name").write_text("bcm2835 (i2c@7e804000)\n")
    monkeypatch.setattr(ports, "I2C_NAMES", tmp_path)
    monkeypatch.setattr(Path, "exists", lambda path, **_: True)
    monkeypatch.setattr(os, "access", lambda *_, **__: True)
    findings, status = look("imu: {run: drivers.bno055, settings: {bus: i2c, port: /dev/i2c-1}}", "imu/imu")
    assert status == 1, "there is none here"
    assert "garbles what a chip says that stretches the clock" in findings[0]["text"]
    assert "dtoverlay=i2c-gpio,bus=3" in findings[0]["attempts"][0]


@pytest.mark.parametrize(("node", "package"), [("bno055", "serial"), ("mpu9250", "smbus2")])
def test_a_package_that_is_missing(look: Look, monkeypatch: pytest.MonkeyPatch, node: str, package: str) -> None:
    monkeypatch.setattr(ports, "find_spec", lambda name: None)
    (finding,), status = look(f"imu: {{run: drivers.{node}}}", "imu/imu")
    assert (status, finding["text"]) == (1, f"no Python package {package}")
    assert finding["attempts"] == ["pip install 'caneflow[devices]'"]


# --- MPU-9250 ---------------------------------------------------------------------------------------------------


@pytest.fixture
def belt(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Puts an emulated chip on every bus, which lies still."""

    def put(field: tuple[float, float, float] = (0.0, 18.0, -45.0), **options: Any) -> None:
        rng = np.random.default_rng(6)
        times = [0.01 * i for i in range(3000)]
        chip = Emulator(
            Motion(
                times=times,
                gyro=[tuple(row) for row in rng.normal(0.0, 0.002, (3000, 3)).tolist()],
                accel=[(0.0, 0.0, 9.81)] * 3000,
                mag=[field] * 3000,
            ),
            Faults(),
            np.random.default_rng(0),
            now=time.monotonic() - 1.0,
            **options,
        )

        @contextmanager
        def opened_bus(_: object) -> Iterator[Callable[[int, bytes, int], bytes]]:
            yield lambda address, data, length: chip.transfer(address, data, length, time.monotonic())

        monkeypatch.setattr(mpu9250, "opened_bus", opened_bus)
        monkeypatch.setattr("caneflow.drivers.mpu9250.opened_bus", opened_bus)
        monkeypatch.setattr(mpu9250, "at_port", lambda *_: iter(()))

    return put


BELT = "imu: {run: drivers.mpu9250}"


def test_a_belt_that_answers(look: Look, belt: Callable[..., None]) -> None:
    belt()
    findings, status = look(BELT, "imu/imu")
    said = texts(findings)
    assert status == 0, said
    assert "ok MPU-9250 on /dev/i2c-1, address 0x68, set up" in said
    assert " Hz, jitter " in said
    assert "m/s^2, a field of 48 uT" in said
    assert "feels 9.81" in said


def test_steel_on_the_belt(look: Look, belt: Callable[..., None]) -> None:
    belt(field=(120.0, 18.0, -45.0))
    findings, status = look(BELT, "imu/imu")
    assert status == 0
    assert "--set imu.mag_offset=" in attempts(findings)


def test_a_belt_without_magnetometer(look: Look, belt: Callable[..., None]) -> None:
    belt(identity=0x70)
    (finding,), status = look(BELT, "imu/imu")
    assert status == 1
    assert "is an MPU-6500" in finding["text"]
    assert "--set imu.magnetometer=false" in attempts([finding])


def test_a_belt_at_another_address(look: Look, belt: Callable[..., None]) -> None:
    belt(address=0x69)
    (finding,), status = look(BELT, "imu/imu")
    assert status == 1
    assert "i2cdetect -y 1" in finding["attempts"][0]
    assert "--set imu.address=0x69" in finding["attempts"][0]


def test_no_bus(look: Look) -> None:
    (finding,), status = look("imu: {run: drivers.mpu9250, settings: {bus: 77}}", "imu/imu")
    assert (status, finding["text"]) == (1, "/dev/i2c-77 is not there")
    assert "switch I2C on" in finding["attempts"][0]


# --- Doppler modules --------------------------------------------------------------------------------------------


def sound(path: Path, samples: NDArray[np.int16]) -> Path:
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(4000)
        file.writeframes(samples.astype("<i2").tobytes())
    return path


def module(path: object, **more: object) -> str:
    chosen = "".join(f", {key}: {value}" for key, value in more.items())
    return f"south: {{run: drivers.doppler_adc, settings: {{file: {path}{chosen}}}}}"


@pytest.mark.parametrize(
    ("name", "state", "said", "attempt"),
    [
        ("noise", "ok", "dB on average", ""),
        ("nothing", "look", "silent: not a bit changes", "is the module powered"),
        ("too loud", "look", "of the samples at its end", "less gain"),
    ],
)
def test_how_loud_a_module_is(look: Look, tmp_path: Path, name: str, state: str, said: str, attempt: str) -> None:
    rng = np.random.default_rng(2)
    loudness = {"noise": 1000.0, "nothing": 0.0, "too loud": 30_000.0}[name]
    samples = np.clip(rng.normal(0.0, 1.0, 6000) * loudness, -(2**15), 2**15 - 1).astype(np.int16)
    findings, status = look(module(sound(tmp_path / "sound.wav", samples)), "south/block")
    assert status == 0, texts(findings)
    assert texts(findings).startswith(f"ok {tmp_path / 'sound.wav'}: 1.5 s at 4000 Hz, PCM_16")
    assert findings[-1]["state"] == state
    assert said in findings[-1]["text"]
    assert attempt in attempts(findings)
    assert "20.0 Hz, jitter" in texts(findings)


def test_which_channel_of_two_is_silent(look: Look, tmp_path: Path) -> None:
    frames = np.zeros((6000, 2), np.int16)
    frames[:, 0] = np.random.default_rng(2).normal(0.0, 1000.0, 6000)
    frames[:, 1] = 77
    path = tmp_path / "sound.wav"
    with wave.open(str(path), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(4000)
        file.writeframes(frames.astype("<i2").tobytes())
    findings, _ = look(module(path, quadrature=1), "south/block")
    assert "ok channel 0 (I): loudest 0." in texts(findings)
    assert "look channel 1 (Q) is silent: not a bit changes" in texts(findings)
    findings, _ = look(module(path, channel=1), "south/block")
    assert "look channel 1 is silent: not a bit changes" in texts(findings)
    assert "is the module powered, and on channel 1?" in attempts(findings)


def test_a_loose_wire(look: Look, tmp_path: Path) -> None:
    samples = np.random.default_rng(2).normal(0.0, 1000.0, 6000).astype(np.int16)
    samples[400:1600] = 0
    findings, _ = look(module(sound(tmp_path / "sound.wav", samples)), "south/block")
    assert findings[-1]["state"] == "look"
    assert "% of the blocks" in findings[-1]["text"]
    assert "a wire may be loose" in attempts(findings)


def test_a_file_that_is_not_there_or_lacks_a_channel(look: Look, tmp_path: Path) -> None:
    (finding,), status = look(module("/nowhere.wav"), "south/block")
    assert (status, finding["text"]) == (1, "/nowhere.wav: is not there")
    path = sound(tmp_path / "sound.wav", np.zeros(10, np.int16))
    (finding,), status = look(module(path, quadrature=1), "south/block")
    assert status == 1
    assert "channel 1 is asked for" in finding["text"]
    assert "--set south.file=" in attempts([finding])


def examined(folder: Path, asoundrc: str, settings: str) -> tuple[list[dict[str, Any]], int]:
    """What the command says in a process of its own, as PortAudio reads ALSA's configuration once."""
    if find_library("portaudio") is None:
        pytest.skip("PortAudio is not installed: apt-get install libportaudio2")
    (folder / "asoundrc").write_text(asoundrc)
    node = f"south: {{run: drivers.doppler_adc, settings: {settings}}}"
    (folder / "flow.yaml").write_text(FLOW.format(node=node, result="south/block"))
    command = [sys.executable, "-m", "caneflow.command", "doctor", "--devices", str(folder / "flow.yaml")]
    done = subprocess.run(
        [*command, "--json", "--seconds", "0.5"],
        env={**os.environ, "ALSA_CONFIG_PATH": str(folder / "asoundrc")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return json.loads(done.stdout), done.returncode


def test_no_sound_card(tmp_path: Path) -> None:
    (finding,), status = examined(tmp_path, "pcm.!default { type hw, card 99 }", "{}")
    assert status == 1
    assert finding["text"] == "there is no sound card with an input"
    assert "arecord -l" in finding["attempts"][0]
    assert "usermod -aG audio" in finding["attempts"][1]


def test_a_card_by_another_name(tmp_path: Path) -> None:
    np.zeros(4000, np.int16).tofile(tmp_path / "sound.raw")
    slave = "slave.pcm { type null }, file /dev/null"
    card = f"pcm.cane {{ type file, {slave}, infile {tmp_path}/sound.raw, format raw }}\npcm.!default pcm.cane"
    (finding,), status = examined(tmp_path, card, "{device: walls}")
    assert status == 1
    assert "No input device matching 'walls'" in finding["text"]
    assert "one of these inputs: 0: cane; 1: default; then --set south.device=" in finding["attempts"][0]
