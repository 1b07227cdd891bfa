"""Serial ports that are made: pseudo-terminals under a name, for emulators of devices."""

import os
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caneflow.errors import CaneflowError

TERMINALS = Path("/dev/pts")
AT_ONCE = 65_536  # bytes


class MadePort:
    """The device's end of a port: never blocks."""

    def __init__(self, end: int) -> None:
        self._end = end
        os.set_blocking(end, False)

    def fileno(self) -> int:
        """For `select`."""
        return self._end

    def read(self) -> bytes | None:
        """What was written to the port; b"" for nothing."""
        try:
            return os.read(self._end, AT_ONCE)
        except OSError:
            return b""

    def write(self, data: bytes) -> int:
        """Bytes that went into the terminal."""
        with suppress(OSError):
            return os.write(self._end, data)
        return 0


@contextmanager
def made_port(path: Path) -> Iterator[MadePort]:
    """A port at `path` as long as the context lasts; raises CaneflowError when something else has that name."""
    # What an emulator that was killed left behind is a link to a pseudo-terminal.
    if os.path.lexists(path) and not (path.is_symlink() and path.readlink().parent == TERMINALS):
        raise CaneflowError(f"{path}: exists and is not an emulator's port; choose another name")
    mine, theirs = os.openpty()  # the other end stays open too: a driver that leaves must not take the terminal along
    try:
        tty.setraw(theirs)
        beside = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            beside.symlink_to(os.ttyname(theirs))
            beside.replace(path)
        except OSError as error:
            raise CaneflowError(f"{path}: {error.strerror or error}") from error
        yield MadePort(mine)
    finally:
        path.unlink(missing_ok=True)
        os.close(mine)
        os.close(theirs)
