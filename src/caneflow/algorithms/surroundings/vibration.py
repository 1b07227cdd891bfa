"""What a cue feels like: distance as repetition, as in sound; what it is by the pulses of each repetition.

Time is handed in, and nothing is kept but when the pulses began: so what is felt at a time is a function of the cues.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from caneflow.algorithms.surroundings.sonification import BLIND_EVERY, LONGEST_SILENCE, interval

SECOND: Final = 1_000_000_000  # ns


class Pulse(NamedTuple):
    """One pulse of the motor."""

    begin: float  # s from the begin of a pattern
    length: float  # s: a small motor takes 30 to 50 ms to start, so none is shorter than 60 ms
    strength: float  # 0..1, of the most that the user wants


PATTERNS: Final[Mapping[str, Sequence[Pulse]]] = {
    "low": (Pulse(0.0, 0.09, 0.6),),
    "waist": (Pulse(0.0, 0.06, 0.8),),
    "head": (Pulse(0.0, 0.06, 1.0), Pulse(0.1, 0.06, 1.0)),  # two short ones
    "drop": (Pulse(0.0, 0.3, 1.0),),  # one that hardly ends before the next
    "blind": (Pulse(0.0, 0.4, 0.5), Pulse(0.55, 0.4, 0.5)),  # two long and weak ones, then a long pause
    "none": (Pulse(0.0, 0.06, 0.25),),  # a faint tick: it runs
}
SHORTEST_PAUSE: Final = 0.09  # s without a pulse after each pattern: what never ends is not felt any more


_TICK_NS: Final = round(PATTERNS["none"][-1].length * SECOND)


@dataclass(frozen=True, kw_only=True)
class FeelingSettings:
    """What one user wants to feel."""

    strength: float = 0.5  # 0..1
    reach: float = 3.0  # m, beyond which nothing is told
    levels: frozenset[str] = frozenset({"low", "waist", "head", "drop"})
    tick: float = 5.0  # s of silence after which a faint tick says that it runs; 0: never


class Vibration:
    """How strong the motor is to be driven, as cues come."""

    def __init__(self, settings: FeelingSettings, now_ns: int) -> None:
        self._settings = settings
        self._state = "none"
        self._distance = 0.0  # m
        self._heard_ns = now_ns  # the last cue
        self._began_ns = now_ns - _TICK_NS  # the last pattern

    def tell(self, now_ns: int, kind: str, level: str | None, distance: float) -> None:
        """Take a cue; `distance` in m."""
        self._heard_ns = now_ns
        wanted = level is not None and level in self._settings.levels and distance <= self._settings.reach
        self._distance = distance
        self._change("blind" if kind == "blind" else str(level) if wanted else "none", now_ns)

    def strength(self, now_ns: int) -> float:
        """0..1: how strong the motor runs at `now_ns`, which never goes back."""
        silent_from = self._heard_ns + round(LONGEST_SILENCE * SECOND)
        if self._state != "blind" and now_ns >= silent_from:
            self._change("blind", silent_from)  # silence of the graph never passes for a free way
        pause_ns = round(self._pause() * SECOND)
        if not pause_ns:
            return 0.0
        since_ns = now_ns - self._began_ns
        if since_ns >= pause_ns:
            self._began_ns += since_ns // pause_ns * pause_ns
            since_ns %= pause_ns
        since = since_ns / SECOND
        share = max((p.strength for p in PATTERNS[self._state] if p.begin <= since < p.begin + p.length), default=0.0)
        return share * self._settings.strength

    def _change(self, state: str, now_ns: int) -> None:
        if state == self._state:
            return
        if state == "none":  # a tick waits for its pause
            self._began_ns = now_ns - _TICK_NS
        elif state in ("blind", "drop") or self._state in ("none", "blind"):
            self._began_ns = now_ns  # what begins to be told is felt at once
        self._state = state

    def _pause(self) -> float:
        """Seconds from one pattern's begin to the next; 0: there is none."""
        if self._state == "none":
            return self._settings.tick
        if self._state == "blind":
            return BLIND_EVERY
        last = PATTERNS[self._state][-1]
        return max(interval(self._distance), last.begin + last.length + SHORTEST_PAUSE)
