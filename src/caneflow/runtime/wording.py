"""How values, paths and choices are put into one line of a message."""

import json
import re
from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches
from itertools import islice
from typing import TypeAlias

KeyPath: TypeAlias = tuple[str | int, ...]  # the way to a value: keys of mappings, numbers in lists

LONGEST = 60  # characters of a value that are worth a look
MOST_NAMES = 200  # that are compared with a misspelt one: a hostile file has thousands of both
MOST_LISTED = 50
PLAIN_KEY = re.compile(r"[\w*<-]+")


def shown(value: object) -> str:
    """`value` as the file might spell it, on one line and not too long."""
    text = repr(value) if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def dotted(path: KeyPath) -> str:
    """`path` in one word, e.g. `nodes.fusion.settings.poles.0`."""
    return ".".join(str(key) if PLAIN_KEY.fullmatch(str(key)) else shown(key) for key in path)


def one_line(text: object) -> str:
    """`text` with every run of white space, line ends among them, made one space."""
    return " ".join(str(text).split())


def listed(names: Iterable[str]) -> str:
    """`names` as a list to read, or the word for none; of very many only the first."""
    first = list(islice(names, MOST_LISTED + 1))
    return ", ".join([*first[:MOST_LISTED], *(["..."] if len(first) > MOST_LISTED else [])]) or "none"


def in_columns(rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> list[str]:
    """`rows` as lines with aligned columns, those of the numbers in `right` to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = (f"{cell:{'>' if i in right else '<'}{widths[i]}}" for i, cell in enumerate(row))
        lines.append("  ".join(cells).rstrip())
    return lines


def did_you_mean(word: str, names: Iterable[str], *, likeness: float = 0.6) -> str:
    """` did you mean 'x'?` for the closest of `names`, or nothing when none is as close as `likeness` (0..1)."""
    close = get_close_matches(word[:LONGEST], list(islice(names, MOST_NAMES)), n=1, cutoff=likeness)
    return f" did you mean {close[0]!r}?" if close else ""


def span(seconds: float) -> str:
    """A time that has passed, in s or, above two minutes, in hours, minutes and seconds."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02} h"
