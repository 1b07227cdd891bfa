"""A recording in parts: a new file by size or time, or the last seconds when someone asks for them."""

import errno
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import NamedTuple, TypeAlias

from caneflow.messages import Sample
from caneflow.recording.errors import RecordingError
from caneflow.recording.writer import RecordingWriter

SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}  # bytes
SPANS = {"s": 1, "min": 60, "h": 3600}  # s
LEAST_ROOM = 512 * 1024  # bytes on a disk that has been full, before a recorder begins another part there
WRITE_NOW = b"write now"  # what a recorder is asked that keeps the last seconds in memory
LARGEST_BUFFER = 512 * 2**20  # bytes of samples that are kept in memory: a gateway has more to do

# Path and number of a part -> its writer; raises FileExistsError where another run was faster.
Opener: TypeAlias = Callable[[Path, int], RecordingWriter]


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """When a new part begins, and how many are kept."""

    size: int | None = None  # bytes
    span_s: float | None = None  # s of log time
    keep: int | None = None  # the newest parts of this run; None: all

    @classmethod
    def read(cls, text: str, keep: int | None = None) -> "Rotation":
        """The rotation that `100MB`, `10min` or both with a comma mean; raises RecordingError for another text."""
        size: int | None = None
        span_s: float | None = None
        for word in text.split(","):
            number, unit = _quantity(word)
            if unit in SIZES:
                size = round(number * SIZES[unit])
            elif unit in SPANS:
                span_s = number * SPANS[unit]
            else:
                raise RecordingError(f"--rotate {text}: give a size or a time, e.g. 100MB, 10min or 100MB,10min")
        return cls(size=size, span_s=span_s, keep=keep)


def read_span(text: str) -> float:
    """Seconds in `30s`, `2min`, `1h` or `30`; raises RecordingError for another text."""
    number, unit = _quantity(text)
    if unit not in ("", *SPANS) or not number > 0:
        raise RecordingError(f"{text!r}: not a duration; expected e.g. 30s or 2min")
    return number * SPANS.get(unit, 1)


