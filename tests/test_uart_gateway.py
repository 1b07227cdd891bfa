"""The gateway against a microcontroller that is made of Python: every sample once, whatever the line does."""

import os
import select
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest

from caneflow.algorithms.cane.luenberger import LuenbergerSettings
from caneflow.algorithms.cane.luenberger_fixed import METHOD, FixedLuenbergerObserver, observer_constants
from caneflow.algorithms.imu_reading import ImuReading
from caneflow.algorithms.rotations import Vector, from_yaw
from caneflow.messages import GroundSpeed, Imu, Pose, Sample, decode, encode
from caneflow.messages.rig import Rig
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.uart_frames import NUMBERS, VERSION, Deframer, Frame, Kind, framed
from caneflow.runtime import Context, Operator, Refused
from caneflow.runtime.errors import DataflowError
from drivers.uart_gateway import READ_TIME, Microcontroller, UartGateway, UartGatewaySettings
from operators.fusion import Fusion, FusionSettings

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
BORESIGHT: Vector = (0.0, 1.0, 0.0)
SETTINGS = UartGatewaySettings()
Damage = Callable[[bytes], bytes]


def samples(count: int, seed: int = 1) -> list[Sample]:
    """A speed and an IMU sample by turns, as fusion gets them."""
    rng = np.random.default_rng(seed)
    made: list[Sample] = []
    for k in range(count):
        stamp = START_NS + k * PERIOD_NS
        x, y, z = rng.normal(0, 1, 3).tolist()
        speed = float(rng.uniform(0, 1.5))
        imu = Imu(stamp=stamp, seq=k, gyro=(x, y, z), orientation=from_yaw(0.01 * k), linear_accel=(x, y, z))
        ground = GroundSpeed(stamp=stamp, seq=k, speed=speed, quality=0.1, rays=16, valid=True, delay=0.32)
        made += [ground, imu] if k % 2 else [imu, ground]
    return made


class Firmware:
    """What mcu/link.c does: takes bytes, gives bytes."""

    def __init__(self) -> None:
        self.constants = observer_constants(LuenbergerSettings(), BORESIGHT)
        self.deframer = Deframer()
        self.handled: list[int] = []
        self.restart()

    def restart(self) -> None:
        self.session = self.expected = self.poses = 0
        self.answer: tuple[Kind, bytes] | None = None
        self.observer = FixedLuenbergerObserver(LuenbergerSettings(), boresight=BORESIGHT)

    def take(self, data: bytes) -> bytes:
        return b"".join(self.handle(frame) for frame in self.deframer.feed(data))

    def handle(self, frame: Frame) -> bytes:
        match frame.kind:
            case Kind.RESET:
                self.restart()
                self.session = int.from_bytes(frame.body, "big")
                return self.status()
            case Kind.ASK:
                return self.status()
            case Kind.IMU | Kind.GROUND_SPEED:
                return self.sample(frame)
        return b""

    def sample(self, frame: Frame) -> bytes:
        if not self.session or frame.number not in (self.expected, (self.expected - 1) % NUMBERS):
            return self.status()
        if frame.number == self.expected:
            self.expected = (self.expected + 1) % NUMBERS
            self.handled.append(frame.number)
            self.answer = None
            if frame.kind == Kind.IMU:
                self.answer = self.estimate(frame.body)
            else:
                self.speed(frame.body)
        return framed(self.answer[0], frame.number, self.answer[1]) if self.answer else b""

    def speed(self, body: bytes) -> None:
        ground = decode(body, GroundSpeed)
        self.observer.speed(ground.stamp, ground.speed, ground.quality, ground.valid, ground.delay)

    def estimate(self, body: bytes) -> tuple[Kind, bytes]:
        imu = decode(body, Imu)
        try:
            made = self.observer.imu(
                imu.stamp, ImuReading(imu.gyro, imu.accel, orientation=imu.orientation, linear_accel=imu.linear_accel)
            )
        except ValueError:
            return Kind.REFUSED, b"\x02"
        pose = Pose(
            stamp=imu.stamp,
            seq=self.poses,
            position=made.position,
            velocity=made.velocity,
            orientation=made.orientation,
            method=METHOD,
            status=" ".join(f"held:{what}" for what in self.observer.held) or None,
        )
        self.poses += 1
        return Kind.POSE, bytes(9) + encode(pose)

    def status(self) -> bytes:
        words = (self.session, self.constants.digest, 1_000_000, 0, 0, self.deframer.bad, 0)
        body = bytes([VERSION]) + b"".join(word.to_bytes(4, "big") for word in words)
        return framed(Kind.STATUS, self.expected, body)


