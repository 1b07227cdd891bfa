"""A folder that only this user can enter: examined on its open descriptor before use, held with a lock while in use.

Under a common folder such as /tmp, another user may have made a folder of the expected name first, or a link. What a
flow reads from such a folder could be forged: plans, snapshots, and the address at which tools attach.
"""

import errno
import fcntl
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from caneflow.runtime.errors import DataflowError

OTHERS = 0o077  # any right of group or others
OTHERS_WRITE = 0o022
ATTEMPTS = 5  # at a folder that a cleaner removes between its making and its lock


class NotOurs(DataflowError):
    """The folder belongs to another user, is open to others, or is a link."""

    def __init__(self, message: str, *, suspicious: bool = True) -> None:
        super().__init__(message)
        self.suspicious = suspicious  # False: others may read it; nobody else can have put anything there


class PrivateFolder:
    """A folder of mode 0700 that belongs to this user, held open.

    The shared lock on it tells cleaners (systemd-tmpfiles, and the next launcher) that it is in use; the kernel drops
    it when this process ends, however it ends.
    """

    def __init__(self, path: Path, descriptor: int, parent: "PrivateFolder | None" = None) -> None:
        self.path = path
        self.descriptor = descriptor
        self.parent = parent

    @classmethod
    def at(cls, path: Path) -> "PrivateFolder":
        """The folder at `path`, made when it is not there.

        Raises NotOurs when it is another user's, a link or open to others, DataflowError when it cannot be made.
        """
        return cls(path, _held(path, str(path), None, strict=True))

    @classmethod
    def given(cls, path: Path) -> "PrivateFolder":
        """The folder at `path`, which this process was told to use: a link to it and readers are taken, not writers.

        Raises NotOurs when it is another user's or others may write into it.
        """
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise DataflowError(f"{path}: {error.strerror}") from error
        found = os.fstat(descriptor)
        if wrong := _wrong(found, OTHERS_WRITE):
            os.close(descriptor)
            raise NotOurs(f"{path}: {wrong}")
        return cls(path, descriptor)

    def child(self, name: str) -> "PrivateFolder":
        """The folder `name` in this one, made when it is not there; raises as `at` does."""
        if name in ("", ".", "..") or "/" in name:
            raise DataflowError(f"{self.path}: {name!r} is not a name of a folder")
        path = self.path / name
        # Nobody else can have made it: one that others may read is an older version's.
        return PrivateFolder(path, _held(path, name, self.descriptor, strict=False), self)

    def write(self, name: str, content: bytes) -> None:
        """Put a file into the folder, whole or not at all; raises DataflowError when it cannot be written."""
        beside = f".{name}"
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
        try:
            with os.fdopen(os.open(beside, flags, 0o600, dir_fd=self.descriptor), "wb") as file:
                file.write(content)
            os.replace(beside, name, src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)
        except OSError as error:
            raise DataflowError(f"{self.path / name}: {error.strerror}") from error

    def remove(self, name: str) -> None:
        """Remove what is called `name` in this folder, if it can be; links are not followed."""
        with suppress(OSError):
            os.unlink(name, dir_fd=self.descriptor)
        shutil.rmtree(name, ignore_errors=True, dir_fd=self.descriptor)

    def remove_unused(self, name: str) -> None:
        """Remove the folder `name` in this one unless a process holds it."""
        with suppress(OSError):
            descriptor = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=self.descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self.remove(name)
            finally:
                os.close(descriptor)

    def names(self) -> list[str]:
        """What is in the folder."""
        return os.listdir(self.descriptor)  # noqa: PTH208 - not by its path

    @property
    def is_there(self) -> bool:
        """Whether its path still leads to it: a cleaner may have removed it."""
        return _is_at(self.path, self.descriptor, None)

    def close(self) -> None:
        """Let go of the folder and its lock."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


@contextmanager
def folder_of_user(path: Path | str, user: int, within: int | None = None) -> Iterator[tuple[int, os.stat_result]]:
    """A descriptor of a folder that may be read, and believed as far as `user` or its owner is to be believed.

    Raises OSError when it is a link, or belongs neither to `user` nor, for root, to anybody else's own; or when others
    than its owner may write into it.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=within)
    try:
        found = os.fstat(descriptor)
        if (user not in (0, found.st_uid)) or found.st_mode & OTHERS_WRITE:
            raise PermissionError(errno.EPERM, "not a folder of one user", str(path))
        yield descriptor, found
    finally:
        os.close(descriptor)


def _held(path: Path, name: str, parent: int | None, *, strict: bool) -> int:
    """A descriptor of the folder `name` of `parent`, examined and locked; `path` is its whole name."""
    for _ in range(ATTEMPTS):
        descriptor = _made_and_opened(path, name, parent)
        try:
            found = os.fstat(descriptor)
            if wrong := _wrong(found, OTHERS if strict else OTHERS_WRITE):
                raise NotOurs(f"{path}: {wrong}", suspicious=bool(_wrong(found, OTHERS_WRITE)))
            if found.st_mode & OTHERS:
                os.fchmod(descriptor, 0o700)
            with suppress(OSError):  # some file systems have no locks
                fcntl.flock(descriptor, fcntl.LOCK_SH)
            if _is_at(Path(name), descriptor, parent):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise DataflowError(f"{path}: is removed as soon as it is made")


def _made_and_opened(path: Path, name: str, parent: int | None) -> int:
    try:
        with suppress(FileExistsError):
            os.mkdir(name, 0o700, dir_fd=parent)
        return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=parent)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENOTDIR) and path.is_symlink():
            raise NotOurs(f"{path}: is a link, not a folder") from error
        if error.errno == errno.ENOTDIR and path.exists():
            raise NotOurs(f"{path}: is not a folder") from error
        if error.errno == errno.EACCES and path.exists():
            raise NotOurs(f"{path}: cannot be entered by this user") from error
        raise DataflowError(f"{path}: cannot be made ({error.strerror})") from error


def _wrong(found: os.stat_result, forbidden: int) -> str:
    """What makes a folder unfit: its owner, or the rights of others among `forbidden`; empty: nothing."""
    if found.st_uid != os.getuid():
        return f"belongs to another user (uid {found.st_uid})"
    if found.st_mode & forbidden:
        return f"is open to others (mode {stat.S_IMODE(found.st_mode):04o}, expected 0700)"
    return ""


def _is_at(path: Path, descriptor: int, parent: int | None) -> bool:
    """Whether `path` leads to what `descriptor` is of."""
    try:
        found = os.stat(path, dir_fd=parent, follow_symlinks=False)
    except OSError:
        return False
    return os.path.samestat(found, os.fstat(descriptor))
