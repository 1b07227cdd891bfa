"""A continuous-wave Doppler module on a sound card or another ADC that PortAudio knows, or in a sound file.

out  block : DopplerBlock   one per 50 ms; shorter where samples are missing behind it, or the file ends
"""

import logging
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from annotated_types import Ge, Le
from numpy.typing import NDArray

from caneflow.algorithms.clocks.clock_fit import ClockFitSettings, LineBelow
from caneflow.algorithms.quantities import Time
from caneflow.errors import not_installed
from caneflow.messages import DopplerBlock, bounds
from caneflow.protocols.doppler_blocks import BlockCutter, ModuleChannels, Samples, block_length
from caneflow.recording.sound_file import SoundFile
from caneflow.runtime import Brought, Context, Quiet, Source
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

log = logging.getLogger(__name__)

SILENCE = 0.5  # s without a frame after which the card is opened again
RETRY = 0.25  # s between two looks for a card that is gone
MOST_WAITING = 256  # pieces, as the card hands them over, that wait for this process: 2 s of usual ones of 8 ms
HAND_OVER = 0.1  # s
OLDEST = 1.0  # s by which a piece may be older than its call; a card that says more does not know
CLOCK_SET = 1_000_000  # ns by which the host's clock must differ from what it was to have been set
REPORT_PERIOD = 60.0  # s
QUIET = 1.0  # s in which not a bit of a channel changes, until this is said: some cards begin with less


@dataclass(frozen=True, kw_only=True)
class DopplerAdcSettings:
    """Which input of which device the module is on."""

    __pydantic_config__ = {"extra": "forbid"}

    device: str = "default"  # as PortAudio names it, or a part of the name that no other has, or its number
    file: str | None = None  # a WAV or FLAC file in the place of the device, played once in real time
    channel: Annotated[int, Ge(0), Le(1023)] = 0  # of the device: the module's output, or I of an I/Q module
    quadrature: Annotated[int, Ge(0), Le(1023)] | None = None  # channel of Q; None: a module with one mixer
    sample_rate: Annotated[float, Ge(bounds.SAMPLE_RATE[0]), Le(bounds.SAMPLE_RATE[1])] = (
        4000.0  # Hz, of a device; a file has its own
    )
    sample_format: Literal["int16", "float32"] = "int16"  # of a device; float32 where the ADC has more than 16 bits
    carrier: Annotated[float, Ge(bounds.CARRIER[0]), Le(bounds.CARRIER[1])] = 24.125e9  # Hz
    block: Annotated[float, Ge(1e-3), Le(10)] = 0.05  # s
    start_timeout_s: Time = 10.0  # s to the first block; later the device is waited for forever

    def __post_init__(self) -> None:
        if self.quadrature == self.channel:
            raise ValueError(f"quadrature is {self.quadrature}, as is channel; I and Q are on two channels")

    @property
    def channels(self) -> ModuleChannels:
        """Where the module is in a frame."""
        return ModuleChannels(first=self.channel, quadrature=self.quadrature)


class Piece(NamedTuple):
    """Frames as the card hands them over."""

    frames: NDArray[Any]  # shape (n, channels)
    last: int  # ns of the host's steady clock: when the last frame was sampled, by the card's word
    overflowed: bool  # frames before these are missing


class Lost(Exception):
    """The card is gone, or was never there."""


class StreamClock:
    """When a frame was sampled: the card's frames counted at its rate, held under the times that it tells.

    A card's word on the time of a piece jitters by as much as a piece; the count does not, but drifts. The line of
    clock_fit has neither. Times are ns of the host's steady clock, and strictly increase from call to call.
    """

    def __init__(self, sample_rate: float) -> None:
        self._step = 1e9 / sample_rate  # ns, as far as the card keeps its rate
        self._last = -(1 << 63)
        self.restart()

    def restart(self) -> None:
        """Begin the count again: frames are missing, nobody knows how many."""
        self._line = LineBelow(ClockFitSettings())
        self._count = 0

    def heard(self, count: int, last: int) -> None:
        """Take note of `count` more frames, the last of them sampled at `last` by the card's word."""
        self._count += count
        self._line.add(self._count * self._step, last)

    def at(self, behind: int) -> int:
        """When the frame was sampled that came `behind` frames before the last one that was heard."""
        found = self._line.at((self._count - behind) * self._step)
        assert found is not None  # something was heard
        self._last = max(self._last + 1, round(found))
        return self._last


