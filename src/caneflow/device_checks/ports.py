"""Serial ports and I2C buses: what keeps one from being opened, or others from being heard there."""

import errno
import getpass
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import psutil

from caneflow.runtime.dataflow.graph import Node
from caneflow.runtime.hosts.attached.way_to import Finding

KERNEL_OPTIONS = Path("/proc/cmdline")
I2C_NAMES = Path("/sys/class/i2c-dev")
CLOCK_STRETCHING = (
    "dtoverlay=i2c-gpio,bus=3 in config.txt (docs/hardware.md), reboot, then the bus that it makes: /dev/i2c-3",
    "or use the UART, which has no such trouble: PS1 high, PS0 low",
)


def at_port(node: Node, path: Path, package: str) -> Iterator[Finding]:
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


def not_opened(node: Node, path: Path, error: OSError) -> Finding:
    """Why a port that is there could not be opened."""
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
    attempts = [f"sudo usermod -aG {group} {getpass.getuser()}, then log in again"]
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
    words = text_of(KERNEL_OPTIONS).split()
    consoles = [word.removeprefix("console=").partition(",")[0] for word in words if word.startswith("console=")]
    return path.resolve().name in {Path("/dev", name).resolve().name for name in consoles}


def _garbles_stretched_clocks(path: Path) -> bool:
    """Whether a bus is that of a Raspberry Pi's own controller, and not one of i2c-gpio."""
    return "bcm2835" in text_of(I2C_NAMES / path.name / "name")


def _holders(path: Path) -> list[str]:
    """Programs that have a port open, as far as they may be seen."""
    wanted, found = str(path.resolve()), []
    for process in psutil.process_iter(["name"]):
        with suppress(OSError):
            if any(str(file.readlink()) == wanted for file in Path(f"/proc/{process.pid}/fd").iterdir()):
                found.append(f"{process.info['name']} (process {process.pid})")
    return found


def text_of(path: Path) -> str:
    """What a file of the system says; "" when it cannot be read."""
    try:
        return path.read_text()
    except OSError:
        return ""


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
