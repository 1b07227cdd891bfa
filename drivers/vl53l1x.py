"""The ST VL53L1X on I2C: one zone of time of flight over 27 degrees, up to 20 times a second.

out  ranges : Ranges   one zone

The chip is set up with a table that is ST's and not shipped: `table` names ST's VL53L1X_api.c (docs/hardware.md). Not
tried with a chip.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Time
from caneflow.i2c_bus import opened_bus
from caneflow.messages import Ranges
from caneflow.protocols import vl53l1x
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink
from caneflow.protocols.vl53l1x import NAME, Chip, Reading
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

POLL = 0.004  # s between two looks for a reading
SILENCE = 0.5  # s without a reading, after which the chip is set up again
RETRY = 0.25  # s between two looks for a chip that is gone
SPARE = 5  # ms between two measurements


@dataclass(frozen=True, kw_only=True)
class Vl53l1xSettings:
    """Where the chip is and how it is to measure."""

    __pydantic_config__ = {"extra": "forbid"}

    table: str | None = None  # ST's VL53L1X_api.c
    bus: Annotated[int, Ge(0), Le(255)] | str = 1  # /dev/i2c-N; or the socket of an emulator
    address: Annotated[int, Ge(0x08), Le(0x77)] = vl53l1x.ADDRESS  # another: it is given to the chip found at 0x29
    budget: Literal[20, 33, 50, 100] = 50  # ms of one measurement: the longer, the farther and the less noise
    start_timeout_s: Time = 10.0  # s to the first reading; later the chip is waited for


class Vl53l1x(Source):
    """Reads as fast as the chip measures; outlives its bus and its power. A stamp is when a reading was found ready."""

    outputs = {"ranges": Ranges}
    Settings = Vl53l1xSettings

    def __init__(self, settings: Vl53l1xSettings, context: Context) -> None:
        self._settings, self._node = settings, context.node
        if settings.table is None:
            raise DataflowError(
                f"{self._node}: settings.table is missing; expected the path of ST's VL53L1X_api.c, "
                "which is not shipped (docs/hardware.md says where it is)"
            )
        self._table = read_table(Path(settings.table))
        ranger = context.rig.rangers.get(context.node)
        self._reach = vl53l1x.REACH if ranger is None else ranger.reach
        self._last_stamp = 0  # ns
        self._said = ""  # the last warning

    def samples(self) -> Brought:
        """Yield readings; raises DataflowError when there is none at the start."""
        give_up = time.monotonic() + self._settings.start_timeout_s
        while True:
            try:
                with opened(self._settings) as chip:
                    yield from self._stay(chip)
            except (OSError, ProtocolError) as error:
                self._set_back(error, give_up)
            yield Quiet(max(time.time_ns(), self._last_stamp))
            time.sleep(RETRY)

    def _stay(self, chip: Chip) -> Brought:
        chip.set_up(self._table, self._settings.budget, self._settings.budget + SPARE)
        heard = time.monotonic()
        while True:
            if chip.is_ready():
                stamp, heard = time.time_ns(), time.monotonic()
                yield from self._reading(stamp, chip.read())
            elif time.monotonic() - heard > SILENCE:
                raise ProtocolError(f"no reading for {time.monotonic() - heard:.1f} s")
            time.sleep(POLL)

    def _reading(self, stamp: int, reading: Reading) -> Brought:
        if stamp <= self._last_stamp:  # the clock was set back
            yield Quiet(self._last_stamp)
            return
        self._last_stamp = stamp
        if self._said:
            log.info("the chip is back")
            self._said = ""
        yield "ranges", ranges_of(stamp, reading, self._reach, 1e-3 * self._settings.budget)

    def _set_back(self, error: Exception, give_up: float) -> None:
        """Take note that there is no chip; raises DataflowError when there never was one."""
        where = f"{NAME} on bus {self._settings.bus}, address 0x{self._settings.address:02X}"
        reason = getattr(error, "strerror", None) or str(error)
        if not self._last_stamp and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: {where}: no reading within {self._settings.start_timeout_s:g} s: {reason}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        if (text := f"{where}: {reason}; tries again") != self._said:
            log.warning("%s", text)
            self._said = text


def ranges_of(stamp: int, reading: Reading, reach: tuple[float, float], exposure: float) -> Ranges:
    """A reading of one zone; `reach` in m, `exposure` in s."""
    status, distance = reading.status, reading.distance
    if status == vl53l1x.TARGET and not reach[0] < distance < reach[1]:
        status = vl53l1x.NO_TARGET if distance >= reach[1] else vl53l1x.TOO_NEAR
    return Ranges(
        stamp=stamp,
        ranges=np.array([distance if status in (vl53l1x.TARGET, vl53l1x.NOT_TRUSTED) else 0.0], np.float32),
        status=np.array([status], np.uint8),
        signal=np.array([reading.signal], np.float32),
        ambient=np.array([reading.ambient], np.float32),
        exposure=exposure,
        delay=exposure / 2,
    )


def read_table(path: Path) -> bytes:
    """ST's table out of its C source; raises DataflowError when it is not there or is something else."""
    try:
        return vl53l1x.table_of(byte_arrays(path.read_text(encoding="latin-1")))
    except OSError as error:
        raise DataflowError(f"table: {path}: {error.strerror}; docs/hardware.md says where to get it") from error
    except ProtocolError as error:
        raise DataflowError(f"table: {path}: {error}") from error


@contextmanager
def opened(settings: Vl53l1xSettings) -> Iterator[Chip]:
    """The chip, at its address; raises OSError or ProtocolError when it is not there."""
    with opened_bus(settings.bus) as transfer:

        def at(address: int) -> Chip:
            device = f"{NAME} at 0x{address:02X}"
            link = I2cLink(partial(transfer, address), time.sleep, time.time_ns, device=device, register_bytes=2)
            return Chip(link, time.sleep)

        chip = at(settings.address)
        try:
            chip.require()
        except ProtocolError:
            if settings.address == vl53l1x.ADDRESS:
                raise
            fresh = at(vl53l1x.ADDRESS)  # it has just been switched on
            fresh.require()
            fresh.move(settings.address)
            chip.require()
        yield chip


if __name__ == "__main__":
    run(Vl53l1x)
