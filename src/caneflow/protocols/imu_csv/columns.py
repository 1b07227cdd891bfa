"""Which column of a table is what: by its title, by the beginning of its title, or by its number."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.imu_csv.text import COMMENT_MARKS

VECTORS = {"gyro": "xyz", "accel": "xyz", "mag": "xyz", "orientation": "wxyz", "linear_accel": "xyz"}  # and their axes
COLUMNS = ("time", *(f"{vector}_{axis}" for vector, axes in VECTORS.items() for axis in axes))
MARKS = "#%/! "


@dataclass(frozen=True)
class Layout:
    """Where a table has what."""

    first_row: int  # lines before the first row of numbers
    titles: tuple[str, ...]  # () where there is no header
    time: int | None  # column, from 0; None: the rows are numbered
    vectors: Mapping[str, tuple[int, ...]]  # columns of each vector's axes, from 0

    def title(self, column: int) -> str:
        """What to call a column: its title and its number, from 1."""
        title = self.titles[column] if column < len(self.titles) else ""
        return f"column {column + 1}" + (f" {title!r}" if title else "")


def assignments(text: str, names: Iterable[str]) -> dict[str, str]:
    """`name=value,name=value` as a mapping; a value may hold commas and equals signs, if no name stands before it.

    Raises ProtocolError for a name that is not among `names`, or that comes twice.
    """
    known = "|".join(map(re.escape, names))
    found = list(re.finditer(rf"(?:^|,)\s*({known})\s*=", text))
    if not found or found[0].start() != 0:
        start = text.partition(",")[0]
        raise ProtocolError(f"{start!r}: expected name=value, where name is one of {known.replace('|', ', ')}")
    ends = [match.start() for match in found[1:]] + [len(text)]
    values: dict[str, str] = {}
    for match, end in zip(found, ends, strict=True):
        name = match[1]
        if name in values:
            raise ProtocolError(f"{text!r}: {name} is there twice")
        values[name] = text[match.end() : end].strip()
    return values


def require_told(columns: Mapping[str, str], *, numbered: bool) -> None:
    """Raise ProtocolError unless time, a gyro and whole vectors are told. `numbered`: the rows need no time."""
    for name in columns:
        if name not in COLUMNS:
            raise ProtocolError(f"{name!r}: not a column; expected one of {', '.join(COLUMNS)}")
    if "time" not in columns and not numbered:
        raise ProtocolError("no column is told for time; expected one, or --rate HZ for evenly spaced rows")
    if not any(name.startswith("gyro_") for name in columns):
        raise ProtocolError("no column is told for gyro_x, gyro_y, gyro_z; expected a gyro")
    for vector, axes in VECTORS.items():
        missing = [f"{vector}_{axis}" for axis in axes if f"{vector}_{axis}" not in columns]
        if missing and len(missing) < len(axes):
            raise ProtocolError(f"no column is told for {missing[0]}")


def layout_of(
    rows: Sequence[Sequence[str]],
    columns: Mapping[str, str],
    *,
    is_row: Callable[[Sequence[str], Layout], bool],
    is_part: bool = False,
) -> Layout:
    """The layout of a table that begins with `rows` of cells.

    Its header is the first of them in which every title of `columns` is found; comments, a preamble and a row of units
    around it are passed over. `is_row`: whether cells are a row of numbers. `is_part`: another file may have the rest.

    Raises ProtocolError that names the column that was not found.
    """
    if all(value.isdigit() for value in columns.values()):
        found = Layout(0, (), *_resolved((), columns, is_part=False))
        first = next((i for i, row in enumerate(rows) if is_row(row, found)), 0)
        above = rows[first - 1] if first else ()
        return Layout(first, _titles(above) if len(above) > 1 else (), found.time, found.vectors)
    reason: ProtocolError | None = None
    for i, row in enumerate(rows):
        titles = _titles(row)
        try:
            found = Layout(i + 1, titles, *_resolved(titles, columns, is_part=is_part))
        except ProtocolError as error:
            if reason is None or (i and len(row) > len(rows[i - 1]) > 0):
                reason = error
            continue
        later = next((k for k in range(i + 1, min(i + 5, len(rows))) if is_row(rows[k], found)), i + 1)
        units = all(_is_text(row, found) for row in rows[i + 1 : later])  # whatever else stands there is a bad row
        return Layout(later if units else i + 1, titles, found.time, found.vectors)
    if reason is None:
        _resolved((), columns, is_part=is_part)
    raise reason or ProtocolError("holds no line")


def _titles(row: Sequence[str]) -> tuple[str, ...]:
    titles = [title.strip() for title in row]
    if titles and titles[0].startswith(COMMENT_MARKS):
        titles[0] = titles[0].lstrip(MARKS)
        if len(titles) > 1 and not titles[0]:
            del titles[0]  # "# time gx": the mark was a cell of its own
    return tuple(titles)


def _is_text(row: Sequence[str], layout: Layout) -> bool:
    """Whether none of a row's cells that count holds a digit alone: a row of units, or a comment."""
    told = [layout.time, *(column for each in layout.vectors.values() for column in each)]
    cells = [row[column] for column in told if column is not None and column < len(row)]
    return len(cells) < 2 or not any(
        re.fullmatch(r"\s*[-+]?[\d.,]+(e[-+]?\d+)?\s*", cell, re.IGNORECASE) for cell in cells
    )