def unharmed(data: bytes) -> bytes:
    return data


@dataclass
class BadLine:
    """A line to the firmware that damages what it carries; its clock goes on while nothing comes."""

    firmware: Firmware
    down: Damage = unharmed
    up: Damage = unharmed
    time: float = 0.0  # s
    coming: bytearray = field(default_factory=bytearray)

    def send(self, data: bytes) -> None:
        self.coming += self.up(self.firmware.take(self.down(data)))

    def receive(self) -> bytes:
        if not self.coming:
            self.time += READ_TIME
            return b""
        data = bytes(self.coming[:50])
        del self.coming[:50]
        return data

    def close(self) -> None:
        pass

    def now(self) -> float:
        self.time += 1e-5
        return self.time


def poses_through(line: BadLine, made: list[Sample]) -> list[bytes]:
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    poses = []
    for sample in made:
        if isinstance(sample, Imu):
            poses.append(microcontroller.estimate(encode(sample)).payload)
        else:
            microcontroller.tell(encode(sample))
    return poses


def context() -> Context:
    return Context(node="fusion", rig=Rig(), ports={}, random=np.random.default_rng(0))


def emitted(operator: Operator, made: list[Sample]) -> list[Pose]:
    ports = [("imu" if isinstance(sample, Imu) else "speed", sample) for sample in made]
    out = [pose for port, sample in ports for _, pose in operator.handle(port, sample)]
    return [pose for pose in out if isinstance(pose, Pose)]


def dropping(rng: np.random.Generator, part: float) -> Damage:
    return lambda data: b"" if rng.random() < part else data


def flipping(rng: np.random.Generator, part: float) -> Damage:
    def damage(data: bytes) -> bytes:
        if not data or rng.random() >= part:
            return data
        at = int(rng.integers(len(data)))
        return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]

    return damage


def cutting(rng: np.random.Generator, part: float) -> Damage:
    return lambda data: data[: int(rng.integers(len(data) + 1))] if rng.random() < part else data


def noise_before(rng: np.random.Generator, part: float) -> Damage:
    return lambda data: rng.bytes(int(rng.integers(1, 700))) + data if rng.random() < part else data


DAMAGES = [dropping, flipping, cutting, noise_before]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_bad_line_changes_nothing(damage: Callable[[np.random.Generator, float], Damage], seed: int) -> None:
    made = samples(60)
    expected = poses_through(BadLine(Firmware()), made)
    rng = np.random.default_rng(seed)
    line = BadLine(Firmware(), down=damage(rng, 0.2), up=damage(rng, 0.2))
    assert poses_through(line, made) == expected
    assert line.firmware.handled == list(range(len(line.firmware.handled))), "each sample once, in order"


def test_the_poses_are_those_of_the_fusion_in_this_process() -> None:
    made = samples(60)
    fusion = Fusion(FusionSettings(method=METHOD), context())
    expected = [encode(msgspec.structs.replace(pose, seq=k)) for k, pose in enumerate(emitted(fusion, made))]
    assert poses_through(BadLine(Firmware()), made) == expected


def test_numbers_begin_anew_after_the_last_one() -> None:
    line = BadLine(Firmware())
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    line.firmware.expected = microcontroller._number = NUMBERS - 3
    for sample in samples(10):
        if isinstance(sample, Imu):
            microcontroller.estimate(encode(sample))
        else:
            microcontroller.tell(encode(sample))
    assert len(line.firmware.handled) == 20
    assert line.firmware.handled[:5] == [NUMBERS - 3, NUMBERS - 2, NUMBERS - 1, 0, 1]
    assert microcontroller.repeated == 0


def test_speeds_without_imu_samples_do_not_pile_up() -> None:
    rng = np.random.default_rng(2)
    line = BadLine(Firmware(), down=dropping(rng, 0.3))
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    for sample in samples(100):
        if isinstance(sample, GroundSpeed):
            microcontroller.tell(encode(sample))
            assert len(microcontroller._unanswered) < 5
    microcontroller.ask()
    assert line.firmware.handled == list(range(100))


