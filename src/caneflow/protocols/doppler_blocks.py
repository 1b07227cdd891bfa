"""A Doppler module's output out of the frames of an ADC: its channel, or I and Q, in blocks of even length.

A frame is one value of each channel, taken at one instant. No I/O here: sound cards are drivers.doppler_adc's, files
recording.sound_file's, and both give the same blocks for the same frames.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.errors import ProtocolError

Samples: TypeAlias = NDArray[np.int16 | np.float32 | np.complex64]
FULL_SCALE = np.float32(2**15)  # of int16


@dataclass(frozen=True, kw_only=True)
class ModuleChannels:
    """Where a module is: one mixer on one channel, or I and Q on two."""

    first: int = 0  # the module's output, or I
    quadrature: int | None = None  # Q; None: a module with one mixer

    @property
    def needed(self) -> int:
        """How many channels the frames must have at least."""
        return 1 + max(self.first, self.quadrature or 0)

    def output(self, frames: NDArray[Any]) -> Samples:
        """The module's samples, shape (n,), of full scale 1 (int16: 32768).

        Args:
            frames: shape (n, channels), int16 or float32.

        Returns:
            One mixer: the channel as it is. I/Q: I + jQ, complex64, exact for int16 too.

        Raises:
            ProtocolError: frames without these channels, or of another type.
        """
        if frames.ndim != 2 or frames.shape[1] < self.needed:
            raise ProtocolError(f"frames of shape {frames.shape}; channel {self.needed - 1} is needed (0 is the first)")
        if frames.dtype not in (np.int16, np.float32):
            raise ProtocolError(f"frames of {frames.dtype}; int16 or float32 can be taken")
        in_phase = frames[:, self.first]
        if self.quadrature is None:
            return in_phase.copy()
        scale = FULL_SCALE if frames.dtype == np.int16 else np.float32(1.0)
        samples = np.empty(len(frames), dtype=np.complex64)
        samples.real, samples.imag = in_phase / scale, frames[:, self.quadrature] / scale
        return samples

    def silent(self, samples: Samples) -> tuple[int, ...]:
        """Which of the module's channels say nothing: no sample of theirs, shape (n,), differs from another."""
        if self.quadrature is None:
            return () if _changes(samples) else (self.first,)
        parts = ((self.first, samples.real), (self.quadrature, samples.imag))
        return tuple(channel for channel, part in parts if not _changes(part))

    def named(self, channel: int) -> str:
        """What to call one of them: "channel 1", and of an I/Q module which of the two it is."""
        if self.quadrature is None:
            return f"channel {channel}"
        return f"channel {channel} ({'Q' if channel == self.quadrature else 'I'})"


class BlockCutter:
    """Cuts samples that come in pieces of any length into blocks of `length`."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._waiting: list[Samples] = []
        self._count = 0  # samples that wait

    def feed(self, samples: Samples) -> Iterator[Samples]:
        """Yield the blocks that `samples` completes, oldest first; the rest waits."""
        start = 0
        while self._count + len(samples) - start >= self._length:
            end = start + self._length - self._count
            yield self._joined(samples[start:end])
            start = end
        if start < len(samples):
            self._waiting.append(samples[start:])
            self._count += len(samples) - start

    def rest(self) -> Samples | None:
        """What waits, as a shorter block; None when nothing does. To be sent where the samples end or break off."""
        return self._joined() if self._waiting else None

    def _joined(self, *last: Samples) -> Samples:
        parts = [*self._waiting, *last]
        self._waiting.clear()
        self._count = 0
        joined: Samples = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return joined


def _changes(values: NDArray[Any]) -> bool:
    return bool((values != values[0]).any())


def is_finite(samples: Samples) -> bool:
    """Whether all samples are numbers: a file of floats may hold others."""
    return samples.dtype.kind == "i" or bool(np.isfinite(samples).all())


def block_length(seconds: float, sample_rate: float) -> int:
    """Samples of a block of `seconds` s at `sample_rate` Hz, at least 1."""
    return max(round(seconds * sample_rate), 1)
