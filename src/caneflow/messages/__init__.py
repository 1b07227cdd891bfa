"""Every message that crosses a process, and its encoding: the contract of docs/messages.md."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from caneflow.messages.codec import MAX_PAYLOAD, MEDIA_TYPE, decode, encode, json_schema, numbered, with_number
    from caneflow.messages.errors import MessageError
    from caneflow.messages.keys import NAME, NAME_RULE, control_key, sample_key, stream_of
    from caneflow.messages.motion import GroundSpeed, Imu, Pose
    from caneflow.messages.radar import DopplerBlock, DopplerTarget, RadarFrame, RadarPoints
    from caneflow.messages.registry import SAMPLES
    from caneflow.messages.sample import Sample
    from caneflow.messages.surroundings import Cue, Grid, Obstacles, RadarTargets, Ranges

__all__ = [
    "MAX_PAYLOAD",
    "MEDIA_TYPE",
    "NAME",
    "NAME_RULE",
    "SAMPLES",
    "Cue",
    "DopplerBlock",
    "DopplerTarget",
    "Grid",
    "GroundSpeed",
    "Imu",
    "MessageError",
    "Obstacles",
    "Pose",
    "RadarFrame",
    "RadarPoints",
    "RadarTargets",
    "Ranges",
    "Sample",
    "control_key",
    "decode",
    "encode",
    "json_schema",
    "numbered",
    "sample_key",
    "stream_of",
    "with_number",
]

LIGHT = {  # where what needs no numpy is, which takes as long to import as all the rest of `caneflow status`
    "MessageError": "errors",
    **dict.fromkeys(("NAME", "NAME_RULE", "control_key", "sample_key", "stream_of"), "keys"),
}
FAMILIES = {  # the file of each family: what it defines
    "motion": ("Imu", "GroundSpeed", "Pose"),
    "radar": ("RadarFrame", "RadarPoints", "DopplerBlock", "DopplerTarget"),
    "surroundings": ("Ranges", "RadarTargets", "Grid", "Obstacles", "Cue"),
}
ROOMS = LIGHT | {"Sample": "sample"} | {name: family for family, names in FAMILIES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "SAMPLES":
        for family in FAMILIES:  # each registers what it defines
            import_module(f"{__name__}.{family}")
    room = "registry" if name == "SAMPLES" else ROOMS.get(name, "codec")
    value = globals()[name] = getattr(import_module(f"{__name__}.{room}"), name)
    return value
