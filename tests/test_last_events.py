"""The end of a process: what comes late is taken, what is due is handled, and neither goes on without end."""

from collections.abc import Iterator

from caneflow.runtime.hosts.process.last_events import PATIENCE, QUIET, take_the_rest


class Ending:
    """A process at its end, with a clock that only waiting and working move."""

    def __init__(self, *, comes_at: list[float], takes: float = 0.0, at_a_time: int = 100) -> None:
        """`comes_at`: when (s) samples come; each `takes` so long (s), and no more are handled at a time."""
        self.now = 0.0
        self.coming = sorted(comes_at)
        self.waiting = 0
        self.handled = 0
        self._takes, self._at_a_time = takes, at_a_time

    def clock(self) -> float:
        return self.now

    def take(self, timeout: float) -> bool:
        """What a process's events do: wait for the first, then take all that has come."""
        if not self.coming or self.coming[0] > self.now + timeout:
            self.now += timeout
            return False
        self.now = max(self.now, self.coming[0])
        came = [at for at in self.coming if at <= self.now]
        del self.coming[: len(came)]
        self.waiting += len(came)
        return True

    def handle(self) -> bool:
        count = min(self.waiting, self._at_a_time)
        self.waiting -= count
        self.handled += count
        self.now += count * self._takes
        return self.waiting > 0

    def end(self, *, replay: bool = False) -> None:
        take_the_rest(self.take, self.handle, replay=replay, clock=self.clock)


def test_what_its_writer_said_last_and_is_on_its_way_is_handled() -> None:
    ending = Ending(comes_at=[0.9 * QUIET, 1.7 * QUIET])
    ending.end()
    assert ending.handled == 2
    assert ending.now == 2.7 * QUIET  # and then nothing came


def test_a_backlog_is_handled_though_not_all_at_a_time() -> None:
    ending = Ending(comes_at=[0.0] * 10, at_a_time=3)
    ending.end()
    assert (ending.handled, ending.waiting) == (10, 0)


def test_a_writer_that_does_not_end_holds_no_process_up() -> None:
    ending = Ending(comes_at=list(_every(0.01, 10.0)))
    ending.end()
    assert PATIENCE <= ending.now <= PATIENCE + QUIET


def test_nor_does_a_backlog_that_takes_long() -> None:
    ending = Ending(comes_at=[0.0] * 1000, takes=0.02, at_a_time=5)
    ending.end()
    assert PATIENCE <= ending.now <= PATIENCE + 5 * 0.02


def test_a_replay_takes_what_is_there_and_waits_for_nothing() -> None:
    ending = Ending(comes_at=[0.0, 0.5 * QUIET])
    ending.end(replay=True)
    assert (ending.handled, ending.now) == (1, 0.0)


def _every(period: float, until: float) -> Iterator[float]:
    for each in range(round(until / period)):
        yield each * period
