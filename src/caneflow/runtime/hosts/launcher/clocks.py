"""The clocks of the other machines: asked for all the time over Zenoh, told on `<flow>/@/clock/<here>/<there>`."""

import logging
import time
from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import zenoh

from caneflow.algorithms.clocks.clock_offset import ClockEstimate, ClockOffset, ClockOffsetSettings
from caneflow.messages import MessageError, control_key, decode, encode
from caneflow.messages.control import Clock

log = logging.getLogger(__name__)

ASK_PERIOD = 1.0  # s between two round trips with one machine
FIRST_PERIOD = 0.1  # s, likewise for the first few
FIRST = 8  # round trips after which a machine is known well enough to be asked less often
TIMEOUT = 2.0  # s that an answer may take
WORTH_SAYING = 0.02  # s of offset beyond its uncertainty that are warned about: two samples at 100 Hz
CHANGED = 0.02  # s that the offset has to change until it is said again


class TheirTime(msgspec.Struct, frozen=True, array_like=True):
    """The answer of the other machine: when the question came and when the answer left, on its clock (ns)."""

    came: int
    left: int


class Answer(msgspec.Struct, frozen=True):
    """The four stamps (ns) of one round trip, on their way to the launcher's thread."""

    machine: str
    sent: int
    came: int
    left: int
    back: int


class Clocks:
    """What one launcher knows of the others' clocks."""

    def __init__(self, flow: str, here: str, others: Iterable[str], now: Callable[[], int] = time.time_ns) -> None:
        """`now`: this machine's clock, in ns."""
        self._flow, self._here, self._now = flow, here, now
        self._settings = ClockOffsetSettings()
        self._offsets = {other: ClockOffset(self._settings) for other in others}
        self._asked = dict.fromkeys(self._offsets, 0)
        self._ask_at = dict.fromkeys(self._offsets, 0.0)  # s, monotonic
        self._said: dict[str, float] = {}  # s of offset that was warned about
        self._held: list[Any] = []

    def open(self, session: zenoh.Session, put: Callable[[Answer], None]) -> None:
        """Answer the others, and ask them; answers are handed to `put`, on Zenoh's thread."""
        self._session, self._put = session, put
        key = control_key(self._flow, "clock", self._here)

        def tell(query: zenoh.Query) -> None:
            came = self._now()
            with query:
                query.reply(key, encode(TheirTime(came, self._now())))

        self._held.append(session.declare_queryable(key, zenoh.handlers.Callback(tell, indirect=False)))

    def look(self) -> None:
        """Ask those whose turn it is."""
        now = time.monotonic()
        for machine, at in self._ask_at.items():
            if now >= at:
                self._ask_at[machine] = now + (FIRST_PERIOD if self._asked[machine] < FIRST else ASK_PERIOD)
                self._asked[machine] += 1
                self._ask(machine)

    def take(self, answer: Answer) -> str | None:
        """Take a round trip into account and publish the estimate; what there is to warn of."""
        offsets = self._offsets[answer.machine]
        stepped = offsets.stepped
        try:
            estimate = offsets.update(answer.sent, answer.came, answer.left, answer.back)
        except ValueError:
            return None  # a clock was set while the answer was on its way
        told = Clock(
            here=self._here,
            there=answer.machine,
            at=estimate.at,
            offset=estimate.offset,
            drift=estimate.drift,
            uncertainty=estimate.uncertainty,
            delay=estimate.delay,
            steps=offsets.stepped,
        )
        self._session.put(control_key(self._flow, "clock", self._here, answer.machine), encode(told))
        return self._worth_saying(answer.machine, estimate, jumped=offsets.stepped > stepped)

    def _ask(self, machine: str) -> None:
        sent = self._now()

        def take(reply: zenoh.Reply) -> None:
            back = self._now()
            if reply.ok is not None:
                try:
                    theirs = decode(reply.ok.payload.to_bytes(), TheirTime)
                except MessageError as error:
                    log.warning("the clock of %s: refused: %s", machine, error)
                    return
                self._put(Answer(machine, sent, theirs.came, theirs.left, back))

        handler = zenoh.handlers.Callback(take, indirect=False)
        self._session.get(control_key(self._flow, "clock", machine), handler, timeout=TIMEOUT)

    def _worth_saying(self, machine: str, estimate: ClockEstimate, *, jumped: bool) -> str | None:
        certain = abs(estimate.offset) - estimate.uncertainty
        if jumped:
            self._said.pop(machine, None)
        elif certain < WORTH_SAYING or self._asked[machine] < FIRST:
            return None
        if abs(estimate.offset - self._said.get(machine, 0.0)) < CHANGED and not jumped:
            return None
        self._said[machine] = estimate.offset
        ahead = "ahead of" if estimate.offset > 0 else "behind"
        amount = f"{abs(estimate.offset):.3f} s (give or take {estimate.uncertainty:.3f} s)"
        how = "was set: it is" if jumped else "is"
        return f"the clock of {machine} {how} {amount} {ahead} this one's; set both by the same NTP server"
