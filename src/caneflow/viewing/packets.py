"""What goes to the page, as msgpack: plain maps, numbers and byte strings of little-endian float64."""

from collections.abc import Mapping
from typing import Any

import msgspec

from caneflow.messages import encode
from caneflow.messages.control import EdgeStatus, NodeStatus
from caneflow.messages.rig import Rig
from caneflow.viewing.radar_picture import TOP_DB, RadarPicture


def packet(kind: str, **values: Any) -> bytes:
    """One message to the page; `kind` says which."""
    return msgspec.msgpack.encode({"kind": kind, **values})


def hello(*, flow: str, source: str, rig: Rig, span_s: float | None = None, note: str = "") -> bytes:
    """What the page is told first. source: live, replay or recording; span_s: how long a recording is."""
    sensors = {name: [*sensor.position[:2], sensor.azimuth] for name, sensor in rig.sensors.items()}
    return packet("hello", flow=flow, source=source, sensors=sensors, area=rig.area, span=span_s, note=note)


def stream(
    *, kind: str, columns: tuple[str, ...], times: bytes, rows: bytes, first_seq: int, gaps: int, method: str = ""
) -> Mapping[str, Any]:
    """Samples of one stream. times: s since the origin; gaps: numbers that never came, since the beginning."""
    return {
        "type": kind,
        "columns": columns,
        "times": times,
        "rows": rows,
        "first_seq": first_seq,
        "gaps": gaps,
        "method": method,
    }


def picture(radar: str, made: RadarPicture, origin: int) -> Mapping[str, Any]:
    """A range-Doppler map."""
    return {
        "stream": radar,
        "time": (made.stamp - origin) * 1e-9,
        "ranges": made.levels.shape[0],
        "speeds": made.levels.shape[1],
        "levels": made.levels.tobytes(),
        "range_start": made.range_start,
        "range_step": made.range_step,
        "speed_limit": made.speed_limit,
        "edges": made.edges.astype("<f8").tobytes(),
        "strongest": made.strongest,
        "top": TOP_DB,
    }


def status(nodes: list[NodeStatus], edges: list[EdgeStatus]) -> Mapping[str, Any]:
    """What the launcher knows of nodes and edges, as plain maps."""
    return {"nodes": [_plain(node) for node in nodes], "edges": [_plain(edge) for edge in edges]}


def _plain(value: msgspec.Struct) -> Any:
    return msgspec.msgpack.decode(encode(value))
