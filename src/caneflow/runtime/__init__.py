"""dataflow.yaml -> checked graph -> processes -> Zenoh: the only room that knows Zenoh, YAML and processes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from caneflow.runtime.node import run
    from caneflow.runtime.program import (
        ANY_PORT,
        Brought,
        Context,
        Emitted,
        Encoded,
        InFlow,
        NoSettings,
        Objection,
        Operator,
        Quiet,
        Refused,
        Sink,
        Source,
    )

__all__ = [
    "ANY_PORT",
    "Brought",
    "Context",
    "Emitted",
    "Encoded",
    "InFlow",
    "NoSettings",
    "Objection",
    "Operator",
    "Quiet",
    "Refused",
    "Sink",
    "Source",
    "run",
]


def __getattr__(name: str) -> Any:
    # What programs are made of is imported when a program asks for it: `caneflow status` has to answer at once.
    if name in __all__:
        home = "node" if name == "run" else "program"
        value = globals()[name] = getattr(import_module(f"caneflow.runtime.{home}"), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
