"""The one error of this room, and what a checked file has to say: problems, each with its place."""

from collections.abc import Sequence
from dataclasses import dataclass

from caneflow.errors import CaneflowError
from caneflow.printable import printable


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where something was written."""

    source: str  # the file as the user named it, or e.g. `--set fusion.method=kalman`
    line: int = 0  # from 1; 0: the source has no lines
    column: int = 0  # from 1

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is wrong, or only odd, in a dataflow.yaml; as text, one line."""

    place: Place
    path: str  # e.g. `nodes.fusion.settings.method`; empty for the file as a whole
    text: str  # what is wrong; what would be right
    warning: bool = False  # the graph runs all the same

    def __str__(self) -> str:
        parts = [str(self.place), "warning" if self.warning else "", self.path, self.text]
        return printable(": ".join(part for part in parts if part))


class DataflowError(CaneflowError):
    """A graph that cannot run, or a run that failed: says where, what was found, what would be right."""

    def __init__(self, message: str, problems: Sequence[Problem] = ()) -> None:
        super().__init__(message)
        self.problems = tuple(problems)  # of a file that was checked: one for each line of the message
