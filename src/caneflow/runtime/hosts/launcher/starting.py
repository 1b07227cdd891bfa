"""What a process is started with: its node's plan, and what has become of the run meanwhile."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from caneflow.runtime.deployment import RECORDER_MODULE
from caneflow.runtime.hosts.launcher.congestion import node_id
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.plan import NodePlan, ProcessPlan
from caneflow.runtime.replayed import REPLAYER_MODULE

GROUP_MODULE = "caneflow.runtime.node"


def plan_to_start(
    members: Sequence[NodeState],
    *,
    run: str,
    state: Path,
    spares: Sequence[str],
    out_of_reach: Sequence[str],
    started_s: float | None,
) -> ProcessPlan:
    """The plan of a start of the process of `members`.

    `run`: from which the id of its session follows. `state`: the folder of its snapshots. `spares`, `out_of_reach`:
    nodes that need not be there. `started_s`: when all nodes were ready (monotonic); None: they were not yet.
    """
    head = members[0]
    identity = node_id(run, head.plan.node, head.started_again)
    again = head.started_again > 0
    nodes = [
        _node_to_start(each.plan, again=again, state=state, absent=(*out_of_reach, *spares), started_s=started_s)
        for each in members
    ]
    links = msgspec.structs.replace(head.plan.links, identity=identity)
    nodes = [msgspec.structs.replace(plan, links=links) for plan in nodes]
    return ProcessPlan(name=head.plan.runs_in, nodes=tuple(nodes))


def _node_to_start(
    plan: NodePlan, *, again: bool, state: Path, absent: tuple[str, ...], started_s: float | None
) -> NodePlan:
    settings = dict(plan.settings)
    if started_s is not None and plan.module == REPLAYER_MODULE:
        settings["started_s"] = started_s
    if again and plan.module == RECORDER_MODULE:
        settings["goes_on"] = True
    return msgspec.structs.replace(
        plan,
        settings=settings,
        state_folder=str(state),
        # What a spare reader misses at the start it asks for: nobody waits for it, as it may never come.
        absent=absent,
        takes_over=again,
    )


def program_arguments(process: ProcessPlan) -> Sequence[str]:
    """What follows `python` to start the program of a process, or the programs of several nodes."""
    if len(process.nodes) > 1:
        return "-m", GROUP_MODULE
    (plan,) = process.nodes
    return (plan.file,) if plan.file is not None else ("-m", str(plan.module))
