"""Ctrl-C, SIGTERM and SIGHUP: before the work they end the program at once, later as an exception that undoes it.

Imports little: what comes before `end_at_once` is the time in which Ctrl-C still prints a traceback.
"""

import atexit
import math
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

INTERRUPTED_STATUS = 130  # 128 + SIGINT, as a shell reports Ctrl-C
NUMBERS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
CAN_HOLD = hasattr(signal, "pthread_sigmask")  # Windows has neither this nor SIGHUP
PATIENCE = 2.0  # s that undoing may take; a further signal in that time is the same wish, said twice


class _Taken:
    """What the handler knows; there is one, as a process has one handler."""

    working = False
    number: int | None = None  # the signal that ended the work
    at = 0.0  # s, monotonic


def hold() -> None:
    """Let signals wait until `end_at_once`, also in a program that takes the place of this one."""
    if CAN_HOLD:
        signal.pthread_sigmask(signal.SIG_BLOCK, NUMBERS)


def end_at_once() -> None:
    """From now on a signal ends this program, silently: there is nothing yet to be undone."""
    _Taken.working, _Taken.number = False, None
    for number in NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, or a shell's job in the background
            signal.signal(number, _take)
    if CAN_HOLD:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, NUMBERS)


def begin_work() -> None:
    """From now on a signal is a KeyboardInterrupt."""
    _Taken.working = True


@contextmanager
def handled() -> Iterator[None]:
    """Inside, signals are handled as above. What SIGTERM or SIGHUP has ended, ends as if that had not been handled."""
    before = {number: signal.getsignal(number) for number in NUMBERS}
    try:
        end_at_once()
    except ValueError:  # not the main thread, and signals are none of its business
        yield
        return
    try:
        yield
    except SystemExit as end:
        number = _Taken.number
        if number is not None:
            _Taken.at = math.inf  # everything is undone: another signal changes nothing
            atexit._run_exitfuncs()
            _end_by(number, end.code if isinstance(end.code, int) else int(end.code is not None))
        raise
    finally:
        _Taken.working, _Taken.number = False, None
        for each, handler in before.items():
            signal.signal(each, handler)


def _take(number: int, frame: FrameType | None) -> None:
    if not _Taken.working:
        _end_by(number)
    if _Taken.number is None or time.monotonic() > _Taken.at + PATIENCE:
        _Taken.number, _Taken.at = number, time.monotonic()
        raise KeyboardInterrupt


def _end_by(number: int, status: int = INTERRUPTED_STATUS) -> NoReturn:
    """End this process as the signal would; after Ctrl-C with `status`."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, RuntimeError):  # closed, or in the middle of a write
            stream.flush()
    if number != signal.SIGINT:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(status)