def test_a_sample_that_is_refused_is_named_and_the_next_one_taken() -> None:
    line = BadLine(Firmware())
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    with pytest.raises(Refused, match="refused by the microcontroller: it has no orientation"):
        microcontroller.estimate(encode(Imu(stamp=START_NS, seq=0, gyro=(0.0, 0.0, 0.0))))
    sample = samples(1)[0]
    assert decode(microcontroller.estimate(encode(sample)).payload, Pose).stamp == START_NS


def test_a_microcontroller_that_lost_its_state_ends_the_run() -> None:
    line = BadLine(Firmware())
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    made = [sample for sample in samples(2) if isinstance(sample, Imu)]
    microcontroller.estimate(encode(made[0]))
    line.firmware.restart()
    with pytest.raises(DataflowError, match="was restarted: its state is lost"):
        microcontroller.estimate(encode(made[1]))


def test_a_line_that_went_dead_is_given_up_in_time() -> None:
    line = BadLine(Firmware())
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)
    line.up = lambda data: b""
    began = line.time
    with pytest.raises(DataflowError, match="has not answered for 2 s"):
        microcontroller.estimate(encode(samples(1)[0]))
    assert line.time - began < 2.1
    line.down = lambda data: b""
    with pytest.raises(DataflowError, match="no microcontroller has answered for 10 s"):
        microcontroller.begin(6)


def test_random_bytes_alone_are_given_up_too() -> None:
    rng = np.random.default_rng(3)
    line = BadLine(Firmware())
    microcontroller = Microcontroller(line, SETTINGS, line.now)
    microcontroller.begin(5)

    def receive() -> bytes:
        line.time += READ_TIME
        return rng.bytes(900)

    line.receive = receive  # type: ignore[method-assign]
    with pytest.raises(DataflowError, match="has not answered"):
        microcontroller.estimate(encode(samples(1)[0]))
    assert microcontroller.bad_frames > 100


# --- the node, on a pseudo-terminal ---------------------------------------------------------------------------------


@contextmanager
def at_a_terminal(firmware: Firmware) -> Iterator[str]:
    """The path of a serial port at which the firmware is."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            if select.select([ours], [], [], 0.05)[0]:
                os.write(ours, firmware.take(os.read(ours, 4096)))

    server = threading.Thread(target=serve)
    server.start()
    try:
        yield os.ttyname(theirs)
    finally:
        ended.set()
        server.join()
        os.close(ours)
        os.close(theirs)


def test_the_node_gives_what_fusion_gives() -> None:
    pytest.importorskip("serial", reason="pyserial is not here; it comes with caneflow[devices]")
    made = samples(40)
    with at_a_terminal(Firmware()) as port:
        gateway = UartGateway(UartGatewaySettings(port=port), context())
        got = emitted(gateway, made)
        assert tuple(gateway.finish()) == ()
    expected = emitted(Fusion(FusionSettings(method=METHOD), context()), made)
    assert [msgspec.structs.replace(pose, seq=0) for pose in got] == [
        msgspec.structs.replace(pose, seq=0) for pose in expected
    ]


def test_firmware_with_other_settings_is_refused_at_the_start() -> None:
    pytest.importorskip("serial", reason="pyserial is not here; it comes with caneflow[devices]")
    with at_a_terminal(Firmware()) as port:
        settings = UartGatewaySettings(port=port, luenberger=LuenbergerSettings(pole_velocity=0.9))
        with pytest.raises(DataflowError, match=r"fusion: .*: the firmware was built with other settings .*mcu config"):
            UartGateway(settings, context())


def test_a_port_that_is_not_there_is_named() -> None:
    pytest.importorskip("serial", reason="pyserial is not here; it comes with caneflow[devices]")
    with pytest.raises(DataflowError, match="fusion: /nowhere/tty: No such file or directory"):
        UartGateway(UartGatewaySettings(port="/nowhere/tty"), context())


def test_settings_that_fixed_point_lacks_are_refused_when_the_graph_is_checked() -> None:
    with pytest.raises(ValueError, match="compensate_delay is motion"):
        UartGatewaySettings(luenberger=LuenbergerSettings(compensate_delay="motion"))


def test_a_status_of_another_version_is_said() -> None:
    line = BadLine(Firmware())
    line.coming += framed(Kind.STATUS, 0, b"\x09")
    with pytest.raises(ProtocolError, match="says version 9"):
        Microcontroller(line, SETTINGS, line.now).begin(5)
