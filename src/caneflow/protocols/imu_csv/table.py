"""One table of IMU readings: read whole, its columns found, its units judged and its times repaired."""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from caneflow.protocols.imu_csv.columns import VECTORS, Layout, layout_of, require_told
from caneflow.protocols.imu_csv.repairs import LATE, OUTLIER, TWICE, Repairs, followed, gaps, spread
from caneflow.protocols.imu_csv.text import BadRowError, cells_of, is_comment, number, separator_of
from caneflow.protocols.imu_csv.times import Clock, clock_of
from caneflow.protocols.imu_csv.units import (
    DEFAULT_UNITS,
    UNITS,
    Judged,
    judged_accel,
    judged_gyro,
    judged_linear,
    judged_mag,
    require_known,
    stated,
)

Floats: TypeAlias = NDArray[np.float64]
HEAD = 500  # lines in which header, separator and kind of time are looked for
UNIT_RANGE = (0.9, 1.1)  # of a quaternion's norm over the usual one


@dataclass
class Refusals:
    """Rows that are lost: how many by cause, and the line of the first."""

    counts: Counter[str] = field(default_factory=Counter)
    first_lines: dict[str, int] = field(default_factory=dict)

    def note(self, cause: str, line: int, count: int = 1) -> None:
        """Count rows."""
        self.counts[cause] += count
        self.first_lines[cause] = min(line, self.first_lines.get(cause, line))

    def __str__(self) -> str:
        if not self.counts:
            return "no row left out"
        causes = (f"{n} {cause} (first in line {self.first_lines[cause]})" for cause, n in self.counts.items())
        total = self.counts.total()
        return f"{total} row{'s' if total > 1 else ''} left out: {', '.join(causes)}"


