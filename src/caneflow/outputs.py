"""Files that commands write: what exists is kept unless it may be replaced, and a new file appears when it is whole.

Every option that names an output goes through here: `whole` for what is written first and there afterwards, `reserved`
for a recording that a flow writes while it runs, `require_free` for the check alone.
"""

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import overload

from caneflow.errors import CaneflowError

try:
    import fcntl
except ModuleNotFoundError:  # not on Windows, where no flow runs that could be writing a file
    CAN_LOCK = False
else:
    CAN_LOCK = True

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # such an error names no file
LOOKED_AT = 4096  # bytes of an existing file that tell which picture it is
SHORT_NAME = 40  # characters of a file's name in that of the folder that it is written in
TIME = "{time}"  # in the name of a recording
STREAMS = re.compile(r"/dev/(stdout|stderr|fd/\d+)|/proc/(self|\d+)/fd/\d+")  # open already, whatever they lead to

# How a picture begins, by the name of its kind. `json` is what `caneflow graph --format json` writes.
PICTURES = {
    "png": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "pdf": re.compile(rb"%PDF-"),
    "svg": re.compile(rb"\s*(<\?xml[^>]*>\s*)?((<!--.*?-->|<!DOCTYPE\s+svg[^>]*>)\s*)*<svg\b", re.DOTALL),
    "mermaid": re.compile(rb"flowchart LR\n"),
    "json": re.compile(rb'\{\s*"flow": "[^"]*",\s*"nodes": \['),
}
BAG = re.compile(r"metadata\.yaml|.*\.(mcap|db3)(\.zstd)?")  # the files in a folder of rosbag2

Inputs = Sequence[Path | None]


class OutputError(CaneflowError):
    """An output that cannot be written, or must not be: which one, why, and what to do."""


def require_free(
    path: Path, *, inputs: Inputs = (), overwrite: bool = False, picture: str | None = None, folder: bool = False
) -> None:
    """Raise OutputError unless `path` can be written and nothing is lost by it.

    `inputs`: what the command reads, which is never written to; None is left out. `overwrite`: what exists may be
    replaced, unless a flow is writing it. `picture`: a picture of this kind, a name in PICTURES, may be replaced too.
    `folder`: the output is one, and what may be replaced is a folder of rosbag2.
    """
    found = _stat(path)
    require_no_input(path, inputs)
    if found is None:
        require_folder(path)
    elif _is_replaceable(path, found):
        _require_replaceable(path, found, overwrite=overwrite, picture=picture, folder=folder)
        require_folder(path)


def require_no_input(path: Path, inputs: Inputs) -> None:
    """Raise OutputError if `path` is one of the files that a command reads, by whatever name."""
    for source in inputs:
        if source is not None and _are_same(path, source):
            raise OutputError(f"{path}: is an input of this command; expected another name for the output")


def require_folder(path: Path) -> None:
    """Raise OutputError unless a new file can be made where `path` would be."""
    folder = _target(path).parent
    if not folder.is_dir():
        raise OutputError(f"{path}: cannot be written, there is no folder {folder}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written, no permission to write in the folder {folder}")


