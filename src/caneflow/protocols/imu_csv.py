"""Readings of an inertial measurement unit in a table of text, as loggers write them: lines in, numbers out.

What is what, and in which unit, has to be told: a header says it to people only.
"""

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from typing import NamedTuple, TypeAlias

from caneflow.physics import GRAVITY
from caneflow.protocols.errors import ProtocolError

Vector: TypeAlias = tuple[float, float, float]

# What the wire has (rad/s, m/s^2, uT) over what the file has; of time: ns.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "gyro": {"rad/s": 1.0, "deg/s": math.radians(1.0), "mdeg/s": math.radians(1e-3)},
    "accel": {"m/s^2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "mag": {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "T": 1e6, "mG": 0.1, "G": 100.0},
}
DEFAULT_UNITS = {quantity: next(iter(units)) for quantity, units in UNITS.items()}
VECTORS = ("gyro", "accel", "mag")
COLUMNS = ("time", *(f"{vector}_{axis}" for vector in VECTORS for axis in "xyz"))
LAST_STAMP = 2**63 - 1  # ns
LARGEST_EXPONENT = 30  # of ten in a time; beyond, no unit makes a stamp of it


class Reading(NamedTuple):
    """One row that can be used."""

    stamp: int  # ns, 0 at the first
    gyro: Vector  # rad/s
    accel: Vector | None  # m/s^2
    mag: Vector | None  # uT


@dataclass
class Refusals:
    """Rows that cannot be used: how many by cause, and the line of the first."""

    counts: Counter[str] = field(default_factory=Counter)
    first_lines: dict[str, int] = field(default_factory=dict)

    def note(self, cause: str, line: int) -> None:
        """Count a row."""
        self.counts[cause] += 1
        self.first_lines.setdefault(cause, line)

    def __str__(self) -> str:
        if not self.counts:
            return "no row refused"
        causes = (f"{n} {cause} (first in line {self.first_lines[cause]})" for cause, n in self.counts.items())
        total = self.counts.total()
        return f"{total} row{'s' if total > 1 else ''} refused: {', '.join(causes)}"


class ImuTable:
    """A table whose first line names the columns; `readings` gives its rows, `refusals` says what it left out.

    Raises ProtocolError for columns that are not there, not told or told of nothing known, and for unknown units.
    """

    def __init__(
        self,
        lines: Iterable[str],
        *,
        columns: Mapping[str, str],
        units: Mapping[str, str],
        delimiter: str = ",",
        most: Mapping[str, float] | None = None,
    ) -> None:
        """`most`: by vector the greatest magnitude of a component, in SI units (mag: uT), that a reading may have."""
        self.refusals = Refusals()
        self._most = most or {}
        self._lines = iter(lines)
        self._delimiter = delimiter
        header = self._cells(next(self._lines, ""))
        _require_known(columns, COLUMNS, "column")
        self._time = _index(header, "time", columns.get("time"))
        self._vectors = {name: _indices(header, name, columns) for name in VECTORS}
        if self._vectors["gyro"] is None:
            raise ProtocolError("no column is told for gyro_x, gyro_y, gyro_z; a gyro there must be")
        self._scales = _scales(units)

    def readings(self) -> Iterator[Reading]:
        """The rows that can be used, in order; stamps strictly increase. Once only."""
        start: Decimal | None = None
        last = -1
        for number, line in enumerate(self._lines, start=2):
            if not line.strip():
                continue
            try:
                row = self._cells(line)
                time = self._time_of(row)
                vectors = [self._vector(name, row) for name in VECTORS]
            except _BadRowError as error:
                self.refusals.note(str(error), number)
                continue
            stamp = 0 if start is None else round((time - start) * Decimal(self._scales["time"]))
            if stamp <= last:
                self.refusals.note("not later than the row before", number)
            elif stamp > LAST_STAMP:
                self.refusals.note("with a time that is no time", number)
            else:
                start, last = time if start is None else start, stamp
                gyro, accel, mag = vectors
                assert gyro is not None  # asked for above
                yield Reading(stamp, gyro, accel, mag)

    def _cells(self, line: str) -> list[str]:
        # One line at a time: a stray quotation mark then costs its row, not all that follow.
        try:
            return next(csv.reader([line], delimiter=self._delimiter, skipinitialspace=True), [])
        except csv.Error as error:
            raise _BadRowError("that are no table row") from error

    def _time_of(self, row: list[str]) -> Decimal:
        try:
            time = Decimal(row[self._time].strip())
        except IndexError:
            raise _BadRowError("with too few cells") from None
        except InvalidOperation:
            raise _BadRowError("with a cell that is no number") from None
        if not time.is_finite() or (time and abs(time.adjusted()) > LARGEST_EXPONENT):
            raise _BadRowError("with a time that is no time")
        return time

    def _vector(self, name: str, row: list[str]) -> Vector | None:
        indices = self._vectors[name]
        if indices is None:
            return None
        scale = self._scales[name]
        i, j, k = indices
        try:
            x, y, z = scale * float(row[i]), scale * float(row[j]), scale * float(row[k])
        except IndexError:
            raise _BadRowError("with too few cells") from None
        except ValueError:
            raise _BadRowError("with a cell that is no number") from None
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            raise _BadRowError("with a number that is not finite")
        most = self._most.get(name, math.inf)
        if max(abs(x), abs(y), abs(z)) > most:
            raise _BadRowError(f"with {name} beyond {most:g} {DEFAULT_UNITS[name]}")
        return x, y, z


class _BadRowError(ProtocolError):
    """Says what is wrong with a row, as it is counted."""


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


def _index(header: list[str], name: str, wanted: str | None) -> int:
    """Where a column is, by its name in the file or by a beginning that no other has."""
    if wanted is None:
        raise ProtocolError(f"no column is told for {name}")
    titles = [title.strip() for title in header]
    matches = [i for i, title in enumerate(titles) if title == wanted]
    matches = matches or [i for i, title in enumerate(titles) if wanted and title.startswith(wanted)]
    if len(matches) == 1:
        return matches[0]
    there = ", ".join(repr(title) for title in titles)
    what = f"{len(matches)} columns" if matches else "no column"
    raise ProtocolError(f"{name}: {what} of the name {wanted!r}; there are {there}")


def _indices(header: list[str], vector: str, columns: Mapping[str, str]) -> tuple[int, int, int] | None:
    names = [f"{vector}_{axis}" for axis in "xyz"]
    if not any(name in columns for name in names):
        return None
    x, y, z = (_index(header, name, columns.get(name)) for name in names)
    return x, y, z


def _scales(units: Mapping[str, str]) -> dict[str, float]:
    _require_known(units, UNITS, "quantity")
    scales = {}
    for quantity, known in UNITS.items():
        unit = units.get(quantity, DEFAULT_UNITS[quantity])
        if unit not in known:
            raise ProtocolError(f"{quantity}: no unit {unit!r}; there are {', '.join(known)}")
        scales[quantity] = known[unit]
    return scales


def _require_known(names: Iterable[str], known: Iterable[str], what: str) -> None:
    for name in names:
        if name not in known:
            raise ProtocolError(f"{name!r} is no {what}; there are {', '.join(known)}")
