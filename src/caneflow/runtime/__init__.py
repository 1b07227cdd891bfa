"""dataflow.yaml -> checked graph -> processes -> Zenoh: the only room that knows Zenoh, YAML and processes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from caneflow.runtime.program import (
        ANY_PORT,
        Brought,
        Context,
        Emitted,
        Encoded,
        NoSettings,
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
    "NoSettings",
    "Operator",
    "Quiet",
    "Refused",
    "Sink",
    "Source",
]


def __getattr__(name: str) -> Any:
    # What programs are made of is imported when a program asks for it: `caneflow status` has to answer at once.
    if name in __all__:
        value = globals()[name] = getattr(import_module("caneflow.runtime.program"), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
