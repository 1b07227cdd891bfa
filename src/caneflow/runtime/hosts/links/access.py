"""What a machine may send to another: mutual TLS says who it is, access control what it may do. Default deny.

The rules come from the graph. Each launcher holds them against what comes in and against what goes out, so a
machine that was taken over can neither write what is not its own nor read what it has no use for. Within a machine
the run's private folder says who it is: its sockets are for this user alone.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from caneflow.messages import MAX_PAYLOAD, control_key, sample_key, stream_of
from caneflow.runtime.dataflow.topology import is_open
from caneflow.runtime.deployment import Deployment, recorder_name
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links.certificates import OBSERVER, ROUTER, Credentials, credentials
from caneflow.runtime.hosts.links.session import UNIX
from caneflow.runtime.site import Site

Grants: TypeAlias = dict[str, list[str]]  # by kind of message the keys

NODES_WORDS = ("progress", "marks", "counters")  # what a node says of itself, under `@/<word>/<node>`
LOCAL = {"unix": UNIX, "tcp": "tcp"}  # by the file's `links` Zenoh's word for those within a machine
KINDS = (
    "put",
    "delete",
    "reply",
    "query",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


def tls(endpoint: str) -> str:
    """The endpoint with TLS: the file says only host and port."""
    return "tls/" + endpoint.partition("/")[2]


def secured_links(deployment: Deployment, site: Site, own: Credentials) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS and for who may do what."""
    control = access_control(deployment, site)
    check_access_control(control)
    return {
        "transport/link/tls": _mutual_tls(own),
        "access_control": control,
        "low_pass_filter": [
            {
                "id": "no sample is larger",
                "link_protocols": ["tls"],
                "flows": ["ingress"],
                "messages": ["put", "reply", "query"],
                "key_exprs": _everything(deployment.flow),
                "size_limit": MAX_PAYLOAD,
            }
        ],
    }


def opened(deployment: Deployment, keys: Path | None) -> tuple[Deployment, dict[str, Any]]:
    """The deployment with the endpoints that its launcher opens for others, and Zenoh's settings for them.

    With keys every link beyond the machine's own is mutual TLS. Without, between machines of this computer all may
    do everything; where all nodes are on one machine, whoever comes reads, and feeds its external nodes. Raises
    DataflowError when a link would lead beyond this computer without keys, unless the file says `insecure: true`.
    """
    site = deployment.site or deployment.door
    if site is None:
        return deployment, {}
    own = None if site.insecure or keys is None or not site.name else credentials(keys, site.name)
    if own is None:
        _require_keys(site, keys)
        if deployment.site is not None:
            return deployment, {}
        control = access_control(deployment, site)
        check_access_control(control)
        return deployment, {"access_control": control}
    if deployment.site is not None and deployment.records and site.name not in site.recorders:
        raise DataflowError(f"--record: {site.name} may not read every stream; write machines.{site.name}.records")
    settings = secured_links(deployment, site, own)
    behind_tls = replace(site, listen=tuple(map(tls, site.listen)), connect=tuple(map(tls, site.connect)))
    if deployment.site is not None:
        return replace(deployment, site=behind_tls), settings
    return replace(deployment, door=behind_tls), settings


def _require_keys(site: Site, keys: Path | None) -> None:
    """Raise DataflowError when a link would lead beyond this computer in the clear, and the file does not say so."""
    beyond = [endpoint for endpoint in (*site.listen, *site.connect) if is_open(endpoint)]
    if beyond and not site.insecure:
        if not site.name:
            raise DataflowError(
                f"{beyond[0]}: leads beyond this computer, and this flow has no keys; name the machine in the file "
                "(machines: {here: {listen: [...]}}) and make its keys, or write `insecure: true`"
            )
        raise DataflowError(
            f"{site.name}: no keys for {beyond[0]} in {keys}; `caneflow keys init` and `caneflow keys add {site.name}` "
            "make them (or write `insecure: true` for a network that only you are in)"
        )


def access_control(deployment: Deployment, site: Site) -> dict[str, Any]:
    """The rules of one machine's launcher, as Zenoh takes them."""
    both_ways = {
        other: (machine_grants(deployment, site, other, site.name), machine_grants(deployment, site, site.name, other))
        for other in site.others
    }
    both_ways[OBSERVER] = observer_grants(deployment.flow)
    if site.router is not None:
        # What comes from the router is anybody's: that each machine says only what is its own, the router sees to.
        ways = list(both_ways.values())
        ways.append(feeder_grants(deployment, site))
        both_ways[ROUTER] = (_together(comes for comes, _ in ways), _together(goes for _, goes in ways))
    control = _default_deny(both_ways)
    everything = dict.fromkeys(KINDS, _everything("*"))
    _allow(control, "this machine", {"link_protocols": [LOCAL[deployment.links]]}, everything, everything)
    if deployment.links != "tcp":  # where it is not the flow's own, who comes by it is nobody in particular
        _allow(control, "anybody by TCP", {"link_protocols": ["tcp"]}, *feeder_grants(deployment, site))
    if site.name:  # who shows this machine's own certificate is one of its programs
        _allow(control, site.name, {"cert_common_names": [site.name]}, *feeder_grants(deployment, site))
    return control


