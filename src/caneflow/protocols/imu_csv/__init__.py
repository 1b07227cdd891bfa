"""Readings of an inertial measurement unit in tables of text, as loggers write them: lines in, numbers out.

text (encoding, separator, numbers) -> columns (which is what) -> times (clocks and counters) -> repairs (wraps,
outliers, equal stamps) and units -> table (one file) -> joining (several files by time).
"""

from caneflow.protocols.imu_csv.columns import COLUMNS, VECTORS, assignments, require_told, shared_out
from caneflow.protocols.imu_csv.joining import Joined, Reading
from caneflow.protocols.imu_csv.repairs import IndistinctTimesError
from caneflow.protocols.imu_csv.table import ImuTable
from caneflow.protocols.imu_csv.text import encoding_of
from caneflow.protocols.imu_csv.units import UNITS

__all__ = [
    "COLUMNS",
    "UNITS",
    "VECTORS",
    "ImuTable",
    "IndistinctTimesError",
    "Joined",
    "Reading",
    "assignments",
    "encoding_of",
    "require_told",
    "shared_out",
]
