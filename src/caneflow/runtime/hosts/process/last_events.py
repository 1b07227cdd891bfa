"""The end of a process: what was on its way to it is still taken, and all that is due is handled, in bounded time.

A recorder ends later and has those samples: without a word of what became of them here its recording would not verify.
"""

import time
from collections.abc import Callable

QUIET = 0.05  # s without anything new, after which a live process has what its writers, which have ended, said last
PATIENCE = 0.25  # s for all of it: who is not ours may go on without end, and each process ends after its writers


def take_the_rest(
    take: Callable[[float], bool],
    handle: Callable[[], bool],
    *,
    replay: bool,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Take and handle until nothing comes and nothing is due.

    `take`: takes what comes within so many s, and says whether anything came; `handle`: handles what is due, and says
    whether more is. In a replay every stream has an end of its own, and nothing is waited for.
    """
    quiet, until = (0.0, clock()) if replay else (QUIET, clock() + PATIENCE)
    more = False
    while True:
        came = take(0.0 if more else quiet)
        more = handle()
        if not (came or more) or clock() >= until:
            return
