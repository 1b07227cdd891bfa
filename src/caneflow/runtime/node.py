"""The door of a program: run(Program), or python -m caneflow.runtime.node PLAN for a group.

The launcher starts `python -m <program> <plan>`; the plan says what to read, what to write and whom to dial.
"""

import logging
import signal
import sys
from pathlib import Path

from caneflow.runtime.building import build
from caneflow.runtime.hosts.process.bus import Bus
from caneflow.runtime.hosts.process.events import Stopped
from caneflow.runtime.hosts.process.last_words import telling_failures
from caneflow.runtime.hosts.process.process import Process
from caneflow.runtime.hosts.process.sources import SourceProcess
from caneflow.runtime.plan import NodePlan, ProcessPlan
from caneflow.runtime.program import Program, Source


def run(program: Program) -> None:
    """Run `program` as the node that the plan on the command line describes; the process ends with it."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.INFO, stream=sys.stderr)
    if len(sys.argv) < 2:
        sys.exit(f"usage: {sys.argv[0]} PLAN; a node is started by `caneflow run`")
    with telling_failures():
        path = Path(sys.argv[1])
        plan = NodePlan.read(path)
        folder = path.parent if plan.state_folder is None else Path(plan.state_folder)
        _run(program, plan, folder / f"{plan.node}.snapshot")
    sys.exit(0)


def _run(program: Program, plan: NodePlan, snapshots: Path) -> None:
    with telling_failures(building=True):
        built = build(program, plan)
    process = ProcessPlan.of(plan)
    with Bus(process) as bus:
        signal.signal(signal.SIGINT, lambda *_: None)  # the launcher decides when a node ends
        host: SourceProcess | Process
        if isinstance(built, Source):
            host = SourceProcess(process, bus, built)
        else:
            signal.signal(signal.SIGTERM, lambda *_: bus.put(Stopped()))
            host = Process(process, bus, {plan.node: built}, snapshots)
        with telling_failures(at=host.at):
            host.run()