def part_path(path: Path, number: int) -> Path:
    """Where part `number` of the recording `path` lies: walk.mcap -> walk_003.mcap."""
    return path.with_name(f"{path.stem}_{number:03}{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """The parts of the recording `path` that exist, of whatever run, by their numbers."""
    return [part_path(path, number) for number in sorted(_numbers(path))]


def further_part(path: Path, opener: Opener) -> RecordingWriter:
    """The part that follows `path` itself and its parts that are there: walk_001.mcap after walk.mcap."""
    return _opened(opener, path, _free_numbers(path, first=1))


def require_room(path: Path) -> None:
    """Raise RecordingError where the disk of `path` is full, or nearly: a part would end as soon as it has begun."""
    try:
        disk = os.statvfs(path.parent)
        if disk.f_bavail * disk.f_frsize < LEAST_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        raise RecordingError(f"{path}: cannot go on: {error.strerror}") from error


class RotatingWriter:
    """Writes one part after the other, each a sound recording by itself; files that are there are left alone."""

    def __init__(self, path: Path, rotation: Rotation, opener: Opener, written: Iterable[Path] = ()) -> None:
        """`written`: parts that this run has written already."""
        self._path = path
        self._rotation = rotation
        self._open = opener
        self._numbers = _free_numbers(path)
        self._written: deque[Path] = deque(written)
        self._began: int | None = None  # log time (ns) of the part's first sample
        self._writer = self._next_part()

    def write(self, key: str, kind: type[Sample], payload: bytes, *, stamp: int, seq: int, log_time: int) -> None:
        """Add a sample, to a new part when the one before is full."""
        self._begin_part_if_due(log_time)
        self._writer.write(key, kind, payload, stamp=stamp, seq=seq, log_time=log_time)

    def write_control(self, key: str, schema_name: str, payload: bytes, *, log_time: int) -> None:
        """Add what the flow said about itself."""
        self._begin_part_if_due(log_time)
        self._writer.write_control(key, schema_name, payload, log_time=log_time)

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """End the last part."""
        self._writer.close()

    def _begin_part_if_due(self, log_time: int) -> None:
        if self._began is None or log_time < self._began:  # the clock was set back
            self._began = log_time
            return
        rotation = self._rotation
        full = rotation.size is not None and self._writer.size >= rotation.size
        if full or (rotation.span_s is not None and log_time - self._began >= rotation.span_s * 1e9):
            self._writer.close()
            self._writer = self._next_part()
            self._began = log_time

    def _next_part(self) -> RecordingWriter:
        while self._rotation.keep is not None and len(self._written) >= self._rotation.keep:
            self._written.popleft().unlink(missing_ok=True)
        writer = _opened(self._open, self._path, self._numbers)
        self._written.append(writer.path)
        return writer


class Kept(NamedTuple):
    """A sample in memory, or what the flow said about itself (then `kind` is the name of its schema)."""

    key: str
    kind: "type[Sample] | str"
    payload: bytes
    stamp: int  # ns
    seq: int
    log_time: int  # ns


class Snapshot(NamedTuple):
    """What was written when someone asked."""

    path: Path
    samples: int
    span_s: float  # from the first sample to the last


@dataclass
class LastSeconds:
    """The last seconds of a flow, in memory; written to a part of their own when asked for."""

    path: Path
    span_s: float
    opener: Opener
    largest: int = LARGEST_BUFFER  # bytes
    overfull: int = 0  # samples that were younger than the span and had to go
    _kept: "deque[Kept]" = field(default_factory=deque)
    _size: int = 0

    def __post_init__(self) -> None:
        self._numbers = _free_numbers(self.path)

    def write(self, key: str, kind: type[Sample], payload: bytes, *, stamp: int, seq: int, log_time: int) -> None:
        """Keep a sample, and forget what is older than the span."""
        self._keep(Kept(key, kind, payload, stamp, seq, log_time))

    def write_control(self, key: str, schema_name: str, payload: bytes, *, log_time: int) -> None:
        """Keep what the flow said about itself."""
        self._keep(Kept(key, schema_name, payload, log_time, 0, log_time))

    def flush(self) -> None:
        """Nothing goes to the disk before it is asked for."""

    def close(self) -> None:
        """Forget everything."""
        self._kept.clear()
        self._size = 0

    def snapshot(self) -> Snapshot:
        """Write what is kept to a new part; raises RecordingError when nothing is, or it cannot be written."""
        if not self._kept:
            raise RecordingError("nothing has come yet; there is nothing to write")
        with _opened(self.opener, self.path, self._numbers) as writer:
            for kept in self._kept:
                if isinstance(kept.kind, str):
                    writer.write_control(kept.key, kept.kind, kept.payload, log_time=kept.log_time)
                else:
                    writer.write(
                        kept.key, kept.kind, kept.payload, stamp=kept.stamp, seq=kept.seq, log_time=kept.log_time
                    )
        return Snapshot(writer.path, len(self._kept), (self._kept[-1].log_time - self._kept[0].log_time) / 1e9)

    def _keep(self, kept: Kept) -> None:
        self._kept.append(kept)
        self._size += len(kept.payload)
        span = round(self.span_s * 1e9)
        while abs(kept.log_time - self._kept[0].log_time) > span:  # either way: the clock may be set
            self._forget()
        while self._size > self.largest and len(self._kept) > 1:
            self._forget()
            self.overfull += 1

    def _forget(self) -> None:
        self._size -= len(self._kept.popleft().payload)


def _opened(opener: Opener, path: Path, numbers: Iterator[int]) -> RecordingWriter:
    """The writer of the next part whose name is free: runs that write beside each other share the numbers."""
    for number in numbers:
        with suppress(FileExistsError):
            return opener(part_path(path, number), number)
    raise AssertionError  # there is always another number


def _free_numbers(path: Path, first: int = 0) -> "count[int]":
    """The numbers of parts that come after those that are there, from `first` on."""
    return count(max(_numbers(path), default=first - 1) + 1)


def _numbers(path: Path) -> list[int]:
    pattern = re.compile(re.escape(path.stem) + r"_(\d{3,})" + re.escape(path.suffix))
    return [int(found[1]) for each in path.parent.glob(f"*{path.suffix}") if (found := pattern.fullmatch(each.name))]


def _quantity(text: str) -> tuple[float, str]:
    """Number and unit of `100MB`; NaN and an unknown unit for what is none."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    return (float(found[1]), found[2]) if found and float(found[1]) > 0 else (float("nan"), "?")
