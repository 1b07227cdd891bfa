"""Ends the processes of a flow when its launcher dies, however it dies. Standard library only.

The launcher writes `+PGID` for each process group that it starts and `-PGID` for each that has ended. When the
pipe closes, what is left is killed: a launcher that ends in good order has taken back every group before.
"""

import contextlib
import os
import signal
import sys


def main() -> None:
    """Follow the launcher's lines until it is gone, then kill what it left."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    groups: set[int] = set()
    for line in sys.stdin:
        group = int(line[1:])
        (groups.add if line[0] == "+" else groups.discard)(group)
    for group in groups:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(group, signal.SIGKILL)


if __name__ == "__main__":
    main()
