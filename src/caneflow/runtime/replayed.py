"""A recording in the place of the drivers: its plans, its span, what the recorded run left out."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from caneflow.messages import MessageError, Sample, control_key, decode, sample_key
from caneflow.messages.control import LeftOut
from caneflow.recording import Recording
from caneflow.runtime.dataflow.graph import Graph, Node
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.plan import NodePlan, OutputPlan
from caneflow.runtime.user_files import place_of

LeftOutStamps: TypeAlias = dict[tuple[str, str], set[int]]  # ns, by node and port

REPLAYER_MODULE = "caneflow.drivers.replay"


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A recording in the place of every node without inputs."""

    recording: Path
    speed: float = 1.0  # times real time; inf: as fast as the readers can
    start_s: float = 0.0  # from the recording's first stamp
    duration_s: float | None = None
    loop: bool = False
    without: frozenset[str] = frozenset()  # nodes that are left out


def outputs_of(flow: str, node: str, kinds: dict[str, type[Sample]]) -> dict[str, OutputPlan]:
    """The outputs of a node, by port, with their message types."""
    return {
        port: OutputPlan(key=sample_key(flow, node, port), schema=kind.schema, kind_at=place_of(kind))
        for port, kind in kinds.items()
    }


def replayed_plan(
    graph: Graph, node: Node, nodes: dict[str, Node], replay: Replay, recording: Recording, origin: int
) -> NodePlan:
    """The replayer in the place of a node without inputs: it plays the streams that the recording holds of it."""
    kinds = {}
    for port, kind in node.outputs.items():
        stream = recording.streams.get((node.name, port))
        if stream is None:
            if any(
                wire.node == node.name and wire.port == port
                for reader in nodes.values()
                for wire in reader.inputs.values()
            ):
                raise DataflowError(
                    f"{replay.recording}: no stream {node.name}/{port}; it holds {recording.named()} "
                    f"(--without {node.name} leaves the node out)"
                )
        elif stream.schema != kind.schema:
            raise DataflowError(
                f"{replay.recording}: {node.name}/{port} holds {stream.schema}, the graph says {kind.schema}"
            )
        else:
            kinds[port] = kind
    settings = {
        "recording": str(replay.recording.resolve()),
        "speed": None if math.isinf(replay.speed) else replay.speed,
        "origin_ns": origin,
        "duration_s": replay.duration_s,
        "loop_s": _loop_s(recording, replay, origin) if replay.loop else None,
    }
    return NodePlan(
        flow=graph.flow,
        node=node.name,
        process=node.process or "",
        module=REPLAYER_MODULE,
        settings=settings,
        seed=graph.seed,
        outputs=outputs_of(graph.flow, node.name, kinds),
        ready_timeout_s=node.ready_timeout_s,
    )


def left_out_of(graph: Graph, recording: Recording) -> LeftOutStamps:
    """What the nodes of a recorded live run said that they did not handle: by node and port, the stamps (ns)."""
    stamps: LeftOutStamps = {}
    lost: dict[tuple[str, str], list[tuple[int, int]]] = {}  # by node and port the numbers, first and last
    for payload in recording.said(control_key(recording.flow, "late")):
        try:
            note = decode(payload, LeftOut)
        except MessageError as error:
            raise DataflowError(f"{recording.path}: what it says was left out cannot be read: {error}") from error
        reader = graph.nodes.get(note.node)
        if reader is None or note.port not in reader.inputs:
            continue  # another graph than the recorded one: what it leaves out is its own affair
        if note.stamp >= 0:
            stamps.setdefault((note.node, note.port), set()).add(note.stamp)
        else:
            lost.setdefault((note.node, note.port), []).append((note.first_seq, note.last_seq))
    for (node, port), ranges in lost.items():
        wire = graph.nodes[node].inputs[port]
        if (wire.node, wire.port) in recording.streams:  # never came there, but did come to the recorder
            numbers = _Numbers(ranges)
            samples = recording.samples([(wire.node, wire.port)])
            stamps.setdefault((node, port), set()).update(s.stamp for s in samples if s.seq in numbers)
    return stamps


class _Numbers:
    """Ranges of numbers, given by their first and last. There are many, so they are not searched for each sample."""

    def __init__(self, ranges: Iterable[tuple[int, int]]) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []  # the largest so far
        for first, last in sorted(ranges):
            self._firsts.append(first)
            self._lasts.append(max([last, *self._lasts[-1:]]))

    def __contains__(self, number: int) -> bool:
        before = bisect_right(self._firsts, number)
        return before > 0 and number <= self._lasts[before - 1]


def _span(recording: Recording) -> tuple[int, int]:
    span = recording.span()
    if span is None:
        raise DataflowError(f"{recording.path}: holds no sample; there is nothing to replay")
    return span


def origin_of(recording: Recording, replay: Replay) -> int:
    """The stamp (ns) at which the replay begins."""
    first, last = _span(recording)
    if replay.start_s * 1e9 > last - first:
        raise DataflowError(
            f"{replay.recording}: --start {replay.start_s:g} s lies beyond its end at {(last - first) / 1e9:.3f} s"
        )
    return first + round(replay.start_s * 1e9)


def last_of(recording: Recording, replay: Replay, origin: int) -> int | None:
    """The last stamp (ns) of the replay that begins at the stamp `origin`; None: it begins again and again."""
    if replay.loop:
        return None
    _, last = _span(recording)
    return last if replay.duration_s is None else min(last, origin + round(replay.duration_s * 1e9))


def require_stamps(recording: Recording, replay: Replay, origin: int, plans: Mapping[str, NodePlan]) -> None:
    """Raise DataflowError for a stream whose stamps go back or are not its samples', up to the end of the replay.

    Before anything starts: half of such a stream would be refused on its way.
    """
    end = None if replay.duration_s is None else origin + round(replay.duration_s * 1e9)
    replayed = [(name, port) for name, plan in plans.items() if plan.module == REPLAYER_MODULE for port in plan.outputs]
    found = recording.examined(replayed, end_ns=end)
    for each in found.values():
        if each.fault:
            raise DataflowError(f"{replay.recording}: {each.fault}")


def _loop_s(recording: Recording, replay: Replay, origin: int) -> float:
    """How long (s) one turn of a loop takes: from the first stamp to one mean sample spacing after the last."""
    first, last = _span(recording)
    longest = max(stream.count for stream in recording.streams.values())
    spacing = (last - first) / max(1, longest - 1)
    whole = (last - origin + spacing) / 1e9
    return whole if replay.duration_s is None else min(whole, replay.duration_s)
