"""Cues as sound: live on a sound device, in a replay into a WAV file; in words through espeak-ng where it is installed.

in   cue : Cue

The file is a pure function of the cues and their stamps: the same bytes on every host, and after kills.
"""

import contextlib
import logging
import math
import os
import struct
import threading
import time
import wave
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from annotated_types import Ge, Le

from caneflow.algorithms.surroundings.cue_texts import CueTexts
from caneflow.algorithms.surroundings.sonification import RATE, HearingSettings, Sonification, Sound
from caneflow.errors import not_installed
from caneflow.messages import Cue, MessageError, Sample, decode
from caneflow.messages.rig import Guidance, User
from caneflow.outputs import require_free
from caneflow.runtime import Context, Sink
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run
from caneflow.runtime.speech import Speech

log = logging.getLogger(__name__)

BLOCK: Final = 480  # frames that the device asks for at a time: 10 ms
REPORT_PERIOD: Final = 10.0  # s
RETRY: Final = 0.5  # s between two attempts to open a device that is gone
MOST_LATENCIES: Final = 1000  # tones whose latency is remembered
LONGEST_FILE: Final = 4 * 3600  # s; beyond, a WAV file would outgrow its head
LENGTH: Final = struct.Struct("<I")  # before each cue in the log
TAIL: Final = RATE // 2  # frames after the last cue: its tone is heard to its end


@dataclass(frozen=True, kw_only=True)
class SoundSettings:
    """Where the sound goes. What is heard is set per user: rig.user.guidance."""

    __pydantic_config__ = {"extra": "forbid"}

    device: str | None = None  # as PortAudio names it, or a part of that; None: the system's
    file: str | None = None  # of a replay: the WAV file to write, a new one; without it a replay is silent
    say: bool = False  # live: in words as well, through espeak-ng
    words_per_minute: Annotated[int, Ge(80), Le(450)] = 220  # of espeak-ng


def hearing_of(guidance: Guidance) -> HearingSettings:
    """What one user wants to hear."""
    return HearingSettings(
        volume=guidance.volume, reach=guidance.range, levels=frozenset(guidance.levels), tick=guidance.tick
    )


