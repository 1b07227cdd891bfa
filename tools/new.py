"""`caneflow new`: a program or a message of your own that works, with its test and the line that uses it."""

import sys
from importlib.util import find_spec
from keyword import iskeyword
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import CaneflowError
from caneflow.messages import NAME, NAME_RULE
from caneflow.options import Overwrite
from caneflow.outputs import require_free, whole
from caneflow.runtime.dataflow.shipped import shipped_text

OPERATOR = '''"""Smoothed rotation: an IMU's samples with a low-pass filter over the gyro.

in   imu : Imu
out  imu : Imu   one per sample, gyro smoothed
"""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
from annotated_types import Gt

from caneflow.messages import Imu, Sample
from caneflow.runtime import Context, Emitted, Operator
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class CLASSSettings:
    """What dataflow.yaml may set."""

    time_constant: Annotated[float, Gt(0)] = 0.1  # s


class CLASS(Operator):
    """Owns no socket, thread or clock: time is the message's stamp."""

    inputs = {"imu": Imu}
    outputs = {"imu": Imu}
    Settings = CLASSSettings

    def __init__(self, settings: CLASSSettings, context: Context) -> None:
        self._settings = settings
        self._last: Imu | None = None  # as it was sent

    def handle(self, port: str, message: Sample) -> Emitted:
        """Yield the sample with its gyro smoothed; the first one is as it came."""
        assert isinstance(message, Imu)
        if self._last is not None:
            elapsed = (message.stamp - self._last.stamp) / 1e9  # s
            share = 1 - math.exp(-elapsed / self._settings.time_constant)
            x, y, z = (old + share * (new - old) for old, new in zip(self._last.gyro, message.gyro, strict=True))
            message = msgspec.structs.replace(message, gyro=(x, y, z))
        self._last = message
        yield "imu", message


if __name__ == "__main__":
    run(CLASS)
'''

OPERATOR_TEST = '''"""A list of messages in, a list out: no process, no clock."""

import numpy as np
import pytest

from caneflow.messages import Imu
from caneflow.testing import run_operator

from NAME import CLASS, CLASSSettings

STEP = 10_000_000  # ns: 100 Hz


def test_a_step_is_reached_to_63_percent_after_the_time_constant() -> None:
    turning = [Imu(stamp=seq * STEP, gyro=(0.0, 0.0, float(seq > 0))) for seq in range(11)]

    out = run_operator(CLASS, {"imu": turning}, settings=CLASSSettings(time_constant=0.1))["imu"]

    assert [message.stamp for message in out] == [sample.stamp for sample in turning]
    assert isinstance(out[-1], Imu)
    assert out[-1].gyro[2] == pytest.approx(1 - np.exp(-1))  # 0.1 s after the step
'''

DRIVER = '''"""A gyro that turns to and fro: the place to read your own device.

out  imu : Imu   `rate` per second
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt

from caneflow.messages import Imu
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.node import run


@dataclass(frozen=True, kw_only=True)
class CLASSSettings:
    """What dataflow.yaml may set."""

    rate: Annotated[float, Gt(0)] = 100.0  # Hz
    amplitude: float = 1.0  # rad/s
    period: Annotated[float, Gt(0)] = 1.0  # s


def reading(stamp: int, settings: CLASSSettings) -> Imu:
    """What the device measured at `stamp` (ns); pure, so that it is tested without the device."""
    turn = settings.amplitude * math.sin(2 * math.pi * stamp / 1e9 / settings.period)
    return Imu(stamp=stamp, gyro=(0.0, 0.0, turn))


def ticks(rate: float, now: Callable[[], float], sleep: Callable[[float], None]) -> Iterator[None]:
    """One tick per 1/`rate` s, counted from one start so that errors do not add up."""
    start, number = now(), 0
    while True:
        number += 1
        sleep(max(0.0, start + number / rate - now()))
        yield


class CLASS(Source):
    """The one kind of program that may read the clock: here a stamp is born."""

    outputs = {"imu": Imu}
    Settings = CLASSSettings

    def __init__(self, settings: CLASSSettings, context: Context) -> None:
        self._settings = settings

    def samples(self) -> Brought:
        """Yield samples as they are measured. Close the device in a `finally`: the flow may end at any yield."""
        for _ in ticks(self._settings.rate, time.monotonic, time.sleep):
            yield "imu", reading(time.time_ns(), self._settings)


if __name__ == "__main__":
    run(CLASS)
'''

DRIVER_TEST = '''"""The device's readings and the driver's pace, without a device and without waiting."""

import itertools

import pytest

from NAME import CLASSSettings, reading, ticks


def test_a_quarter_of_a_period_is_the_greatest_turn() -> None:
    settings = CLASSSettings(amplitude=2.0, period=4.0)
    assert reading(1_000_000_000, settings).gyro == pytest.approx((0.0, 0.0, 2.0))


def test_ticks_keep_their_rate_whatever_a_reading_takes() -> None:
    clock = [0.0]

    def sleep(seconds: float) -> None:
        clock[0] += seconds

    at = []
    for _ in itertools.islice(ticks(100.0, lambda: clock[0], sleep), 50):
        at.append(clock[0])
        clock[0] += 0.004  # s that a reading takes
    assert at == pytest.approx([(number + 1) / 100 for number in range(50)])
'''


