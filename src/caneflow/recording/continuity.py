"""How the samples of one stream follow each other: gaps, numbers that begin again, wrong stamps."""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec

ADVICE = "stamps of one stream strictly increase"


class _Head(msgspec.Struct, gc=False):
    """Of a sample all that is looked at here."""

    stamp: int


_head = msgspec.msgpack.Decoder(_Head).decode


@dataclass
class Continuity:
    """What was found in one stream, sample by sample in the order of the file."""

    key: str
    missing: int = 0  # gaps in seq are losses
    restarts: int = 0  # seq that jump back are a source that was restarted
    stamps_back: int = 0  # samples whose stamp does not lie after that of the one before
    stamps_unlike: int = 0  # samples whose stamp is not the publish_time that they are filed under
    smallest: int | None = None  # ns, of the stamps
    largest: int | None = None
    fault: str = ""  # the first of those with stamps, in words
    last_seq: int = -1
    last_stamp: int = -1

    def take_all(self, samples: Iterable[tuple[int, int, bytes]]) -> None:
        """Note the next samples: number, stamp (ns) that it is filed under, payload."""
        for seq, stamp, payload in samples:
            if seq == self.last_seq + 1 and stamp > self.last_stamp == self.largest:  # as nearly all are
                try:
                    if _head(payload).stamp == stamp:
                        self.last_seq, self.last_stamp, self.largest = seq, stamp, stamp
                        continue
                except msgspec.DecodeError:
                    pass
            self.take(seq, stamp, payload)

    def take(self, seq: int, stamp: int, payload: bytes) -> None:
        """Note the next sample."""
        if seq <= self.last_seq:
            self.restarts += 1
        elif self.last_seq >= 0:
            self.missing += seq - self.last_seq - 1
        if stamp <= self.last_stamp:
            self._note_back(seq, stamp)
        elif self.largest is None or stamp > self.largest:
            self.largest = stamp
        if self.smallest is None or stamp < self.smallest:
            self.smallest = stamp
        try:
            own = _head(payload).stamp
        except msgspec.DecodeError:  # not readable: its reader refuses it, by name
            own = stamp
        if own != stamp:
            self._note_unlike(seq, stamp, own)
        self.last_seq, self.last_stamp = seq, stamp

    def _note_back(self, seq: int, stamp: int) -> None:
        self.stamps_back += 1
        by = (self.last_stamp - stamp) / 1e9
        how = f"time goes back by {by:.9g} s" if by else "time does not go on, nor back"
        self.fault = (
            self.fault or f"{self.key}: {how}: sample {seq} has stamp {stamp}, after {self.last_stamp}; {ADVICE}"
        )

    def _note_unlike(self, seq: int, stamp: int, own: int) -> None:
        self.stamps_unlike += 1
        self.fault = self.fault or (
            f"{self.key}: sample {seq} has stamp {own} and is recorded with publish_time {stamp}, "
            f"{abs(own - stamp) / 1e9:.9g} s {'later' if stamp > own else 'earlier'}; the two are one"
        )
