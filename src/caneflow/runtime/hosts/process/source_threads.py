"""The sources of a process that others share, each on a thread of its own."""

import logging
import signal
import threading
import time
from collections.abc import Callable, Mapping
from typing import Protocol

from caneflow.messages import Sample
from caneflow.runtime.hosts.process.last_words import words_of
from caneflow.runtime.hosts.process.speaker import SPEAKER
from caneflow.runtime.program import Encoded, Quiet, Source
from caneflow.runtime.stages.merge import BEGIN, END

log = logging.getLogger(__name__)

SOURCES_END = signal.SIGUSR1  # the launcher's word that the sources of a group are to end, and all else goes on
ENDING = 1.0  # s that sources have to end: they say something about twice a second, if only that nothing comes
LOOK_PERIOD = 0.05  # s between two looks at whether there is room again


class Taker(Protocol):
    """Who takes what sources bring."""

    def bring(self, node: str, port: str, sample: Sample | Encoded) -> None:
        """Take a sample."""

    def nothing_until(self, node: str, stamp: int) -> None:
        """Hear that no sample with a stamp (ns) at or before this will come."""

    def has_room(self, node: str) -> bool:
        """Whether more may be brought."""

    def source_ended(self, node: str) -> None:
        """Hear that nothing more will come."""

    def break_down(self, error: BaseException) -> None:
        """Hear what a source has raised."""


class SourceThreads:
    """All sources of one process; they begin when the launcher says so."""

    def __init__(self, sources: Mapping[str, Source], taker: Taker, lock: threading.RLock, *, replay: bool) -> None:
        """`lock`: the process's, under which samples are taken."""
        self._taker = taker
        self._changed = threading.Condition(lock)
        self._started = False
        self.stopping = False  # they are to end
        self._left: set[str] = set()  # those that did not end
        self._until = BEGIN if replay else END  # how far a replay may send
        self._threads = [
            threading.Thread(target=self._run, args=(name, source), name=name, daemon=True)
            for name, source in sources.items()
        ]

    def begin(self) -> None:
        """Let them wait for the launcher's word."""
        for thread in self._threads:
            thread.start()

    def start(self) -> None:
        """Take the launcher's word that every node is ready; with the lock held."""
        self._started = True
        self._changed.notify_all()

    def open(self, until: int) -> None:
        """Let them send up to a stamp (ns); with the lock held."""
        self._until = max(self._until, until)
        self._changed.notify_all()

    def stop(self) -> None:
        """Let them end, and wait for that; without the lock."""
        self.stopping = True
        with self._changed:
            self._changed.notify_all()
        until = time.monotonic() + ENDING
        for thread in self._threads:
            if thread.ident is not None and thread is not threading.current_thread():
                thread.join(max(0.0, until - time.monotonic()))
                if thread.is_alive() and thread.name not in self._left:
                    self._left.add(thread.name)
                    log.warning("%s: its source said nothing for %g s and is left behind", thread.name, ENDING)

    def stop_and(self, then: Callable[[], None]) -> None:
        """Let them end, on a thread of its own that does `then` when they have."""

        def end() -> None:
            self.stop()
            then()

        threading.Thread(target=end, name="ending", daemon=True).start()

    def _run(self, name: str, source: Source) -> None:
        SPEAKER.node = name
        try:
            self._wait_for(lambda: self._started)
            self._bring_all(name, source)
            if not self.stopping:
                self._taker.source_ended(name)
        except BaseException as error:
            if not self.stopping:
                self._taker.break_down(error)
                return
            SPEAKER.node = name
            for line in words_of(error, building=False, at=None).lines:  # nobody else hears of it any more
                log.error("at its end: %s", line)

    def _bring_all(self, name: str, source: Source) -> None:
        samples = source.samples()
        try:
            for item in samples:
                if self.stopping:
                    return
                if isinstance(item, Quiet):
                    self._taker.nothing_until(name, item.until)
                    continue
                port, sample = item
                if sample.stamp > self._until:
                    self._taker.nothing_until(name, sample.stamp - 1)
                    self._wait_for(lambda: sample.stamp <= self._until)  # noqa: B023 - it is over before the next one
                self._wait_for_room(name)
                self._taker.bring(name, port, sample)
                SPEAKER.node = name
        finally:
            samples.close()

    def _wait_for_room(self, name: str) -> None:
        while not self.stopping:
            if self._taker.has_room(name):
                return
            self._wait_for(lambda: False, LOOK_PERIOD)

    def _wait_for(self, condition: Callable[[], bool], timeout: float | None = None) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self.stopping or condition(), timeout)
