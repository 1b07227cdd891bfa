"""`caneflow doctor`: what is wrong, and what to try next. So far of the devices: `--devices`."""

import errno
import getpass
import json
import logging
import math
import os
import socket
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import Imu, RadarFrame, Sample
from caneflow.messages.rig import read_rig
from caneflow.protocols import bno055, mrm
from caneflow.protocols.bno055_chip import Chip, Identity
from caneflow.protocols.bno055_link import I2cLink, Link, UartLink
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime import Context, Quiet, Source
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.dataflow.loading import load

TROUBLE_STATUS = 1
PROBE_READS = 50
ENOUGH = 0.97  # part of the rate that is asked for
MOST_OVERRUNS = 0.1  # part of the readings
GRAVITY_TOLERANCE = 1.0  # m/s^2, between gravity by the orientation and by the accelerometer
ANSWER_TIME = 0.5  # s, of a radar
ASKED = 4  # times


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was looked at."""

    node: str
    state: Literal["ok", "look", "bad"]
    text: str
    attempts: tuple[str, ...] = ()  # what to try next, the likeliest first


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The dataflow whose devices are meant.")] = Path(
        "dataflow.yaml"
    ),
    devices: Annotated[
        bool, typer.Option("--devices", help="Look at the devices; the flow must not be running.")
    ] = False,
    machine: Annotated[str | None, typer.Option(metavar="NAME", help="Only those at this machine.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="s of samples to judge a device by.")] = 3.0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list.")] = False,
) -> None:
    """Say whether each device is there, answers, how often it measures and how it is calibrated; else what to try.

    Exit status 0: nothing is bad. 1: something is.

    Example: caneflow doctor --devices dataflow.yaml --set imu.port=/dev/ttyUSB0
    """
    if not devices:
        raise CaneflowError("so far it looks at devices only; say --devices")
    graph = load(file, settings or ())
    nodes = [node for node in graph.nodes.values() if _is_source(node) and machine in (None, node.machine)]
    if not nodes:
        raise CaneflowError(f"{file}: no node{f' at {machine}' if machine else ''} brings samples in")
    findings = []
    logging.disable()  # a driver says in its own words what is said here
    try:
        for node in nodes:
            for finding in examined(node, seconds, graph.rig):
                findings.append(finding)
                if not as_json:
                    print("\n".join(_lines(finding)), flush=True)
    finally:
        logging.disable(logging.NOTSET)
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    raise typer.Exit(TROUBLE_STATUS if any(finding.state == "bad" for finding in findings) else 0)


def examined(node: Node, seconds: float, rig: dict[str, Any]) -> Iterator[Finding]:
    """What there is to say of one device; a finding that is bad is the last."""
    for check in (CHECKS.get(node.run, _nothing), lambda found: _stream(found, seconds, rig)):
        for finding in check(node):
            yield finding
            if finding.state == "bad":
                return


def _is_source(node: Node) -> bool:
    return node.program is not None and issubclass(node.program, Source)


def _nothing(node: Node) -> Iterator[Finding]:
    yield from ()


def _lines(finding: Finding) -> Iterator[str]:
    yield f"{finding.node}: {finding.state:4} {finding.text}"
    for attempt in finding.attempts:
        yield f"{'':{len(finding.node) + 2}}try  {attempt}"


# --- BNO055 -----------------------------------------------------------------------------------------------------


def _bno055(node: Node) -> Iterator[Finding]:
    """Whether the port can be opened and a chip answers, and how fast."""
    settings = node.settings
    path = Path(settings.port)
    if not path.exists():
        yield Finding(node=node.name, state="bad", text=f"{path} is not there", attempts=_to_make_appear(node, path))
        return
    if not os.access(path, os.R_OK | os.W_OK):
        text = f"{path} may not be opened by {getpass.getuser()}"
        yield Finding(node=node.name, state="bad", text=text, attempts=_to_be_permitted(path))
        return
    try:
        with _link(settings) as link:
            chip = Chip(link, time.sleep)
            yield from _chip(node, chip)
    except OSError as error:
        busy = error.errno in (errno.EAGAIN, errno.EBUSY)
        attempt = "end the flow that uses it: it holds the port alone" if busy else f"is {path} the right one?"
        text = f"{path}: {error.strerror or error}"
        yield Finding(node=node.name, state="bad", text=text, attempts=(attempt,))


def _chip(node: Node, chip: Chip) -> Iterator[Finding]:
    where, i2c = f"{node.settings.port}", node.settings.bus == "i2c"
    if i2c:
        where += f", address 0x{node.settings.address:02X}"
    try:
        chip.require()
        identity = chip.identity()
    except ProtocolError as error:
        attempts = _i2c_attempts(node.settings) if i2c else UART_ATTEMPTS
        yield Finding(node=node.name, state="bad", text=f"no BNO055 on {where}: {error}", attempts=attempts)
        return
    yield Finding(node=node.name, state="ok", text=f"BNO055 on {where}, software {identity.software}, {chip.state()}")
    if identity.self_test != bno055.SELF_TEST_PASSED:
        text = f"its self-test failed: {_failed_parts(identity)}"
        attempts = ("take its power off and on; the same again: the chip is broken",)
        yield Finding(node=node.name, state="look", text=text, attempts=attempts)
    yield _speed(node, chip)


def _failed_parts(identity: Identity) -> str:
    parts = ("accelerometer", "magnetometer", "gyro", "microcontroller")
    return ", ".join(part for bit, part in enumerate(parts) if not identity.self_test >> bit & 1)


def _speed(node: Node, chip: Chip) -> Finding:
    """How long one reading takes, against the rate that is asked for."""
    block = bno055.WHOLE if node.settings.accel_and_mag else bno055.WITHOUT_ACCEL_AND_MAG
    took = []
    for _ in range(PROBE_READS):
        began = time.monotonic()
        try:
            chip.read(block)
        except ProtocolError:
            continue
        took.append(time.monotonic() - began)
    if not took:
        text = f"answers, but gave none of {PROBE_READS} readings: {chip.link.faults}"
        return Finding(node=node.name, state="bad", text=text, attempts=("take the chip's power off and on",))
    median = statistics.median(took)
    text = f"{block.length} bytes take {1e3 * median:.1f} ms, up to {1e3 * max(took):.1f}; {chip.link.faults}"
    attempts: tuple[str, ...] = ()
    if median > 0.95 / node.settings.rate:
        attempts = _to_be_faster(node)
    elif sum(chip.link.faults) > MOST_OVERRUNS * PROBE_READS:
        attempts = ("shorter wires, one common ground, 3.3 V at the chip while it runs",)
    return Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)


def _to_make_appear(node: Node, path: Path) -> tuple[str, ...]:
    if path.name.startswith("i2c"):
        return (
            "switch I2C on: sudo raspi-config, Interface Options, I2C; then reboot",
            "see which buses there are: ls /dev/i2c-*",
        )
    return (
        "switch the serial port on: sudo raspi-config, Interface Options, Serial Port: no login shell, hardware yes; "
        "then reboot",
        f"with an adapter on USB see ls /dev/ttyUSB* /dev/ttyACM*, then --set {node.name}.port=...",
    )


def _to_be_permitted(path: Path) -> tuple[str, ...]:
    group = path.group()
    attempts = [f"sudo usermod -aG {group} {getpass.getuser()}, then log in anew"]
    if group == "tty":  # a login shell has it
        attempts.insert(0, f"sudo systemctl disable --now serial-getty@{path.resolve().name}: a login shell has it")
    return tuple(attempts)


UART_ATTEMPTS = (
    "cross the wires: the chip's TX (its SDA pin) to RX of the host, its RX (SCL) to TX, ground to ground",
    "select its UART: PS1 high, PS0 low, then power it anew",
    "no login shell on the port: sudo raspi-config, Interface Options, Serial Port",
    "on a Raspberry Pi 3 or later: dtoverlay=disable-bt in config.txt gives the pins the better UART",
)


def _i2c_attempts(settings: Any) -> tuple[str, ...]:
    other = 0x29 if settings.address == 0x28 else 0x28
    return (
        f"see who is on the bus: i2cdetect -y {settings.port.rpartition('-')[2]}; it may be address 0x{other:02X}",
        "a Raspberry Pi garbles what a chip says that stretches the clock, as this one does: "
        "dtoverlay=i2c-gpio in config.txt, then the bus that it makes; or use the UART",
        "PS1 and PS0 low, then power it anew",
    )


def _to_be_faster(node: Node) -> tuple[str, ...]:
    if node.settings.bus == "i2c":
        return (
            f"--set {node.name}.accel_and_mag=false reads 34 bytes in the place of 46",
            "400 kHz on the bus: i2c_gpio_delay_us=1 with dtoverlay=i2c-gpio",
            "use the UART: 46 bytes take 4.7 ms there",
        )
    return ("an adapter on USB: echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB*/latency_timer",)


@contextmanager
def _link(settings: Any) -> Iterator[Link]:
    """The way to a BNO055; raises CaneflowError when its package is not installed."""
    package = "serial" if settings.bus == "uart" else "smbus2"
    if find_spec(package) is None:
        raise CaneflowError(f"no Python package {package}; it comes with `pip install caneflow[devices]`")
    if settings.bus == "uart":
        import serial

        timeout = settings.answer_timeout_ms / 1e3
        with serial.Serial(settings.port, settings.baud, timeout=timeout, exclusive=True) as port:
            yield UartLink(port, time.sleep, time.time_ns)
    else:
        import smbus2

        with smbus2.SMBus(settings.port) as bus:

            def transfer(data: bytes, length: int) -> bytes:
                messages = [smbus2.i2c_msg.write(settings.address, data)]
                if length:
                    messages.append(smbus2.i2c_msg.read(settings.address, length))
                bus.i2c_rdwr(*messages)
                return bytes(messages[-1]) if length else b""

            yield I2cLink(transfer, time.sleep, time.time_ns)


# --- P440 -------------------------------------------------------------------------------------------------------


def _p440(node: Node) -> Iterator[Finding]:
    """Whether a radar answers on Ethernet, and how it is; on a serial link only the stream tells."""
    settings = node.settings
    if settings.link != "udp":
        yield from _serial_port(node, Path(settings.device))
        return
    where = f"{settings.host}, UDP port {settings.port}"
    try:
        said = _radar_status(settings.host, settings.port)
    except OSError as error:
        attempts = _network_attempts(node, error)
        text = f"no P440 at {where}: {error.strerror or error}"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    version = ".".join(map(str, said.application))
    text = f"P440 at {where}, number {said.serial_number}, software {version}, {said.temperature:g} degC"
    yield Finding(node=node.name, state="ok", text=text)
    if said.self_test:
        attempts = ("take its power off and on; the same again: the module is broken",)
        text = f"its self-test says 0x{said.self_test:02X}; good is 0"
        yield Finding(node=node.name, state="look", text=text, attempts=attempts)


def _serial_port(node: Node, path: Path) -> Iterator[Finding]:
    if not path.exists():
        attempts = ("see ls /dev/ttyACM* /dev/ttyUSB*, then --set " + f"{node.name}.device=...",)
        yield Finding(node=node.name, state="bad", text=f"{path} is not there", attempts=attempts)
    elif not os.access(path, os.R_OK | os.W_OK):
        text = f"{path} may not be opened by {getpass.getuser()}"
        yield Finding(node=node.name, state="bad", text=text, attempts=_to_be_permitted(path))


def _radar_status(host: str, port: int) -> mrm.GetStatusConfirm:
    """What a radar says of itself; raises OSError when it says nothing."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        udp.connect((host, port))
        udp.settimeout(ANSWER_TIME)
        for number in range(ASKED):
            udp.send(mrm.build(mrm.GetStatusRequest(message_id=number)))
            until = time.monotonic() + ANSWER_TIME
            while time.monotonic() < until:  # one that scans sends its scans in between
                try:
                    message = mrm.parse(udp.recv(65_535))
                except (TimeoutError, ProtocolError):
                    continue
                if isinstance(message, mrm.GetStatusConfirm):
                    return message
    raise TimeoutError(None, f"no answer, asked {ASKED} times")


