"""The door of a program: run(Program), or python -m caneflow.runtime.node PLAN for a group.

The launcher starts `python -m <program> <plan>`; the plan says what to read, what to write and whom to dial.
"""

import gc
import logging
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

from caneflow.runtime.building import build
from caneflow.runtime.dataflow.programs import Located, program_at
from caneflow.runtime.hosts.process.last_words import telling_failures
from caneflow.runtime.hosts.process.speaker import name_speakers
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
        _run({plan.node: program}, ProcessPlan.of(plan), folder / f"{plan.node}.snapshot")
    sys.exit(0)


def run_group() -> None:
    """Run the nodes that the plan on the command line describes; the process ends with them."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.INFO, stream=sys.stderr)
    if len(sys.argv) < 2:
        sys.exit(f"usage: {sys.argv[0]} PLAN; a process is started by `caneflow run`")
    name_speakers()
    with telling_failures():
        path = Path(sys.argv[1])
        plan = ProcessPlan.read(path)
        with telling_failures(building=True):
            programs = {node.node: _program(node) for node in plan.nodes}
        folder = plan.nodes[0].state_folder
        _run(programs, plan, (path.parent if folder is None else Path(folder)) / f"{plan.name}.snapshot")
    sys.exit(0)


def _program(plan: NodePlan) -> Program:
    name = plan.file or str(plan.module)
    return program_at(Located(plan.module, None if plan.file is None else Path(plan.file)), name)


def _run(programs: Mapping[str, Program], process: ProcessPlan, snapshots: Path) -> None:
    # Imported here, as it takes Zenoh: a program is imported by many who do not run it as a process.
    from caneflow.runtime.hosts.process.bus import Bus
    from caneflow.runtime.hosts.process.events import SourcesEnd, Stopped
    from caneflow.runtime.hosts.process.process import Process
    from caneflow.runtime.hosts.process.source_threads import SOURCES_END
    from caneflow.runtime.hosts.process.sources import SourceProcess

    with telling_failures(building=True):
        built = {name: build(programs[name], plan) for name, plan in process.members.items()}
    with Bus(process) as bus:
        signal.signal(signal.SIGINT, lambda *_: None)  # the launcher decides when a node ends
        host: SourceProcess | Process
        (first, *others) = built.values()
        if isinstance(first, Source) and not others:
            host = SourceProcess(process, bus, first)
        else:
            signal.signal(signal.SIGTERM, lambda *_: bus.put(Stopped()))
            if len(built) > 1:
                signal.signal(SOURCES_END, lambda *_: bus.put(SourcesEnd()))
            host = Process(process, bus, built, snapshots)
        gc.freeze()  # what is there now stays until the end: at thousands of samples a second it shows
        with telling_failures(at=host.at):
            host.run()


if __name__ == "__main__":
    run_group()
