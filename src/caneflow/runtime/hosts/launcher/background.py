"""A run that goes on in the background: the command that started it ends as soon as nothing can be wrong any more."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

LONGEST = 4096  # bytes of the last word


class Background:
    """The run's end of the pipe to the command that waits for it."""

    def __init__(self, waiting: int) -> None:
        self._waiting = waiting

    def let_go(self, words: str) -> None:
        """Have the waiting command print `words` and end; what this process prints from now on, nobody sees."""
        if self._waiting < 0:
            return
        sys.stdout.flush()
        sys.stderr.flush()
        silence()
        with suppress(OSError):  # the command was killed: the run was wanted all the same
            os.write(self._waiting, words.encode()[:LONGEST])
        os.close(self._waiting)
        self._waiting = -1


def in_background() -> Background:
    """Go on in a process of its own, in a session of its own; to be called before there is any thread.

    Does not return in the process that calls it: that waits until the other one lets it go, or has ended, and ends with
    status 0 or that one's. Ctrl-C while it waits ends both.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        _wait(pid, reading)
    os.close(reading)
    os.setsid()
    with Path(os.devnull).open("rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    return Background(writing)


def silence() -> None:
    """Let what this process prints go nowhere; whoever reads its output is told of its end."""
    with Path(os.devnull).open("wb") as nothing:
        for descriptor in (1, 2):
            os.dup2(nothing.fileno(), descriptor)


def _wait(pid: int, reading: int) -> None:
    """Wait for the run's last word, print it and end; raises SystemExit."""
    try:
        words = os.read(reading, LONGEST)  # whole, as it is short
        if words:
            sys.stdout.write(f"{words.decode()}\n")
            sys.stdout.flush()
            raise SystemExit(0)
        _, status = os.waitpid(pid, 0)
    except KeyboardInterrupt:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)
        raise
    code = os.waitstatus_to_exitcode(status)
    raise SystemExit(code if code >= 0 else 128 - code)
