"""The same function on many things: in this process, in several that end when this one does, or on a Dask cluster."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process
from typing import TypeVar

from caneflow.errors import not_installed
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.wording import one_line

Given = TypeVar("Given")
Made = TypeVar("Made")


def mapped(function: Callable[[Given], Made], items: Sequence[Given], jobs: int) -> Iterator[Made]:
    """`function` of each item, in their order; with `jobs` > 1 in as many processes, to which both are pickled.

    When the iteration is left early, the processes end at once.
    """
    if jobs == 1 or len(items) < 2:
        yield from map(function, items)
        return
    # spawn: a fork would copy threads and locks of numpy's and Zenoh's in whatever state they are
    spawn = get_context("spawn")
    end, ender = spawn.Pipe(duplex=False)
    with (
        end,
        ender,
        ProcessPoolExecutor(min(jobs, len(items)), spawn, initializer=_end_with_parent, initargs=(end,)) as pool,
    ):
        try:
            with _signals_wait():  # also in the workers, from their first instruction on: they end with their parent
                futures = deque(pool.submit(function, item) for item in items)  # starts them
            while futures:
                yield futures.popleft().result()
        except BaseException:
            ender.close()  # the workers hear of it and end; a future that was cancelled would confuse the pool then
            raise


def mapped_on_cluster(
    function: Callable[[Given], Made], items: Sequence[Given], scheduler: str, timeout: float = 10.0
) -> Iterator[Made]:
    """The same on the workers of an existing Dask cluster, `scheduler` being its address.

    The workers need caneflow and see the same files under the same paths. When the iteration is left early, what has
    not been started is cancelled. Raises DataflowError when nobody answers within `timeout` s.
    """
    try:
        from distributed import Client  # an extra, and slow to import
    except ImportError:
        raise DataflowError(f"--scheduler: {not_installed('distributed', 'cluster')}") from None
    try:
        client = Client(scheduler, timeout=timeout, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise DataflowError(f"no Dask scheduler at {scheduler}: {one_line(error)}") from error
    with client:
        # pure=False: the same recording may have changed since; retries: a worker may be taken away.
        futures = client.map(function, items, pure=False, retries=2)
        try:
            for index in range(len(futures)):
                made: Made = futures[index].result()
                futures[index].release()  # type: ignore[no-untyped-call]
                yield made
        except BaseException:
            client.cancel(futures, force=True)  # type: ignore[no-untyped-call]
            raise


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Inside, Ctrl-C waits until the end; processes that are started inside never hear of it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent(end: connection.Connection) -> None:
    """Let this process end at once and in silence when its parent says so or dies, however it died."""
    threading.Thread(target=_follow_parent, args=(end,), daemon=True).start()


def _follow_parent(end: connection.Connection) -> None:
    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel, end])
    os._exit(1)
