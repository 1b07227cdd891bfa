"""A walk that was recorded, as if its sensors were here: in real time, stamped now, again and again."""

import time
from dataclasses import dataclass
from itertools import count
from typing import Literal

import msgspec

from caneflow.messages import Imu, RadarFrame
from caneflow.recording import Recording
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.node import run

STREAMS = {("imu", "imu"): "imu", ("radar", "frame"): "frame"}


@dataclass(frozen=True, kw_only=True)
class WalkSettings:
    """Which walk."""

    recording: str
    plays: Literal["imu", "frame", "both"] = "both"


class Walk(Source):
    """IMU and radar of a simulated walk."""

    outputs = {"imu": Imu, "frame": RadarFrame}
    Settings = WalkSettings

    def __init__(self, settings: WalkSettings, context: Context) -> None:
        with Recording(settings.recording) as recording:
            streams = {stream: port for stream, port in STREAMS.items() if settings.plays in (port, "both")}
            self._samples = [(s.stamp, streams[s.node, s.port], s.decoded()) for s in recording.samples(streams)]

    def samples(self) -> Brought:
        """Yield each when it is due; its stamp is the instant at which it leaves."""
        first, last = self._samples[0][0], self._samples[-1][0]
        begin = time.time_ns()
        for turn in count():
            for stamp, port, sample in self._samples:
                due = begin + turn * (last - first + 10_000_000) + stamp - first
                if (wait := due - time.time_ns()) > 0:
                    time.sleep(wait / 1e9)
                yield port, msgspec.structs.replace(sample, stamp=time.time_ns())


if __name__ == "__main__":
    run(Walk)
