"""Text as loggers write it: its encoding, its column separator, its comments and its numbers."""

import codecs
import csv
import math
import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

from caneflow.protocols.errors import ProtocolError

SEPARATORS = (",", ";", "\t", "|")
SPACES = " "  # one or more
COMMENT_MARKS = ("#", "%", "//", "!")
# Cells that say that there is no value; "nan" is a number to Python already.
MISSING = {"", "-", "--", "null", "none", "na", "n/a", "#n/a", "<na>", "nil", "missing"}
RECEIVED = re.compile(r"\s*(\d{1,2}:\d\d:\d\d[.,]\d+)\s*->\s*")  # when a serial monitor got the line
GROUPED = re.compile(r"([+-]?)(\d{1,3}(?:\.\d{3})+(?=,)|\d{1,3}(?:,\d{3})+(?=\.))[.,](\d*)")  # 1.234,5 or 1,234.5
LARGEST = 1e30  # no unit makes a measurement of more
LARGEST_EXPONENT = 30  # of ten in a number for a time; beyond, no unit makes a stamp of it
BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


class BadRowError(ProtocolError):
    """Says what is wrong with a row, in the words in which it is counted."""


def encoding_of(head: bytes) -> str:
    """The encoding of a text that begins with `head`: by its mark, by its zero bytes (UTF-16), or by trial."""
    for mark, name in BOMS:
        if head.startswith(mark):
            return name
    even, odd = head[0::2].count(0), head[1::2].count(0)
    if max(even, odd) > len(head) // 8:  # letters, digits and separators have one zero byte each
        return "utf-16-be" if even > odd else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def separator_of(lines: Sequence[str]) -> str:
    """The separator that cuts most of the lines into the same number of cells, more than one; spaces as a last resort.

    A comma that is in every cell is a decimal comma if another separator cuts the lines as well.
    """
    rows = [line for line in lines if line.strip()]
    best, most = ",", 0
    for separator in (";", "\t", "|", ","):
        counts = [line.count(separator) for line in rows]
        usual = max(set(counts), key=counts.count, default=0)
        agreeing = counts.count(usual) if usual else 0
        if agreeing > most:
            best, most = separator, agreeing
    if most < len(rows) / 2:
        counts = [len(line.split()) for line in rows]
        usual = max(set(counts), key=counts.count, default=0)
        if usual > 1 and counts.count(usual) > most:
            return SPACES
    return best


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of one line: a stray quotation mark then costs its row, not all that follow."""
    if "->" in line and (found := RECEIVED.match(line)):
        line = found[1] + separator + line[found.end() :]
    if separator == SPACES:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error as error:
        raise BadRowError("that are not table rows") from error


def is_comment(line: str) -> bool:
    """Whether a line is empty or a comment."""
    stripped = line.strip()
    return not stripped or stripped.startswith(COMMENT_MARKS)


def number(cell: str) -> float:
    """A cell's number, with a decimal point or comma; NaN where it says that there is none. Raises BadRowError."""
    try:
        value = float(cell)
    except ValueError:
        if cell.strip().lower() in MISSING:
            return math.nan
        try:
            value = float(_with_point(cell))
        except ValueError:
            raise BadRowError("with a cell that is not a number") from None
    if not math.isfinite(value):
        return math.nan
    if abs(value) > LARGEST:
        raise BadRowError("with a cell that is not a number")
    return value


def exact_number(cell: str) -> Decimal | None:
    """A cell's number to the last digit; None where it is not one, or too large for any time."""
    try:
        value = Decimal(_with_point(cell))
    except InvalidOperation:
        return None
    if not value.is_finite() or (value and abs(value.adjusted()) > LARGEST_EXPONENT):
        return None
    return value


def _with_point(cell: str) -> str:
    """The cell with a decimal point: a comma is one too, and of groups of three digits the last mark is."""
    cell = cell.strip()
    if "," not in cell:
        return cell
    if found := GROUPED.fullmatch(cell):
        sign, whole, fraction = found.groups()
        return sign + re.sub("[.,]", "", whole) + "." + fraction
    return cell.replace(",", ".", 1) if cell.count(",") == 1 and "." not in cell else cell
