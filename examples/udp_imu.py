"""A driver of one's own: an IMU that some other program sends as JSON datagrams, e.g. a phone through an SSH tunnel.

settings  port : int   on 127.0.0.1, where the datagrams come
out       imu : Imu

A datagram: {"gyro": [x, y, z], "accel": [x, y, z]} in rad/s and m/s^2, in the frame of the body.
"""

import logging
import socket
import time
from dataclasses import dataclass
from typing import Annotated

import msgspec
from annotated_types import Ge, Le

from caneflow.messages import Imu
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

LONGEST = 4096  # bytes of a datagram
QUIET = 0.5  # s without a datagram, after which the flow is told so


class Reading(msgspec.Struct):
    """What a datagram holds."""

    gyro: tuple[float, float, float]  # rad/s
    accel: tuple[float, float, float]  # m/s^2


@dataclass(frozen=True, kw_only=True)
class UdpImuSettings:
    """What dataflow.yaml may set."""

    port: Annotated[int, Ge(1024), Le(65535)] = 5555


def sample(datagram: bytes, stamp: int) -> Imu | None:
    """The sample that a datagram means, taken at `stamp` (ns); None, and a line that says why, for one that is none."""
    try:
        reading = msgspec.json.decode(datagram, type=Reading)
        return Imu(stamp=stamp, gyro=reading.gyro, accel=reading.accel)
    except ValueError as error:  # of the JSON, or beyond what any IMU measures
        log.warning("a datagram of %d bytes is not a reading: %s", len(datagram), error)
        return None


class UdpImu(Source):
    """The one kind of program that reads a clock: here a stamp is born."""

    outputs = {"imu": Imu}
    Settings = UdpImuSettings

    def __init__(self, settings: UdpImuSettings, context: Context) -> None:
        self._port = settings.port

    def samples(self) -> Brought:
        """Yield each reading as it comes; while none does, say so, so that the flow can end and ask."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", self._port))
            receiver.settimeout(QUIET)
            last = 0
            while True:
                try:
                    datagram = receiver.recv(LONGEST)
                except TimeoutError:
                    last = max(time.time_ns(), last + 1)
                    yield Quiet(until=last)
                    continue
                last = max(time.time_ns(), last + 1)  # strictly increasing, also where the clock is set back
                if (imu := sample(datagram, last)) is not None:
                    yield "imu", imu


if __name__ == "__main__":
    run(UdpImu)
