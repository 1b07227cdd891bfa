"""dataflow.yaml -> checked graph -> processes -> Zenoh: the only room that knows Zenoh, YAML and processes."""

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