class DopplerAdc(Source):
    """Reads blocks of the module's output; outlives an overflow and a card that is pulled out."""

    outputs = {"block": DopplerBlock}
    Settings = DopplerAdcSettings

    def __init__(self, settings: DopplerAdcSettings, context: Context) -> None:
        self._settings = settings
        self._node = context.node
        self._clock = StreamClock(settings.sample_rate)
        self._offset = time.time_ns() - time.monotonic_ns()  # of the Unix epoch
        self._said = ""  # the last warning
        self._blocks = self._overflows = self._overflows_told = 0
        self._refused = self._refused_told = 0  # blocks with what is not sound
        self._next_report = 0.0  # s, monotonic
        self._quiet: dict[int, float] = {}  # by silent channel, s without a change

    def samples(self) -> Brought:
        """Yield what the module gives; raises DataflowError when it gives nothing at the start."""
        if self._settings.file is not None:
            yield from self._played(Path(self._settings.file))
            return
        give_up = time.monotonic() + self._settings.start_timeout_s
        try:
            while True:
                try:
                    with opened(self._settings) as pieces:
                        yield from self._heard(pieces)
                except Lost as error:
                    self._set_back(error, give_up)
                self._clock.restart()
                yield Quiet(time.time_ns())
                time.sleep(RETRY)
        finally:
            self._report(at_once=True)

    def _heard(self, pieces: Iterator[Piece]) -> Brought:
        """Blocks of what the card says, each gapless in itself; raises Lost."""
        settings, channels = self._settings, self._settings.channels
        cutter = BlockCutter(block_length(settings.block, settings.sample_rate))
        waiting = 0  # frames in the cutter
        for piece in pieces:
            if piece.overflowed:
                self._overflows += 1
                rest = cutter.rest()
                if rest is not None:
                    yield from self._block(rest, self._epoch(self._clock.at(0)))
                self._clock.restart()
                waiting = 0
            self._clock.heard(len(piece.frames), piece.last)
            waiting += len(piece.frames)
            for samples in cutter.feed(channels.output(piece.frames)):
                waiting -= len(samples)
                yield from self._block(samples, self._epoch(self._clock.at(waiting)))
            self._report()

    def _played(self, path: Path) -> Brought:
        """Blocks of a file, each when its last sample would have been taken."""
        sound = SoundFile(path, self._settings.channels, block=self._settings.block)
        log.info("%s: %d frames at %g Hz, %s", path, sound.frames, sound.sample_rate, sound.subtype)
        began, steady = time.time_ns(), time.monotonic()
        for samples, last in sound.blocks():
            taken = (last + 1) / sound.sample_rate
            if (wait := steady + taken - time.monotonic()) > 0:
                time.sleep(wait)
            yield from self._block(samples, began + round(taken * 1e9), sound.sample_rate)
        if refused := sound.refused + self._refused:
            log.warning("%s: %d blocks left out: they hold what is not a number, or no sound", path, refused)

    def _block(self, samples: Samples, stamp: int, sample_rate: float | None = None) -> Brought:
        """A block of them, unless they hold what no converter says: NaN, or floats far beyond full scale."""
        self._blocks += 1
        self._said = ""
        rate = sample_rate or self._settings.sample_rate
        try:
            block = DopplerBlock(stamp=stamp, samples=samples, sample_rate=rate, carrier=self._settings.carrier)
        except ValueError as error:
            if not self._refused:
                log.warning("a block is left out, as are others like it: %s", error)
            self._refused += 1
            yield Quiet(stamp)
            return
        self._listen(samples, len(samples) / rate)
        yield "block", block

    def _listen(self, samples: Samples, seconds: float) -> None:
        """Say of a channel that has become silent which one it is, once until it changes again."""
        channels = self._settings.channels
        before, silent = self._quiet, channels.silent(samples)
        self._quiet = {channel: before.get(channel, 0.0) + seconds for channel in silent}
        for channel, quiet in self._quiet.items():
            if quiet >= QUIET > before.get(channel, 0.0):
                log.warning(
                    "%s is silent: not a bit changes for %g s; `caneflow doctor --devices` says what to try",
                    channels.named(channel),
                    QUIET,
                )

    def _epoch(self, instant: int) -> int:
        """`instant` (ns of the steady clock) as ns of the Unix epoch."""
        offset = time.time_ns() - time.monotonic_ns()
        if abs(offset - self._offset) > CLOCK_SET:
            self._offset = offset
        return instant + self._offset

    def _set_back(self, error: Lost, give_up: float) -> None:
        """Take note that there is no card; raises DataflowError when there never was one."""
        if not self._blocks and time.monotonic() > give_up:
            raise DataflowError(
                f"{self._node}: no block within {self._settings.start_timeout_s:g} s: {error}; "
                "`caneflow doctor --devices` says what to try, --replay REC plays a recording"
            ) from error
        if str(error) != self._said:
            log.warning("%s; tries again", error)
            self._said = str(error)

    def _report(self, *, at_once: bool = False) -> None:
        """Say how often frames were missing, once a minute and at the end, if there is something to say."""
        now = time.monotonic()
        news = (self._overflows, self._refused) != (self._overflows_told, self._refused_told)
        if not news or (now < self._next_report and not at_once):
            return
        self._overflows_told, self._next_report = self._overflows, now + REPORT_PERIOD
        self._refused_told = self._refused
        left_out = f"; {self._refused} blocks left out" if self._refused else ""
        log.warning("%d overflows in %d blocks: samples are missing there%s", self._overflows, self._blocks, left_out)


