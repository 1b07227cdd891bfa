"""What a node has sent and its readers have not made sure of: kept so that it can be sent again."""

from collections import deque
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from caneflow.runtime.stages.byte_budget import PER_SAMPLE, SENT

LONGEST = 20_000  # samples per stream of a live run; a reader that makes sure of nothing must not fill the memory


class Kept(NamedTuple):
    """A sample as it was sent."""

    seq: int
    payload: bytes


class History:
    """The samples of each output port, from the oldest that some reader may still ask for."""

    def __init__(
        self, readers: Mapping[str, Iterable[str]], budgets: Mapping[str, int] | None = None, *, waits: bool = False
    ) -> None:
        """By output port: the names of the nodes that read it, and how many bytes may be kept.

        What exceeds that is let go, the oldest first; `waits`: nothing is, who sends waits while a port is full.
        """
        self._kept: dict[str, deque[Kept]] = {port: deque() for port in readers}
        self._confirmed = {port: dict.fromkeys(names, -1) for port, names in readers.items()}
        self._next: dict[str, int] = dict.fromkeys(readers, 0)
        self._held: dict[str, int] = dict.fromkeys(readers, 0)  # bytes
        self._budgets = budgets or dict.fromkeys(readers, SENT)
        self._waits = waits
        self.full: set[str] = set()  # ports whose samples take more than the budget
        self.let_go = 0  # samples that cannot be had again, though some reader has not confirmed them

    @property
    def held(self) -> int:
        """What everything that is kept takes, in bytes."""
        return sum(self._held.values())

    def keep(self, port: str, seq: int, payload: bytes) -> None:
        """Keep a sample that is being sent."""
        self._next[port] = seq + 1
        if self._confirmed[port]:  # nobody reads it: nobody will ask
            kept = self._kept[port]
            kept.append(Kept(seq, payload))
            held = self._held[port] = self._held[port] + PER_SAMPLE + len(payload)
            if held > self._budgets[port] or len(kept) > LONGEST:
                self._make_room(port)

    def _make_room(self, port: str) -> None:
        kept = self._kept[port]
        if self._waits:
            if self._held[port] > self._budgets[port]:
                self.full.add(port)
            return
        while len(kept) > 1 and (self._held[port] > self._budgets[port] or len(kept) > LONGEST):
            self._forget_oldest(port)
            self.let_go += 1

    def _forget_oldest(self, port: str) -> None:
        self._held[port] -= PER_SAMPLE + len(self._kept[port].popleft().payload)

    def confirm(self, port: str, reader: str, seq: int) -> None:
        """Note that `reader` will not ask for the sample `seq` of `port` or one before it."""
        confirmed = self._confirmed.get(port, {})
        if reader in confirmed:
            confirmed[reader] = max(confirmed[reader], seq)
            sure, kept = min(confirmed.values()), self._kept[port]
            while kept and kept[0].seq <= sure:
                self._forget_oldest(port)
            if self._held[port] <= self._budgets[port]:
                self.full.discard(port)

    def first(self, port: str) -> int:
        """The seq of the oldest sample of `port` that can be sent again; that of the next one when there is none."""
        kept = self._kept[port]
        return kept[0].seq if kept else self._next[port]

    def since(self, port: str, seq: int) -> list[bytes]:
        """The samples of `port` from `seq` on, as they were sent."""
        return [kept.payload for kept in self._kept[port] if kept.seq >= seq]

    def kept(self) -> dict[str, list[Kept]]:
        """Everything that is kept, by port."""
        return {port: list(kept) for port, kept in self._kept.items()}