def _network_attempts(node: Node, error: OSError) -> tuple[str, ...]:
    host, port = node.settings.host, node.settings.port
    if isinstance(error, ConnectionRefusedError):
        return (f"{host} is there, but no radar: find the radar's address, then --set {node.name}.host=...",)
    if isinstance(error, socket.gaierror):
        return (f"{host} is no address; the radar's own is 192.168.1.100 unless it was changed",)
    network = host.rpartition(".")[0]
    return (
        f"give the network interface an address beside it: sudo ip addr add {network}.10/24 dev eth0",
        f"ping {host}: when that is silent too, see cable and power (5 to 48 V, 3 W)",
        f"let its answers through the firewall: sudo ufw allow proto udp from {host} port {port}",
    )


# --- any driver -------------------------------------------------------------------------------------------------


def _stream(node: Node, seconds: float, rig: dict[str, Any]) -> Iterator[Finding]:
    """What the driver itself brings."""
    try:
        samples = _brought(node, seconds, rig)
    except (CaneflowError, OSError) as error:
        yield Finding(node=node.name, state="bad", text=f"its driver fails: {error}")
        return
    if len(samples) < 2:
        attempts = ("more time: --seconds 10",)
        text = f"{len(samples)} samples in {seconds:g} s"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    yield _rate(node, samples)
    last = samples[-1]
    if isinstance(last, Imu):
        yield from _imu(node, last, [sample for sample in samples if isinstance(sample, Imu)])
    elif isinstance(last, RadarFrame):
        length = last.range_start + last.range_step * last.scans.shape[1]
        text = f"{last.scans.shape[1]} range bins, {last.range_start:.2f} to {length:.2f} m"
        yield Finding(node=node.name, state="ok", text=text)


