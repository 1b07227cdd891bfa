"""Point clouds of radars in ROS as ours: sensor_msgs/PointCloud2 with a field of Doppler.

Fields are found by the names that drivers of radars use. In ROS a Doppler is positive for what recedes (TI's driver,
reve), as the radar says it; ours is positive for what approaches.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from caneflow.messages import RadarPoints
from caneflow.messages.bounds import POINT, RANGE_RATE, SNR

Floats = NDArray[np.float32]

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
DOPPLER = ("v_doppler_mps", "doppler", "velocity", "v_r", "radial_speed", "radial_velocity", "range_rate", "vel")
STRENGTH = ("snr_db", "snr", "intensity")
NOISE = ("noise_db", "noise")
KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


class Bins(NamedTuple):
    """What a cloud does not say of its radar."""

    frame_time: float  # s
    step: float  # m/s
    limit: float  # m/s


def has_doppler(message: Any) -> bool:
    """Whether a sensor_msgs/PointCloud2 has a field of Doppler beside x, y and z."""
    names = {str(field.name) for field in message.fields}
    return {"x", "y", "z"} <= names and not names.isdisjoint(DOPPLER)


def doppler_of(message: Any) -> Floats:
    """The Dopplers (m/s) of a cloud as they stand; raises ValueError for one that has none."""
    return _column(message, DOPPLER)


def cloud_of(message: Any, stamp: int, bins: Bins, *, approaching: bool = False) -> RadarPoints:
    """The points of a cloud in its own frame, x ahead; points that are not numbers are left out.

    `approaching`: its Doppler is positive for what approaches. Raises ValueError for a cloud that does not add up.
    """
    names = [str(field.name) for field in message.fields]
    position = np.stack([_column(message, (axis,)) for axis in "xyz"], axis=1)
    doppler = doppler_of(message) * np.float32(1.0 if approaching else -1.0)
    levels = [_column(message, each) if not set(each).isdisjoint(names) else None for each in (STRENGTH, NOISE)]
    with np.errstate(invalid="ignore"):
        fit = (np.abs(position) < POINT).all(axis=1) & (np.abs(doppler) < RANGE_RATE)
        for level in levels:
            if level is not None:
                fit &= np.abs(level) < SNR
    snr, noise = (None if level is None else np.ascontiguousarray(level[fit]) for level in levels)
    return RadarPoints(
        stamp=stamp,
        position=np.ascontiguousarray(position[fit]),
        doppler=np.ascontiguousarray(doppler[fit]),
        snr=snr,
        noise=noise,
        frame_time=bins.frame_time,
        doppler_step=bins.step,
        doppler_limit=bins.limit,
    )


def _column(message: Any, names: Sequence[str]) -> Floats:
    """The first of the fields `names` that is there, of all points; raises ValueError when none is."""
    fields = {str(field.name): field for field in message.fields}
    field = next((fields[name] for name in names if name in fields), None)
    if field is None:
        raise ValueError(f"it has no field {names[0]}")
    if int(field.datatype) not in KINDS:
        raise ValueError(f"its field {field.name} is of an unknown type, {field.datatype}")
    kind = np.dtype((">" if message.is_bigendian else "<") + KINDS[int(field.datatype)])
    width, height = int(message.width), int(message.height)
    step, row, offset = int(message.point_step), int(message.row_step), int(field.offset)
    data = np.asarray(message.data, np.uint8)
    if not width or not height:
        return np.zeros(0, np.float32)
    if offset + kind.itemsize > step or row < width * step or len(data) < (height - 1) * row + width * step:
        raise ValueError(f"{len(data)} bytes; {height} rows of {width} points of {step} bytes do not fit")
    taken = np.lib.stride_tricks.as_strided(
        data[offset:], (height, width, kind.itemsize), (row * data.strides[0], step * data.strides[0], data.strides[0])
    )
    values: Floats = np.ascontiguousarray(taken).view(kind).reshape(-1).astype(np.float32)
    return values
