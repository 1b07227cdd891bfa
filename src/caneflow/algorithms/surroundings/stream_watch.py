"""Whether a stream still tells something: it has gone silent, or repeats itself bit by bit."""

from typing import Final

SILENT_NS: Final = 200_000_000  # ns without a sample: three periods of a ranger
FROZEN_NS: Final = 300_000_000  # ns of the same reading: no sensor is that quiet


class StreamWatch:
    """One stream, judged in event time."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.heard_ns: int | None = None  # stamp of the newest sample
        self.new_ns: int | None = None  # stamp of the first of those that are like the newest
        self._content: object = None

    def take(self, stamp_ns: int, content: object) -> None:
        """Take a sample; `content` is what must change (None: this one may repeat itself)."""
        self.heard_ns = stamp_ns
        if content is None or content != self._content or self.new_ns is None:
            self.new_ns = stamp_ns
        self._content = content

    def is_silent(self, now_ns: int) -> bool:
        """Whether nothing has come for too long, or ever."""
        return self.heard_ns is None or now_ns - self.heard_ns > SILENT_NS

    @property
    def is_frozen(self) -> bool:
        """Whether it has been saying the same for too long."""
        return self.heard_ns is not None and self.new_ns is not None and self.heard_ns - self.new_ns >= FROZEN_NS

    def last_good_ns(self, start_ns: int) -> int:
        """Stamp of the last sample that told something; `start_ns` if there was none."""
        return start_ns if self.new_ns is None else self.new_ns if self.is_frozen else self.heard_ns or start_ns
