"""Times in a table: numbers of some unit, sample numbers, dates by ISO 8601 and clock times, as nanoseconds."""

import calendar
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from statistics import median

from caneflow.protocols.imu_csv.text import BadRowError, exact_number
from caneflow.protocols.imu_csv.units import UNITS, Judged, judged_time

SECOND = 10**9  # ns
DAY = 86400 * SECOND
LARGEST = 2**62  # ns: the difference of two still fits 64 bits
COUNTER_BITS = (8, 16, 24, 31, 32)

# 2024-05-01T12:00:00.010+02:00, with or without separators; a date in another order counts only by its clock.
ISO = re.compile(r"(\d{4})[-/.]?(\d\d)[-/.]?(\d\d)(?:[T _]+|$)(.*)", re.IGNORECASE)
CLOCK = re.compile(
    r"(\d{1,2})[:.-]?(\d\d)[:.-]?(\d\d)(?:[.,:_](\d+))?\s*([ap]\.?m\.?)?\s*(Z|UTC|GMT|[-+]\d\d:?\d\d|[-+]\d\d)?",
    re.IGNORECASE,
)
ENDS = re.compile(r"[\sT_,]", re.IGNORECASE)  # of what may stand before a clock time: a date in another order
MINUTES = re.compile(r"(\d{1,3}):(\d\d)[.,](\d+)")


@dataclass(frozen=True)
class Clock:
    """How a table tells the time."""

    nanoseconds: Callable[[str], int]  # of a cell; raises BadRowError
    wraps: tuple[int, ...]  # ns after which a counter or clock of this kind begins again
    judged: Judged  # the unit, and why


def clock_of(cells: Sequence[str], *, unit: str | None, stated: str | None, rate: float | None) -> Clock:
    """The clock of a column that begins with `cells`.

    `unit`: as told; `stated`: by the table; `rate`: Hz, where the cells are numbers of samples.
    """
    numbers = [value for cell in cells if (value := exact_number(cell)) is not None]
    if rate is not None:
        return _counter(Decimal(SECOND) / Decimal(rate), Judged("samples", f"sample numbers at {rate:g} Hz"))
    if 2 * len(numbers) < len(cells) or not cells:
        dated = sum(ISO.match(cell.strip()) is not None for cell in cells) * 2 > len(cells)
        kind = "dates and times" if dated else "clock times"
        return Clock(_time_of_day, () if dated else (DAY, DAY // 2, 3600 * SECOND), Judged("clock", kind))
    steps = [later - earlier for earlier, later in pairwise(numbers)]
    forward = [float(step) for step in steps if step > 0]
    share = len(forward) / max(len(forward) + sum(step == 0 for step in steps), 1)  # stamps that differ
    counts = bool(forward) and share * median(forward) == 1 and all(value == int(value) for value in numbers)
    step = share * median(forward) if forward else math.nan
    judged = judged_time(step, told=unit, stated=stated, counts=counts)
    return _counter(Decimal(UNITS["time"][judged.unit]), judged)


def _counter(tick: Decimal, judged: Judged) -> Clock:
    """A clock of numbers: `tick` ns each."""

    def nanoseconds(cell: str) -> int:
        value = exact_number(cell)
        if value is None:
            raise BadRowError("with a time that is not a time")
        stamp = round(value * tick)
        if abs(stamp) > LARGEST:
            raise BadRowError("with a time that is not a time")
        return stamp

    # A counter of microseconds may be written in seconds, so the bits may be of any of the units.
    ticks = {round(tick), *(round(scale) for scale in UNITS["time"].values() if scale <= tick)} - {0}
    wraps = sorted({each << bits for each in ticks for bits in COUNTER_BITS} | {DAY})
    return Clock(nanoseconds, tuple(wraps), judged)


def _time_of_day(cell: str) -> int:
    """Nanoseconds since 1970 of a date with time, or since midnight of a time alone."""
    cell = cell.strip()
    if found := MINUTES.fullmatch(cell):
        minutes, seconds, fraction = found.groups()
        return (int(minutes) * 60 + int(seconds)) * SECOND + _fraction(fraction)
    day = 0
    if date := ISO.match(cell):
        year, month, number, cell = date.groups()
        if not (1 <= int(month) <= 12 and 1 <= int(number) <= 31):
            raise BadRowError("with a time that is not a time")
        day = calendar.timegm((int(year), int(month), int(number), 0, 0, 0)) * SECOND
    found = CLOCK.fullmatch(cell)
    begins = (other.end() for other in ENDS.finditer(cell))
    found = found or next((late for begin in begins if (late := CLOCK.fullmatch(cell, begin))), None)
    if found is None:
        raise BadRowError("with a time that is not a time")
    hours, minutes, seconds, fraction, half, zone = found.groups()
    hour = int(hours) if half is None else int(hours) % 12 + (12 if half[0] in "pP" else 0)
    stamp = day + ((hour * 60 + int(minutes)) * 60 + int(seconds)) * SECOND + _fraction(fraction or "0")
    stamp -= _offset(zone) if zone else 0
    if abs(stamp) > LARGEST:
        raise BadRowError("with a time that is not a time")
    return stamp


def _fraction(digits: str) -> int:
    return int(digits[:9].ljust(9, "0"))


def _offset(zone: str) -> int:
    """Nanoseconds east of Greenwich."""
    if zone[0] not in "+-":
        return 0
    digits = zone[1:].replace(":", "").ljust(4, "0")
    return (1 if zone[0] == "+" else -1) * (int(digits[:2]) * 60 + int(digits[2:])) * 60 * SECOND
