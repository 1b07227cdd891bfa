"""What may have been meant by the name of a file that is not there."""

from difflib import get_close_matches
from itertools import islice
from pathlib import Path

MOST_FILES = 1000  # of a folder that are looked at
LIKENESS = 0.6  # 0..1, of two names


def near_file(path: Path) -> str:
    """`; did you mean X?` for the file of the same folder and ending whose name is nearest; else nothing."""
    try:
        if path.exists():
            return ""
        names = [each.name for each in islice(path.parent.glob(f"*{path.suffix}"), MOST_FILES)]
    except (OSError, ValueError):  # a folder that may not be read, or no pattern
        return ""
    close = get_close_matches(path.name, names, n=1, cutoff=LIKENESS)
    return f"; did you mean {path.with_name(close[0])}?" if close else ""
