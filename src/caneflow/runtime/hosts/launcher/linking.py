"""Who listens and who dials, by process."""

from collections.abc import Collection
from dataclasses import replace

import msgspec

from caneflow.runtime.deployment import Deployment
from caneflow.runtime.hosts.links.session import Ports, Sockets
from caneflow.runtime.plan import Links, NodePlan
from caneflow.runtime.site import Site


def linked(deployment: Deployment, ports: Ports | Sockets, launcher: str) -> Deployment:
    """The same with an endpoint for every writer here: readers dial writers, everybody dials the launcher."""
    here = {name: plan for name, plan in deployment.plans.items() if deployment.runs_here(name)}
    process = {name: plan.runs_in for name, plan in here.items()}
    wires = {  # between processes: who is read, by whom; in the order of the file
        (process[name], process[reader]): None
        for name, plan in here.items()
        for reader in plan.readers
        if reader in here and process[reader] != process[name]
    }
    endpoints = {writer: ports.endpoint() for writer in dict.fromkeys(writer for writer, _ in wires)}
    links = {}
    for reader in dict.fromkeys(process.values()):
        # Of two processes that read each other, one dials.
        dialled = [writer for writer, by in wires if by == reader and not _dials(wires, writer, reader)]
        connect = (launcher, *(endpoints[writer] for writer in dialled))
        links[reader] = Links(listen=(endpoints[reader],) if reader in endpoints else (), connect=connect)
    plans = dict(deployment.plans)
    for name, plan in here.items():
        plan = msgspec.structs.replace(plan, links=links[process[name]])
        plans[name] = _with_clocks(plan, deployment.site) if deployment.site else plan
    return replace(deployment, plans=plans)


def _dials(wires: Collection[tuple[str, str]], one: str, other: str) -> bool:
    """Whether `one` is the one of two that read each other which dials."""
    return (other, one) in wires and (one, other) in wires and one < other


def _with_clocks(plan: NodePlan, site: Site) -> NodePlan:
    """The plan with the machine on whose clock each input is."""
    inputs = {
        port: msgspec.structs.replace(
            wire, clock="" if site.places[wire.writer] == site.name else site.places[wire.writer]
        )
        for port, wire in plan.inputs.items()
    }
    return msgspec.structs.replace(plan, inputs=inputs, machine=site.name)
