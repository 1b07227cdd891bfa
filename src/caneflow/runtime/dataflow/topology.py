"""Checks the machines of a graph: that samples can reach every reader.

Zenoh peers do not relay for peers, and say nothing about it: two machines that share a wire need a link of their
own, which exactly one of the two dials, or a router that both dial.
"""

import ipaddress
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from caneflow.runtime.dataflow.wiring import Part
from caneflow.runtime.dataflow.yaml_file import Document
from caneflow.runtime.dataflow.yaml_shape import FlowShape, is_written
from caneflow.runtime.wording import did_you_mean, listed

EVERYWHERE = {"0.0.0.0", "[::]"}  # noqa: S104 - compared with, not bound to
HIGHEST_PORT = 65535
NOBODY_LISTENS = (
    "is a program of someone else's, and this machine does not listen for it; "
    "write e.g. machines: {here: {listen: [tcp/127.0.0.1:7447]}}, or give --listen tcp/127.0.0.1:7447"
)
RESERVED = {"ca", "observer", "router"}  # names among the keys of a flow


class Layout(NamedTuple):
    """Where everything runs."""

    places: dict[str, str | None]  # the machine of every node; None: there is only one, without a name
    leader: str | None  # the first machine of the file that has a link with every other one
    links: dict[str, tuple[str, ...]]  # by machine those that it has a link with


class Endpoint(NamedTuple):
    """A Zenoh endpoint in parts."""

    protocol: str
    host: str
    port: int


def check_machines(document: Document, flow: FlowShape, parts: Mapping[str, Part]) -> Layout:
    """The machine of every node, and the one that leads; what is wrong is noted."""
    places = {name: _machine_of(document, flow, name, part) for name, part in parts.items()}
    reached = _reached(document, flow)
    if flow.router is not None:
        _check_port(document, ("router",), flow.router)
        reached = {name: set(flow.machines) - {name} for name in flow.machines}
    dead = False
    for reader, part in parts.items():
        for port, wire in part.wires.items():
            here, there = places[reader], places.get(wire.node)
            if here is None or there is None or here == there:
                continue
            if there not in reached[here] and here not in reached[there]:
                dead = True
                document.problem(
                    ("nodes", reader, "inputs", port),
                    f"leads from machine {there!r} to machine {here!r}, and neither dials the other; "
                    f"{_advice(flow, there, here)} (a third machine does not relay)",
                )
    for machine in flow.machines:
        if machine in RESERVED:
            document.problem(("machines", machine), "is taken by caneflow; call it otherwise", key=True)
        if machine not in places.values():
            document.problem(("machines", machine), "no node runs here", key=True, warning=True)
    for name, part in parts.items():
        at = flow.machines.get(places[name] or "")
        if part.shape.external and not (at and at.listen) and flow.router is None:
            document.problem(("nodes", name), NOBODY_LISTENS, key=True, warning=True)
    used = [machine for machine in flow.machines if machine in places.values()]
    leader = _leader(used, reached)
    if len(used) > 1 and leader is None and not dead:
        document.problem(
            ("machines",),
            f"none of {listed(used)} has a link with every other one, so none can lead: "
            f"the others hear from it when to start; {_advice(flow, used[0], used[1])}",
        )
    links = {
        name: tuple(other for other in flow.machines if other in reached[name] or name in reached[other])
        for name in flow.machines
    }
    if flow.insecure:
        alone = len(used) <= 1 and flow.links != "tcp"  # then it listens for those who only read
        rights = "reads everything" if alone else "reads and writes everything"
        document.problem(("insecure",), f"machines talk in the clear: whoever reaches them {rights}", warning=True)
    return Layout(places, leader if len(used) > 1 else None, links)


def _leader(machines: Sequence[str], reached: Mapping[str, set[str]]) -> str | None:
    """The first machine that has a link with every other one."""
    for machine in machines:
        if all(other in reached[machine] or machine in reached[other] for other in machines if other != machine):
            return machine
    return None


