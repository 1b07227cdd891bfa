"""What is said of a cue, in words: few changes, since each one interrupts what the user was hearing."""

import math
from typing import Final

NAMES: Final = {"low": "Low", "waist": "Waist high", "head": "Head high", "drop": "Drop"}
CLEAR: Final = "Clear"
BLIND: Final = "Not seeing"
AHEAD: Final = math.radians(10)  # rad to each side
SETTLED_NS: Final = 400_000_000  # ns that another level must last; a drop is said at once
CLEAR_NS: Final = 1_500_000_000  # ns without anything until the way is called clear
HALF: Final = 0.5  # of the distance that was said: then it is said again
FARTHER: Final = 1.5  # times that: something behind it, from whose distance the next half is counted


class CueTexts:
    """Decides when the text changes: another kind or level that lasts, or half the distance."""

    def __init__(self, reach: float = math.inf, levels: frozenset[str] = frozenset(NAMES)) -> None:
        """Nothing beyond `reach` (m), or of another level, is said."""
        self._reach = reach
        self._levels = levels
        self._said = ""  # what the text is about: a level, "none" or "blind"
        self._distance = math.inf  # m, that was said last
        self._candidate = ""
        self._candidate_ns = 0  # since when
        self.text = ""

    def update(self, stamp_ns: int, kind: str, level: str | None, distance: float, azimuth: float, reason: str) -> bool:
        """Take a cue; whether `text` has changed. `distance` in m, `azimuth` in rad, left positive."""
        about = level if level in self._levels and distance <= self._reach else "none"
        about = "blind" if kind == "blind" else about or "none"
        if about != self._candidate:
            self._candidate, self._candidate_ns = about, stamp_ns
        if about == self._said:
            return about in NAMES and self._is_nearer(about, distance, azimuth)
        if stamp_ns - self._candidate_ns < self._patience_ns(about):
            return False
        self._said, self._distance = about, distance
        self.text = (
            f"{BLIND}: {reason}" if about == "blind" else CLEAR if about == "none" else worded(about, distance, azimuth)
        )
        return True

    def _patience_ns(self, about: str) -> int:
        """How long (ns) it must last before it is said."""
        if about in ("blind", "drop") or self._said in ("", "blind"):
            return 0
        return CLEAR_NS if about == "none" else SETTLED_NS if self._said in NAMES else 0

    def _is_nearer(self, about: str, distance: float, azimuth: float) -> bool:
        if distance > FARTHER * self._distance:
            self._distance = distance
        if distance > HALF * self._distance:
            return False
        self._distance = distance
        self.text = worded(about, distance, azimuth)
        return True


def worded(level: str, distance: float, azimuth: float) -> str:
    """For example `Head high, 1.5 metres, left`; distances to half a metre, below one to a tenth."""
    rounded = round(distance, 1) if distance < 1 else round(2 * distance) / 2
    side = "ahead" if abs(azimuth) < AHEAD else "left" if azimuth > 0 else "right"
    return f"{NAMES[level]}, {rounded:g} {'metre' if rounded == 1 else 'metres'}, {side}"
