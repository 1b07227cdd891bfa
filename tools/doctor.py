"""`caneflow doctor`: what is wrong, and what to try next: with a running flow, or with the devices (`--devices`)."""

import errno
import getpass
import json
import logging
import math
import os
import socket
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import psutil
import typer

from caneflow.errors import CaneflowError
from caneflow.messages import DopplerBlock, Imu, RadarFrame, Sample
from caneflow.messages.rig import read_rig
from caneflow.protocols import bno055, mrm
from caneflow.protocols.bno055_chip import Chip as Bno055Chip
from caneflow.protocols.bno055_chip import Identity
from caneflow.protocols.bno055_link import UartLink
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mpu9250 import MAGNETOMETER_ADDRESS
from caneflow.protocols.mpu9250_chip import NAME as MPU9250
from caneflow.protocols.mpu9250_chip import Chip as Mpu9250Chip
from caneflow.protocols.mpu9250_chip import Setup
from caneflow.protocols.register_link import I2cLink, Link
from caneflow.recording.sound_file import SoundFile
from caneflow.runtime import Context, Quiet, Source
from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.hosts.attach import DEFAULT_KEYS
from caneflow.runtime.hosts.diagnosis import Finding, diagnosed

TROUBLE_STATUS = 1
PROBE_READS = 50
ENOUGH = 0.97  # part of the rate that is asked for
MOST_OVERRUNS = 0.1  # part of the readings
GRAVITY_TOLERANCE = 1.0  # m/s^2, between gravity by the orientation and by the accelerometer
ANSWER_TIME = 0.5  # s, of a radar
ASKED = 4  # times


