"""A MaxBotix range finder by sound: MB12xx on I2C, or MB10xx on a serial line.

out  ranges : Ranges   one zone, as often as the sensor measures (10 Hz on I2C, 20 Hz on a serial line)

Nothing nearer than 0.2 m is told apart. Two that hear each other must never measure at once (docs/hardware.md).
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Time
from caneflow.i2c_bus import opened_bus
from caneflow.messages import Ranges
from caneflow.protocols import maxbotix
from caneflow.protocols.errors import ProtocolError
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

RETRY = 0.25  # s between two looks for a sensor that is gone
SILENCE = 0.5  # s without a word on a serial line, after which it is opened again
SERIAL_READING = 0.05  # s of one measurement of an MB10xx
SERIAL_DELAY = 0.04  # s from the ping to the end of the word: 37.5 ms of listening and 4 ms of sending (PD11832)
MB1010_FARTHEST = 6.45  # m, 254 inches: what it says when nothing answers


@dataclass(frozen=True, kw_only=True)
class SonarSettings:
    """Where the sensor is."""

    __pydantic_config__ = {"extra": "forbid"}

    link: Literal["i2c", "serial"] = "i2c"
    bus: Annotated[int, Ge(0), Le(255)] | str = 1  # /dev/i2c-N; or the socket of an emulator
    address: Annotated[int, Ge(0x03), Le(0x77)] = maxbotix.ADDRESS
    port: str = "/dev/serial0"  # of link: serial
    unit: maxbotix.Unit = "inch"  # of its words: inch (LV), cm (XL), mm (HRLV)
    start_timeout_s: Time = 10.0  # s to the first reading; later the sensor is waited for


class Sonar(Source):
    """Measures again and again; outlives its bus and its power. A stamp is when the reading had come."""

    outputs = {"ranges": Ranges}
    Settings = SonarSettings

    def __init__(self, settings: SonarSettings, context: Context) -> None:
        self._settings, self._node = settings, context.node
        ranger = context.rig.rangers.get(context.node)
        self._reach = (maxbotix.NEAREST, 6.0) if ranger is None else ranger.reach
        self._last_stamp = 0  # ns
        self._said = ""  # the last warning

    def samples(self) -> Brought:
        """Yield readings; raises DataflowError when there is none at the start."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        while True:
            try:
                yield from self._on_i2c() if self._settings.link == "i2c" else self._on_serial_line()
            except (OSError, ProtocolError) as error:
                self._set_back(error, give_up)
            yield Quiet(max(time.time_ns(), self._last_stamp))
            time.sleep(RETRY)

    def _on_i2c(self) -> Brought:
        with opened_bus(self._settings.bus) as transfer:
            chip = partial(transfer, self._settings.address)
            while True:
                began = time.monotonic()
                distance = maxbotix.taken(chip, time.sleep)
                elapsed = time.monotonic() - began
                yield from self._reading(distance, delay=elapsed)

    def _on_serial_line(self) -> Brought:
        words = maxbotix.SerialWords(self._settings.unit)
        heard = time.monotonic()
        with opened_line(self._settings.port) as line:
            while True:
                for distance in words.feed(line.read(64)):
                    heard = time.monotonic()
                    yield from self._reading(distance, delay=SERIAL_DELAY)
                if time.monotonic() - heard > SILENCE:
                    raise ProtocolError(f"no word for {SILENCE} s; {words.garbled} bytes were not words")

    def _reading(self, distance: float, *, delay: float) -> Brought:
        stamp = time.time_ns()
        if stamp <= self._last_stamp:  # the clock was set back
            yield Quiet(self._last_stamp)
            return
        self._last_stamp = stamp
        if self._said:
            log.info("the sensor is back")
            self._said = ""
        yield "ranges", ranges_of(stamp, distance, self._reach, delay)

    def _set_back(self, error: Exception, give_up: float) -> None:
        """Take note that there is no sensor; raises DataflowError when there never was one."""
        settings = self._settings
        where = settings.port if settings.link == "serial" else f"bus {settings.bus}, address 0x{settings.address:02X}"
        reason = getattr(error, "strerror", None) or str(error)
        if not self._last_stamp and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: sonar on {where}: no reading within {settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        text = f"sonar on {where}: {reason}; tries again"
        if text != self._said:
            log.warning("%s", text)
            self._said = text


def ranges_of(stamp: int, distance: float, reach: tuple[float, float], delay: float) -> Ranges:
    """A reading of one zone: a distance (m), or what it means at the ends of the reach."""
    status = 2 if distance <= reach[0] else 1 if distance >= reach[1] else 0
    return Ranges(
        stamp=stamp,
        ranges=np.array([distance if status == 0 else 0.0], np.float32),
        status=np.array([status], np.uint8),
        exposure=delay,
        delay=delay,
    )


@contextmanager
def opened_line(port: str) -> Iterator[Any]:
    """A serial line; raises OSError when it cannot be opened."""
    try:
        import serial
    except ImportError as error:
        raise DataflowError("pyserial is not installed; it comes with `pip install caneflow[devices]`") from error
    if not Path(port).exists():
        raise OSError(f"there is no {port}")
    with serial.Serial(port, maxbotix.BAUD, timeout=0.1) as line:
        yield line


if __name__ == "__main__":
    run(Sonar)