def router_settings(deployment: Deployment, site: Site, own: Credentials) -> dict[str, Any]:
    """The configuration of a Zenoh router that passes on for all machines of the flow, and holds each to its rules."""
    assert site.router is not None
    machines = (site.name, *site.others)
    asks, gets = observer_grants(deployment.flow)
    both_ways = {OBSERVER: (asks, gets)}
    for machine in machines:
        others = [other for other in machines if other != machine]
        comes = [machine_grants(deployment, site, machine, other) for other in others]
        goes = [machine_grants(deployment, site, other, machine) for other in others]
        observed = observed_grants(deployment, site, machine)
        # Its external nodes show its certificate: what they write goes to it, and they hear that it reads that.
        fed = external_keys(deployment, site, machine)
        feeds: Grants = {"declare_subscriber": fed}
        both_ways[machine] = (_together([*comes, observed, feeds]), _together([*goes, asks, feeds, {"put": fed}]))
    control = _default_deny(both_ways)
    check_access_control(control)
    port = site.router.rpartition(":")[2]
    return {
        "mode": "router",
        "listen": {"endpoints": [f"tls/[::]:{port}"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": _mutual_tls(own)}},
        "access_control": control,
    }


def machine_grants(deployment: Deployment, site: Site, sender: str, receiver: str) -> Grants:
    """What `sender` may send to `receiver`: samples that are read there, and what keeps the flow going."""
    flow, leads = deployment.flow, sender == site.leader
    senders = _nodes_on(deployment, site, sender)
    receivers = _nodes_on(deployment, site, receiver)

    def control(*parts: str) -> str:
        return control_key(flow, *parts)

    heard = [control(word, "*") for word in NODES_WORDS]
    heard += [control("failed", "*")] if leads else [control(word) for word in ("start", "window", "end")]
    told = [control(word, node) for node in senders for word in NODES_WORDS]
    told += [control(word) for word in ("start", "window", "end")] if leads else [control("failed", sender)]
    told += [control("late")] if receiver in site.recorders else []
    heard += [control("late")] if sender in site.recorders else []
    answered = [_history_of(key) for key in _samples_between(deployment, site, sender, receiver)]
    answered += [control("edge", node, reader) for node in receivers for reader in senders]
    answered += [control("status"), control("clock", sender)]
    asked = [_history_of(key) for key in _samples_between(deployment, site, receiver, sender)]
    asked += [control("edge", node, reader) for node in senders for reader in receivers]
    asked += [control("status"), control("clock", receiver)]
    everybody = [control("ready", "*"), control("machine", "*", "*", "*", "*")]
    return {
        "put": [*_samples_between(deployment, site, sender, receiver), *told],
        "declare_subscriber": [*_samples_between(deployment, site, receiver, sender), *heard],
        "declare_queryable": answered,
        "reply": answered,
        "query": asked,
        "liveliness_token": [control("ready", node) for node in senders] + [control("machine", sender, "*", "*", "*")],
        "declare_liveliness_subscriber": everybody,
        "liveliness_query": everybody,
    }


def observer_grants(flow: str) -> tuple[Grants, Grants]:
    """What an observer may send, and what may be sent to it: it reads everything and writes nothing."""
    everything = _everything(flow)
    status = [control_key(flow, "status"), control_key("*", "status")]  # of it, or of the one that answers
    asks: Grants = {
        "declare_subscriber": everything,
        "query": status,
        "declare_liveliness_subscriber": everything,
        "liveliness_query": everything,
    }
    gets: Grants = {
        "put": everything,
        "delete": everything,
        "declare_queryable": status,
        "reply": status,
        "liveliness_token": everything,
    }
    return asks, gets


def feeder_grants(deployment: Deployment, site: Site) -> tuple[Grants, Grants]:
    """An observer's rights, and to write what the external nodes of this machine do."""
    asks, gets = observer_grants(deployment.flow)
    written = external_keys(deployment, site, site.name)
    # That someone reads these keys is told to who writes them: without, a publisher sends nothing.
    return _together([asks, {"put": written}]), _together([gets, {"declare_subscriber": written}])


def external_keys(deployment: Deployment, site: Site, machine: str) -> list[str]:
    """The keys that the external nodes of `machine` write."""
    plans = [plan for name, plan in deployment.plans.items() if plan.external and site.places[name] == machine]
    return [out.key for plan in plans for out in plan.outputs.values()]


def observed_grants(deployment: Deployment, site: Site, machine: str) -> Grants:
    """What `machine` may send to observers behind a router: all that is its own."""
    flow = deployment.flow
    nodes = _nodes_on(deployment, site, machine)
    counted = [control_key(flow, word, node) for node in nodes for word in NODES_WORDS]
    status = [control_key(flow, "status")]
    return {"put": [*_written_on(deployment, site, machine), *counted], "declare_queryable": status, "reply": status}


def check_access_control(control: Mapping[str, Any]) -> None:
    """Raise DataflowError for rules that Zenoh would take without a word and not keep."""
    rules, subjects = ({each["id"] for each in control[what]} for what in ("rules", "subjects"))
    if not control.get("enabled") or control.get("default_permission") != "deny":
        raise DataflowError("access control: is not on, or does not deny what is not allowed")
    for what, known in (("rules", rules), ("subjects", subjects)):
        if len(known) != len(control[what]):
            raise DataflowError(f"access control: two {what} have one id")
        for policy in control["policies"]:
            if unknown := set(policy[what]) - known:
                raise DataflowError(f"access control: a policy names {min(unknown)!r}; no such {what[:-1]}")
    for rule in control["rules"]:
        if unknown := set(rule["messages"]) - set(KINDS):
            raise DataflowError(f"access control: rule {rule['id']!r} names the message {min(unknown)!r}; no such one")
    for subject in control["subjects"]:
        if not subject.get("cert_common_names") and not subject.get("link_protocols"):
            raise DataflowError(f"access control: the subject {subject['id']!r} would be everybody")


def _mutual_tls(own: Credentials) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(own.authority),
        "enable_mtls": True,
        "listen_certificate": str(own.certificate),
        "listen_private_key": str(own.key),
        "connect_certificate": str(own.certificate),
        "connect_private_key": str(own.key),
        # Who is at the other end is known by its common name, at either end of the link; addresses change.
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


def _default_deny(both_ways: Mapping[str, tuple[Grants, Grants]]) -> dict[str, Any]:
    """Access control by common name: what may come from it, and what may go to it."""
    control: dict[str, Any] = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [],
        "subjects": [],
        "policies": [],
    }
    for name, (comes, goes) in both_ways.items():
        _allow(control, name, {"cert_common_names": [name]}, comes, goes)
    return control


def _allow(control: dict[str, Any], name: str, who: Mapping[str, list[str]], comes: Grants, goes: Grants) -> None:
    """Let those whom `who` describes send what `comes` allows, and have sent to them what `goes` does."""
    rules = _rules(name, comes, goes)
    control["rules"] += rules
    control["subjects"].append({"id": name, **who})
    control["policies"].append({"subjects": [name], "rules": [rule["id"] for rule in rules]})


def _together(grants: Iterable[Grants]) -> Grants:
    """What any of `grants` allows."""
    union: Grants = {}
    for each in grants:
        for kind, keys in each.items():
            union[kind] = list(dict.fromkeys([*union.get(kind, []), *keys]))
    return union


def _rules(name: str, comes: Grants, goes: Grants) -> list[dict[str, Any]]:
    ways = (("ingress", comes), ("egress", goes))
    return [_rule(name, way, kind, keys) for way, grants in ways for kind, keys in grants.items() if keys]


def _rule(name: str, way: str, kind: str, keys: list[str]) -> dict[str, Any]:
    return {
        "id": f"{name} {way} {kind}",
        "permission": "allow",
        "flows": [way],
        "messages": [kind],
        "key_exprs": list(dict.fromkeys(keys)),
    }


def _everything(flow: str) -> list[str]:
    return ["**", control_key(flow, "**")]  # `**` does not stand for `@`


def _nodes_on(deployment: Deployment, site: Site, machine: str) -> list[str]:
    nodes = [name for name in deployment.plans if site.places[name] == machine]
    recorder = recorder_name(machine)
    return [*nodes, recorder] if machine in site.recorders and recorder not in nodes else nodes


def _samples_between(deployment: Deployment, site: Site, writer: str, reader: str) -> list[str]:
    """The keys that nodes on `writer` publish and nodes on `reader` read."""
    plans, written = deployment.plans, _written_on(deployment, site, writer)
    if reader in site.recorders:
        return sorted(written)
    read = {wire.key for name, plan in plans.items() if site.places[name] == reader for wire in plan.inputs.values()}
    return sorted(written & read)


def _history_of(key: str) -> str:
    """Where past samples of the stream `key` are asked for."""
    return control_key(key.partition("/")[0], "history", *stream_of(key))


def _written_on(deployment: Deployment, site: Site, machine: str) -> set[str]:
    """The keys that nodes on `machine` publish."""
    return {
        sample_key(deployment.flow, name, port)
        for name, plan in deployment.plans.items()
        if site.places[name] == machine
        for port in plan.outputs
    }
