"""What the sources of a group brought, and what it decided by the clock, since its last snapshot: it outlives a kill.

The system keeps what was written, whatever becomes of the process: it does not have to reach the disk for that.
"""

import logging
import os
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import msgspec

from caneflow.runtime.stages.decisions import Decision, WasLeftOut, WentOn

log = logging.getLogger(__name__)

LARGEST = 64 * 2**20  # bytes of one file: while no snapshot can be written, no more is kept
LENGTH = struct.Struct("<I")


class Brought(msgspec.Struct, frozen=True, array_like=True, tag="brought", gc=False):
    """A sample that a source brought, under its number."""

    node: str
    port: str
    payload: bytes


Record: TypeAlias = Brought | Decision


class Journal:
    """Files that follow each other; a snapshot begins a new one."""

    def __init__(self, path: Path) -> None:
        """`path`: of the files, but for their numbers; the folder is this user's alone."""
        self._name = path.name
        self._file = -1  # not open
        self._size = 0  # bytes of that file
        self._failed = False
        self._folder = -1  # no folder, no journal: that there are no snapshots either is said elsewhere
        with suppress(OSError):
            self._folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        self.number = max(self._numbers(), default=-1) + 1  # of the file that is written

    def append(self, what: Record) -> None:
        """Keep a sample that is about to be handled, or a decision; a disk without room is said once."""
        if self._failed or self._size > LARGEST or self._folder < 0:
            return
        record = msgspec.msgpack.encode(what)
        try:
            if self._file < 0:
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
                self._file = os.open(self._called(self.number), flags, 0o600, dir_fd=self._folder)
            self._size += os.write(self._file, LENGTH.pack(len(record)) + record)
        except OSError as error:
            self._failed = True
            log.warning("cannot keep what sources bring: %s; a kill may lose some of it", error.strerror)

    def begin(self) -> int:
        """Begin a new file; its number."""
        if self._file >= 0:
            os.close(self._file)
        self._file, self._size, self._failed = -1, 0, False
        self.number += 1
        return self.number

    def forget(self, before: int) -> None:
        """Remove the files with a smaller number: a snapshot holds what followed from them."""
        for number in self._numbers():
            if number < before:
                with suppress(OSError):
                    os.unlink(self._called(number), dir_fd=self._folder)

    def since(self, number: int) -> Iterator[Record]:
        """What the files from `number` on hold, in order, up to a record that was torn by the kill."""
        for each in sorted(self._numbers()):
            if each >= number:
                with suppress(OSError, msgspec.DecodeError):
                    yield from self._records(self._read(each))

    def _records(self, data: bytes) -> Iterator[Record]:
        at = 0
        while at + LENGTH.size <= len(data):
            (length,) = LENGTH.unpack_from(data, at)
            at += LENGTH.size
            if at + length > len(data):
                return
            yield msgspec.msgpack.decode(data[at : at + length], type=Brought | WentOn | WasLeftOut)
            at += length

    def _read(self, number: int) -> bytes:
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
        with os.fdopen(os.open(self._called(number), flags, dir_fd=self._folder), "rb") as file:
            return file.read()

    def _numbers(self) -> list[int]:
        if self._folder < 0:
            return []
        named = re.compile(rf"{re.escape(self._name)}\.(\d{{1,9}})")
        return [int(found[1]) for name in os.listdir(self._folder) if (found := named.fullmatch(name))]  # noqa: PTH208 - not by its path

    def _called(self, number: int) -> str:
        return f"{self._name}.{number}"