MESSAGE = '''"""The message CLASS, which travels between nodes. Import it from here: one file defines a schema."""

from typing import Annotated

from msgspec import Meta

from caneflow.messages import Sample
from caneflow.messages.bounds import require_within

FARTHEST = 100.0  # m


class CLASS(Sample, frozen=True, kw_only=True):
    """How far something is away. On the wire: one msgpack map; a new optional field keeps the version."""

    schema = "mine.CLASS/1"

    distance: Annotated[float, Meta(ge=0, le=FARTHEST, description="m, from the sensor")]
    sensor: Annotated[str, Meta(max_length=32, description="which one")] = "front"

    def __post_init__(self) -> None:
        require_within("distance", self.distance, 0.0, FARTHEST, "m")  # here as well: also refuses NaN
'''

MESSAGE_TEST = '''"""What is sent is what is read, and what breaks the contract is refused on both sides."""

import math

import pytest

from caneflow.messages import MessageError, decode, encode, with_number

from NAME import FARTHEST, CLASS


def test_what_is_sent_is_what_is_read() -> None:
    sent = with_number(CLASS(stamp=1, distance=2.5, sensor="left"), 0)
    assert decode(encode(sent), CLASS) == sent


@pytest.mark.parametrize("distance", [-0.1, FARTHEST + 0.1, math.nan])
def test_a_distance_out_of_bounds_is_refused(distance: float) -> None:
    with pytest.raises(ValueError, match="distance is"):
        CLASS(stamp=1, distance=distance)
    with pytest.raises(MessageError, match="distance"):
        decode(encode({"stamp": 1, "seq": 0, "distance": distance}), CLASS)  # type: ignore[arg-type]
'''


def operator(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the file and of the node, e.g. smooth.")],
    folder: Annotated[Path, typer.Option("--folder", metavar="DIR", help="Where to put the files.")] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Write NAME.py, an operator that works, and test_NAME.py; print its line for dataflow.yaml.

    An operator turns messages into messages. This one smooths an IMU's gyro, time constant in s; put your own in.

    Example: caneflow new operator smooth
    """
    line = f"  {name}: {{run: ./{name}.py, inputs: {{imu: imu/imu}}, settings: {{time_constant: 0.1}}}}"
    _write(name, folder, OPERATOR, OPERATOR_TEST, line, overwrite=overwrite)


def driver(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the file and of the node, e.g. my_gyro.")],
    folder: Annotated[Path, typer.Option("--folder", metavar="DIR", help="Where to put the files.")] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Write NAME.py, a driver that works, and test_NAME.py; print its line for dataflow.yaml.

    A driver brings samples in. This one makes up a gyro that turns to and fro (rate in Hz, amplitude in rad/s, period
    in s); put your device there.

    Example: caneflow new driver my_gyro
    """
    line = f"  {name}: {{run: ./{name}.py, settings: {{rate: 100}}}}"
    _write(name, folder, DRIVER, DRIVER_TEST, line, overwrite=overwrite)


def message(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the file and of the message, e.g. range.")],
    folder: Annotated[Path, typer.Option("--folder", metavar="DIR", help="Where to put the files.")] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Write NAME.py, a message of your own, and test_NAME.py; print how programs take it.

    A message is a class of fields with a schema of its own name. This one has a distance in m; put your fields in.

    Example: caneflow new message range
    """
    if name in sys.stdlib_module_names:
        raise CaneflowError(
            f"{name!r} is a module of Python itself, which programs would import instead; use another name"
        )
    class_name = _write_files(name, folder, MESSAGE, MESSAGE_TEST, overwrite=overwrite)
    print("into a program that sends or reads it:")
    print(f"  from {name} import {class_name}")


def flow(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Which: cane, room ...; a wrong name lists them.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="By default NAME.yaml.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a dataflow that comes with caneflow, to be run as it is or changed.

    Example: caneflow new flow cane
    """
    text = shipped_text(name)
    file = output or Path(f"{name}.yaml")
    with whole(file, overwrite=overwrite) as fresh:
        assert fresh is not None, "an output is named"
        fresh.write_text(text.replace("caneflow check dataflow.yaml", f"caneflow check {file.name}"), encoding="utf-8")
    print(f"{file}: written")
    if name == "cane":
        print("caneflow simulate walk -o walk.mcap")  # 54 s of a walk, made in about 20
        print(f"caneflow run {file} --replay walk.mcap --speed max --record track.mcap")


commands = {"operator": operator, "driver": driver, "message": message, "flow": flow}


def _is_installed(name: str) -> bool:
    """Whether a package, of pip or of Debian, has this name."""
    spec = find_spec(name)
    return spec is not None and spec.origin is not None and "-packages" in spec.origin


def _write(name: str, folder: Path, program: str, test: str, line: str, *, overwrite: bool) -> None:
    _write_files(name, folder, program, test, overwrite=overwrite)
    print("into dataflow.yaml, under nodes:")
    print(line)


def _write_files(name: str, folder: Path, program: str, test: str, *, overwrite: bool) -> str:
    """Write both files; gives the name of the class in them."""
    if not NAME.fullmatch(name):
        raise CaneflowError(f"{name!r} is not a valid name: expected {NAME_RULE}")
    if iskeyword(name):
        raise CaneflowError(f"{name!r} is a word of Python's own; a file of this name cannot be imported")
    if name in sys.stdlib_module_names or _is_installed(name):
        raise CaneflowError(f"{name!r} is the name of an installed module, which a file of this name would hide")
    files = {folder / f"{name}.py": program, folder / f"test_{name}.py": test}
    for path in files:
        require_free(path, overwrite=overwrite)
    class_name = "".join(part.capitalize() for part in name.split("_"))
    for path, text in files.items():
        with whole(path, overwrite=overwrite) as fresh:
            fresh.write_text(text.replace("CLASS", class_name).replace("NAME", name), encoding="utf-8")
    program_path, test_path = files
    print(f"{program_path}: edit it; `pytest {test_path}` tests it without any process")
    return class_name
