"""What may be written in a dataflow.yaml, and in which form: its keys, their types, their defaults.

The semantic checks (wires, programs, machines) come after it, and take what this leaves standing: a value that is
wrong here is reported and then treated as not written.
"""

import copy
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from caneflow.messages import NAME, NAME_RULE
from caneflow.messages.rig import Rig
from caneflow.runtime.dataflow.validation import Checked, Mistake, is_inside
from caneflow.runtime.wording import KeyPath

NAME_PATTERN = f"^{NAME.pattern}$"
STREAM_PATTERN = f"^{NAME.pattern}/{NAME.pattern}$"
QUEUE_PATTERN = "^(latest|all|fifo [1-9][0-9]{0,5})$"
ENDPOINT_PATTERN = r"^tcp/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):[0-9]{1,5}$"

ALL_LENGTH = 4096  # samples that may wait on an input that takes `all`: 40 s at 100 Hz

Policy = Literal["never", "on-failure", "always"]
LocalLinks = Literal["unix", "tcp"]

Name = Annotated[str, Field(pattern=NAME_PATTERN, description=NAME_RULE)]
Stream = Annotated[str, Field(pattern=STREAM_PATTERN, examples=["radar/frame"])]
Endpoint = Annotated[str, Field(pattern=ENDPOINT_PATTERN, examples=["tcp/0.0.0.0:7447"])]


