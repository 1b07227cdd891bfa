"""A TI mmWave radar that answers its command line and sends recorded packets. Knows no clock: the time is told."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

PROMPT: Final = b"mmwDemo:/>"
# fmt: off
KNOWN: Final = frozenset((  # words of the demos of SDK 3 and of the low-power SDK
    "CQRxSatMonitor", "CQSigImgMonitor", "adcCfg", "adcbufCfg", "analogMonitor", "antGeometryCfg", "aoaFovCfg",
    "aoaProcCfg", "baudRate", "bpmCfg", "calibData", "calibDcRangeSig", "cfarCfg", "cfarFovCfg", "cfarProcCfg",
    "channelCfg", "chirpCfg", "chirpComnCfg", "chirpTimingCfg", "clusterCfg", "clutterRemoval",
    "compRangeBiasAndRxChanPhase", "dfeDataOutputMode", "extendedMaxVelocity", "factoryCalibCfg", "flushCfg",
    "frameCfg", "guiMonitor", "lowPower", "lowPowerCfg", "lvdsStreamCfg", "measureRangeBiasAndRxChanPhase",
    "mpdBoundaryBox", "multiObjBeamForming", "profileCfg", "rangeSelCfg", "sensorStart", "sensorStop",
    "sigProcChainCfg", "sigProcChainCfg2", "staticBoundaryBox", "steerVecCorr", "trackingCfg", "version",
))
# fmt: on


class MmwaveRadar:
    """Takes a configuration, then sends the packets at their times; the recording runs on from the first start."""

    def __init__(
        self, times: Sequence[float], packets: Sequence[bytes], *, loss: float = 0.0, random: np.random.Generator
    ) -> None:
        """`times`: s since the first packet."""
        self._times, self._packets = times, packets
        self._loss, self._random = loss, random
        self._asked = b""
        self._begin: float | None = None  # s
        self._next = 0
        self._streaming = False
        self.lines = self.refused = self.sent = self.lost = 0

    @property
    def over(self) -> bool:
        """Whether every packet is past."""
        return self._next >= len(self._packets)

    def next_due(self) -> float | None:
        """When the next packet is due; None before the first start, and at the end."""
        return None if self._begin is None or self.over else self._begin + self._times[self._next]

    def receive(self, data: bytes, now: float) -> bytes:
        """The answers to what came."""
        *lines, self._asked = (self._asked + data).replace(b"\r", b"\n").split(b"\n")
        return b"".join(self._answer(line.strip(), now) for line in lines if line.strip())

    def send_due(self, now: float) -> Iterator[bytes]:
        """Yield the packets that are due."""
        while (due := self.next_due()) is not None and due <= now:
            packet, self._next = self._packets[self._next], self._next + 1
            if not self._streaming:
                continue
            if self._loss and self._random.random() < self._loss:
                self.lost += 1
                continue
            self.sent += 1
            yield packet

    def _answer(self, line: bytes, now: float) -> bytes:
        self.lines += 1
        word = line.split()[0].decode("ascii", "replace")
        if word not in KNOWN:
            self.refused += 1
            return line + b"\n'" + word.encode() + b"' is not recognized as a CLI command\n" + PROMPT
        if word == "sensorStart":
            self._begin = now if self._begin is None else self._begin
        if word in ("sensorStart", "sensorStop"):
            self._streaming = word == "sensorStart"
        return line + b"\nDone\n" + PROMPT
