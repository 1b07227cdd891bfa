"""The recorder: the node that `caneflow run --record OUT` adds; it writes every stream to one file."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from caneflow.messages import Pose, Sample, sample_key
from caneflow.recording import Recorded, Recording, RecordingWriter
from caneflow.runtime import Context, Sink
from caneflow.runtime.node import run

TRUTH = ("truth", "pose")


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """Where to write, and what to say of it."""

    path: str
    flow: str
    source: Literal["live", "replayed"]
    rig: dict[str, Any]
    truth_from: str | None = None  # a replayed recording whose ground truth is carried over


class Recorder(Sink):
    """Writes samples as they come, with their bytes as sent."""

    Settings = RecordSettings

    def __init__(self, settings: RecordSettings, context: Context) -> None:
        self._flow = settings.flow
        self._writer = RecordingWriter(
            Path(settings.path), flow=settings.flow, source=settings.source, rig=settings.rig
        )
        self._truth = _truth(settings.truth_from)
        self._next_truth = next(self._truth, None)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Write one sample, after the ground truth up to its stamp."""
        self._carry_truth(until=message.stamp, time=time)
        self._writer.write(key, type(message), payload, stamp=message.stamp, seq=message.seq, log_time=time)

    def note(self, key: str, payload: bytes, time: int) -> None:
        """Write down what a node left out: a replay will leave it out as well."""
        self._writer.write_control(key, "caneflow.LeftOut/1", payload, log_time=time)

    def idle(self, time: int) -> None:
        """Bring what was written to the disk: a killed recorder loses at most a second."""
        self._writer.flush()

    def finish(self) -> None:
        """Complete the file."""
        self._writer.close()

    def _carry_truth(self, until: int, time: int) -> None:
        while (truth := self._next_truth) is not None and truth.stamp <= until:
            key = sample_key(self._flow, *TRUTH)
            self._writer.write(key, Pose, truth.payload, stamp=truth.stamp, seq=truth.seq, log_time=time)
            self._next_truth = next(self._truth, None)


def _truth(path: str | None) -> Iterator[Recorded]:
    if path is None:
        return
    with Recording(Path(path)) as recording:
        if TRUTH in recording.streams:
            yield from recording.samples([TRUTH])


if __name__ == "__main__":
    run(Recorder)
