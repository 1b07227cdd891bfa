"""What a cue sounds like: distance as repetition, level as pitch, side as level and time difference of the two ears.

At most these three dimensions are told at once, as WatchOut found with 61 blind users. Integers from the tables on: the
blocks are the same however they are cut, so a file of them is a pure function of cues and stamps.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Sound: TypeAlias = NDArray[np.int16]  # shape (frames, 2): left, right

RATE: Final = 48_000  # Hz
PITCHES: Final[Mapping[str, float]] = {"low": 330.0, "waist": 660.0, "head": 1320.0}  # Hz: an octave per level
NEAREST, SHORTEST = 0.5, 0.12  # m and nearer, s from one tone to the next
FARTHEST, LONGEST = 3.0, 0.95  # m and farther, s
TONE: Final = 0.03  # s: with 0.07 a corridor sounds for 12 to 15 % of the time, with this for 8 to 9 %
DROP_PITCH: Final = 220.0  # Hz, from where a drop falls by an octave
DROP_TONE: Final = 0.2  # s
DROP_SHORTEST: Final = 0.3  # s from one falling tone to the next: they must not run into each other
BLIND_PITCH: Final = 150.0  # Hz, twice
BLIND_TONE: Final = 0.16  # s
BLIND_EVERY: Final = 10.0  # s
TICK: Final = 0.008  # s
TICK_PITCH: Final = 2000.0  # Hz
TICK_LOUDNESS: Final = 0.12  # of a tone's
ATTACK: Final = 0.003  # s
DECAY: Final = 4.0  # time constants in a tone
LONGEST_SILENCE: Final = 0.5  # s without a cue, which is as good as blind
EARS: Final = 0.0006  # s, the largest difference of arrival between the ears
WIDEST: Final = math.radians(60)  # rad, azimuth at which one side is silent
GAIN: Final = 1 << 14  # 1.0 of a gain
LOUDEST: Final = 0.7 * 32767  # of int16, at volume 1: two sounds that meet are clipped only when both are at their peak


@dataclass(frozen=True, kw_only=True)
class HearingSettings:
    """What one user wants to hear."""

    volume: float = 0.5  # 0..1
    reach: float = 3.0  # m, beyond which nothing sounds
    levels: frozenset[str] = frozenset({"low", "waist", "head", "drop"})  # that sound
    tick: float = 5.0  # s of silence after which a soft tick says that all is well; 0: never


def interval(distance: float) -> float:
    """Seconds from one tone to the next for something `distance` m ahead."""
    share = (min(max(distance, NEAREST), FARTHEST) - NEAREST) / (FARTHEST - NEAREST)
    return SHORTEST + share * (LONGEST - SHORTEST)


class Sonification:
    """Sounds as cues come; whoever calls says how much time passes between them, in frames of RATE."""

    def __init__(self, settings: HearingSettings) -> None:
        self._settings = settings
        self._tones = {level: _tone(pitch, TONE) for level, pitch in PITCHES.items()}
        self._tones["drop"] = _falling(DROP_PITCH, DROP_TONE)
        self._blind = _twice(_tone(BLIND_PITCH, BLIND_TONE, harmonics=3), gap=0.08)
        self._tick = np.rint(_tone(TICK_PITCH, TICK) * TICK_LOUDNESS).astype(np.int32)
        self._gain = round(settings.volume * GAIN)
        self._now = 0  # frames rendered
        self._heard = 0  # when the last cue came
        self._started: int | None = None  # when the last sound began; None: the next one does at once
        self._state = "none"  # a level, "none" or "blind"
        self._distance = 0.0  # m
        self._azimuth = 0.0  # rad
        self._playing: list[tuple[int, NDArray[np.int32]]] = []  # when it began, (frames, 2)
        self.first_tone: int | None = None  # the frame at which the first tone of what is told now began

    def tell(self, kind: str, level: str | None, distance: float, azimuth: float) -> None:
        """Take a cue, from the next frame on; `distance` in m, `azimuth` in rad, left positive."""
        self._heard = self._now
        wanted = level is not None and level in self._settings.levels and distance <= self._settings.reach
        state = "blind" if kind == "blind" else str(level) if wanted else "none"
        self._distance, self._azimuth = distance, azimuth
        self._change(state)

    def render(self, frames: int) -> Sound:
        """The next frames: shape (frames, 2) int16."""
        block = np.zeros((frames, 2), np.int32)
        begin, end = self._now, self._now + frames
        while (at := max(self._due(), self._now)) < end:
            self._now = at
            if self._state != "blind" and at >= self._heard + round(LONGEST_SILENCE * RATE):
                self._change("blind")  # silence of the graph never passes for a free way
                continue
            self._begin(at)
        self._now = end
        for started, sound in self._playing:
            first, last = max(started, begin), min(started + len(sound), end)
            if first < last:
                block[first - begin : last - begin] += sound[first - started : last - started]
        self._playing = [each for each in self._playing if each[0] + len(each[1]) > end]
        return np.clip(block, -32768, 32767).astype(np.int16)

    def _change(self, state: str) -> None:
        if state == self._state:
            return
        if state in ("blind", "drop") or self._state in ("none", "blind"):
            self._started = None if state != "none" else self._started  # what begins is heard at once
        self._state = state
        self.first_tone = None

    def _due(self) -> int:
        """When something happens next: a sound begins, or the cues have been missing for too long."""
        missing = self._heard + round(LONGEST_SILENCE * RATE)
        if self._state == "none":
            pause = self._settings.tick or math.inf
        elif self._state == "blind":
            pause = BLIND_EVERY
        else:
            pause = interval(self._distance)
            pause = max(pause, DROP_SHORTEST) if self._state == "drop" else pause
        if self._started is None:
            sound = self._now if self._state != "none" or self._settings.tick else missing
        else:
            sound = missing if pause == math.inf else self._started + round(pause * RATE)
        return sound if self._state == "blind" else min(sound, missing)

    def _begin(self, at: int) -> None:
        self._started = at
        if self._state == "blind":
            sound = _placed(self._blind, 0.0, self._gain)
        elif self._state == "none":
            sound = _placed(self._tick, 0.0, self._gain)
        else:
            sound = _placed(self._tones[self._state], self._azimuth, self._gain)
            self.first_tone = at if self.first_tone is None else self.first_tone
        self._playing.append((at, sound))


def _tone(pitch: float, seconds: float, harmonics: int = 1) -> NDArray[np.int32]:
    """A percussive tone: a short attack, then a decay. Harmonics carry a low one through a small loudspeaker."""
    time = np.arange(round(seconds * RATE)) / RATE
    wave = sum(
        (np.sin(2 * math.pi * k * pitch * time) / k for k in range(2, harmonics + 1)), np.sin(math.tau * pitch * time)
    )
    return _shaped(wave, time, seconds)


def _falling(pitch: float, seconds: float) -> NDArray[np.int32]:
    """A tone that falls by an octave, with two harmonics."""
    time = np.arange(round(seconds * RATE)) / RATE
    phase = math.tau * pitch * seconds / math.log(2) * (1 - np.exp2(-time / seconds))
    return _shaped(np.sin(phase) + np.sin(2 * phase) / 2 + np.sin(3 * phase) / 3, time, seconds)


def _shaped(wave: NDArray[np.float64], time: NDArray[np.float64], seconds: float) -> NDArray[np.int32]:
    attack, release = np.minimum(time / ATTACK, 1.0), np.minimum((seconds - time) / ATTACK, 1.0)
    shaped = wave * attack * release * np.exp(-DECAY * time / seconds)
    found: NDArray[np.int32] = np.rint(LOUDEST * shaped / np.abs(shaped).max()).astype(np.int32)
    return found


def _twice(tone: NDArray[np.int32], gap: float) -> NDArray[np.int32]:
    return np.concatenate([tone, np.zeros(round(gap * RATE), np.int32), tone])


def _placed(tone: NDArray[np.int32], azimuth: float, gain: int) -> NDArray[np.int32]:
    """The tone in two ears, (frames, 2): equal power, and the far ear later."""
    share = min(max(azimuth / WIDEST, -1.0), 1.0)  # 1: all left
    late = round(EARS * RATE * abs(math.sin(min(max(azimuth, -math.pi / 2), math.pi / 2))))
    angle = (1.0 - share) * math.pi / 4
    placed = np.zeros((len(tone) + late, 2), np.int64)
    for ear, loudness, is_far in ((0, math.cos(angle), azimuth < 0), (1, math.sin(angle), azimuth > 0)):
        begin = late if is_far else 0
        placed[begin : begin + len(tone), ear] = tone.astype(np.int64) * round(loudness * gain) // GAIN
    return placed.astype(np.int32)