@overload
def whole(
    path: Path, *, inputs: Inputs = (), overwrite: bool = False, picture: str | None = None, folder: bool = False
) -> AbstractContextManager[Path]: ...
@overload
def whole(
    path: Path | None, *, inputs: Inputs = (), overwrite: bool = False, picture: str | None = None, folder: bool = False
) -> AbstractContextManager[Path | None]: ...
def whole(
    path: Path | None, *, inputs: Inputs = (), overwrite: bool = False, picture: str | None = None, folder: bool = False
) -> AbstractContextManager[Path | None]:
    """A path to write a file or folder to, which gets the name `path` when the `with` block has ended well.

    Until then it lies beside `path`, in a folder that only its owner can enter; when the block ends badly, by an error
    or a signal, nothing of it is left. Enter the block before the work that fills the file: the checks of
    `require_free` come first. A device or a pipe is written directly. None for no path at all.

    Raises OutputError, also for errors of the block's own that come of writing there.
    """
    if path is None:
        return nullcontext()
    require_free(path, inputs=inputs, overwrite=overwrite, picture=picture, folder=folder)
    found = _stat(path)
    if found is not None and not _is_replaceable(path, found):
        return nullcontext(path)
    return _beside(path, replace=found is not None)


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder for outputs where there is none; it goes again when nothing was written to it."""
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError:
        raise OutputError(f"{folder}: cannot be made, there is no folder {folder.parent}") from None
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error
    try:
        yield
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()


@contextmanager
def reserved(path: Path, *, inputs: Inputs = (), overwrite: bool = False) -> Iterator[None]:
    """Keep `path` for a recording of this process or its children, which is written in place while a flow runs.

    A new file is made at once, empty, and removed at the end if it still is. One that may be replaced keeps its
    content until the recording begins. No other command gets the file meanwhile. Raises OutputError.
    """
    require_free(path, inputs=inputs, overwrite=overwrite)
    found = _stat(path)
    if found is not None and not _is_replaceable(path, found):
        yield
        return
    target = _target(path)
    held = _opened_or_made(path, target, overwrite=overwrite)
    try:
        _require_unused(held, path)
        share_lock(held)
        yield
    finally:
        with suppress(FileNotFoundError):
            if os.fstat(held).st_size == 0 and os.path.samestat(os.fstat(held), target.stat()):
                target.unlink()  # nothing was recorded
        os.close(held)


def share_lock(descriptor: int) -> None:
    """Mark an open file as being written, for as long as it is open: `--overwrite` does not replace it."""
    with suppress(OSError):  # a file system without locks: the file's name alone protects it
        if CAN_LOCK:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)


def named_at(path: Path, now: datetime) -> Path:
    """`path` with `{time}` replaced by `now` in UTC, e.g. 20261130T140501Z; a number follows where that exists."""
    stamp = f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    for number in count(1):
        named = Path(str(path).replace(TIME, stamp if number == 1 else f"{stamp}-{number}"))
        if named == path or not os.path.lexists(named):
            return named
    raise AssertionError  # count() does not end


def _require_replaceable(
    path: Path, found: os.stat_result, *, overwrite: bool, picture: str | None, folder: bool
) -> None:
    if stat.S_ISDIR(found.st_mode) and not (folder and overwrite and _is_bag(path)):
        expected = "a new name, or --overwrite for a folder of rosbag2" if folder else "the name of a file"
        raise OutputError(f"{path}: is an existing folder; expected {expected}")
    if folder and not stat.S_ISDIR(found.st_mode):
        raise OutputError(f"{path}: is an existing file; expected the name of a new folder")
    if not overwrite and not (picture is not None and _is_picture(path, picture)):
        raise OutputError(f"{path}: already exists; use --overwrite to replace it")
    if not os.access(path, os.W_OK):
        raise OutputError(f"{path}: cannot be written, no permission")
    with suppress(PermissionError):  # it cannot be read, so it can hold no picture and no recording of ours
        held = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            _require_unused(held, path)
        finally:
            os.close(held)


def _require_unused(descriptor: int, path: Path) -> None:
    """Raise OutputError if a flow writes this file; else it is locked until the descriptor is closed or shares it."""
    if not CAN_LOCK:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(f"{path}: is being written by a running flow; expected another name") from None
    except OSError:
        return  # a file system without locks


def _opened_or_made(path: Path, target: Path, *, overwrite: bool) -> int:
    """A descriptor of `target`, as new or, if that may be replaced, as it is."""
    flags = os.O_RDWR | os.O_CLOEXEC
    try:
        try:
            return os.open(target, flags | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:  # also where another run was faster by a hair
            if overwrite:
                return os.open(target, flags)
            raise OutputError(f"{path}: already exists; use --overwrite to replace it") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


@contextmanager
def _beside(path: Path, *, replace: bool) -> Iterator[Path]:
    target = _target(path)
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{target.name[:SHORT_NAME]}.", dir=target.parent))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        fresh = folder / target.name
        with _told_of(path, fresh):
            yield fresh
            if fresh.is_dir():
                _publish_folder(fresh, target, replace=replace)
            elif fresh.exists():
                _publish_file(fresh, target, path, replace=replace)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _publish_file(fresh: Path, target: Path, path: Path, *, replace: bool) -> None:
    """Give a finished file its name; raises OutputError when another command has taken that meanwhile."""
    with fresh.open("rb") as file:
        os.fsync(file.fileno())
    if replace:
        require_free(path, overwrite=True)  # a flow may have begun to write it
        with suppress(FileNotFoundError):
            shutil.copymode(target, fresh)
        fresh.replace(target)
        return
    try:
        target.hardlink_to(fresh)  # unlike a rename, it never replaces
    except FileExistsError:
        raise OutputError(f"{path}: was made by another command meanwhile; that one is kept") from None
    except OSError:  # a file system without hard links, e.g. on a memory card
        require_free(path)
        fresh.rename(target)


def _publish_folder(fresh: Path, target: Path, *, replace: bool) -> None:
    """Give a finished folder its name; what it replaces goes with the folder that it was made in."""
    if replace:
        target.rename(fresh.with_name(f"{target.name[:SHORT_NAME]}.replaced"))
    fresh.rename(target)


@contextmanager
def _told_of(path: Path, fresh: Path) -> Iterator[None]:
    """Errors name the output as the user did, not the place that it is written at."""
    try:
        yield
    except CaneflowError as error:
        error.args = tuple(
            each.replace(str(fresh), str(path)) if isinstance(each, str) else each for each in error.args
        )
        raise
    except OSError as error:
        is_ours = error.errno in FULL if error.filename is None else str(error.filename).startswith(str(fresh))
        if not is_ours:
            raise
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _target(path: Path) -> Path:
    """The file behind `path`, which may be a link: the link stays."""
    return Path(os.path.realpath(path))


def _stat(path: Path) -> os.stat_result | None:
    """What is at `path`, behind links; None for nothing."""
    try:
        return path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _is_replaceable(path: Path, found: os.stat_result) -> bool:
    """Whether it holds data of its own: no device, pipe or stream of this process."""
    kind = found.st_mode
    return (stat.S_ISREG(kind) or stat.S_ISDIR(kind)) and not STREAMS.fullmatch(str(path.absolute()))


def _are_same(path: Path, source: Path) -> bool:
    """Whether both are one file with data, also through links; or will be."""
    try:
        kind = path.stat().st_mode
        return (stat.S_ISREG(kind) or stat.S_ISDIR(kind)) and path.samefile(source)
    except OSError:
        return _target(path) == _target(source)


def _is_picture(path: Path, kind: str) -> bool:
    try:
        with path.open("rb") as file:
            return PICTURES[kind].match(file.read(LOOKED_AT)) is not None
    except OSError:
        return False


def _is_bag(path: Path) -> bool:
    names = [each.name for each in path.iterdir()]
    return not names or ("metadata.yaml" in names and all(map(BAG.fullmatch, names)))
