"""caneflow: a handful of sensors become a position, as a graph of processes over Zenoh."""

from importlib.metadata import version

__version__ = version("caneflow")
