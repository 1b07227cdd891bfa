"""A phone's motion as an IMU, through a page in its browser; its clock is compared with ours over the page's socket.

out  imu : Imu   one per DeviceMotion event (60 Hz as a rule), stamped on this machine's clock

The page's address is in the log, as a QR code where the extra `phone` is installed. Motion comes once the person has
tapped for it; gaps are said.
"""

import logging
import queue
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import msgspec
from annotated_types import Ge, Le

from caneflow.algorithms.quantities import Milliseconds
from caneflow.errors import CaneflowError, not_installed
from caneflow.messages import Imu, MessageError
from caneflow.messages.rig import Guidance
from caneflow.protocols.device_motion import Batch, motion_of
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

SILENCE: Final = 0.3  # s without a reading, after which is said that nothing comes
MARGIN_NS: Final = 1_000_000_000  # ns that readings may be older than now when they come
AHEAD_NS: Final = 20_000_000  # ns that a stamp may lie after its arrival: twice the error of the clock comparison
GAP_NS: Final = 200_000_000  # ns between two readings, which is told


@dataclass(frozen=True, kw_only=True)
class PhoneSettings:
    """Where the page is."""

    __pydantic_config__ = {"extra": "forbid"}

    listen: str = "127.0.0.1"  # an address of this machine; any other than loopback needs keys/page.crt
    port: Annotated[int, Ge(0), Le(65535)] = 0  # 0: any that is free
    keys: str = "keys"  # the folder with page.crt and page.key
    worst_clock_ms: Milliseconds = 20.0  # ms of round trip up to which the clocks count as compared


class Phone(Source):
    """Serves the page, and takes what it sends."""

    outputs = {"imu": Imu}
    Settings = PhoneSettings

    def __init__(self, settings: PhoneSettings, context: Context) -> None:
        self._settings = settings
        self._last = 0  # ns: stamp of the last sample, or until when nothing was promised
        self._sample = 0  # ns: stamp of the last sample
        self._lost = 0  # readings that the page has lost, as it says
        self.refused: dict[str, int] = {}  # readings left out, by cause

    def samples(self) -> Brought:
        """Yield readings as they come; raises DataflowError where the page cannot be served."""
        try:
            from caneflow.viewing.phone_server import PhoneServer, certificate_in, in_squares
        except ModuleNotFoundError as error:
            raise DataflowError(not_installed(str(error.name), "phone")) from error
        settings = self._settings
        tls = certificate_in(Path(settings.keys))
        try:
            server = PhoneServer(
                Guidance(), hears=False, senses=True, listen=settings.listen, port=settings.port, tls=tls
            )
        except CaneflowError as error:
            raise DataflowError(str(error)) from error
        with server:
            log.info("the phone's page is at %s", server.address)
            for line in in_squares(server.address).splitlines():
                log.info("%s", line)
            try:
                while True:
                    try:
                        came = server.readings.get(timeout=SILENCE)
                    except queue.Empty:
                        self._last = max(self._last, time.time_ns() - MARGIN_NS)
                        yield Quiet(self._last)
                    else:
                        for sample in self.taken(came.said, came.arrival):
                            yield "imu", sample
            finally:
                for cause, count in self.refused.items():
                    log.info("%d readings left out: %s", count, cause)

    def taken(self, said: dict[str, object], arrival: int) -> list[Imu]:
        """The samples of what a page sent, which came at `arrival` (ns)."""
        try:
            batch = msgspec.convert(said, Batch)
        except msgspec.ValidationError as error:
            self._refuse(f"not readings: {error}", 1)
            return []
        if batch.lost > self._lost:
            log.warning("%d readings were lost on the phone while there was no link", batch.lost - self._lost)
        self._lost = batch.lost
        if batch.delay > self._settings.worst_clock_ms:
            self._refuse("the clocks could not be compared well enough", len(batch.readings))
            return []
        samples = []
        for reading in batch.readings:
            motion = motion_of(reading, batch.offset)
            if motion.stamp > arrival + AHEAD_NS:
                self._refuse("stamped after it came", 1)
            elif motion.stamp <= self._last:
                self._refuse("not after the one before", 1)
            else:
                try:
                    sample = Imu(
                        stamp=motion.stamp,
                        gyro=motion.gyro,
                        accel=motion.accel,
                        linear_accel=motion.linear_accel,
                        orientation=motion.orientation,
                    )
                except (MessageError, ValueError) as error:
                    self._refuse(str(error), 1)
                    continue
                if self._sample and motion.stamp - self._sample > GAP_NS:
                    log.warning("no reading for %.1f s", (motion.stamp - self._sample) * 1e-9)
                self._last = self._sample = motion.stamp
                samples.append(sample)
        return samples

    def _refuse(self, cause: str, count: int) -> None:
        self.refused[cause] = self.refused.get(cause, 0) + count


if __name__ == "__main__":
    run(Phone)
