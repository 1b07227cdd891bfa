"""Samples of one stream as numpy columns: one structured array, a field of it for each field of the message."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caneflow.messages import RadarFrame, Sample


def structured(samples: Sequence[Sample]) -> NDArray[np.void]:
    """One row per sample; what a message lacks is NaN ("" for words), a field that none of them has is left out.

    Vectors are (n, length). Arrays keep their type and shape, (n, ...); frames of one scan are (n, bins). Whole
    numbers that some samples lack become float64.

    Raises:
        ValueError: an array changes its shape from sample to sample, so that it is not a column.
    """
    if not samples:
        return np.empty(0, dtype=[("stamp", np.int64), ("seq", np.int64)])
    columns = {name: _column(name, [getattr(each, name) for each in samples]) for name in samples[0].__struct_fields__}
    found = {name: column for name, column in columns.items() if column is not None}
    if isinstance(samples[0], RadarFrame) and found["scans"].shape[1] == 1:
        found["scans"] = found["scans"][:, 0]
    rows = np.empty(len(samples), dtype=[(name, column.dtype, column.shape[1:]) for name, column in found.items()])
    for name, column in found.items():
        rows[name] = column
    return rows


def flat(rows: NDArray[np.void]) -> dict[str, NDArray[Any]]:
    """The columns of `structured` rows for a table: a vector as one column per element, `gyro_0`, `gyro_1` ...

    Larger arrays do not fit into a table and are left out.
    """
    columns: dict[str, NDArray[Any]] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 1:
            columns[name] = column
        elif column.ndim == 2 and column.shape[1] <= LONGEST_VECTOR:
            columns |= {f"{name}_{index}": column[:, index] for index in range(column.shape[1])}
    return columns


def arrays(rows: NDArray[np.void]) -> dict[str, NDArray[Any]]:
    """The columns that `flat` leaves out, (n, ...); complex ones in two parts, `scans_re` and `scans_im`."""
    columns: dict[str, NDArray[Any]] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 1 or (column.ndim == 2 and column.shape[1] <= LONGEST_VECTOR):
            continue
        if np.iscomplexobj(column):
            columns |= {f"{name}_re": column.real.copy(), f"{name}_im": column.imag.copy()}
        else:
            columns[name] = column.copy()
    return columns


LONGEST_VECTOR = 4  # elements: a quaternion; what is longer is an array


def _column(name: str, values: list[Any]) -> NDArray[Any] | None:
    """The values of one field as an array, those that are absent as NaN; None when all are."""
    present = [value for value in values if value is not None]
    if not present:
        return None
    shapes = {np.shape(value) for value in present}
    if len(shapes) > 1:
        raise ValueError(f"{name} has the shapes {', '.join(map(str, sorted(shapes)))}: no column holds them")
    if len(present) < len(values):
        absent: Any = "" if isinstance(present[0], str) else np.full(shapes.pop(), np.nan)
        values = [absent if value is None else value for value in values]
    return np.array(values)