def _resolved(
    titles: Sequence[str], columns: Mapping[str, str], *, is_part: bool
) -> tuple[int | None, dict[str, tuple[int, ...]]]:
    time = _index(titles, "time", columns["time"]) if "time" in columns else None
    vectors: dict[str, tuple[int, ...]] = {}
    for vector, axes in VECTORS.items():
        names = [f"{vector}_{axis}" for axis in axes]
        if any(name in columns for name in names):
            try:
                vectors[vector] = tuple(_index(titles, name, columns[name]) for name in names)
            except ProtocolError:
                if not is_part:
                    raise
    if not vectors:
        raise ProtocolError(f"none of the vectors that are told; there are {', '.join(map(repr, titles))}")
    return time, vectors


def _index(titles: Sequence[str], name: str, wanted: str) -> int:
    """Where a column is: by its title, by a beginning that no other has, or by its number, from 1.

    Capital letters count where there are titles that differ in nothing else.
    """
    if wanted not in titles and wanted.startswith(COMMENT_MARKS):
        wanted = wanted.lstrip(MARKS)  # as the first title of a header that is a comment is written
    matches = [i for i, title in enumerate(titles) if title == wanted]
    matches = matches or [i for i, title in enumerate(titles) if wanted and title.startswith(wanted)]
    matches = matches or [i for i, title in enumerate(titles) if title.casefold() == wanted.casefold()]
    if len(matches) == 1:
        return matches[0]
    if not matches and wanted.isdigit():
        if 0 < int(wanted) <= max(len(titles), 1000 if not titles else 0):
            return int(wanted) - 1
        raise ProtocolError(f"{name}: no column {wanted}; there are {len(titles)}, the first is 1")
    there = ", ".join(repr(title) for title in titles)
    what = f"{len(matches)} columns" if matches else "no column"
    raise ProtocolError(f"{name}: {what} of the name {wanted!r}; there are {there}")


# How files of one sensor are named, in lower case; the first that fits counts.
FILE_WORDS = {
    "linear_accel": ("linear", "useraccel", "user_accel"),
    "gyro": ("gyr", "angular", "rotationrate", "rotation_rate"),
    "mag": ("mag", "compass"),
    "orientation": ("orient", "quat", "rotation", "attitude"),
    "accel": ("acc",),
}


def shared_out(columns: Mapping[str, str], files: Sequence[str]) -> list[dict[str, str]]:
    """What of `columns` is to be looked for in each of several files, named without their endings.

    `FILE:COLUMN` is in that file alone, named with its ending or without. Where two vectors are told the same columns,
    each is in the file that is named after it. Raises ProtocolError where none is.
    """
    if len(files) == 1:
        return [{name: _parted(value, files)[1] for name, value in columns.items()}]
    shared: list[dict[str, str]] = [{} for _ in files]
    parted = {name: _parted(value, files) for name, value in columns.items()}
    titles = {v: [parted.get(f"{v}_{axis}", ("", ""))[1] for axis in axes] for v, axes in VECTORS.items()}
    for name, (file, title) in parted.items():
        vector = name.rpartition("_")[0]
        if file is not None:
            places = [files.index(file)]
        elif name != "time" and list(titles.values()).count(titles[vector]) > 1:
            elsewhere = {other for each, (other, _) in parted.items() if not each.startswith(vector)}
            places = [i for i, each in enumerate(files) if _sensor_of(each) == vector]
            places = places or [i for i, each in enumerate(files) if each not in elsewhere]
            if len(places) != 1:
                raise ProtocolError(
                    f"{name}: {title!r} is told for another vector too; "
                    f"expected FILE:COLUMN, e.g. {name}={files[0]}:{title}"
                )
        else:
            places = list(range(len(files)))
        for place in places:
            shared[place][name] = title
    return shared


def _parted(value: str, files: Sequence[str]) -> tuple[str | None, str]:
    """The file, without its ending, and the column of FILE:COLUMN; a column's own title may hold a colon."""
    file, _, column = value.partition(":")
    base = file.rpartition("/")[2]
    for name in (file, base, base.rpartition(".")[0]):
        if column and name in files:
            return name, column
    return None, value


def _sensor_of(file: str) -> str | None:
    lower = file.lower()
    return next((vector for vector, words in FILE_WORDS.items() if any(word in lower for word in words)), None)
