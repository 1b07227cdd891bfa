"""A MaxBotix range finder that is not there: given distances over time, it answers as an MB12xx or an MB10xx does.

Pure: what is written, and the time (s), in; what is read out. A bus that does not acknowledge raises OSError.
"""

import errno
import struct
from bisect import bisect_right
from collections.abc import Sequence

from caneflow.protocols.maxbotix import FARTHEST_CM, READING_TIME, TAKE_READING, Unit, said

BUSY = 0.08  # s after a command in which the chip does not acknowledge; its data sheet says up to 100 ms
PERIOD = 0.05  # s between two words of an MB10xx


class Echoes:
    """Distances (m; None: no echo) from times (s) on, increasing."""

    def __init__(self, times: Sequence[float], distances: Sequence[float | None]) -> None:
        if len(times) != len(distances) or not times:
            raise ValueError(f"{len(times)} times and {len(distances)} distances; expected as many of both, at least 1")
        self._times, self._distances = list(times), list(distances)

    @property
    def end(self) -> float:
        """Time (s) of the last distance."""
        return self._times[-1]

    def at(self, time: float) -> float | None:
        """The distance (m) at `time`, s; the first one before."""
        return self._distances[max(bisect_right(self._times, time) - 1, 0)]


class I2cSonar:
    """An MB1202."""

    def __init__(self, echoes: Echoes) -> None:
        self.readings = 0
        self._echoes = echoes
        self._free = 0.0  # s, from when on it acknowledges
        self._taken: float | None = None  # m
        self._asked = False

    def transfer(self, written: bytes, length: int, time: float) -> bytes:
        """One transfer at `time`, s; raises OSError while the chip measures, and for what it does not know."""
        if time < self._free or (written and written[0] != TAKE_READING):
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        if written:
            self._taken, self._asked = self._echoes.at(time), True
            self._free = time + BUSY
        if not length:
            return b""
        self.readings += self._asked
        self._asked = False
        centimetres = FARTHEST_CM if self._taken is None else round(100.0 * self._taken)
        return struct.pack(">H", min(max(centimetres, 20), FARTHEST_CM))[:length]


class SerialSonar:
    """An MB1010, which measures by itself."""

    def __init__(self, echoes: Echoes, unit: Unit = "inch", farthest: float = 6.45) -> None:
        self._echoes, self._unit, self._farthest = echoes, unit, farthest
        self.next = 0.0  # s

    def due(self, time: float) -> bytes:
        """The words that are due by `time`, s."""
        words = b""
        while self.next <= time:
            words += said(self._echoes.at(self.next), self._unit, self._farthest)
            self.next += PERIOD
        return words


assert BUSY < READING_TIME
