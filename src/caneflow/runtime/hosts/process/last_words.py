"""What a failing node tells its launcher of the failure: one line of its output, which the launcher shows its own way.

So a traceback is shown once and not at every restart, and the launcher knows whether a restart can help at all.
"""

import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import msgspec

from caneflow.errors import CaneflowError
from caneflow.runtime.wording import one_line

MARK = "\x02last words "  # no line for people begins like this
DEPTH = 20  # links of a chain of exceptions that are looked at


class LastWords(msgspec.Struct, frozen=True):
    """Why a node's process ends."""

    error: str  # for people
    place: str  # the kind of error and where it was raised: what was shown once for it need not be again
    traceback: tuple[str, ...] = ()  # lines for people; none for an expected error
    at: str | None = None  # the sample that the node was at; None: it had not begun
    lasting: bool = False  # a new start cannot mend it

    @property
    def lines(self) -> tuple[str, ...]:
        """All of it, for people."""
        return (*self.traceback, self.error)


class _Said(SystemExit):
    """The end of a process whose last words are said."""


@contextmanager
def telling_failures(*, building: bool = False, at: Callable[[], str | None] | None = None) -> Iterator[None]:
    """Tell the launcher what fails within the block, and end the process: status 2 for an expected error, else 1.

    `building`: nothing has been handled yet, so what is wrong will be wrong again. `at` says where the node is.
    """
    try:
        yield
    except _Said:
        raise
    except SystemExit as end:
        if at is not None:
            code = 0 if end.code is None else end.code
            error = f"SystemExit: {code}"
            _say(LastWords(error=error, place=error, at=at()))
        raise
    except BaseException as error:
        _say(words_of(error, building=building, at=at and at()))
        raise _Said(2 if isinstance(error, CaneflowError) else 1) from None


def words_of(error: BaseException, *, building: bool, at: str | None) -> LastWords:
    """What there is to say of an exception."""
    lasting = _stems_from(error, ImportError) or (
        building and isinstance(error, Exception) and not _stems_from(error, OSError)
    )
    if isinstance(error, CaneflowError):
        return LastWords(error=f"ERROR {one_line(str(error))}", place=str(error), at=at, lasting=lasting)
    lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
    name = "".join(traceback.format_exception_only(error)).strip()
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{type(error).__qualname__} {frames[-1].filename}:{frames[-1].lineno}" if frames else name
    shown = tuple(lines[: len(lines) - len(name.splitlines())])
    return LastWords(error=one_line(name), place=place, traceback=shown, at=at, lasting=lasting)


def heard(line: str) -> LastWords | None:
    """The last words in a line of a node's output; None for any other line."""
    _, mark, words = line.partition(MARK)
    if not mark:
        return None
    try:
        return msgspec.json.decode(words, type=LastWords)
    except msgspec.MsgspecError:
        return None


def _stems_from(error: BaseException, kind: type[BaseException]) -> bool:
    """Whether an error, or what caused it, is of a kind.

    ImportError: a package is missing, and will be the next time. OSError: the operating system refused something; a
    device or a disk may be there the next time.
    """
    cause: BaseException | None = error
    for _ in range(DEPTH):
        if isinstance(cause, kind):
            return True
        cause = cause.__cause__ if cause is not None else None
    return False


def _say(words: LastWords) -> None:
    with suppress(OSError, ValueError):  # the launcher is gone
        sys.stdout.flush()
        sys.stderr.flush()
        by_hand = sys.stderr.isatty()  # and not by a launcher
        text = "\n".join(words.lines) if by_hand else f"{MARK}{msgspec.json.encode(words).decode()}"
        os.write(sys.stderr.fileno(), f"{text}\n".encode())
