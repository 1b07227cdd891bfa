"""A phone's motion as an IMU, through a page in its browser; its clock is compared with ours over the page's socket.

out  imu : Imu   one per DeviceMotion event (60 Hz as a rule), stamped on this machine's clock

The page's address is in the log, as a QR code where the extra `phone` is installed. Motion comes once the person has
tapped for it; gaps are said.
"""

import logging
import queue
import time
from dataclasses import dataclass
from typing import Final

import msgspec

from caneflow.algorithms.quantities import Milliseconds
from caneflow.messages import Imu, MessageError
from caneflow.messages.rig import Guidance
from caneflow.protocols.device_motion import Batch, motion_of
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.node import run
from caneflow.viewing.phone_page import PhonePageSettings, page_server, squares_of

log = logging.getLogger(__name__)

SILENCE: Final = 0.3  # s without a reading, after which is said that nothing comes
MARGIN_NS: Final = 1_000_000_000  # ns that readings may be older than now when they come
AHEAD_NS: Final = 20_000_000  # ns that a stamp may lie after its arrival: twice the error of the clock comparison
GAP_NS: Final = 200_000_000  # ns between two readings, which is told


@dataclass(frozen=True, kw_only=True)
class PhoneSettings(PhonePageSettings):
    """Where the page is, and how well the clocks have to be compared."""

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
        self._unheard = 0  # messages that came faster than they could be taken
        self.refused: dict[str, int] = {}  # readings left out, by cause

    def samples(self) -> Brought:
        """Yield readings as they come; raises CaneflowError where the page cannot be served."""
        with page_server(self._settings, Guidance(), hears=False, senses=True) as server:
            log.info("the phone's page is at %s", server.address)
            for line in squares_of(server):
                log.info("%s", line)
            try:
                while True:
                    try:
                        came = server.readings.get(timeout=SILENCE)
                    except queue.Empty:
                        self._last = max(self._last, time.time_ns() - MARGIN_NS)
                        yield Quiet(self._last)
                    else:
                        self._note_unheard(server.unheard)
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
            self._refuse("not readings", 1, error)
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
                    self._refuse("not what an IMU measures", 1, error)
                    continue
                if self._sample and motion.stamp - self._sample > GAP_NS:
                    log.warning("no reading for %.1f s", (motion.stamp - self._sample) * 1e-9)
                self._last = self._sample = motion.stamp
                samples.append(sample)
        return samples

    def _note_unheard(self, unheard: int) -> None:
        if unheard > self._unheard:
            log.warning("%d messages of the page came faster than they could be taken", unheard - self._unheard)
            self._unheard = unheard

    def _refuse(self, cause: str, count: int, found: object = "") -> None:
        """Count readings by their cause; `found`: what is wrong with the first of them, which is told."""
        if found and cause not in self.refused:
            log.warning("%s: %s", cause, found)
        self.refused[cause] = self.refused.get(cause, 0) + count


if __name__ == "__main__":
    run(Phone)