def _brought(node: Node, seconds: float, rig: dict[str, Any]) -> list[Sample]:
    """The samples of `seconds`, counted from the first, which may take as long as the driver allows."""
    assert node.program is not None
    context = Context(node=node.name, rig=read_rig(rig), ports=node.outputs, random=np.random.default_rng(0))
    source = node.program(node.settings, context)
    assert isinstance(source, Source)
    brought: list[Sample] = []
    patience = time.monotonic() + 5.0 + seconds
    with closing(source.samples()) as items:
        for item in items:
            if not isinstance(item, Quiet):
                assert isinstance(item[1], Sample)
                if not brought:
                    patience = time.monotonic() + seconds
                brought.append(item[1])
            if time.monotonic() > patience:
                break
    return brought


def _rate(node: Node, samples: list[Sample]) -> Finding:
    steps = [(b.stamp - a.stamp) / 1e6 for a, b in pairwise(samples)]
    rate = 1e3 / statistics.mean(steps)
    text = f"{rate:.1f} Hz, jitter {statistics.pstdev(steps):.2f} ms, longest step {max(steps):.1f} ms"
    asked = _asked_rate(node)
    attempts: tuple[str, ...] = ()
    if asked is not None and rate < ENOUGH * asked:
        text += f"; {asked:g} Hz are asked for"
        attempts = ("another program may take the processor: see top",)
        if isinstance(samples[-1], RadarFrame):
            attempts = ("a shorter scan or a lower integration index: docs/hardware.md", *attempts)
    return Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)


