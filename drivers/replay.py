"""A recording in the place of a driver: the same streams under the same node's name.

out  what the recording holds of this node, with the recorded stamps and spacing
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
from annotated_types import Ge, Le

from caneflow.messages import MessageError, Sample, decode
from caneflow.recording import Recording
from caneflow.runtime import Brought, Context, Encoded, Quiet, Source
from caneflow.runtime.node import run

SLICE = 0.05  # s: while it waits, the replayer says this often that nothing has come

Duration: TypeAlias = Annotated[float, Ge(0), Le(1e10)]  # s: three centuries


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """Which part of a recording to play, and how fast."""

    recording: str  # path
    speed: Annotated[float, Ge(1e-3), Le(1e6)] | None = 1.0  # times real time; None: as fast as the readers can
    origin_ns: Annotated[int, Ge(0), Le(2**63 - 1)]  # the stamp at which the whole replay begins, for every node
    duration_s: Duration | None = None  # s, from the origin
    loop_s: Duration | None = None  # s of one turn; None: play once
    started_s: Duration | None = None  # s of the machine's monotonic clock at the origin; None: when it is started


class Replay(Source):
    """Plays the streams that a recording holds of the node that it stands for."""

    Settings = ReplaySettings
    ordered = True

    def __init__(self, settings: ReplaySettings, context: Context) -> None:
        self._settings = settings
        self._node = context.node
        self._ports = context.ports

    def samples(self) -> Brought:
        """Yield the recorded samples, each when its time has come."""
        speed = self._settings.speed
        if speed is None:
            yield from self.recorded()
        else:
            # A replayer in the place of one that was killed catches up; its readers know what they have had.
            started = time.monotonic() if self._settings.started_s is None else self._settings.started_s
            yield from paced(self.recorded(), self._settings.origin_ns, started, speed)

    def recorded(self) -> Iterator[tuple[str, Sample | Encoded]]:
        """Yield the recorded samples in the order of their stamps; a loop goes on with shifted stamps."""
        settings = self._settings
        if settings.loop_s is None:
            yield from self._once(settings.duration_s)
            return
        turn_ns, shift = round(settings.loop_s * 1e9), 0
        while True:
            for port, sample in self._once(settings.loop_s):
                yield port, shifted(sample, shift) if shift else sample
            shift += turn_ns

    def _once(self, duration_s: float | None) -> Iterator[tuple[str, Encoded]]:
        start = self._settings.origin_ns
        # The end is exclusive: the next turn of a loop begins with that stamp.
        end = None if duration_s is None else start + round(duration_s * 1e9)
        with Recording(Path(self._settings.recording)) as recording:
            streams = [(self._node, port) for port in self._ports]
            for found in recording.samples(streams, start_ns=start, end_ns=end):
                yield found.port, Encoded(self._ports[found.port], found.stamp, found.seq, found.payload)


def shifted(sample: Encoded, by: int) -> Sample | Encoded:
    """The sample `by` ns later; one that cannot be decoded stays as it is and is refused further on."""
    try:
        message = decode(sample.payload, sample.kind)
    except MessageError:
        return sample
    return msgspec.structs.replace(message, stamp=message.stamp + by)


def paced(samples: Iterator[tuple[str, Sample | Encoded]], origin: int, started: float, speed: float) -> Brought:
    """Hold each sample until its time, counted from one start (s, monotonic) so that errors do not add up."""
    for port, sample in samples:
        due = started + (sample.stamp - origin) / 1e9 / speed
        while (wait := due - time.monotonic()) > 0:
            time.sleep(min(wait, SLICE))
            if wait > SLICE:  # nothing for a while: readers of other streams need not wait for this one
                now = origin + int((time.monotonic() - started) * speed * 1e9)
                yield Quiet(min(now, sample.stamp - 1))
        yield port, sample


if __name__ == "__main__":
    run(Replay)