def _machine_of(document: Document, flow: FlowShape, name: str, part: Part) -> str | None:
    machines = list(flow.machines)
    machine, path = part.shape.machine, ("nodes", name, "machine")
    if machine in flow.machines:
        return machine
    if machine is not None:
        if not is_written(document.value, ("machines", machine)):
            document.problem(
                path, f"no machine {machine!r};{did_you_mean(machine, machines)} there are {listed(machines)}"
            )
        return None
    if len(machines) > 1 and not is_written(document.value, path):
        document.problem(path, f"is missing; there are several: {listed(machines)}", key=True)
    return machines[0] if len(machines) == 1 else None


def _reached(document: Document, flow: FlowShape) -> dict[str, set[str]]:
    """For each machine, those that it dials."""
    reached: dict[str, set[str]] = {name: set() for name in flow.machines}
    for name, machine in flow.machines.items():
        for word, endpoints in (("listen", machine.listen), ("connect", machine.connect)):
            for i, endpoint in enumerate(endpoints):
                _check_port(document, ("machines", name, word, i), endpoint)
        for i, endpoint in enumerate(machine.connect):
            met = _met(flow, name, _parts(endpoint))
            reached[name] |= met
            if not met:
                document.problem(("machines", name, "connect", i), "no other machine listens there", warning=True)
    for name in reached:
        for other in reached[name]:
            if name < other and name in reached[other]:
                document.problem(
                    ("machines", other, "connect"),
                    f"{name} and {other} dial each other; one of the two should: a link dialled from both ends "
                    "may stay split after a loss",
                    warning=True,
                )
    return reached


def _check_port(document: Document, path: tuple[str | int, ...], endpoint: str) -> None:
    port = _parts(endpoint).port
    if not 1 <= port <= HIGHEST_PORT:
        document.problem(path, f"has port {port}; ports are 1..{HIGHEST_PORT}")


def _met(flow: FlowShape, dialling: str, dialled: Endpoint) -> set[str]:
    """The machines that may be meant by `dialled`."""
    met = {
        name
        for name, machine in flow.machines.items()
        if name != dialling and any(_may_be(dialled, _parts(listening)) for listening in machine.listen)
    }
    # All may listen on the same port: then the name of the host tells which of them it is.
    by_name = {name for name in met if dialled.host.split(".")[0] == name}
    return by_name or met


def _may_be(dialled: Endpoint, listening: Endpoint) -> bool:
    if (dialled.protocol, dialled.port) != (listening.protocol, listening.port):
        return False
    if listening.host in EVERYWHERE or dialled.host == listening.host:
        return True
    if _is_loopback(listening.host) or _is_loopback(dialled.host):
        return _is_loopback(listening.host) and _is_loopback(dialled.host)
    return not (_is_address(dialled.host) and _is_address(listening.host))  # a name may stand for any address


def _parts(endpoint: str) -> Endpoint:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    return Endpoint(protocol, host, int(port))


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def is_open(endpoint: str) -> bool:
    """Whether `endpoint` leads beyond this computer."""
    return not _is_loopback(_parts(endpoint).host)


def _is_loopback(host: str) -> bool:
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host.strip("[]")).is_loopback)


def _advice(flow: FlowShape, one: str, other: str) -> str:
    """What to write so that two machines have a link."""
    for listener, dialler in ((one, other), (other, one)):
        for endpoint in flow.machines[listener].listen:
            protocol, host, port = _parts(endpoint)
            if not _is_loopback(host):
                host = f"{listener}.local" if host in EVERYWHERE else host
                return f"e.g. {dialler}: {{connect: [{protocol}/{host}:{port}]}}"
    return f"e.g. {one}: {{listen: [tcp/0.0.0.0:7447]}}, {other}: {{connect: [tcp/{one}.local:7447]}}"
