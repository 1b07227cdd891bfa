"""Standard output and error of a command, whose reader may go before the command ends: `| head`, a closed terminal."""

import atexit
import errno
import io
import sys
from typing import Any, TextIO

GONE = (errno.EPIPE, errno.EIO)  # the reader of a pipe, the other end of a terminal


def outlive_readers(*, end: bool) -> None:
    """From now on, what nobody reads is left out, and the work goes on; `end`: the program ends there, quietly.

    To be called before anything holds on to `sys.stdout` or `sys.stderr`.
    """
    sys.stdout = _wrapped(sys.stdout, end=end)
    sys.stderr = _wrapped(sys.stderr, end=False)


class _Output(io.FileIO):
    """A descriptor that takes everything, also when nobody reads it any more."""

    def __init__(self, descriptor: int, *, end: bool) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self._end = end
        atexit.register(self._end_no_more)  # the interpreter's last flush comes later, and takes no exception

    def _end_no_more(self) -> None:
        self._end = False

    def write(self, data: Any, /) -> int:
        """Write what someone reads; raises SystemExit the first time that nobody does, if that is the end."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in GONE:
                raise
            if self._end:
                self._end_no_more()
                raise SystemExit(0) from None
            return memoryview(data).nbytes


def _wrapped(stream: TextIO, *, end: bool) -> TextIO:
    own = stream in (sys.__stdout__, sys.__stderr__)  # and not in the hands of a test
    if not (own and isinstance(stream, io.TextIOWrapper)):  # None: closed from the start
        return stream
    stream.flush()
    binary = io.BufferedWriter(_Output(stream.fileno(), end=end))
    return io.TextIOWrapper(
        binary, stream.encoding, stream.errors, line_buffering=stream.line_buffering, write_through=stream.write_through
    )
