"""The ST VL53L5CX on I2C: 8 x 8 zones of time of flight, 15 times a second.

out  ranges : Ranges   64 zones, along their rays

The chip gets its firmware at each start. It is ST's and not shipped: `firmware` names ST's vl53l5cx_buffers.h
(docs/hardware.md). Not tried with a chip.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Time
from caneflow.i2c_bus import opened_bus
from caneflow.messages import Ranges
from caneflow.protocols import vl53l5cx
from caneflow.protocols.c_arrays import byte_arrays
from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.register_link import I2cLink
from caneflow.protocols.vl53l5cx import NAME, Firmware, Reading
from caneflow.protocols.vl53l5cx_chip import Chip
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

POLL = 0.004  # s between two looks for a reading
SILENCE = 0.5  # s without a reading, after which the chip is set up again
RETRY = 0.25  # s between two looks for a chip that is gone


@dataclass(frozen=True, kw_only=True)
class Vl53l5cxSettings:
    """Where the chip is and how it is to measure."""

    __pydantic_config__ = {"extra": "forbid"}

    firmware: str | None = None  # ST's vl53l5cx_buffers.h
    bus: Annotated[int, Ge(0), Le(255)] | str = 1  # /dev/i2c-N; or the socket of an emulator
    address: Annotated[int, Ge(0x08), Le(0x77)] = vl53l5cx.ADDRESS  # another: it is given to the chip found at 0x29
    rate: Annotated[int, Ge(1), Le(vl53l5cx.FASTEST)] = vl53l5cx.FASTEST  # Hz
    start_timeout_s: Time = 20.0  # s to the first reading; later the chip is waited for


class Vl53l5cx(Source):
    """Reads as fast as the chip measures; outlives its bus and its power. A stamp is when a reading was found ready."""

    outputs = {"ranges": Ranges}
    Settings = Vl53l5cxSettings

    def __init__(self, settings: Vl53l5cxSettings, context: Context) -> None:
        self._settings, self._node = settings, context.node
        if settings.firmware is None:
            raise DataflowError(
                f"{self._node}: settings.firmware is missing; expected the path of ST's vl53l5cx_buffers.h, "
                "which is not shipped (docs/hardware.md says where it is)"
            )
        self._firmware = read_firmware(Path(settings.firmware))
        ranger = context.rig.rangers.get(context.node)
        self._reach = vl53l5cx.REACH if ranger is None else ranger.reach
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
        chip.boot(self._firmware)
        chip.set_up(self._firmware, self._settings.rate)
        chip.start()
        heard = time.monotonic()
        while True:
            if chip.is_ready():
                stamp, heard = time.time_ns(), time.monotonic()
                yield from self._reading(stamp, chip.read())
            elif time.monotonic() - heard > max(SILENCE, 3.0 / self._settings.rate):
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
        yield "ranges", ranges_of(stamp, reading, self._reach, 1.0 / self._settings.rate)

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
    """A reading along the zones' rays: the chip says how far perpendicular to itself. `exposure` in s."""
    along = (reading.distance * vl53l5cx.tilt_factors()).astype(np.float32)
    status = reading.status.copy()
    is_target = status == vl53l5cx.TARGET
    status[is_target & (along >= reach[1])] = vl53l5cx.NO_TARGET
    status[is_target & (along <= reach[0])] = vl53l5cx.TOO_NEAR
    along[(status != vl53l5cx.TARGET) & (status != vl53l5cx.NOT_TRUSTED)] = 0.0
    return Ranges(
        stamp=stamp,
        ranges=along,
        status=status,
        sigma=reading.sigma,
        signal=reading.signal,
        ambient=reading.ambient,
        exposure=exposure,
        delay=exposure / 2,
    )


def read_firmware(path: Path) -> Firmware:
    """ST's firmware out of its C source; raises DataflowError when it is not there or is something else."""
    try:
        return Firmware.of(byte_arrays(path.read_text(encoding="latin-1")))
    except OSError as error:
        raise DataflowError(f"firmware: {path}: {error.strerror}; docs/hardware.md says where to get it") from error
    except ProtocolError as error:
        raise DataflowError(f"firmware: {path}: {error}") from error


@contextmanager
def opened(settings: Vl53l5cxSettings) -> Iterator[Chip]:
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
            if settings.address == vl53l5cx.ADDRESS:
                raise
            fresh = at(vl53l5cx.ADDRESS)  # it has just been switched on
            fresh.require()
            fresh.move(settings.address)
            chip.require()
        yield chip


if __name__ == "__main__":
    run(Vl53l5cx)
