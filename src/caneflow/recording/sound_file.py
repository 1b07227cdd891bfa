"""A Doppler module's output in a sound file: WAV, FLAC and what else libsndfile reads, as blocks of samples."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from caneflow.errors import not_installed
from caneflow.protocols.doppler_blocks import BlockCutter, ModuleChannels, Samples, block_length, is_finite
from caneflow.recording.errors import RecordingError

SHORT = {"PCM_16", "PCM_S8", "PCM_U8"}  # what 16 bits hold exactly; the rest is read as float32
READ_FRAMES = 1 << 16  # at a time
MOST_CHANNELS = 256
MISSING = not_installed("soundfile", "audio")


class SoundBlock(NamedTuple):
    """Samples that follow each other, and where they end."""

    samples: Samples
    last: int  # number of the last one in the file, from 0


class SoundFile:
    """One file; what it is can be asked before its blocks are drawn."""

    def __init__(self, path: str | Path, channels: ModuleChannels, *, block: float) -> None:
        """Blocks of `block` s. Raises RecordingError for a file that is not sound, or lacks the channels."""
        self.path = Path(path)
        self.refused = 0  # blocks that held NaN or infinity
        self._channels = channels
        with closing(self._opened()) as sound:
            self.sample_rate = float(sound.samplerate)  # Hz
            self.frames = int(sound.frames)  # as its head says; a file that was cut off has fewer
            self.subtype = str(sound.subtype)
            self.channels = there = int(sound.channels)
        if not channels.needed <= there <= MOST_CHANNELS:
            of = "1 channel" if there == 1 else f"{there} channels"
            raise RecordingError(f"{self.path}: has {of}; channel {channels.needed - 1} is asked for (0 is the first)")
        if self.sample_rate <= 0:
            raise RecordingError(f"{self.path}: a sample rate of {self.sample_rate:g} Hz")
        self._length = block_length(block, self.sample_rate)

    def blocks(self) -> Iterator[SoundBlock]:
        """Yield the file's blocks in order, the last one perhaps shorter; raises RecordingError where it breaks."""
        cutter = BlockCutter(self._length)
        end = 0
        for samples in self._pieces():
            for block in cutter.feed(samples):
                end += len(block)
                yield from self._sound(block, end)
        rest = cutter.rest()
        if rest is not None:
            yield from self._sound(rest, end + len(rest))

    def _sound(self, samples: Samples, end: int) -> Iterator[SoundBlock]:
        if is_finite(samples):
            yield SoundBlock(samples, end - 1)
        else:
            self.refused += 1

    def _pieces(self) -> Iterator[Samples]:
        dtype = "int16" if self.subtype in SHORT else "float32"
        with closing(self._opened()) as sound:
            while True:
                try:
                    frames = sound.read(READ_FRAMES, dtype=dtype, always_2d=True)
                except RuntimeError as error:  # libsndfile's own
                    raise RecordingError(f"{self.path}: cannot be read on: {error}") from error
                if not len(frames):
                    return
                yield self._channels.output(frames)

    def _opened(self) -> Any:
        try:
            import soundfile  # type: ignore[import-untyped]  # it has no types
        except ImportError as error:
            raise RecordingError(MISSING) from error
        try:
            return soundfile.SoundFile(self.path)
        except (RuntimeError, TypeError, ValueError) as error:  # TypeError: .raw, of which nothing is known
            if not self.path.exists():
                raise RecordingError(f"{self.path}: is not there") from error
            raise RecordingError(f"{self.path}: not a sound file: {str(error).splitlines()[-1]}") from error
