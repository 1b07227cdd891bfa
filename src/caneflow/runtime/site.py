"""The machine that a launcher runs on, among those of its flow."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.wording import did_you_mean, listed

if TYPE_CHECKING:  # `status` wants to know where keys lie, and half a second goes by until a graph is imported
    from caneflow.runtime.dataflow.graph import Graph, Node

DEFAULT_KEYS = Path("keys")  # the folder with an observer's certificate


@dataclass(frozen=True, kw_only=True)
class Site:
    """The machine that a launcher runs on, among those of its flow."""

    name: str
    leader: str  # the machine whose launcher says when all start and end
    others: tuple[str, ...]
    places: Mapping[str, str]  # by node the machine that it runs on
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    router: str | None = None  # an endpoint that all machines dial; None: they dial each other
    recorders: frozenset[str] = frozenset()  # the machines that may read every stream
    insecure: bool = False  # the file says that machines talk in the clear

    @property
    def leads(self) -> bool:
        """Whether this machine's launcher leads."""
        return self.name == self.leader


def site_of(graph: "Graph", machine: str, nodes: "Mapping[str, Node]") -> Site | None:
    """The place of `machine` in the graph; None when it is the only one."""
    if machine not in graph.machines:
        raise DataflowError(
            f"--machine {machine}: no such machine;{did_you_mean(machine, graph.machines)} "
            f"there are {listed(graph.machines)}"
        )
    places = {name: str(node.machine) for name, node in nodes.items()}
    used = [name for name in graph.machines if name in places.values()]
    if machine not in used:
        raise DataflowError(f"--machine {machine}: no node runs there")
    if len(used) == 1:
        return None
    leader = graph.leader if graph.leader in used else used[0]
    assert leader is not None
    written = graph.machines[machine]
    return Site(
        name=machine,
        leader=leader,
        others=tuple(name for name in used if name in written.linked),
        places=places,
        listen=written.listen,
        connect=(*written.connect, *filter(None, (graph.router,))),
        router=graph.router,
        recorders=frozenset(name for name in used if graph.machines[name].records),
        insecure=graph.insecure,
    )


def door_of(graph: "Graph", listen: str | None) -> Site | None:
    """Where the only machine of the graph, and `listen`, let other programs in, and its router; None: nowhere."""
    used = list({node.machine: None for node in graph.nodes.values()})
    if len(used) != 1:
        return None
    name = used[0] or ""
    site = Site(
        name=name,
        leader=name,
        others=(),
        places=dict.fromkeys(graph.nodes, name),
        listen=graph.machines[name].listen if name else (),
        connect=tuple(filter(None, (graph.router,))),
        router=graph.router,
        insecure=graph.insecure,
    )
    site = with_endpoint(site, listen)
    return site if site.listen or site.router else None


def with_endpoint(site: Site, listen: str | None) -> Site:
    """The same, listening at `listen` as well; raises DataflowError when that is not an endpoint."""
    if listen is None:
        return site
    from caneflow.runtime.dataflow.yaml_shape import ENDPOINT_PATTERN

    if not re.fullmatch(ENDPOINT_PATTERN, listen):
        raise DataflowError(f"--listen {listen}: not an endpoint; expected tcp/HOST:PORT, e.g. tcp/127.0.0.1:7447")
    return replace(site, listen=tuple(dict.fromkeys([*site.listen, listen])))
