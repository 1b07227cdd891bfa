"""What a process is started with: its node's plan, and what has become of the run meanwhile."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from caneflow.runtime.deployment import RECORDER_MODULE
from caneflow.runtime.hosts.launcher.congestion import node_id
from caneflow.runtime.hosts.launcher.node_state import NodeState
from caneflow.runtime.plan import NodePlan
from caneflow.runtime.replayed import REPLAYER_MODULE


def plan_to_start(
    node: NodeState,
    *,
    run: str,
    state: Path,
    spares: Sequence[str],
    out_of_reach: Sequence[str],
    started_s: float | None,
) -> NodePlan:
    """The plan of a start of `node`.

    `run`: from which the id of its session follows. `state`: the folder of its snapshots. `spares`, `out_of_reach`:
    nodes that need not be there. `started_s`: when all nodes were ready (monotonic); None: they were not yet.
    """
    plan = node.plan
    settings = dict(plan.settings)
    if started_s is not None and plan.module == REPLAYER_MODULE:
        settings["started_s"] = started_s
    if node.started_again and plan.module == RECORDER_MODULE:
        settings["goes_on"] = True
    return msgspec.structs.replace(
        plan,
        settings=settings,
        state_folder=str(state),
        # What a spare reader misses at the start it asks for: nobody waits for it, as it may never come.
        absent=(*out_of_reach, *spares),
        takes_over=node.started_again > 0,
        links=msgspec.structs.replace(plan.links, identity=node_id(run, plan.node, node.started_again)),
    )


def program_arguments(plan: NodePlan) -> Sequence[str]:
    """What follows `python` to start the plan's program."""
    return (plan.file,) if plan.file is not None else ("-m", str(plan.module))
