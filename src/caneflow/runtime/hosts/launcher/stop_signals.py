"""Ctrl-C, SIGTERM and SIGHUP as an event: everything ends in order."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Interrupted:
    """Ctrl-C, SIGTERM or SIGHUP."""


@contextmanager
def stop_signals(put: Callable[[Interrupted], None]) -> Iterator[None]:
    """Put an event for each signal that ends a flow; SIGHUP is left alone where nohup has it ignored."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    for number in before:
        signal.signal(number, lambda *_: put(Interrupted()))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def signal_name(number: int) -> str:
    """SIGKILL of 9, and so on."""
    try:
        return signal.Signals(number).name
    except ValueError:  # of the real-time signals only two have names
        return f"signal {number}"
