"""Writes a recording, so that a process killed at any instant leaves all but its last second behind."""

import errno
import json
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Literal, Self, TypeAlias

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

import caneflow
from caneflow.messages import Sample, json_schema
from caneflow.outputs import FULL, share_lock
from caneflow.recording.errors import RecordingError
from caneflow.recording.platform import Platform

Compression: TypeAlias = Literal["zstd", "lz4", "none"]
Origin: TypeAlias = Literal["live", "replayed", "simulated", "imported"]

FORMAT_VERSION = "1"  # of the layout of a recording; the program's own version is in the file's header
NOTHING_MORE: Mapping[str, object] = MappingProxyType({})
FLUSH_INTERVAL = 1_000_000_000  # ns of log time: what a killed recorder may lose
# A second of the cane is 0.2 MB, so most chunks end with a flush; a burst ends here, for the reader's memory.
CHUNK_SIZE = 256 * 1024  # bytes before compression
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
MAX_SEQUENCE = 2**32 - 1  # MCAP's sequence is a uint32; a stream of 100 Hz gets there after 16 months


class RecordingWriter:
    """One file, written in place and from one thread. What exists is replaced: `caneflow.outputs` decides about that.

    Metadata is on disk before the first sample, and samples are at most FLUSH_INTERVAL of log time later than
    that; `flush` puts them there at once. Leaving the `with` block ends the file soundly, whatever happened in it.

    Raises RecordingError, here and in every method, when the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        flow: str,
        source: Origin,
        rig: dict[str, Any],
        run: str | None = None,
        compression: Compression = "zstd",
        part: int | None = None,
        new: bool = False,
        records: Mapping[str, object] = NOTHING_MORE,
    ) -> None:
        """`part`: which of the files of one run this is. `new`: raise FileExistsError where there is a file.

        `records`: more metadata records by name, each written as JSON, e.g. what a simulator knows of its scene.
        """
        about = {"flow": flow, "version": FORMAT_VERSION, "run": run or uuid.uuid4().hex, "source": source}
        if part is not None:
            about["part"] = str(part)
        about["platform"] = Platform.here().as_json()
        bolted_on = {"json": json.dumps(rig, allow_nan=False)}
        self.path = Path(path)
        self._channels: dict[str, tuple[int, str]] = {}  # by key: channel id, name of its schema
        self._schemas: dict[str, int] = {}  # by name
        self._flushed: int | None = None  # log time, ns
        try:
            # A buffered file: of an unbuffered one, mcap would leave the end in a buffer that nobody flushes.
            self._file = self.path.open("xb" if new else "wb")
        except OSError as error:
            if new and isinstance(error, FileExistsError):
                raise
            raise RecordingError(_cannot_open(self.path, error)) from error
        share_lock(self._file.fileno())
        self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE, compression=COMPRESSIONS[compression])
        try:
            with self._ending_at_failure():
                self._mcap.start(library=f"caneflow {caneflow.__version__}")
                self._mcap.add_metadata("caneflow", about)
                self._mcap.add_metadata("rig", bolted_on)
                for name, content in records.items():
                    self._mcap.add_metadata(name, {"json": json.dumps(content, allow_nan=False)})
                self._flush()
        except RecordingError:
            if self.path.is_file() and not self.path.is_symlink():  # it holds nothing
                self.path.unlink(missing_ok=True)
            raise

    def write(self, key: str, kind: type[Sample], payload: bytes, *, stamp: int, seq: int, log_time: int) -> None:
        """Add sample `seq` of the stream `key`: its bytes as sent; stamp and time of reception in ns."""
        with self._ending_at_failure():
            self._add(self._channel(key, kind.schema, kind), payload, stamp, seq, log_time)

    def write_control(self, key: str, schema_name: str, payload: bytes, *, log_time: int) -> None:
        """Add what the flow said about itself under `<flow>/@/...`: a msgpack map of no fixed shape."""
        with self._ending_at_failure():
            self._add(self._channel(key, schema_name, None), payload, log_time, 0, log_time)

    @property
    def size(self) -> int:
        """Bytes in the file so far; up to FLUSH_INTERVAL of samples come on top."""
        return self._file.tell()

    def flush(self) -> None:
        """Hand everything written so far to the operating system, where it outlives this process."""
        with self._ending_at_failure():
            self._flush()

    def close(self) -> None:
        """End the file soundly; a second call does nothing."""
        if self._file.closed:
            return
        with self._ending_at_failure():
            self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without a return type
            self._require_there()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _add(self, channel: int, payload: bytes, stamp: int, seq: int, log_time: int) -> None:
        self._mcap.add_message(channel, log_time, payload, stamp, seq & MAX_SEQUENCE)
        if self._flushed is None:
            self._flushed = log_time
        elif not 0 <= log_time - self._flushed < FLUSH_INTERVAL:  # below 0: the clock was set back
            self._flush()
            self._flushed = log_time

    def _flush(self) -> None:
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap leaves it without a return type
        self._require_there()

    def _require_there(self) -> None:
        """Raise OSError when the file has lost its name: one can go on writing to it, and nobody will read that."""
        with suppress(FileNotFoundError):
            if os.path.samestat(self.path.stat(), os.fstat(self._file.fileno())):
                return
        raise FileNotFoundError(errno.ENOENT, "the file was removed or moved while it was written")

    def _channel(self, key: str, schema_name: str, kind: type[Sample] | None) -> int:
        if known := self._channels.get(key):
            channel, known_schema = known
            if known_schema != schema_name:
                raise RecordingError(f"{self.path}: {key} is a stream of {known_schema}, not of {schema_name}")
            return channel
        if schema_name not in self._schemas:
            schema = {"type": "object"} if kind is None else json_schema(kind)
            self._schemas[schema_name] = self._mcap.register_schema(
                schema_name, SchemaEncoding.JSONSchema, json.dumps(schema).encode()
            )
        channel = self._mcap.register_channel(key, MessageEncoding.MessagePack, self._schemas[schema_name])
        self._channels[key] = channel, schema_name
        return channel

    @contextmanager
    def _ending_at_failure(self) -> Iterator[None]:
        """Give the file up when the disk does: what is on it stays readable up to there."""
        if self._file.closed:
            raise RecordingError(f"{self.path}: is closed; nothing can be added")
        try:
            yield
        except OSError as error:
            with suppress(OSError):  # closing flushes, which fails for the same reason
                self._file.close()
            advice = "; make room, or record on another disk" if error.errno in FULL else ""
            raise RecordingError(
                f"{self.path}: {error.strerror or error}; the recording ends here, what was written before can be read"
                f"{advice}"
            ) from error


def _cannot_open(path: Path, error: OSError) -> str:
    if isinstance(error, FileNotFoundError):
        return f"{path}: cannot be written, there is no folder {path.parent}"
    return f"{path}: cannot be written: {error.strerror or error}"
