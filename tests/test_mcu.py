"""The firmware: built, measured, and held to the Python model bit for bit, on this computer and on an emulated one."""

import os
import re
import shutil
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest

from caneflow.algorithms.cane.luenberger import LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import METHOD, FixedLuenbergerObserver, observer_constants
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import Vector
from caneflow.errors import CaneflowError
from caneflow.messages import (
    GroundSpeed,
    Imu,
    MessageError,
    Pose,
    RadarFrame,
    Sample,
    bounds,
    decode,
    encode,
    with_number,
)
from caneflow.messages.rig import read_rig
from caneflow.protocols.uart_frames import NUMBERS, Deframer, Frame, Kind, Status, framed, pose_answer, reset, status
from caneflow.recording import Recording
from caneflow.runtime import Context
from caneflow.simulation.scenario import simulate_walk
from operators.ground_speed import GroundSpeedOperator, GroundSpeedSettings
from tests.flows import caneflow, caneflow_here
from tools import mcu

ROOT = Path(__file__).parents[1]
MCU = ROOT / "mcu"
WALKS = ROOT.parent / "shared" / "data" / "walks"
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
BORESIGHT: Vector = (0.0, 1.0, 0.0)
FLASH, RAM = 32 * 1024, 8 * 1024  # bytes that a small part has
MOST_INSTRUCTIONS = 20_000  # per IMU sample
INSTRUCTIONS_PER_TICK = 40  # -icount shift=0 is 1 ns per instruction; the board's clock has 25 MHz
FIRST, LAST = 300, 420  # samples of the walk that the emulator gets by default: it walks, after 2 s of rest
ANSWER_TIME = 100.0  # s; a loaded machine emulates slowly


# --- caneflow mcu config --------------------------------------------------------------------------------------------


def header_of(flow: Path, *settings: str, node: str | None = None) -> str:
    output = flow.parent / "observer_config.h"
    mcu.config(flow, output=output, node=node, settings=list(settings), overwrite=True)
    return output.read_text()


def defined(header: str) -> dict[str, int]:
    """Name -> value of a header's constants."""
    found = re.findall(r"#define OBSERVER_(\w+) \(?(-?)(?:U?INT32_C\()?(0x[0-9a-f]+|\d+)", header)
    return {name: int(sign + number, 0) for name, sign, number in found}


@pytest.fixture
def flow(tmp_path: Path) -> Path:
    path = tmp_path / "flow.yaml"
    path.write_text((ROOT / "dataflow.yaml").read_text())
    return path


def test_the_header_has_the_constants_of_the_model(tmp_path: Path) -> None:
    output = tmp_path / "observer_config.h"
    assert caneflow_here("mcu", "config", ROOT / "dataflow.yaml", "-o", output).returncode == 0
    constants = observer_constants(LuenbergerSettings(), BORESIGHT)
    found = defined(output.read_text())
    assert found["DIGEST"] == constants.digest
    assert [found[f"BORESIGHT_{axis}"] for axis in "XYZ"] == list(constants.boresight)
    named = [found[f"GAIN_{entry}"] for entry in ("AA", "AV", "VA", "VV")]
    assert named == [constants.gain_aa, constants.gain_av, constants.gain_va, constants.gain_vv]
    assert (found["FOLLOWS_INTERVAL"], found["HEADING_AT_DELAY"]) == (1, 0)


def test_settings_and_rig_reach_the_header(flow: Path) -> None:
    flow.write_text(flow.read_text().replace("boresight: [0, 1, 0]", "boresight: [0, 0.6, -0.8]"))
    gain = "fusion.luenberger.gain=[[0.5, -0.25], [0.01, 0.05]]"
    found = defined(header_of(flow, gain, "fusion.luenberger.compensate_delay=heading"))
    assert found["GAIN_AV"] == -(2**27)
    assert found["BORESIGHT_Z"] == -round(0.8 * 2**30)
    assert (found["FOLLOWS_INTERVAL"], found["HEADING_AT_DELAY"]) == (0, 1)


