"""The messages that a file names in words: the outputs of external nodes."""

from collections.abc import Iterable
from pathlib import Path

from caneflow.messages import SAMPLES, Sample
from caneflow.messages.errors import MessageError
from caneflow.runtime.dataflow.programs import require_message
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.user_files import kind_at
from caneflow.runtime.wording import did_you_mean, listed, shown

OWN = "a message of your own is named by its file and class, e.g. ./ranges.py:Range"


def message_named(written: str, base: Path) -> type[Sample]:
    """The message type of `Imu`, `caneflow.Imu/1` or `./ranges.py:Range`, a path being taken from the folder `base`.

    By name it finds ours and what the programs of the flow have defined. Raises DataflowError when it finds none.
    """
    file, _, name = written.rpartition(":")
    if file.endswith(".py"):
        kind = _in_file(base / file, name)
    else:
        found = [kind for schema, kind in SAMPLES.items() if written in (schema, kind.__name__)]
        if len(found) > 1:
            raise DataflowError(f"{shown(written)} can be {listed(kind.schema for kind in found)}; name one of these")
        if not found:
            names = sorted(_names(SAMPLES.values()))  # the registry's order is that of imports
            raise DataflowError(
                f"no message {shown(written)};{did_you_mean(written, names)} there are {listed(names)}; {OWN}"
            )
        kind = found[0]
    try:
        require_message(kind)
    except MessageError as error:
        raise DataflowError(str(error)) from error
    return kind


def _in_file(file: Path, name: str) -> type[Sample]:
    if not file.is_file():
        raise DataflowError(f"no Python file {str(file)!r}; {OWN}")
    return kind_at(f"{file.resolve()}:{name}")


def _names(kinds: Iterable[type[Sample]]) -> list[str]:
    """How messages are named for people: ours by their class, others by their schema."""
    return [kind.__name__ if kind.schema.startswith("caneflow.") else kind.schema for kind in kinds]
