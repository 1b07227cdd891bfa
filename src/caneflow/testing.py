"""What tests of one's own programs need: a context, an operator on lists of messages, a source's first samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import msgspec
import numpy as np
from pydantic import TypeAdapter

from caneflow.messages import Sample, with_number
from caneflow.messages.rig import read_rig
from caneflow.runtime.plan import InputPlan, OutputPlan
from caneflow.runtime.program import ANY_PORT, Context, Operator, Quiet, Source
from caneflow.runtime.stages.operator_stage import Stage

__all__ = ["Handled", "context", "run_operator", "run_source"]

FLOW, NODE = "test", "tested"


@dataclass(frozen=True, kw_only=True)
class Handled:
    """What an operator made of the messages that it was given."""

    outputs: dict[str, list[Sample]] = field(default_factory=dict)  # by port, in the order in which they left
    refused: dict[str, int] = field(default_factory=dict)  # by input port, messages that it refused

    def __getitem__(self, port: str) -> list[Sample]:
        return self.outputs[port]


def context(
    *,
    node: str = NODE,
    rig: Mapping[str, Any] | None = None,
    ports: Mapping[str, type[Sample]] | None = None,
    seed: int = 0,
) -> Context:
    """What a host hands to a program: `rig` as in a dataflow.yaml, `ports` that are wired, random numbers of `seed`.

    Raises MessageError for a rig that is not right.
    """
    return Context(node=node, rig=read_rig(dict(rig or {})), ports=ports or {}, random=np.random.default_rng(seed))


def run_operator(
    kind: type[Operator],
    inputs: Mapping[str, Sequence[Sample]],
    *,
    settings: Any = None,
    rig: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> Handled:
    """Give an operator messages by port, in event time and numbered as a flow does it, then end its inputs.

    `settings`: an instance of its Settings, or a mapping as in a dataflow.yaml (None: all by default). Messages keep
    the numbers that they have; those without any are numbered from 0.

    Raises what the operator raises, ValueError for settings that are not right, and DataflowError for an output that
    breaks the rules (a port that is not declared, a stamp that goes back).
    """
    ports = {port: _kind(kind.inputs, port) for port in inputs}
    operator = kind(_settings(kind.Settings, settings), context(rig=rig, ports=ports, seed=seed))
    stage = Stage(
        NODE,
        operator,
        {port: InputPlan(key=f"{FLOW}/{port}/{port}", schema=each.schema, writer=port) for port, each in ports.items()},
        {port: OutputPlan(key=f"{FLOW}/{NODE}/{port}", schema=each.schema) for port, each in kind.outputs.items()},
    )
    for port, messages in inputs.items():
        for seq, message in enumerate(messages):
            stage.offer(port, _numbered(message, seq))
        stage.close(port)
    outputs: dict[str, list[Sample]] = {port: [] for port in kind.outputs}
    while (emitted := stage.step()) is not None:
        for port, message, seq in emitted:
            outputs[port].append(with_number(message, seq))
    refused = {port: counts.refused for port, counts in stage.input_counts().items()}
    return Handled(outputs=outputs, refused=refused)


def run_source(
    kind: type[Source], count: int, *, settings: Any = None, rig: Mapping[str, Any] | None = None, seed: int = 0
) -> list[tuple[str, Sample]]:
    """The first `count` samples of a source as (port, sample), `Quiet` aside; the source is closed after them.

    It runs here, so it may block, as its driver does: give it a fake of its device in `settings`, or an emulator.
    """
    source = kind(_settings(kind.Settings, settings), context(rig=rig, ports=kind.outputs, seed=seed))
    samples = source.samples()
    try:
        found = (item for item in samples if not isinstance(item, Quiet))
        return [(port, sample) for port, sample in islice(found, count) if isinstance(sample, Sample)]
    finally:
        samples.close()


def _settings(kind: type[Any], settings: Any) -> Any:
    if settings is None or isinstance(settings, Mapping):
        return TypeAdapter(kind).validate_python(dict(settings or {}))
    return settings


def _kind(declared: Mapping[str, type[Sample]], port: str) -> type[Sample]:
    kind = declared.get(port) or declared.get(ANY_PORT)
    if kind is None:
        raise ValueError(f"no input {port!r}; there are {', '.join(declared)}")
    return kind


def _numbered(message: Sample, seq: int) -> Sample:
    return message if message.seq >= 0 else msgspec.structs.replace(message, seq=seq)