@contextmanager
def opened(settings: DopplerAdcSettings) -> Iterator[Iterator[Piece]]:
    """What the card hands over, as long as it does; raises Lost when it does not (any more)."""
    sound = _portaudio()
    pieces: queue.Queue[Piece] = queue.Queue(MOST_WAITING)
    ends = threading.Event()
    to_come = Heard(settings.sample_rate, pieces, ends)
    try:
        stream = sound.InputStream(
            device=named(settings.device),
            channels=settings.channels.needed,
            samplerate=settings.sample_rate,
            dtype=settings.sample_format,
            latency="high",  # a longer buffer in the card's driver: the stamps do not come from it
            callback=to_come,
        )
    except (sound.PortAudioError, ValueError) as error:
        raise Lost(f"{settings.device}: {_reason(error)}") from error
    try:
        stream.start()
        yield _handed_over(pieces, settings)
    except sound.PortAudioError as error:
        raise Lost(f"{settings.device}: {_reason(error)}") from error
    finally:
        ends.set()
        stream.close(ignore_errors=True)


class Heard:
    """What PortAudio's thread calls with new frames. Where the queue is full it waits: then the card overflows."""

    def __init__(self, sample_rate: float, pieces: "queue.Queue[Piece]", ends: threading.Event) -> None:
        self._rate = sample_rate
        self._pieces = pieces
        self._ends = ends

    def __call__(self, frames: NDArray[Any], count: int, times: Any, status: Any) -> None:
        """Hand frames over, with when the last of them was sampled."""
        piece = Piece(frames.copy(), self._sampled(count, times, time.monotonic_ns()), bool(status.input_overflow))
        while not self._ends.is_set():
            try:
                self._pieces.put(piece, timeout=HAND_OVER)
            except queue.Full:
                continue
            return

    def _sampled(self, count: int, times: Any, now: int) -> int:
        """When the last of `count` frames was sampled, ns of the steady clock; `now` is the call's time on it.

        The stream's own clock may be any: only how much older the first frame is than the call is taken from it.
        """
        took = count / self._rate
        age = float(times.currentTime - times.inputBufferAdcTime)
        if not (times.inputBufferAdcTime > 0 and 0 <= age <= took + OLDEST):
            age = took
        return min(now - round((age - (count - 1) / self._rate) * 1e9), now)


def _handed_over(pieces: "queue.Queue[Piece]", settings: DopplerAdcSettings) -> Iterator[Piece]:
    while True:
        try:
            yield pieces.get(timeout=SILENCE + 2.0 * settings.block)
        except queue.Empty:
            raise Lost(f"{settings.device}: says nothing any more") from None


def named(device: str) -> str | int | None:
    """A device as PortAudio wants it: its number, a name, or None for the default one."""
    if device == "default":
        return None
    return int(device) if device.isdigit() else device


def _reason(error: Exception) -> str:
    """What PortAudio says, without its numbers."""
    return str(error).partition(" [PaErrorCode")[0]


def _portaudio() -> Any:
    """The sounddevice module, which has looked for cards just now."""
    try:
        import sounddevice  # type: ignore[import-untyped]  # it has no types
    except ImportError as error:
        raise DataflowError(not_installed("sounddevice", "audio")) from error
    except OSError as error:
        raise DataflowError("PortAudio is not installed; sudo apt install libportaudio2") from error
    # PortAudio looks for cards when it is started, and never again.
    sounddevice._terminate()
    sounddevice._initialize()
    return sounddevice


if __name__ == "__main__":
    run(DopplerAdc)
