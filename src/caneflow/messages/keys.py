"""The keys of a flow, built here and nowhere typed by hand: `<flow>/<node>/<port>` and `<flow>/@/...`."""

import re

NAME = re.compile(r"[a-z][a-z0-9_]*")
NAME_RULE = "a lower-case letter, then lower-case letters, digits or _"
CONTROL = "@"


def sample_key(flow: str, node: str, port: str) -> str:
    """Where the samples of one stream travel, e.g. `cane/imu/imu`: the role, never the machine or program."""
    return f"{flow}/{node}/{port}"


def control_key(flow: str, *parts: str) -> str:
    """Where the flow talks about itself, e.g. `cane/@/progress/fusion`."""
    return "/".join((flow, CONTROL, *parts))


def stream_of(key: str) -> tuple[str, str]:
    """Node and port of a sample's key, whatever the flow's name; raises ValueError for any other key."""
    parts = key.split("/")
    if len(parts) != 3 or CONTROL in parts:
        raise ValueError(f"{key!r}: not a sample's key; expected <flow>/<node>/<port>")
    return parts[1], parts[2]