def _asked_rate(node: Node) -> float | None:
    period = getattr(node.settings, "scan_period_us", 0)
    rate: float | None = 1e6 / period if period else getattr(node.settings, "rate", None)
    return rate


def _imu(node: Node, last: Imu, samples: list[Imu]) -> Iterator[Finding]:
    if last.calibration is not None:
        levels = dict(zip(("system", "gyro", "accelerometer", "magnetometer"), last.calibration, strict=True))
        low = [name for name, level in levels.items() if name in TO_CALIBRATE and level < 3]
        if getattr(node.settings, "mode", "") == "imu" and "magnetometer" in low:
            low.remove("magnetometer")  # it sleeps
        text = "calibration " + ", ".join(f"{name} {level}" for name, level in levels.items()) + " of 3"
        attempts = tuple(TO_CALIBRATE[name] for name in low)
        yield Finding(node=node.name, state="look" if low else "ok", text=text, attempts=attempts)
    apart = [_gravity_apart(sample) for sample in samples]
    known = [value for value in apart if value is not None]
    if known:
        median = statistics.median(known)
        text = f"gravity by orientation and by accelerometer: {median:.2f} m/s^2 apart"
        bad = median > GRAVITY_TOLERANCE
        attempts = ("one of the two is turned: see `axes` in docs/hardware.md",) if bad else ()
        yield Finding(node=node.name, state="look" if bad else "ok", text=text, attempts=attempts)


TO_CALIBRATE = {
    "gyro": "gyro: lay the cane down for some seconds",
    "accelerometer": "accelerometer: hold the cane still in six positions, some seconds each",
    "magnetometer": "magnetometer: swing the cane in a figure of eight, away from steel",
}


def _gravity_apart(sample: Imu) -> float | None:
    """How far gravity by the orientation is from gravity by the accelerometer, m/s^2."""
    if sample.orientation is None or sample.accel is None or sample.linear_accel is None:
        return None
    w, x, y, z = sample.orientation
    by_orientation = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    by_accel = (a - b for a, b in zip(sample.accel, sample.linear_accel, strict=True))
    return math.dist([9.81 * along for along in by_orientation], list(by_accel))


CHECKS: dict[str, Callable[[Node], Iterator[Finding]]] = {"drivers.bno055": _bno055, "drivers.p440": _p440}
