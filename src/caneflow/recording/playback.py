"""Plays a recording against the clock, for a viewer that plays, pauses, jumps and changes the speed."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from caneflow.recording.reader import Recorded, Recording

TICK = 0.05  # s between two times that are told while it plays
SLOWEST, FASTEST = 0.01, 100.0  # times real time


@dataclass(frozen=True)
class PlaybackState:
    """Where the playback is, and what it does."""

    playing: bool
    ended: bool
    speed: float  # times real time
    at: int  # ns


class Playback:
    """One recording that is played; `run` reads it on the thread that calls, `control` may come from any other.

    span: the first and the last stamp, ns.
    """

    def __init__(
        self,
        source: Recording,
        take: Callable[[Recorded], None],
        tell: Callable[[PlaybackState], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`take` gets each sample when it is due; `tell` the state, every TICK while it plays and at the end."""
        self.span = source.span() or (0, 0)
        self._source = source
        self._take = take
        self._tell = tell
        self._clock = clock
        self._changed = threading.Condition()
        self._state = PlaybackState(playing=False, ended=False, speed=1.0, at=self.span[0])
        self._since = clock()  # s: when the state was as it says
        self._jumps = 0  # how often the reading had to begin elsewhere
        self._begin = self.span[0]  # ns: where it did so last
        self._next_tick = 0.0
        self._closed = False

    def control(self, *, playing: bool, speed: float, at: int | None = None) -> PlaybackState:
        """Play or pause, at a speed that is kept within its bounds; `at`: jump to this time (ns). The new state."""
        first, last = self.span
        with self._changed:
            was = self._now()
            if at is None and playing and was.ended:
                at = first
            place = was.at if at is None else min(max(at, first), last)
            bounded = min(max(speed, SLOWEST), FASTEST) if speed == speed else was.speed  # NaN is not a speed
            ended = was.ended and at is None
            self._state = PlaybackState(playing=playing and not ended, ended=ended, speed=bounded, at=place)
            self._since = self._clock()
            if at is not None:
                self._jumps += 1
                self._begin = place
            self._changed.notify_all()
            return self._state

    def state(self) -> PlaybackState:
        """The state now."""
        with self._changed:
            return self._now()

    def run(self) -> None:
        """Hand out samples as the state says, until `close`; raises RecordingError for a damaged file."""
        while True:
            with self._changed:
                if self._closed:
                    return
                jumps, start = self._jumps, self._begin
            for sample in self._source.samples(start_ns=start):
                if not self._is_due(sample.stamp, jumps):
                    break
                self._take(sample)
            else:
                self._rest_at_the_end(jumps)

    def close(self) -> None:
        """Let `run` return."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _now(self) -> PlaybackState:
        state = self._state
        if not state.playing:
            return state
        passed = round((self._clock() - self._since) * state.speed * 1e9)
        return replace(state, at=min(state.at + passed, self.span[1]))

    def _is_due(self, stamp: int, jumps: int) -> bool:
        """Wait until the sample with `stamp` is due; False: the reading has to begin elsewhere."""
        while True:
            with self._changed:
                if self._closed or self._jumps != jumps:
                    return False
                now = self._now()
                if now.playing and now.at >= stamp:
                    return True
                ahead = (stamp - now.at) / 1e9 / now.speed
                self._changed.wait(min(ahead, TICK) if now.playing else None)
                told = self._now() if self._clock() >= self._next_tick else None
            if told is not None and told.playing:
                self._next_tick = self._clock() + TICK
                self._tell(told)

    def _rest_at_the_end(self, jumps: int) -> None:
        with self._changed:
            if self._jumps != jumps:
                return
            self._state = PlaybackState(playing=False, ended=True, speed=self._state.speed, at=self.span[1])
            ended = self._state
        self._tell(ended)
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._jumps != jumps)
