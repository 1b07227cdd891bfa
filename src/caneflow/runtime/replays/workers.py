"""The same function on many things, in this process or in several that end when this one does."""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import connection, get_context, parent_process
from typing import TypeVar

Given = TypeVar("Given")
Made = TypeVar("Made")


def mapped(function: Callable[[Given], Made], items: Sequence[Given], jobs: int) -> Iterator[Made]:
    """`function` of each item, in their order; with `jobs` > 1 in as many processes, to which both are pickled.

    When the iteration is left early, what has not been started is not started any more.
    """
    if jobs == 1 or len(items) < 2:
        yield from map(function, items)
        return
    # spawn: a fork would copy threads and locks of numpy's and Zenoh's in whatever state they are
    with ProcessPoolExecutor(min(jobs, len(items)), get_context("spawn"), _end_with_parent) as pool:
        try:
            yield from pool.map(function, items)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """Let Ctrl-C end this process at once and in silence, and the death of its parent as well, however it died."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
