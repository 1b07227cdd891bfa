"""The recorder: the node that `caneflow run --record OUT` adds; it writes every stream to one file, or to several."""

import logging
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from annotated_types import Ge, Le

from caneflow.messages import Pose, Sample, sample_key
from caneflow.recording import TRUTH, Recorded, Recording, RecordingError, RecordingWriter
from caneflow.recording.parts import (
    WRITE_NOW,
    LastSeconds,
    RotatingWriter,
    Rotation,
    further_part,
    parts_of,
    require_room,
)
from caneflow.runtime import Context, Sink
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

Duration: TypeAlias = Annotated[float, Ge(1e-3), Le(1e10)]  # s: three centuries


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """Where to write, when to begin a new file, and what to say of it."""

    path: str
    flow: str
    source: Literal["live", "replayed"]
    rig: dict[str, Any]
    truth_from: str | None = None  # a replayed recording whose ground truth is carried over
    rotate_bytes: Annotated[int, Ge(1), Le(2**63 - 1)] | None = None  # a new file when this one is as large
    rotate_s: Duration | None = None  # s, a new file after this long
    keep: Annotated[int, Ge(1), Le(10**9)] | None = None  # files; older ones of this run are removed
    last_s: Duration | None = None  # s of samples held in memory and written on request only
    run: str | None = None  # the id of the run, the same in all its parts; None: a new one
    goes_on: bool = False  # in the place of a recorder that has ended: what that one wrote is left alone


class Recorder(Sink):
    """Writes samples as they come, with their bytes as sent."""

    Settings = RecordSettings

    def __init__(self, settings: RecordSettings, context: Context) -> None:
        self._flow = settings.flow
        self._settings = settings
        self._run = settings.run or uuid.uuid4().hex
        self._writer = self._writer_of(settings)
        self._truth = _truth(settings.truth_from)
        self._next_truth = next(self._truth, None)
        self._warned = False

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Write one sample, after the ground truth up to its stamp."""
        self._carry_truth(until=message.stamp, time=time)
        self._writer.write(key, type(message), payload, stamp=message.stamp, seq=message.seq, log_time=time)

    def note(self, key: str, payload: bytes, time: int) -> None:
        """Write down what a node left out: a replay will leave it out as well."""
        self._writer.write_control(key, "caneflow.LeftOut/1", payload, log_time=time)

    def asked(self, question: bytes, time: int) -> bytes | None:
        """Write the last seconds to a file; the answer says which, or why not."""
        if question != WRITE_NOW or not isinstance(self._writer, LastSeconds):
            return None
        try:
            written = self._writer.snapshot()
        except RecordingError as error:
            return msgspec.json.encode({"error": str(error)})
        log.info("%s: the last %.1f s, %d samples", written.path, written.span_s, written.samples)
        about = {"path": str(written.path), "samples": written.samples, "span": written.span_s}
        return msgspec.json.encode(about)

    def idle(self, time: int) -> None:
        """Bring what was written to the disk: a killed recorder loses at most a second."""
        self._writer.flush()
        if isinstance(self._writer, LastSeconds) and self._writer.overfull and not self._warned:
            self._warned = True
            log.warning("the last %g s do not fit into memory; the oldest of them go", self._settings.last_s)

    def finish(self) -> None:
        """Complete the file."""
        self._writer.close()

    def _writer_of(self, settings: RecordSettings) -> RecordingWriter | RotatingWriter | LastSeconds:
        path = Path(settings.path)
        if settings.last_s is not None:
            return LastSeconds(path, settings.last_s, self._part)
        if settings.goes_on:
            require_room(path)
        if settings.rotate_bytes is None and settings.rotate_s is None:
            if settings.goes_on:
                part = further_part(path, self._part)
                log.info("goes on in %s", part.path)
                return part
            return RecordingWriter(path, flow=settings.flow, source=settings.source, rig=settings.rig, run=self._run)
        rotation = Rotation(size=settings.rotate_bytes, span_s=settings.rotate_s, keep=settings.keep)
        written = filter(self._is_ours, parts_of(path)) if settings.goes_on and settings.keep else ()
        return RotatingWriter(path, rotation, self._part, written)

    def _is_ours(self, part: Path) -> bool:
        """Whether this run has written the part."""
        try:
            with Recording(part) as recording:
                return recording.metadata.get("run") == self._run
        except RecordingError:  # nobody's, and not to be removed
            return False

    def _part(self, path: Path, number: int) -> RecordingWriter:
        settings = self._settings
        return RecordingWriter(
            path, flow=settings.flow, source=settings.source, rig=settings.rig, run=self._run, part=number, new=True
        )

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
