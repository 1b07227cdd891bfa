"""Ends the processes of a flow when its launcher dies, however it dies. Standard library only.

The launcher holds the other end of this process's standard input. When it closes, whatever carries a path of the
run's own folder on its command line, as every node does, is killed with its process group. A launcher that ends in
good order has ended its nodes before.
"""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROUNDS = 10  # looks, since a node may just be starting when its launcher dies
PAUSE = 0.1  # s between them


def main() -> None:
    """Wait for the launcher's end, then kill what it left."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    folder = os.fsencode(sys.argv[1]) + b"/"
    sys.stdin.buffer.read()
    for _ in range(ROUNDS if Path(sys.argv[1]).exists() else 0):  # the folder of a run that ended in order is gone
        for group in set(groups_of(folder)):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(group, signal.SIGKILL)
        time.sleep(PAUSE)


def groups_of(folder: bytes) -> Iterator[int]:
    """The process groups of those whose command line has a path in `folder`."""
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it may end while it is looked at
            arguments = (process / "cmdline").read_bytes().split(b"\0")
            if any(argument.startswith(folder) for argument in arguments):
                yield os.getpgid(int(process.name))


if __name__ == "__main__":
    main()
