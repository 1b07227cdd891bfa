"""caneflow: a handful of sensors become a position, as a graph of processes over Zenoh."""

import sys

if sys.argv[0].endswith("/caneflow"):  # the command: Ctrl-C waits from here on until it can be taken (interrupts)
    import signal

    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))

from caneflow import dispatch

__version__: str

dispatch.pin()  # before anything imports numpy


def __getattr__(name: str) -> str:
    """`__version__`, looked up when it is asked for: the look-up takes longer than a small program."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    globals()[name] = version("caneflow")
    return str(globals()[name])
