"""One file of a process's in a folder of this user's alone, exchanged as a whole."""

import logging
import os
from contextlib import suppress
from pathlib import Path

from caneflow.runtime.stages.references import SnapshotError

log = logging.getLogger(__name__)

OTHERS_WRITE = 0o022


class SnapshotFile:
    """The newest snapshot of a process."""

    def __init__(self, path: Path) -> None:
        self._file = path.name
        self._failed = False  # to write one, and that was said
        # Held open: a folder that is removed and made again by another user gets nothing of ours, and gives nothing.
        self._folder = self._opened(path.parent)

    def keep(self, snapshot: bytes) -> bool:
        """Write what was taken in place of the one before; the file is whole at any moment. False: not possible now.

        A folder that was removed is not made again: what stands under its name later may be another user's.
        """
        fresh = f"{self._file}.new"
        try:
            self._write(fresh, snapshot)
            os.replace(fresh, self._file, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        except OSError as error:
            self._remove(fresh)  # a full disk has no room for half a snapshot
            if not self._failed:
                log.warning(
                    "cannot write a snapshot: %s; goes on without (tried again, not said again)", error.strerror
                )
            self._failed = True
            return False
        return True

    def discard(self) -> None:
        """Remove the newest snapshot, if there is one."""
        self._remove(self._file)

    def read(self) -> bytes | None:
        """The newest snapshot; None: there is none. Raises SnapshotError when it cannot be read."""
        return self._read()

    def _opened(self, folder: Path) -> int:
        """A descriptor of the folder, if nobody else can write to it; -1, said once, when that is not so."""
        descriptor = -1
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            about = os.fstat(descriptor)
            if about.st_uid == os.geteuid() and not about.st_mode & OTHERS_WRITE:
                return descriptor
            os.close(descriptor)
            found = "others can write to it; expected a folder of this user's alone"
        except OSError as error:
            found = str(error.strerror)
        log.warning("keeps no snapshots: %s: %s", folder, found)
        return -1

    def _read(self) -> bytes | None:
        if self._folder < 0:
            return None
        try:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            with os.fdopen(os.open(self._file, flags, dir_fd=self._folder), "rb") as file:
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SnapshotError(f"it cannot be read: {error.strerror}") from error

    def _write(self, name: str, data: bytes) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
        with os.fdopen(os.open(name, flags, 0o600, dir_fd=self._folder), "wb") as file:
            file.write(data)

    def _remove(self, name: str) -> None:
        if self._folder >= 0:
            with suppress(OSError):  # it is not there
                os.unlink(name, dir_fd=self._folder)