class Shape(BaseModel):
    """A mapping of the file: nothing in it that is not listed here."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class InputShape(Shape):
    """One input of a node, where more is to be said than `port: node/output`."""

    source: Annotated[
        str,
        Field(alias="from", pattern=STREAM_PATTERN, examples=["radar/frame"], description="node and output"),
    ]
    queue: Annotated[
        str,
        Field(
            pattern=QUEUE_PATTERN,
            examples=["latest", "fifo 10", "all"],
            description=f"live: which samples wait. `latest`: the newest one; `fifo N`: the newest N; "
            f"`all`: every one, up to {ALL_LENGTH}. The oldest is dropped and counted beyond that",
        ),
    ] = "all"
    max_lag_ms: Annotated[
        float | None,
        Field(ge=0, le=3.6e6, description="ms, live: how long the node waits for this input; left out: forever"),
    ] = None
    max_age_ms: Annotated[
        float | None, Field(ge=0.1, le=3.6e6, description="ms, live: an older sample is dropped; left out: none is")
    ] = None


class RestartShape(Shape):
    """What becomes of a node whose process ends."""

    policy: Annotated[Policy, Field(description="start it again never, when it failed, or whenever it has ended")] = (
        "on-failure"
    )
    max_restarts: Annotated[
        int,
        Field(ge=1, le=1000, description="restarts until it is given up; each counts for as long as `window_s` says"),
    ] = 10
    window_s: Annotated[
        float,
        Field(ge=0.1, le=86400, description="s that the node has to be up until earlier ends of it no longer count"),
    ] = 60.0
    delay_s: Annotated[
        float, Field(ge=0, le=3600, description="s before the first restart; doubles with each one that counts")
    ] = 0.25
    max_delay_s: Annotated[float, Field(ge=1e-3, le=3600, description="s; the delay grows no further")] = 10.0


class MachineShape(Shape):
    """One computer: where it is reached, and whom it dials."""

    listen: Annotated[
        list[Endpoint],
        Field(description="where other machines reach it, and programs that read, or that are its external nodes"),
    ] = []
    connect: Annotated[
        list[Endpoint], Field(description="whom it dials: for each pair of machines, one of the two does")
    ] = []
    records: Annotated[
        bool, Field(description="may read every stream, to record them (`--record`); with keys it has to be said")
    ] = False


def _expanded_input(written: object) -> object:
    return {"from": written} if isinstance(written, str) else written


def _expanded_restart(written: object) -> object:
    return {"policy": written} if isinstance(written, str) else written


def _short_or(short: dict[str, Any], long: type[Shape], description: str) -> WithJsonSchema:
    schema = long.model_json_schema()
    return WithJsonSchema({"anyOf": [short, schema], "description": description})


Input = Annotated[
    InputShape,
    BeforeValidator(_expanded_input),
    _short_or(
        {"type": "string", "pattern": STREAM_PATTERN, "examples": ["radar/frame"]},
        InputShape,
        "node/output, or a mapping that says more",
    ),
]
Restart = Annotated[
    RestartShape,
    BeforeValidator(_expanded_restart),
    _short_or(
        {"type": "string", "enum": ["never", "on-failure", "always"]},
        RestartShape,
        "what becomes of the node when its process ends (left out: on-failure); a mapping says how fast",
    ),
]


class NodeShape(Shape):
    """One node: a program and how it is wired."""

    run: Annotated[
        str,
        Field(
            default_factory=str,
            examples=["drivers.bno055", "operators.fusion", "my/own.py"],
            description="the program: a module of caneflow, or a path (from this file) to a Python file; "
            "an external node has none",
        ),
    ]
    machine: Annotated[Name | None, Field(description="one of `machines`; needed when there are several")] = None
    process: Annotated[
        Name | None,
        Field(
            description="the process that runs it, with all nodes of its machine that say the same: samples between "
            "them go by a call; left out: one of its own. `recorder`: the one of `--record`"
        ),
    ] = None
    inputs: Annotated[dict[Name, Input], Field(description="for each port of the program, what it reads")] = {}
    settings: Annotated[dict[str, Any], Field(description="the program's own; see its Settings")] = {}
    restart: Annotated[Restart, Field(default_factory=RestartShape)]
    external: Annotated[
        bool, Field(description="a device that publishes by itself: it has `outputs`, and no program")
    ] = False
    outputs: Annotated[
        dict[Name, str],
        Field(
            description="external only: for each port, the message it sends, e.g. `Imu` or `caneflow.Imu/1`; "
            "of your own `mine.Range/1`, or `./ranges.py:Range`"
        ),
    ] = {}
    ready_timeout_s: Annotated[
        float, Field(ge=0.1, le=3600, description="s from its start within which the node says that it is ready")
    ] = 20.0


class FlowShape(Shape):
    """A dataflow.yaml."""

    model_config = ConfigDict(title="caneflow dataflow", json_schema_extra={"required": ["flow", "nodes"]})

    flow: Annotated[
        str,
        Field(
            default_factory=str,
            pattern=NAME_PATTERN,
            examples=["cane"],
            description=f"first part of every key: {NAME_RULE}",
        ),
    ]
    seed: Annotated[int, Field(ge=0, le=2**32 - 1, description="where all random numbers of the flow come from")] = 0
    rig: Annotated[Rig, Field(default_factory=Rig, description="what is bolted on")]
    machines: Annotated[dict[Name, MachineShape], Field(description="when the flow runs on several computers")] = {}
    router: Annotated[
        Endpoint | None,
        Field(
            description="a Zenoh router (zenohd) that every machine dials, also a single one; several need no "
            "links with each other then"
        ),
    ] = None
    links: Annotated[
        LocalLinks,
        Field(
            description="between the processes of one machine: `unix`, sockets in a folder that only this user can "
            "enter; `tcp`, ports on 127.0.0.1, which every user of the machine can reach"
        ),
    ] = "unix"
    insecure: Annotated[
        bool, Field(description="machines talk in the clear, with whoever reaches them; else with keys only")
    ] = False
    nodes: Annotated[dict[Name, NodeShape], Field(default_factory=dict, description="the programs and their wires")]
    results: Annotated[
        list[Stream], Field(description="outputs that are for people and recordings: no node has to read them")
    ] = []


_checked_flow: Checked[FlowShape] = Checked(FlowShape)


def read_shape(values: dict[str, Any]) -> tuple[FlowShape, list[Mistake]]:
    """`values` as far as their form is right, and every mistake of form."""
    flow, mistakes = _checked_flow(values)
    left, wrong = copy.deepcopy(values), mistakes
    while flow is None:
        # What hangs on something wrong may be wrong only for that: so only the first round is reported.
        for path in {_nearest(left, mistake.path) for mistake in wrong}:
            _take_out(left, path)
        flow, wrong = _checked_flow(left)
    return flow, mistakes


def yaml_schema() -> dict[str, Any]:
    """The JSON Schema of a dataflow.yaml, for editors: docs/dataflow.schema.json."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **FlowShape.model_json_schema()}


def is_written(values: Any, path: KeyPath) -> bool:
    """Whether anything stands at `path`, right or wrong."""
    return _nearest(values, path) == path


def _nearest(values: Any, path: KeyPath) -> KeyPath:
    """`path`, as far as it leads through `values`."""
    for i, key in enumerate(path):
        if not is_inside(values, key):
            return path[:i]
        values = values[key]
    return path


def _take_out(values: Any, path: KeyPath) -> None:
    """Delete what stands at `path`, unless it went with something else; all of it for the empty path."""
    if not path:
        values.clear()
    elif _nearest(values, path) == path:
        for key in path[:-1]:
            values = values[key]
        values.pop(path[-1])