def test_the_header_may_be_printed(flow: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mcu.config(flow, output=None, node=None, settings=None)
    assert capsys.readouterr().out == header_of(flow)


def test_a_flow_whose_observer_cannot_be_had_is_refused(flow: Path) -> None:
    with pytest.raises(CaneflowError, match=r"nodes.fusion.settings.luenberger: compensate_delay is motion"):
        header_of(flow, "fusion.luenberger.compensate_delay=motion")
    with pytest.raises(CaneflowError, match="node 'radar' has no settings of the luenberger observer; fusion"):
        header_of(flow, node="radar")
    with pytest.raises(CaneflowError, match=r"fusion.*method"):
        header_of(flow, "fusion.method=nonsense")
    with pytest.raises(CaneflowError, match="no single node with the luenberger observer: there is none"):
        mcu.config(ROOT / "dataflows" / "room.yaml", output=None, node=None, settings=None)


def test_of_several_observers_the_one_in_fixed_point_is_meant_or_the_one_that_is_named(flow: Path) -> None:
    again = re.search(r"  fusion:\n(?:    .*\n)+", flow.read_text())
    assert again
    second = again[0].replace("fusion:", "second:", 1)
    flow.write_text(flow.read_text().replace("\nresults:", "\n" + second + "\nresults:"))
    with pytest.raises(CaneflowError, match="there are fusion, second; say --node NAME"):
        header_of(flow)
    assert "node second" in header_of(flow, node="second")
    assert "node second" in header_of(flow, "second.method=luenberger_fixed")


# --- building and talking -------------------------------------------------------------------------------------------


def need(program: str, package: str) -> None:
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not here; it comes with the Debian package {package}")


def built(board: str, build: Path, *variables: str) -> Path:
    command = ["make", "-s", "-C", str(MCU), f"BOARD={board}", f"BUILD={build}", f"FLOW={ROOT / 'dataflow.yaml'}"]
    subprocess.run([*command, f"CANEFLOW={' '.join(CANEFLOW)}", *variables], check=True, timeout=100)
    return build / "firmware.elf"


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware for the emulated board."""
    need("make", "make")
    need("arm-none-eabi-gcc", "gcc-arm-none-eabi")
    return built("mps2_an386", tmp_path_factory.mktemp("mps2"))


@pytest.fixture(scope="module")
def on_this_computer(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The same sources as a program of this computer that ends at the first thing that C does not define."""
    need("make", "make")
    need("cc", "gcc")
    sanitize = "SANITIZE=-O1 -fsanitize=undefined,address -fno-sanitize-recover=all"
    return [str(built("host", tmp_path_factory.mktemp("host"), sanitize))]


def emulator(firmware: Path, *options: str, serial: str = "stdio") -> list[str]:
    need("qemu-system-arm", "qemu-system-arm")
    quiet = ["-display", "none", "-monitor", "none"]
    return ["qemu-system-arm", "-M", "mps2-an386", "-kernel", str(firmware), *quiet, "-serial", serial, *options]


def answers(command: Sequence[str], stream: bytes, patience: float = ANSWER_TIME) -> tuple[list[Frame], list[Status]]:
    """What the firmware says to `stream`, which ends with a question: poses and refusals; statuses."""
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin and process.stdout
    watchdog = threading.Timer(patience, process.kill)
    watchdog.start()
    writer = threading.Thread(target=_send, args=(process.stdin.fileno(), stream + framed(Kind.ASK, 0)))
    writer.start()
    deframer, got, statuses, questions = Deframer(), [], [], 0
    try:
        while questions < 2 + stream.count(framed(Kind.ASK, 0)) + stream.count(RESET):
            data = os.read(process.stdout.fileno(), 1 << 16)
            assert data, "the firmware has ended"
            for frame in deframer.feed(data):
                if frame.kind == Kind.STATUS:
                    statuses.append(status(frame.body))
                    questions += 1
                else:
                    got.append(frame)
    finally:
        process.kill()
        process.wait()
        watchdog.cancel()
        writer.join()
        process.stdin.close()
        process.stdout.close()
    assert deframer.bad == 0
    return got, statuses


def _send(file: int, stream: bytes) -> None:
    try:
        while stream:
            stream = stream[os.write(file, stream) :]
    except BrokenPipeError:
        pass  # it was killed; the reader says so


RESET = reset(77)


def numbered(samples: Sequence[Sample]) -> list[bytes]:
    """A frame for each sample, as the gateway numbers them."""
    kinds = {Imu: Kind.IMU, GroundSpeed: Kind.GROUND_SPEED}
    return [framed(kinds[type(each)], n % NUMBERS, encode(needed(each))) for n, each in enumerate(samples)]


def needed(sample: Sample) -> Sample:
    """The sample without what the observer has no use for, as the gateway sends it."""
    if isinstance(sample, Imu):
        accel = sample.accel if sample.linear_accel is None else None
        return msgspec.structs.replace(sample, mag=None, calibration=None, accel=accel)
    return msgspec.structs.replace(sample, velocity=None, velocity_cov=None, velocity_delay=None)


def model(samples: Sequence[Sample], settings: LuenbergerSettings | None = None) -> list[tuple[bytes, bool, bool]]:
    """For each IMU sample the pose's bytes, and whether it was flagged as saturated and as a gap."""
    observer = FixedLuenbergerObserver(settings or LuenbergerSettings(), boresight=BORESIGHT)
    made: list[tuple[bytes, bool, bool]] = []
    for each in samples:
        if isinstance(each, GroundSpeed):
            observer.speed(each.stamp, each.speed, each.quality, each.valid, each.delay)
        elif isinstance(each, Imu):
            gaps = observer.gaps
            got = observer.imu(
                each.stamp,
                ImuReading(each.gyro, each.accel, orientation=each.orientation, linear_accel=each.linear_accel),
            )
            pose = Pose(
                stamp=each.stamp,
                seq=len(made),
                position=got.position,
                velocity=got.velocity,
                orientation=got.orientation,
                method=METHOD,
                status=" ".join(f"held:{what}" for what in observer.held) or None,
            )
            made.append((encode(pose), observer.saturated, observer.gaps > gaps))
    return made


def said(frames: Sequence[Frame]) -> list[tuple[bytes, bool, bool]]:
    """The same of what the firmware said; the pose goes through a Pose, as msgpack has several ways to say a number."""
    assert {frame.kind for frame in frames} <= {Kind.POSE}
    got = [pose_answer(frame.body) for frame in frames]
    return [(encode(decode(each.payload, Pose)), each.saturated, each.gap) for each in got]


@cache
def walk() -> tuple[Sample, ...]:
    """IMU samples and ground speeds of 5 s of a simulated walk, the first 2 at rest."""
    made = simulate_walk("straight", seed=3, duration=5.0)
    imu, operator = made.imu, ground_speed()
    samples: list[Sample] = []
    for i, stamp in enumerate(made.stamps_ns.tolist()):
        about = {name: getattr(made, name) for name in ("scan_period", "range_start", "range_step")}
        frame = RadarFrame(
            stamp=stamp, scans=made.scans[i : i + 1], carrier=made.carrier, bandwidth=made.bandwidth, **about
        )
        vectors = {name: tuple(getattr(imu, name)[i].tolist()) for name in ("gyro", "accel", "mag", "linear_accel")}
        reading = Imu(stamp=stamp, seq=i, orientation=tuple(imu.orientation[i].tolist()), **vectors)
        speeds = [
            speed for port, each in (("frame", frame), ("imu", reading)) for _, speed in operator.handle(port, each)
        ]
        samples += [reading, *(with_number(speed, i) for speed in speeds)]
    return tuple(samples)


def ground_speed() -> GroundSpeedOperator:
    rig = read_rig({"hand_height": 0.95, "aperture": 0.87, "pivot": [0, -0.3, 0], "step_length": 0.42})
    context = Context(node="test", rig=rig, ports={}, random=np.random.default_rng(0))
    return GroundSpeedOperator(GroundSpeedSettings(), context)


def hostile(count: int, seed: int) -> list[Sample]:
    """Samples that no cane gives, up to their bounds: huge and tiny numbers, gaps, lulls, floods of speeds, nothing."""
    rng = np.random.default_rng(seed)
    samples: list[Sample] = []
    stamp = 10**9
    for k in range(count):
        stamp += int(rng.choice([1, 10_000_000, 499_999_999, 500_000_000, 500_000_001, 10**10, 2**46], p=WEIGHTS))
        for _ in range(int(rng.choice([0, 1, 2, 30], p=[0.3, 0.5, 0.15, 0.05]))):
            speed, delay = (rng.normal(0, 1, 2) * 10.0 ** rng.integers(-12, 12, 2)).tolist()
            speed, delay = min(max(speed, -bounds.SPEED), bounds.SPEED), min(abs(delay), bounds.DELAY)
            valid, late = bool(rng.random() < 0.8), int(rng.choice([0, 1, -5_000_000]))
            quality = float(rng.choice([0.0, 0.3, np.inf]))
            samples.append(
                GroundSpeed(
                    stamp=max(0, stamp + late),
                    seq=len(samples),
                    speed=speed,
                    quality=quality,
                    rays=int(rng.integers(0, 300)),
                    valid=valid,
                    delay=None if rng.random() < 0.3 else delay,
                )
            )
        q = rng.normal(0, 1, 4) if rng.random() < 0.9 else np.eye(4)[rng.integers(4)] * rng.choice([-1.0, 1.0])
        w, x, y, z = (q / np.linalg.norm(q) * (1 + rng.uniform(-9e-4, 9e-4))).tolist()
        wild = rng.normal(0, 1, 3) * 10.0 ** rng.integers(-10, 5, 3)
        a, b, c = np.clip(wild, -bounds.ACCELERATION, bounds.ACCELERATION).tolist()
        g = (0.0, -0.0, 5e-324)
        absent = rng.random() < 0.2
        samples.append(
            Imu(
                stamp=stamp,
                seq=k,
                gyro=g,
                orientation=(w, x, y, z),
                accel=(c, a, b),
                linear_accel=None if absent else (a, b, c),
            )
        )
    return samples


WEIGHTS = [0.05, 0.75, 0.05, 0.05, 0.04, 0.05, 0.01]


# --- what it takes --------------------------------------------------------------------------------------------------


def test_the_firmware_fits_into_a_small_part(firmware: Path) -> None:
    printed = subprocess.run(["arm-none-eabi-size", firmware], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, printed.splitlines()[1].split()[:3])
    assert text + data < FLASH
    assert data + bss < RAM, "the stack among it"


def test_there_is_no_floating_point_and_no_heap_in_it(firmware: Path) -> None:
    symbols = subprocess.run(["arm-none-eabi-nm", firmware], capture_output=True, text=True, check=True).stdout
    assert "observer_imu" in symbols
    # with -mfloat-abi=soft each operation on a float would be a call
    assert not re.findall(r"__aeabi_(?:c?[fd](?!iv0)\w+|u?[il]2[fd])\b|\b(?:malloc|calloc|sbrk|_sbrk)\b", symbols)


def test_an_imu_sample_takes_at_most_20000_instructions(firmware: Path) -> None:
    """All that the processor does from sleep to sleep: reception, frames, messages, observer, transmission."""
    samples = [each for each in walk() if isinstance(each, Imu)][FIRST - 50 : FIRST + 10]
    command = emulator(firmware, "-icount", "shift=0")
    frames, statuses = answers(command, RESET + b"".join(numbered(samples)))
    assert (len(frames), statuses[-1].lost_bytes) == (len(samples), 0)
    ticks = statuses[-1].busy - statuses[-2].busy
    assert 1000 < ticks * INSTRUCTIONS_PER_TICK / len(samples) <= MOST_INSTRUCTIONS


# --- bit for bit ----------------------------------------------------------------------------------------------------


def test_the_sources_agree_with_the_model_on_a_walk(on_this_computer: list[str]) -> None:
    frames, _ = answers(on_this_computer, RESET + b"".join(numbered(walk())))
    expected = model(walk())
    assert len(expected) > 490
    assert decode(expected[-1][0], Pose).position[0] ** 2 + decode(expected[-1][0], Pose).position[1] ** 2 > 0.25
    assert said(frames) == expected


@pytest.mark.parametrize("seed", [1, 2])
def test_the_sources_agree_with_the_model_whatever_comes(on_this_computer: list[str], seed: int) -> None:
    samples = hostile(400, seed)
    frames, _ = answers(on_this_computer, RESET + b"".join(numbered(samples)))
    expected = model(samples)
    assert said(frames) == expected
    assert 20 < sum(saturated for _, saturated, _ in expected) < len(expected)
    assert sum(gap for _, _, gap in expected) > 20


@pytest.mark.parametrize("seed", [4, 5])
def test_the_sources_hold_what_the_model_holds(on_this_computer: list[str], seed: int) -> None:
    """A walk in which every fourth sample is a hostile one, two or three in a row among them, and some are lost."""
    rng = np.random.default_rng(seed)
    wild: dict[type[Sample], list[Sample]] = {
        kind: [each for each in hostile(300, seed) if type(each) is kind] for kind in (Imu, GroundSpeed)
    }
    samples: list[Sample] = []
    for each in walk():
        if rng.random() < 0.25:
            other = wild[type(each)][int(rng.integers(200))]
            samples.append(msgspec.structs.replace(other, stamp=each.stamp, seq=each.seq))
        elif rng.random() < 0.98:
            samples.append(each)
    frames, _ = answers(on_this_computer, RESET + b"".join(numbered(samples)))
    expected = model(samples)
    assert said(frames) == expected
    statuses = [decode(pose, Pose).status or "" for pose, _, _ in expected]
    for word in ("held:orientation", "held:accel", "held:linear_accel", "held:speed"):
        assert sum(word in status.split() for status in statuses) > 5, word
    assert statuses.count("") > 100


@pytest.mark.parametrize(
    "settings",
    [
        LuenbergerSettings(gain=((0.4, -0.1), (0.012, 0.06))),
        LuenbergerSettings(pole_acceleration=-0.5, pole_velocity=0.8, compensate_delay="heading"),
    ],
)
def test_other_settings_agree_as_well(tmp_path: Path, settings: LuenbergerSettings) -> None:
    need("cc", "gcc")
    flow = tmp_path / "flow.yaml"
    about = {key: value for key, value in vars(settings).items() if value is not None}
    about["gain"] = [list(row) for row in settings.gain] if settings.gain else None
    text = (ROOT / "dataflows" / "paper.yaml").read_text()
    flow.write_text(text.replace("{ method: luenberger }", f"{{ luenberger: {msgspec.json.encode(about).decode()} }}"))
    command = [str(built("host", tmp_path, f"FLOW={flow}", "SANITIZE=-O0"))]
    for samples in (walk(), hostile(200, 3)):
        frames, statuses = answers(command, RESET + b"".join(numbered(samples)))
        assert said(frames) == model(samples, settings)
        assert statuses[-1].digest == observer_constants(settings, BORESIGHT).digest


def test_the_emulated_firmware_agrees_with_the_model(firmware: Path) -> None:
    samples = walk()[2 * FIRST : 2 * LAST]
    frames, statuses = answers(emulator(firmware), RESET + b"".join(numbered(samples)))
    assert said(frames) == model(samples)
    assert statuses[-1].bad_frames == statuses[-1].lost_bytes == 0


def test_hostile_samples_agree_on_the_emulated_firmware(firmware: Path) -> None:
    samples = hostile(40, 6)
    frames, _ = answers(emulator(firmware), RESET + b"".join(numbered(samples)))
    assert said(frames) == model(samples)


TEN_WALKS = [
    *("swing_1", "swing_stop_2", "stops_3", "hard_4", "varied_5", "varied_6"),
    *("swing", "varied", "figure_eight", "step_back"),
]


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", TEN_WALKS)
def test_every_pose_of_ten_walks_is_equal_in_every_bit(firmware: Path, tmp_path: Path, name: str) -> None:
    path = WALKS / f"{name}.mcap"
    if "_" in name and name[-1].isdigit() and not path.exists():
        pytest.skip(f"{name}.mcap is not here; it comes with the shared recordings")
    if not path.exists():
        path = tmp_path / "walk.mcap"
        command = [*CANEFLOW, "simulate", "walk", "--scenario", name, "--seed", "11", "-o", str(path)]
        subprocess.run(command, check=True, timeout=300)
    samples = recorded_samples(path)
    frames, _ = answers(emulator(firmware), RESET + b"".join(numbered(samples)), patience=1700.0)
    assert len(frames) > 4500
    assert said(frames) == model(samples)


def recorded_samples(path: Path) -> list[Sample]:
    """IMU samples and the ground speeds that the project makes of the frames, in event time."""
    operator, samples = ground_speed(), []
    with Recording(path) as recording:
        for each in recording.samples([("radar", "frame"), ("imu", "imu")]):
            assert each.kind
            message = decode(each.payload, each.kind)
            speeds = [with_number(speed, each.seq) for _, speed in operator.handle(each.port, message)]
            samples += [message, *speeds] if isinstance(message, Imu) else speeds
    return samples


# --- whatever comes -------------------------------------------------------------------------------------------------


def disturbed(samples: Sequence[Sample], rng: np.random.Generator) -> bytes:
    """Each sample's frame, whole, behind random bytes or parts of frames."""
    frames = numbered(samples)
    stream = bytearray(rng.bytes(300) + RESET)
    for frame in frames:
        other = frames[int(rng.integers(len(frames)))]
        kinds = [b"", rng.bytes(int(rng.integers(1, 60))), other[: int(rng.integers(len(other)))], b"\x05" * 700]
        stream += kinds[int(rng.choice(4, p=[0.4, 0.3, 0.27, 0.03]))] + frame
    return bytes(stream)


def test_the_next_good_frame_is_taken_whatever_came_before(on_this_computer: list[str]) -> None:
    samples = walk()[-400:]
    frames, statuses = answers(on_this_computer, disturbed(samples, np.random.default_rng(1)))
    assert said(frames) == model(samples)
    assert statuses[-1].bad_frames > 50


def test_the_emulated_firmware_takes_the_next_good_frame_too(firmware: Path) -> None:
    samples = walk()[-60:]
    frames, statuses = answers(emulator(firmware), disturbed(samples, np.random.default_rng(2)))
    assert said(frames) == model(samples)
    assert statuses[-1].bad_frames > 5


def test_messages_in_all_of_msgpacks_ways_are_read_as_in_python(on_this_computer: list[str]) -> None:
    """Whole numbers and singles for doubles, long heads, nil for absent, keys that nobody knows."""
    plain = {
        "stamp": 10**9,
        "seq": 70000,
        "gyro": [0, 1, -1],
        "linear_accel": [1, -300, 2.5],
        "orientation": [1, 0, 0, 0],
    }
    unknown = {"later": {"a": [1, [None, True], b"bytes", msgpack.ExtType(1, b"d" * 20), "x" * 300, -(2**40), 1.5]}}
    bodies = [
        msgpack.packb(plain),
        msgpack.packb(plain, use_single_float=True),
        msgpack.packb({**unknown, **plain, "accel": None, "mag": [1.0, 2.0, 3.0]}),
        msgpack.packb({**plain, "linear_accel": None, "accel": [-(2**11), 4000, -129]}),
        msgpack.packb({**plain, **{f"k{i}": msgpack.ExtType(5, bytes(1 << i)) for i in range(6)}, "s" * 40: 1}),
        b"\xde\x00\x05" + msgpack.packb(plain)[1:],
        b"\xdf\x00\x00\x00\x05" + msgpack.packb(plain)[1:].replace(b"\x93", b"\xdc\x00\x03", 1),
        b"\x85\xd9\x05" + msgpack.packb(plain)[2:],
    ]
    assert len(bodies[0]) < len(bodies[2])
    for body in bodies:
        frames, _ = answers(on_this_computer, RESET + framed(Kind.IMU, 0, body))
        assert said(frames) == model([decode(body, Imu)])


def test_what_is_no_message_is_refused_and_the_session_goes_on(on_this_computer: list[str]) -> None:
    good = {"stamp": 10**9, "seq": 0, "gyro": [0.0] * 3, "linear_accel": [0.0] * 3, "orientation": [1.0, 0.0, 0.0, 0.0]}
    nan, inf = float("nan"), float("inf")
    bad = [
        *({key: value for key, value in good.items() if key != gone} for gone in ("stamp", "seq", "gyro")),
        *(
            {**good, key: value}
            for key, value in [("stamp", -1), ("stamp", 2**63), ("stamp", 1.0), ("gyro", [0.0] * 4)]
        ),
        *({**good, "linear_accel": [0.0, each, 0.0]} for each in (nan, inf, -inf, None, "1", True, 2**60)),
        *({**good, "linear_accel": [0.0, each, 0.0]} for each in (1e200, -1e30, 4010.1, -4011, 2**53)),
        {**good, "gyro": [0.0, 0.0, -1000000.1]},
        {**good, "accel": [4000.1, 0.0, 0.0]},
        {**good, "orientation": [1.0, 0.0, 0.0]},
        {**good, "orientation": 1.0},
    ]
    bodies = [msgpack.packb(each) for each in bad] + [msgpack.packb(good) + b"\0", b"", b"\xc1", b"\xdf" + b"\xff" * 9]
    refused = [b"\x01"] * len(bodies)
    for reason, change in (
        (2, {"orientation": None}),
        (3, {"orientation": [0.5] * 3 + [0.6]}),
        (4, {"linear_accel": None}),
    ):
        bodies.append(msgpack.packb({**good, **change}))
        refused.append(bytes([reason]))
    bodies += [msgpack.packb(good), msgpack.packb(good)]
    stream = b"".join(framed(Kind.IMU, n, body) for n, body in enumerate(bodies))
    frames, _ = answers(on_this_computer, RESET + stream)
    assert [frame.number for frame in frames] == list(range(len(bodies)))
    assert [frame.body for frame in frames[:-2]] == refused
    assert (frames[-2].kind, frames[-1].kind, frames[-1].body) == (Kind.POSE, Kind.REFUSED, b"\x05")


def test_the_bounds_of_the_sources_are_those_of_python() -> None:
    found = re.findall(r"#define (\w+) UINT64_C\(0x([0-9a-f]{16})\)", (MCU / "messages.c").read_text())
    values = {name: struct.unpack(">d", bytes.fromhex(bits))[0] for name, bits in found}
    assert values.pop("COSINE") > 1 + bounds.UNIT_TOLERANCE
    assert values.pop("INFINITE") == np.inf
    assert values == {name: getattr(bounds, name) for name in values}
    assert {"TURN_RATE", "ACCELERATION", "LINEAR_ACCELERATION", "SPEED", "SPREAD", "DELAY"} == values.keys()


@pytest.mark.parametrize(
    "change",
    [
        {"speed": 100.1}, {"speed": -1e200}, {"quality": 1000.5}, {"quality": -1e-300}, {"delay": -0.001},
        {"delay": 60.5}, {"delay": 1e308}, {"rays": 1_000_001},
    ],
)  # fmt: skip
def test_a_speed_that_python_refuses_changes_nothing(on_this_computer: list[str], change: dict[str, float]) -> None:
    good = {"stamp": 10**9, "seq": 0, "speed": 1.0, "quality": 0.1, "rays": 9, "valid": True, "delay": 0.3}
    with pytest.raises(MessageError):
        decode(msgpack.packb({**good, **change}), GroundSpeed)
    samples = walk()[2 * FIRST : 2 * FIRST + 20]
    good["stamp"] = samples[10].stamp - 1  # the newest when the next IMU sample asks
    kinds = {Imu: Kind.IMU, GroundSpeed: Kind.GROUND_SPEED}
    sent = [(kinds[type(each)], encode(needed(each))) for each in samples]

    def with_speed(fields: dict[str, float]) -> tuple[list[tuple[bytes, bool, bool]], int]:
        """What the firmware said of the poses, and how often it refused a sample."""
        all_sent = [*sent[:10], (Kind.GROUND_SPEED, msgpack.packb(fields)), *sent[10:]]
        stream = b"".join(framed(kind, number, body) for number, (kind, body) in enumerate(all_sent))
        frames, _ = answers(on_this_computer, RESET + stream)
        poses = [frame for frame in frames if frame.kind == Kind.POSE]
        return said(poses), len(frames) - len(poses)

    assert with_speed({**good, **change}) == (model(samples), 1)
    moved, refused = with_speed(good)
    assert refused == 0
    assert moved != model(samples)


def test_damaged_messages_are_taken_only_if_python_takes_them_or_they_lie_in_what_is_not_read(
    on_this_computer: list[str],
) -> None:
    rng = np.random.default_rng(4)
    whole = encode(needed(walk()[2 * FIRST]))
    bodies = []
    for _ in range(600):
        damaged = bytearray(whole)
        for _ in range(int(rng.integers(1, 3))):
            damaged[int(rng.integers(len(whole)))] = int(rng.integers(256))
        bodies.append(bytes(damaged[: int(rng.integers(len(whole) + 1))] if rng.random() < 0.2 else damaged))
    stream = b"".join(RESET + framed(Kind.IMU, 0, body) for body in bodies)
    frames, _ = answers(on_this_computer, stream)
    assert len(frames) == len(bodies)
    taken = 0
    for body, frame in zip(bodies, frames, strict=True):
        try:
            expected = model([decode(body, Imu)])
        except (MessageError, ValueError):
            continue
        taken += 1
        assert frame.kind == Kind.POSE
        assert said([frame]) == expected
    assert 100 < taken < 500


# --- a stage of the graph -------------------------------------------------------------------------------------------


@contextmanager
def emulated_port(firmware: Path) -> Iterator[str]:
    """The path of the serial port of an emulated board."""
    command = emulator(firmware, serial="pty")
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert process.stdout
    try:
        said = process.stdout.readline().decode()
        port = re.search(r"/dev/\S+", said)
        assert port, said
        yield port[0]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def run(flow: str, recording: Path, out: Path, *options: str) -> list[bytes]:
    """The poses of a replay of 1.2 s of walking."""
    run = caneflow_here if "--in-process" in options else caneflow
    part = ("--start", "2.6", "--duration", "1.2")
    done = run("run", ROOT / flow, "--replay", recording, "--record", out, *options, *part)
    assert done.returncode == 0, done.stderr
    with Recording(out) as recorded:
        return [sample.payload for sample in recorded.samples([("fusion", "pose")])]


@pytest.mark.timeout(400)  # five processes and an emulator: seconds on an idle machine, a minute on a busy one
def test_a_replay_through_the_emulated_microcontroller_gives_the_bytes_of_one_in_process(
    firmware: Path, tmp_path: Path
) -> None:
    pytest.importorskip("serial", reason="pyserial is not here; it comes with caneflow[devices]")
    recording = tmp_path / "walk.mcap"
    simulated = caneflow_here("simulate", "walk", "--scenario", "straight", "--duration", 4, "-o", recording)
    assert simulated.returncode == 0, simulated.stderr
    expected = run(
        "dataflow.yaml", recording, tmp_path / "model.mcap", "--in-process", "--set", f"fusion.method={METHOD}"
    )
    with emulated_port(firmware) as port:
        patient = ["--set", "fusion.answer_timeout_ms=2000", "--set", "fusion.give_up_s=30"]
        options = ["--speed", "max", "--set", f"fusion.port={port}", *patient]
        got = run("dataflows/mcu.yaml", recording, tmp_path / "mcu.mcap", *options)
    assert len(got) > 110
    assert got == expected