def command(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="FLOW|FILE",
            help="The running flow; by default the only one here. With --devices the file; by default dataflow.yaml.",
        ),
    ] = None,
    devices: Annotated[
        bool, typer.Option("--devices", help="Look at the devices; the flow must not be running.")
    ] = False,
    at: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Where the flow runs, if not here: tcp/gateway.local:7447.")
    ] = None,
    keys: Annotated[
        Path, typer.Option(metavar="DIR", help="Of --at tls/...: the folder with a key and ca.crt.")
    ] = DEFAULT_KEYS,
    machine: Annotated[str | None, typer.Option(metavar="NAME", help="Only those at this machine.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="s of samples to judge a device by.")] = 3.0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NODE.KEY=VALUE", help="Override a setting (may be given again)."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON list.")] = False,
) -> None:
    """Say what is wrong with a running flow: links, nodes, wires, clocks (ms); or with the devices; and what to try.

    Of a flow: who listens, who dials, who is denied, versions and clocks of its machines, where samples are lost. Of
    each device (--devices): whether it is there, answers, how often it measures (Hz) and how it is calibrated.
    Exit status 0: nothing is bad. 1: something is.

    Example: caneflow doctor cane

    Example: caneflow doctor --devices dataflow.yaml --set imu.port=/dev/ttyUSB0
    """
    if not devices:
        if settings or machine:
            raise CaneflowError("--set and --machine are for devices; add --devices")
        _told(diagnosed(what, at, keys), as_json=as_json)
    file = Path(what or "dataflow.yaml")
    graph = load(file, settings or ())
    nodes = [node for node in graph.nodes.values() if _is_source(node) and machine in (None, node.machine)]
    if not nodes:
        raise CaneflowError(f"{file}: no node{f' at {machine}' if machine else ''} brings samples in")
    logging.disable()  # a driver says in its own words what is said here
    try:
        _told((finding for node in nodes for finding in examined(node, seconds, graph.rig)), as_json=as_json)
    finally:
        logging.disable(logging.NOTSET)


def _told(found: Iterable[Finding], *, as_json: bool) -> NoReturn:
    """Print the findings as they come, or all together as JSON."""
    findings = []
    for finding in found:
        findings.append(finding)
        if not as_json:
            print("\n".join(_lines(finding)), flush=True)
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
    for finding in _at_port(node, path, "serial" if settings.bus == "uart" else "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    try:
        with _link(settings) as link:
            yield from _chip(node, Bno055Chip(link, time.sleep))
    except OSError as error:
        yield _not_opened(node, path, error)


def _chip(node: Node, chip: Bno055Chip) -> Iterator[Finding]:
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


def _speed(node: Node, chip: Bno055Chip) -> Finding:
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
    """The way to a BNO055; raises OSError when it cannot be opened."""
    if settings.bus == "uart":
        import serial

        timeout = settings.answer_timeout_ms / 1e3
        with serial.Serial(settings.port, settings.baud, timeout=timeout, exclusive=True) as port:
            yield UartLink(port, time.sleep, time.time_ns)
    else:
        with opened_bus(settings.port) as transfer:
            yield I2cLink(partial(transfer, settings.address), time.sleep, time.time_ns)


# --- MPU-9250 ---------------------------------------------------------------------------------------------------


def _mpu9250(node: Node) -> Iterator[Finding]:
    """Whether both dies answer on the bus, and whether the chip can be set up."""
    settings = node.settings
    path = Path(f"/dev/i2c-{settings.bus}")
    for finding in _at_port(node, path, "smbus2"):
        yield finding
        if finding.state == "bad":
            return
    where = f"{path}, address 0x{settings.address:02X}"
    try:
        with opened_bus(str(path)) as transfer:
            inertial, magnetometer = partial(transfer, settings.address), partial(transfer, MAGNETOMETER_ADDRESS)
            chip = Mpu9250Chip(
                I2cLink(inertial, time.sleep, time.time_ns, device=MPU9250),
                I2cLink(magnetometer, time.sleep, time.time_ns, device=f"{MPU9250}, magnetometer"),
                time.sleep,
            )
            name = chip.require(magnetometer=settings.magnetometer)
            chip.set_up(Setup(magnetometer=settings.magnetometer))
    except OSError as error:
        yield _not_opened(node, path, error)
    except ProtocolError as error:
        other = 0x69 if settings.address == 0x68 else 0x68
        attempts = (
            f"see who is on the bus: i2cdetect -y {settings.bus}; it may be address 0x{other:02X} (AD0 high: 0x69), "
            f"then --set {node.name}.address=0x{other:02X}",
            "SDA to GPIO 2 (pin 3), SCL to GPIO 3 (pin 5), 3.3 V, ground; nCS high, or the chip speaks SPI",
            f"a board sold as an MPU-9250 may hold an MPU-6500: --set {node.name}.magnetometer=false",
        )
        yield Finding(node=node.name, state="bad", text=f"no MPU-9250 on {where}: {error}", attempts=attempts)
    else:
        yield Finding(node=node.name, state="ok", text=f"{name} on {where}, set up; {chip.link.faults}")


# --- ports and buses --------------------------------------------------------------------------------------------


def _at_port(node: Node, path: Path, package: str) -> Iterator[Finding]:
    """What keeps a port or a bus from being opened, or others from being heard there."""
    if find_spec(package) is None:
        attempts = ("pip install 'caneflow[devices]'",)
        yield Finding(node=node.name, state="bad", text=f"no Python package {package}", attempts=attempts)
    elif not path.exists():
        yield Finding(node=node.name, state="bad", text=f"{path} is not there", attempts=_to_make_appear(node, path))
    elif not os.access(path, os.R_OK | os.W_OK):
        text = f"{path} may not be opened by {getpass.getuser()}"
        yield Finding(node=node.name, state="bad", text=text, attempts=_to_be_permitted(path))
    elif _is_console(path):
        text = f"{path} is the system's console as well: it writes there, and what you write it takes for a login"
        yield Finding(node=node.name, state="look", text=text, attempts=_to_end_console(path))
    elif _garbles_stretched_clocks(path) and node.run == "drivers.bno055":
        text = f"{path} is a Raspberry Pi's own I2C, which garbles what a chip says that stretches the clock, as this"
        yield Finding(node=node.name, state="look", text=text, attempts=CLOCK_STRETCHING)


def _not_opened(node: Node, path: Path, error: OSError) -> Finding:
    attempts: tuple[str, ...] = (f"is {path} the right one?",)
    if error.errno in (errno.EAGAIN, errno.EBUSY):
        attempts = ("end the flow that uses it: it holds the port alone",)
        if holders := _holders(path):
            attempts = (f"{', '.join(holders)} holds it: end that, as a port is for one", *attempts)
    return Finding(node=node.name, state="bad", text=f"{path}: {error.strerror or error}", attempts=attempts)


def _to_make_appear(node: Node, path: Path) -> tuple[str, ...]:
    if path.name.startswith("i2c"):
        return (
            "switch I2C on: sudo raspi-config, Interface Options, I2C; then reboot",
            f"see which buses there are: ls /dev/i2c-*; now: {_there('/dev', 'i2c-*')}",
        )
    setting = "device" if node.run == "drivers.p440" else "port"
    return (
        "switch the serial port on: sudo raspi-config, Interface Options, Serial Port: no login shell, hardware yes; "
        "then reboot",
        f"with an adapter on USB see ls /dev/ttyUSB* /dev/ttyACM*, then --set {node.name}.{setting}=...; "
        f"now: {_there('/dev', 'ttyUSB*', 'ttyACM*')}",
    )


def _there(folder: str, *patterns: str) -> str:
    return " ".join(sorted(str(path) for pattern in patterns for path in Path(folder).glob(pattern))) or "none"


def _to_be_permitted(path: Path) -> tuple[str, ...]:
    group = path.group()
    attempts = [f"sudo usermod -aG {group} {getpass.getuser()}, then log in anew"]
    if group == "tty":  # a login shell has it
        attempts = [*_to_end_console(path), *attempts]
    return tuple(attempts)


def _to_end_console(path: Path) -> tuple[str, ...]:
    return (
        f"sudo systemctl disable --now serial-getty@{path.resolve().name}: a login shell has it",
        "sudo raspi-config, Interface Options, Serial Port: no login shell, hardware yes (it takes console=serial0 out "
        "of cmdline.txt); then reboot",
    )


def _is_console(path: Path) -> bool:
    """Whether the kernel writes its messages to a serial port."""
    words = _text(KERNEL_OPTIONS).split()
    consoles = [word.removeprefix("console=").partition(",")[0] for word in words if word.startswith("console=")]
    return path.resolve().name in {Path("/dev", name).resolve().name for name in consoles}


def _garbles_stretched_clocks(path: Path) -> bool:
    """Whether a bus is that of a Raspberry Pi's own controller, and not one of i2c-gpio."""
    return "bcm2835" in _text(I2C_NAMES / path.name / "name")


def _holders(path: Path) -> list[str]:
    """Programs that have a port open, as far as they may be seen."""
    wanted, found = str(path.resolve()), []
    for process in psutil.process_iter(["name"]):
        with suppress(OSError):
            if any(str(file.readlink()) == wanted for file in Path(f"/proc/{process.pid}/fd").iterdir()):
                found.append(f"{process.info['name']} (process {process.pid})")
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


KERNEL_OPTIONS = Path("/proc/cmdline")
I2C_NAMES = Path("/sys/class/i2c-dev")
CLOCK_STRETCHING = (
    "dtoverlay=i2c-gpio,bus=3 in config.txt (docs/hardware.md), reboot, then the bus that it makes: /dev/i2c-3",
    "or use the UART, which has no such trouble: PS1 high, PS0 low",
)


@contextmanager
def opened_bus(path: str) -> Iterator[Callable[[int, bytes, int], bytes]]:
    """Transfers on an I2C bus: address, what to write, bytes to read; raises OSError when it cannot be opened."""
    import smbus2

    with smbus2.SMBus(path) as bus:

        def transfer(address: int, data: bytes, length: int) -> bytes:
            messages = [smbus2.i2c_msg.write(address, data)]
            if length:
                messages.append(smbus2.i2c_msg.read(address, length))
            bus.i2c_rdwr(*messages)
            return bytes(messages[-1]) if length else b""

        yield transfer


# --- P440 -------------------------------------------------------------------------------------------------------


def _p440(node: Node) -> Iterator[Finding]:
    """Whether a radar answers on Ethernet, and how it is; on a serial link only the stream tells."""
    settings = node.settings
    if settings.link != "udp":
        yield from _at_port(node, Path(settings.device), "serial")
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
    attempts = [
        f"ping {host}: when that is silent too, see cable and power (5 to 48 V, 3 W)",
        "the radar sends to one host only: end the flow, or the vendor's program, that has it",
    ]
    firewall = f"let its answers through the firewall: sudo ufw allow proto udp from {host} port {port}"
    attempts.insert(0 if "ENABLED=yes" in _text(FIREWALL) else len(attempts), firewall)
    network, own = host.rpartition(".")[0], _own_address(host)
    if own is None or own.rpartition(".")[0] != network:
        via = "there is no way to it" if own is None else f"this host would ask from {own}"
        attempts.insert(0, f"{via}: give it an address beside it: sudo ip addr add {network}.10/24 dev eth0")
    return tuple(attempts)


def _own_address(host: str) -> str | None:
    """The address from which this host would ask another one; None: it has no way there."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        try:
            udp.connect((host, mrm.UDP_PORT))
        except OSError:
            return None
        address: str = udp.getsockname()[0]
        return address


FIREWALL = Path("/etc/ufw/ufw.conf")


# --- Doppler modules --------------------------------------------------------------------------------------------


def _doppler_adc(node: Node) -> Iterator[Finding]:
    """Whether there is a sound file or an input of a sound card that takes the settings."""
    settings = node.settings
    if settings.file is not None:
        yield from _sound_file(node)
        return
    try:
        import sounddevice  # type: ignore[import-untyped]  # it has no types
    except ImportError:
        attempts = ("pip install 'caneflow[audio]'",)
        yield Finding(node=node.name, state="bad", text="no Python package sounddevice", attempts=attempts)
        return
    except OSError:
        attempts = ("sudo apt install libportaudio2",)
        yield Finding(node=node.name, state="bad", text="PortAudio is not installed", attempts=attempts)
        return
    yield _sound_card(node, sounddevice)


def _sound_card(node: Node, sounddevice: Any) -> Finding:
    """Whether there is such an input, and it takes the settings."""
    settings = node.settings
    inputs = [found for found in sounddevice.query_devices() if found["max_input_channels"]]
    if not inputs:
        return Finding(node=node.name, state="bad", text="there is no sound card with an input", attempts=NO_CARD)
    device: str | int | None = None if settings.device == "default" else settings.device
    device = int(device) if isinstance(device, str) and device.isdigit() else device
    needed, rate = settings.channels.needed, settings.sample_rate
    try:
        name = sounddevice.query_devices(device, "input")["name"]
        sounddevice.check_input_settings(device, needed, settings.sample_format, samplerate=rate)
    except (sounddevice.PortAudioError, ValueError) as error:
        text = f"{settings.device}: {str(error).partition(' [PaErrorCode')[0]}"
        there = "; ".join(f"{found['index']}: {found['name']}" for found in inputs)
        attempts = (f"one of these inputs: {there}; then --set {node.name}.device=...", *_to_be_taken(node))
        return Finding(node=node.name, state="bad", text=text, attempts=attempts)
    channels = "1 channel" if needed == 1 else f"{needed} channels"
    return Finding(node=node.name, state="ok", text=f"{name}: takes {channels} at {rate:g} Hz")


def _to_be_taken(node: Node) -> tuple[str, ...]:
    return (
        f"a rate and channels that it has: --set {node.name}.sample_rate=48000, {node.name}.channel=0; "
        "ALSA's default and plughw convert, hw does not",
        "when it is in use: end the program that has it, or share it by ALSA's dsnoop (docs/hardware.md)",
    )


def _sound_file(node: Node) -> Iterator[Finding]:
    settings = node.settings
    try:
        sound = SoundFile(settings.file, settings.channels, block=settings.block)
    except CaneflowError as error:
        attempts = (f"a WAV or FLAC file that has the channels: --set {node.name}.file=... {node.name}.channel=0",)
        yield Finding(node=node.name, state="bad", text=str(error), attempts=attempts)
        return
    length = f"{sound.frames / sound.sample_rate:.1f} s at {sound.sample_rate:g} Hz, {sound.subtype}"
    yield Finding(node=node.name, state="ok", text=f"{settings.file}: {length}")


NO_CARD = (
    "see what ALSA has: arecord -l; a card on USB has to be plugged in",
    f"sudo usermod -aG audio {getpass.getuser()}, then log in anew: others may not use it",
)


def _sound(node: Node, blocks: list[DopplerBlock]) -> Iterator[Finding]:
    """How loud a module is: a dead wire and an overdriven input look alike to a spectrum."""
    samples = np.concatenate([block.samples for block in blocks])
    full = 2.0**15 if samples.dtype.kind == "i" else 1.0
    parts = np.concatenate([samples.real, samples.imag]) if samples.dtype.kind == "c" else samples
    peak = float(np.abs(parts.astype(np.float64)).max()) / full
    rms = float(np.std(parts.astype(np.float64))) / full
    clipped = float((np.abs(parts.astype(np.float64)) >= full * (1.0 - 2.0**-14)).mean())
    text = f"loudest {peak:.3f} of full scale, {20 * math.log10(max(rms, 1e-6)):.0f} dB in the mean"
    attempts: tuple[str, ...] = ()
    if rms < 2.0**-15:
        text = "silent: not a bit changes"
        attempts = (
            "is the module powered, and on this channel? its wire to the input, its ground to the input's",
            "the input may be muted or its gain 0: alsamixer, capture (F4)",
        )
    elif clipped > CLIPPED:
        text += f", {100 * clipped:.1f} % of the samples at its end"
        attempts = ("less gain: alsamixer, capture (F4); or a divider before the input",)
    yield Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=attempts)


CLIPPED = 0.001  # part of the samples


# --- any driver -------------------------------------------------------------------------------------------------


def _stream(node: Node, seconds: float, rig: dict[str, Any]) -> Iterator[Finding]:
    """What the driver itself brings."""
    try:
        samples = _brought(node, seconds, rig)
    except (CaneflowError, OSError) as error:
        attempts = ("its own words say more: caneflow run FILE", f"is {node.run} set as docs/hardware.md says?")
        yield Finding(node=node.name, state="bad", text=f"its driver fails: {error}", attempts=attempts)
        return
    if len(samples) < 2:
        attempts = ("more time: --seconds 10", "its own words say more: caneflow run FILE")
        text = f"{len(samples)} samples in {seconds:g} s"
        yield Finding(node=node.name, state="bad", text=text, attempts=attempts)
        return
    yield _rate(node, samples)
    last = samples[-1]
    if isinstance(last, Imu):
        imu = [sample for sample in samples if isinstance(sample, Imu)]
        yield from _imu(node, last, imu) if last.orientation is not None else _raw_imu(node, imu)
    elif isinstance(last, DopplerBlock):
        yield from _sound(node, [sample for sample in samples if isinstance(sample, DopplerBlock)])
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
    block = getattr(node.settings, "block", 0)
    rate: float | None = 1e6 / period if period else getattr(node.settings, "rate", 1.0 / block if block else None)
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


def _raw_imu(node: Node, samples: list[Imu]) -> Iterator[Finding]:
    """Whether a chip without fusion of its own measures what it must at rest."""
    gyro = np.array([sample.gyro for sample in samples])
    accel = np.array([sample.accel for sample in samples if sample.accel is not None])
    mag = np.array([sample.mag for sample in samples if sample.mag is not None])
    attempts = []
    rests = float(gyro.std(axis=0).max()) < AT_REST and len(accel) > 0
    turn = math.degrees(float(np.linalg.norm(gyro.mean(axis=0))))
    text = f"turns by {turn:.1f} deg/s"
    if len(accel):
        pull = float(np.linalg.norm(accel.mean(axis=0)))
        text += f", feels {pull:.2f} m/s^2"
        if rests and abs(pull - 9.81) > GRAVITY_TOLERANCE:
            attempts.append("at rest it must feel 9.81 m/s^2: is accel_range the chip's? a board may be broken")
    if rests and turn > MOST_BIAS:
        attempts.append("at rest it turns: let it warm up; operators.attitude takes off what stays the same")
    if len(mag):
        field = float(np.linalg.norm(mag.mean(axis=0)))
        text += f", a field of {field:.0f} uT"
        if not FIELD[0] < field < FIELD[1]:
            attempts.append(
                f"the earth's field has {FIELD[0]:g} to {FIELD[1]:g} uT: away from steel and magnets, or, for what is "
                f"worn with it, --set {node.name}.mag_offset=[x,y,z] (docs/hardware.md)"
            )
    elif getattr(node.settings, "magnetometer", False):
        text += ", no field"
        attempts.append("a magnet is too near: the magnetometer is at its end")
    if not rests:
        text += "; it moves"
        attempts.append("hold it still, and look again: then more can be said")
    yield Finding(node=node.name, state="look" if attempts else "ok", text=text, attempts=tuple(attempts))


AT_REST = 0.05  # rad/s, standard deviation of the gyro
MOST_BIAS = 5.0  # deg/s: the data sheet's zero-rate output
FIELD = (20.0, 70.0)  # uT, somewhere on earth (25 to 65)

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


CHECKS: dict[str, Callable[[Node], Iterator[Finding]]] = {
    "drivers.bno055": _bno055,
    "drivers.p440": _p440,
    "drivers.mpu9250": _mpu9250,
    "drivers.doppler_adc": _doppler_adc,
}
