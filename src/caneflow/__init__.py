"""caneflow: a handful of sensors become a position, as a graph of processes over Zenoh."""

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