class ImuTable:
    """A table as it was read: `stamps` (n,) ns, `vectors` by name (n, axes) in SI units and uT, NaN where missing.

    `notes`: a line for all that was repaired or is doubtful; `units`: what each quantity was taken for, and why.
    """

    def __init__(
        self,
        lines: Iterable[str],
        *,
        columns: Mapping[str, str],
        units: Mapping[str, str],
        separator: str | None = None,
        rate: float | None = None,
        most: Mapping[str, float] | None = None,
        is_part: bool = False,
    ) -> None:
        """Read a table.

        Args:
            lines: of text, with or without their ends.
            columns: by name, as in COLUMNS, a title, its beginning, or a number from 1.
            units: by quantity, as in UNITS; what is not told is taken from the table.
            separator: of cells; None: found.
            rate: Hz, where time is a sample number, or not there.
            most: by vector the greatest magnitude of a component (SI, uT) that a reading may have.
            is_part: whether other tables have vectors that are not here.

        Raises:
            ProtocolError: columns that are not there, not told or not known; unknown units; nothing to read.
            IndistinctTimesError: times that many readings share.
        """
        if not is_part:
            require_told(columns, numbered=rate is not None)
        require_known(units)
        self.refusals, self.repairs, self.notes = Refusals(), Repairs(), list[str]()
        self.units: dict[str, Judged] = {}
        self._most = most or {}
        lines = iter(lines)
        head = list(islice(lines, HEAD))
        self.separator = separator or separator_of(head)
        self.layout = self._layout_of(head, columns, is_part=is_part)
        self._told = units
        self._stated = self._stated_units(head)
        self._clock = self._clock_of(head, rate)
        self._read(chain(head, lines))
        self._leave_out_empty()
        self._repair_times()
        self._judge_units()
        self._leave_out_absurd()

    @property
    def rows(self) -> int:
        """How many rows of readings there were, lost ones too."""
        return len(self.stamps) + self.refusals.counts.total()

    def doubts(self) -> Iterator[str]:
        """A line for each unit that was not told and is not the usual one, or that another one may be."""
        for quantity, judged in self.units.items():
            told = quantity in self._told
            if judged.doubt:
                yield f"{quantity}: taken as {judged.unit} ({judged.why}), but {judged.doubt}"
            elif not told and judged.unit in UNITS[quantity] and judged.unit != DEFAULT_UNITS[quantity]:
                settles = f"--units {quantity}={judged.unit} confirms it, another unit overrules it"
                yield f"{quantity}: taken as {judged.unit} ({judged.why}); {settles}"

    def _layout_of(self, head: Sequence[str], columns: Mapping[str, str], *, is_part: bool) -> Layout:
        rows = [_cells_or_none(line, self.separator) for line in head]

        def is_row(cells: Sequence[str], layout: Layout) -> bool:
            told = [i for each in layout.vectors.values() for i in each]
            if any(i >= len(cells) for i in told) or (layout.time is not None and layout.time >= len(cells)):
                return False
            try:
                return bool(np.isfinite([number(cells[i]) for i in told]).any())
            except BadRowError:
                return False

        return layout_of(rows, columns, is_row=is_row, is_part=is_part)

    def _stated_units(self, head: Sequence[str]) -> dict[str, str]:
        """The units that titles, or a row of units below them, give."""
        layout = self.layout
        title_row = next((i for i, line in enumerate(head) if self._titles_of(line) == layout.titles), 0)
        below = [_cells_or_none(line, self.separator) for line in head[title_row + 1 : layout.first_row]]
        first = {name: columns[0] for name, columns in layout.vectors.items()}
        if layout.time is not None:
            first["time"] = layout.time
        found: dict[str, str] = {}
        for quantity, column in first.items():
            texts = [row[column] for row in (layout.titles, *below) if column < len(row)]
            unit = stated(quantity, texts)
            if unit is not None:
                found[quantity] = unit
        return found

    def _titles_of(self, line: str) -> tuple[str, ...]:
        return tuple(cell.strip() for cell in _cells_or_none(line, self.separator))

    def _clock_of(self, head: Sequence[str], rate: float | None) -> Clock:
        column = self.layout.time
        rows = [_cells_or_none(line, self.separator) for line in head[self.layout.first_row :] if not is_comment(line)]
        cells = [] if column is None else [row[column] for row in rows if column < len(row)]
        clock = clock_of(cells, unit=self._told.get("time"), stated=self._stated.get("time"), rate=rate)
        self.units["time"] = clock.judged
        return clock

    def _read(self, lines: Iterable[str]) -> None:
        """Take the numbers of all rows, as they are in the table."""
        times, numbers = list[int](), array("q")
        values = {name: array("d") for name in self.layout.vectors}
        header = self._titles_of
        for line_number, line in enumerate(lines, start=1):
            if line_number <= self.layout.first_row or is_comment(line):
                continue
            try:
                row = cells_of(line, self.separator)
                vectors = {name: [number(row[i]) for i in axes] for name, axes in self.layout.vectors.items()}
                time = len(times) if self.layout.time is None else row[self.layout.time]
                stamp = self._clock.nanoseconds(str(time))
            except IndexError:
                self.refusals.note("with too few cells", line_number)
            except BadRowError as error:
                if not self.layout.titles or header(line) != self.layout.titles:  # not the header again
                    self.refusals.note(str(error), line_number)
            else:
                times.append(stamp)
                numbers.append(line_number)
                for name, vector in vectors.items():
                    values[name].extend(vector)
        self.stamps: NDArray[np.int64] = np.array(times, dtype=np.int64)
        self.lines: NDArray[np.int64] = np.array(numbers, dtype=np.int64)
        self.vectors: dict[str, Floats] = {
            name: _whole_or_nan(np.array(each, dtype=np.float64).reshape(-1, len(VECTORS[name])))
            for name, each in values.items()
        }

    def _judge_units(self) -> None:
        """Choose the units of the vectors and apply them."""
        for name in ("accel", "gyro", "mag", "linear_accel"):
            if name in self.vectors:
                self.units[name] = self._judged(name)
        for name in ("accel", "gyro", "mag", "linear_accel"):
            if name in self.vectors:
                self.vectors[name] = self.vectors[name] * UNITS[name][self.units[name].unit]
        if "orientation" in self.vectors:
            self._normalize_orientation()

    def _judged(self, name: str) -> Judged:
        told, found, vector = self._told.get(name), self._stated.get(name), self.vectors[name]
        accel_unit = self.units["accel"].unit if "accel" in self.units else None
        if name == "accel":
            return judged_accel(vector, told=told, stated=found)
        if name == "mag":
            return judged_mag(vector, told=told, stated=found)
        if name == "gyro":
            times = (self.stamps - self.stamps[:1]).astype(np.float64) * 1e-9
            accel = self.vectors.get("accel")
            return judged_gyro(times, vector, accel, accel_unit=accel_unit, told=told, stated=found)
        return judged_linear(vector, self.vectors.get("accel"), accel_unit=accel_unit, told=told, stated=found)

    def _normalize_orientation(self) -> None:
        quaternions = self.vectors["orientation"]
        norm = np.linalg.norm(quaternions, axis=1)
        known = np.isfinite(norm) & (norm > 0)
        usual = float(np.median(norm[known])) if known.any() else 1.0
        sound = known & (norm >= UNIT_RANGE[0] * usual) & (norm <= UNIT_RANGE[1] * usual)
        lost = int((np.isfinite(norm) & ~sound).sum())
        if lost:
            self.notes.append(f"orientation: {lost} are not unit quaternions; these readings go without")
        if not UNIT_RANGE[0] <= usual <= UNIT_RANGE[1]:
            self.notes.append(f"orientation: the usual norm is {usual:.6g}, taken for 1")
        self.vectors["orientation"] = np.where(
            sound[:, None], quaternions / np.where(sound, norm, 1.0)[:, None], np.nan
        )

    def _leave_out_absurd(self) -> None:
        """Leave out rows with what no sensor can say."""
        sound = np.ones(len(self.stamps), dtype=np.bool_)
        for name, most in self._most.items():
            if name in self.vectors:
                beyond = sound & (np.abs(self.vectors[name]) > most).any(axis=1)
                if beyond.any():
                    unit = DEFAULT_UNITS.get(name, "")
                    cause = f"with {name} beyond {most:g} {unit}".strip()
                    self.refusals.note(cause, int(self.lines[beyond.argmax()]), int(beyond.sum()))
                sound &= ~beyond
        self._keep(sound)

    def _leave_out_empty(self) -> None:
        """Leave out rows that hold nothing."""
        empty = np.ones(len(self.stamps), dtype=np.bool_)
        for vector in self.vectors.values():
            empty &= ~np.isfinite(vector[:, 0])
        if empty.any():
            self.refusals.note("without a reading", int(self.lines[empty.argmax()]), int(empty.sum()))
        self._keep(~empty)

    def _repair_times(self) -> None:
        """Make the stamps strictly increasing, and say what that took."""
        found = followed(self.stamps.tolist(), self._clock.wraps, self.repairs)
        on_clock = np.array([stamp is not None for stamp in found], dtype=np.bool_)
        self.stamps = np.array([stamp or 0 for stamp in found], dtype=np.int64)
        self.repairs.first = {what: int(self.lines[row]) for what, row in self.repairs.first.items()}
        self._tell_outliers(on_clock)
        self._keep(on_clock)
        order = np.argsort(self.stamps, kind="stable")
        moved = np.flatnonzero(np.diff(self.stamps) < 0)
        if len(moved):
            self.repairs.note(LATE, int(self.lines[moved[0] + 1]), len(moved))
            self._keep(order)
        self._take_once()
        self.stamps = spread(self.stamps, self.repairs, self.lines)
        self.notes += [
            f"{n} {what} (first in line {self.repairs.first[what]})" for what, n in self.repairs.counts.items()
        ]
        self.notes += gaps(self.stamps, self.lines)

    def _tell_outliers(self, on_clock: NDArray[np.bool_]) -> None:
        lost = int((~on_clock).sum())
        if lost:
            self.repairs.counts.pop(OUTLIER, None)
            self.refusals.note(OUTLIER, int(self.lines[(~on_clock).argmax()]), lost)

    def _take_once(self) -> None:
        """Leave out rows that repeat the one before to the last digit, where that is what equal stamps are here."""
        equal = np.flatnonzero(np.diff(self.stamps) == 0) + 1
        same = np.ones(len(equal), dtype=np.bool_)
        for vector in self.vectors.values():
            same &= ((vector[equal] == vector[equal - 1]) | ~np.isfinite(vector[equal])).all(axis=1)
        if len(equal) and same.mean() >= 0.9:
            twice = equal[same]
            self.repairs.note(TWICE, int(self.lines[twice[0]]), len(twice))
            kept = np.ones(len(self.stamps), dtype=np.bool_)
            kept[twice] = False
            self._keep(kept)

    def _keep(self, which: NDArray[Any]) -> None:
        self.stamps, self.lines = self.stamps[which], self.lines[which]
        self.vectors = {name: vector[which] for name, vector in self.vectors.items()}


def _cells_or_none(line: str, separator: str) -> list[str]:
    try:
        return cells_of(line, separator)
    except BadRowError:
        return []


def _whole_or_nan(vectors: Floats) -> Floats:
    """The vectors (n, k), wholly NaN where a component is missing."""
    vectors[~np.isfinite(vectors).all(axis=1)] = np.nan
    return vectors
