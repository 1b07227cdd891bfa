"""An operator brought back to where it was before a sample that it could not handle, exact to the last bit.

Nobody can foresee which sample it will be, and to copy the state before each would cost more than most operators do.
So the state is packed once in many samples, and what came since then is remembered: when a sample fails, the state
is unpacked and those samples are handled again, without the one. What they led to has been sent and is not sent again.

What is an error of the program, and not of the sample, still ends the node: `blames_sample` tells them apart.
"""

import logging
from contextlib import suppress
from contextvars import ContextVar
from types import TracebackType

import numpy as np

from caneflow.messages import MessageError, Sample
from caneflow.runtime.program import Operator, Refused
from caneflow.runtime.stages.byte_budget import weight_of
from caneflow.runtime.stages.references import SnapshotError
from caneflow.runtime.stages.snapshot import pack, unpack
from caneflow.runtime.wording import one_line

log = logging.getLogger(__name__)

# Samples between two packed states. Measured: to pack one costs as much as 15 to 30 samples, so 0.4 to 0.8 % of them.
JOURNAL_LENGTH = 4096
JOURNAL_BYTES = 8 * 2**20  # of those samples: what a node may hold is bounded (see byte_budget)
MOST_IN_A_ROW = 1000  # samples of one input that fail, after which the state is suspected: 10 s at 100 Hz

_overflow_raises: ContextVar[bool] = ContextVar("_overflow_raises", default=False)


def let_overflow_raise() -> None:
    """Let numpy raise FloatingPointError in this thread (context) instead of making infinities, from now on."""
    if not _overflow_raises.get():
        np.seterr(over="raise")
        _overflow_raises.set(True)


def blames_sample(error: Exception) -> str | None:
    """What is wrong with a sample whose handling raised `error`; None: it is the program that is wrong.

    A sample is to blame for numbers that overflow or that make a matrix singular, for arrays that no memory holds, and
    for an output whose own checks refuse it. A division by zero, a wrong index and all else are bugs.
    """
    if isinstance(error, OverflowError | FloatingPointError | np.linalg.LinAlgError):
        return f"it makes the arithmetic fail: {one_line(error)}"
    if isinstance(error, MemoryError):
        return f"it takes more memory than there is: {one_line(error)}"
    if isinstance(error, MessageError) or (isinstance(error, ValueError) and _is_of_a_sample(error.__traceback__)):
        return f"what follows from it is not a sample: {one_line(error)}"
    return None


class Rollback:
    """The newest packed state of one operator and the samples since then."""

    def __init__(self, node: str, operator: Operator) -> None:
        """`operator`: as it was just built; in the last resort it begins again from there."""
        self._node = node
        self._module = type(operator).__module__
        self._journal: list[tuple[str, Sample]] = []
        self._bytes = 0  # of those
        self._base: bytes | None = None  # None: the state cannot be packed
        self._why = ""
        self._said = False
        self._failed: dict[str, int] = {}  # by port, samples in a row
        self._pack(operator)
        self._first = self._base

    def note(self, port: str, message: Sample, operator: Operator) -> None:
        """Remember a sample that `operator` has handled, or refused by itself."""
        if self._failed:
            self._failed.pop(port, None)
        if self._base is None:
            return
        self._journal.append((port, message))
        self._bytes += weight_of(message)
        if len(self._journal) >= JOURNAL_LENGTH or self._bytes >= JOURNAL_BYTES:
            self._pack(operator)

    def rebase(self, state: bytes) -> None:
        """Take a state that was packed just now, for another purpose, as the newest one."""
        if self._base is not None:
            self._keep(state)

    def resume(self, operator: Operator) -> None:
        """Go on with the operator of a snapshot."""
        self._pack(operator)

    def restored(self, port: str, message: Sample, damaged: Operator, error: Exception) -> Operator:
        """The operator as it was before it was given a sample that it could not handle because of `error`.

        Where that cannot be had, said once, it is the one that may have been changed by the sample; raises `error`
        when that one can no longer handle any.
        """
        in_a_row = self._failed[port] = self._failed.get(port, 0) + 1
        if self._base is None and in_a_row == MOST_IN_A_ROW:
            raise error
        if self._first is not None and in_a_row % MOST_IN_A_ROW == 0 and self._can_begin_again(port, message):
            log.warning("%s: %d samples of %s in a row could not be handled; begins again", self._node, in_a_row, port)
            self._keep(self._first)
            self._failed.clear()
        if self._base is None:
            return self._given_up(damaged, self._why)
        try:
            operator: Operator = unpack(self._base, self._module)
            for at, each in self._journal:
                with suppress(Refused):
                    for _ in operator.handle(at, each):
                        pass  # it has been sent
        except Exception as error:  # it is not the same every time: nothing else can be done about it
            return self._given_up(damaged, f"{type(error).__name__}: {one_line(error)}")
        self._pack(operator)  # the next one may come soon
        return operator

    def _can_begin_again(self, port: str, message: Sample) -> bool:
        """Whether an operator that has just been built can handle the sample: then the state is to blame."""
        assert self._first is not None
        try:
            for _ in unpack(self._first, self._module).handle(port, message):
                pass
        except Exception:
            return False
        return True

    def _given_up(self, damaged: Operator, why: str) -> Operator:
        if not self._said:
            self._said = True
            log.warning("%s: what a refused sample has changed cannot be undone: %s", self._node, why)
        return damaged

    def _pack(self, operator: Operator) -> None:
        try:
            self._keep(pack(operator, self._module))
        except SnapshotError as error:
            self._base, self._why = None, one_line(error)
            self._journal.clear()

    def _keep(self, state: bytes) -> None:
        self._base = state
        self._journal.clear()
        self._bytes = 0


def _is_of_a_sample(place: TracebackType | None) -> bool:
    """Whether an error was raised by a sample's own checks."""
    while place is not None:
        frame = place.tb_frame
        if frame.f_code.co_name == "__post_init__" and isinstance(frame.f_locals.get("self"), Sample):
            return True
        place = place.tb_next
    return False
