"""Who listens and who dials, by process."""

from dataclasses import replace

import msgspec

from caneflow.runtime.deployment import Deployment
from caneflow.runtime.hosts.links.session import Ports, Sockets
from caneflow.runtime.plan import Links, NodePlan
from caneflow.runtime.site import Site


def linked(deployment: Deployment, ports: Ports | Sockets, launcher: str) -> Deployment:
    """The same with an endpoint for every writer here: readers dial writers, everybody dials the launcher."""
    here = {name: plan for name, plan in deployment.plans.items() if deployment.runs_here(name)}
    endpoints = {name: ports.endpoint() for name, plan in here.items() if any(map(here.get, plan.readers))}
    plans = dict(deployment.plans)
    for name, plan in here.items():
        writers = dict.fromkeys(wire.writer for wire in plan.inputs.values())
        connect = (launcher, *(endpoints[writer] for writer in writers if writer in endpoints))
        listen = (endpoints[name],) if name in endpoints else ()
        plan = msgspec.structs.replace(plan, links=Links(listen=listen, connect=connect))
        plans[name] = _with_clocks(plan, deployment.site) if deployment.site else plan
    return replace(deployment, plans=plans)


def _with_clocks(plan: NodePlan, site: Site) -> NodePlan:
    """The plan with the machine on whose clock each input is."""
    inputs = {
        port: msgspec.structs.replace(
            wire, clock="" if site.places[wire.writer] == site.name else site.places[wire.writer]
        )
        for port, wire in plan.inputs.items()
    }
    return msgspec.structs.replace(plan, inputs=inputs, machine=site.name)