class CueSound(Sink):
    """Plays cues as they come, or keeps them until the replay's end and writes the file."""

    Settings = SoundSettings

    def __init__(self, settings: SoundSettings, context: Context) -> None:
        strangers = [port for port, kind in context.ports.items() if kind is not Cue]
        if strangers or len(context.ports) != 1:
            raise DataflowError(f"{context.node}: expected one input, a Cue; found {', '.join(context.ports)}")
        self._hearing = hearing_of((context.rig.user or User()).guidance)
        self._player: Player | None = None
        self._log: CueLog | None = None
        self._file = Path(settings.file) if settings.file is not None else None
        self._speech: Speech | None = None
        self._texts = CueTexts(self._hearing.reach, self._hearing.levels)
        if not context.replay:
            self._player = Player(settings.device, self._hearing)
            if settings.say:
                self._speech = _speech(settings.words_per_minute)
        elif self._file is not None:
            if not context.takes_over:
                require_free(self._file)
            self._log = CueLog(self._file.with_name(f"{self._file.name}.cues"), goes_on=context.takes_over)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Take one cue."""
        assert isinstance(message, Cue)
        if self._log is not None:
            self._log.append(message.stamp, payload)
        if self._player is not None:
            self._player.tell(message)
        if self._speech is not None and self._texts.update(message.stamp, *told(message), message.reason or ""):
            self._speech.say(self._texts.text)

    def idle(self, time: int) -> None:
        """Look after the device: silence of the graph is heard by itself."""
        if self._player is not None:
            self._player.look_after()

    def finish(self) -> None:
        """Write the file, or close the device."""
        if self._log is not None and self._file is not None:
            write_wav(self._file, self._log.cues(), self._hearing)
            self._log.remove()
        if self._player is not None:
            self._player.close()
        if self._speech is not None:
            self._speech.close()


def told(cue: Cue) -> tuple[str, str | None, float, float]:
    """Kind, level, distance (m) and azimuth (rad) of a cue."""
    return cue.kind, cue.level, cue.distance or 0.0, cue.azimuth or 0.0


class CueLog:
    """The cues of a replay so far, in a file that outlives a kill: appended before they count as taken."""

    def __init__(self, path: Path, *, goes_on: bool) -> None:
        """`goes_on`: in the place of a process that was killed. Raises DataflowError where nothing can be written."""
        self.path = path
        self._last = -1  # ns
        try:
            if goes_on and path.exists():
                whole = 0
                for cue, end in self._read():
                    self._last, whole = cue.stamp, end
                os.truncate(path, whole)  # the kill may have cut the last one
            else:
                path.write_bytes(b"")
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise DataflowError(f"{path.with_suffix('')}: cannot be written: {error.strerror}") from error

    def append(self, stamp: int, payload: bytes) -> None:
        """Keep a cue; one that was kept by the process before this one is not kept twice."""
        if stamp > self._last:
            os.write(self._file, LENGTH.pack(len(payload)) + payload)
            self._last = stamp

    def cues(self) -> Iterator[Cue]:
        """All cues in their order."""
        for cue, _ in self._read():
            yield cue

    def remove(self) -> None:
        """Close and remove the file."""
        os.close(self._file)
        self.path.unlink(missing_ok=True)

    def _read(self) -> Iterator[tuple[Cue, int]]:
        """Each cue, and where it ends in the file."""
        end = 0
        with self.path.open("rb") as file:
            while len(head := file.read(LENGTH.size)) == LENGTH.size:
                (length,) = LENGTH.unpack(head)
                payload = file.read(length)
                try:
                    cue = decode(payload, Cue)
                except MessageError:
                    return
                end += LENGTH.size + length
                yield cue, end


def rendered(cues: Iterable[Cue], hearing: HearingSettings) -> Iterator[Sound]:
    """The sound of cues from the first one's stamp on, block by block: shape (frames, 2) int16."""
    sonification = Sonification(hearing)
    first: int | None = None
    done = 0
    for cue in cues:
        first = cue.stamp if first is None else first
        at = (cue.stamp - first) * RATE // 1_000_000_000
        if at > LONGEST_FILE * RATE:
            log.warning("the file ends after %d h; the cues go on", LONGEST_FILE // 3600)
            return
        while done < at:
            block = sonification.render(min(at - done, RATE))
            done += len(block)
            yield block
        sonification.tell(*told(cue))
    if first is not None:
        yield sonification.render(TAIL)


def write_wav(path: Path, cues: Iterable[Cue], hearing: HearingSettings) -> None:
    """The sound of cues as a WAV file of 16 bits, stereo; whole or not at all. Raises DataflowError."""
    part = path.with_name(f"{path.name}.part")
    try:
        with wave.open(str(part), "wb") as file:
            file.setnchannels(2)
            file.setsampwidth(2)
            file.setframerate(RATE)
            for block in rendered(cues, hearing):
                file.writeframes(block.astype("<i2").tobytes())
        part.replace(path)
    except OSError as error:
        raise DataflowError(f"{path}: cannot be written: {error.strerror}") from error


class Player:
    """A sound device; says how long it took from the middle of an exposure to the first frame of its tone."""

    def __init__(self, device: str | None, hearing: HearingSettings) -> None:
        """Raises DataflowError when there is no such device, or no library for it."""
        try:
            import sounddevice  # type: ignore[import-untyped]
        except (ImportError, OSError) as error:  # OSError: PortAudio itself is missing
            reason = not_installed("sounddevice", "sound") if isinstance(error, ImportError) else str(error)
            raise DataflowError(f"sound: {reason}") from error
        self._library: Any = sounddevice
        self._device = device
        self._lock = threading.Lock()
        self._sonification = Sonification(hearing)
        self._frames = 0  # given to the device
        self._since = 0  # ns, of the cue told last
        self._counted: int | None = None  # the tone whose latency was taken last
        self._latencies: deque[float] = deque(maxlen=MOST_LATENCIES)  # s
        self._tones = self._tones_told = 0
        self._next_report = time.monotonic() + REPORT_PERIOD
        self._next_attempt = 0.0
        self._stream: Any = self._opened()

    def tell(self, cue: Cue) -> None:
        """Sound as `cue` says, from the next block on."""
        with self._lock:
            self._sonification.tell(*told(cue))
            self._since = cue.since
        self.look_after()

    def look_after(self) -> None:
        """Open a device again that is gone, and say the latency now and then."""
        now = time.monotonic()
        if not self._stream.active and now >= self._next_attempt:
            self._next_attempt = now + RETRY
            with contextlib.suppress(DataflowError):
                self._stream.close()
                self._stream = self._opened()
                log.warning("the sound device was gone, and is back")
        if now >= self._next_report:
            self._next_report = now + REPORT_PERIOD
            self.report()

    def report(self) -> None:
        """Say the latency, where there are new tones: `caneflow status` shows the last line of a node."""
        with self._lock:
            latencies, tones = sorted(self._latencies), self._tones
        if tones > self._tones_told:
            self._tones_told = tones
            p50, p99 = (latencies[min(math.ceil(p * len(latencies)), len(latencies)) - 1] for p in (0.5, 0.99))
            log.info("exposure to sound: p50 %.0f ms, p99 %.0f ms of %d tones", 1e3 * p50, 1e3 * p99, tones)

    def close(self) -> None:
        """Say the latency, and let the device go."""
        self.report()
        self._stream.close()

    def fill(self, out: Any, frames: int, moment: Any, status: Any) -> None:
        """Give the device its next frames; called on its own thread."""
        with self._lock:
            begin = self._frames
            out[:] = self._sonification.render(frames)
            self._frames += frames
            tone = self._sonification.first_tone
            if tone is not None and tone != self._counted and tone >= begin:
                self._counted = tone
                ahead = moment.outputBufferDacTime - moment.currentTime + (tone - begin) / RATE  # s until it is heard
                self._latencies.append((time.time_ns() - self._since) * 1e-9 + ahead)
                self._tones += 1

    def _opened(self) -> Any:
        try:
            stream = self._library.OutputStream(
                samplerate=RATE,
                blocksize=BLOCK,
                device=self._device,
                channels=2,
                dtype="int16",
                latency="low",
                callback=self.fill,
            )
            stream.start()
        except (self._library.PortAudioError, ValueError) as error:
            raise DataflowError(f"sound device {self._device or 'of the system'}: {error}") from error
        return stream


def _speech(words_per_minute: int) -> Speech | None:
    try:
        return Speech(words_per_minute)
    except DataflowError as error:
        log.warning("%s; words are on the phone's page only", error)
        return None


if __name__ == "__main__":
    run(CueSound)
