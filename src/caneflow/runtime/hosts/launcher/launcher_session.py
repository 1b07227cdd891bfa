"""A launcher's session: its nodes, tools and the launchers of other machines reach it there."""

import secrets
from collections.abc import Mapping
from typing import Any

import zenoh

from caneflow.runtime.dataflow.topology import is_open
from caneflow.runtime.deployment import Deployment
from caneflow.runtime.hosts.launcher.companions import LINK_SETTINGS
from caneflow.runtime.hosts.launcher.congestion import launcher_ids, node_ids, tool_links
from caneflow.runtime.hosts.links.session import open_session, protocol
from caneflow.runtime.site import Site


def open_launcher_session(deployment: Deployment, run: str, endpoint: str, more: Mapping[str, Any]) -> zenoh.Session:
    """Listen at `endpoint` for this machine's nodes and tools, and where the file says so for others.

    `run`: from which the ids of its nodes' sessions follow; `more`: Zenoh's settings for links with others. It is a
    router where there are such links: a peer would not pass on what its nodes send. Raises DataflowError when the
    session cannot be opened.
    """
    flow, replay, site = deployment.flow, deployment.replay, deployment.site or deployment.door
    own = [each for node in filter(deployment.runs_here, deployment.plans) for each in node_ids(run, node)]
    if site is None:
        links = tool_links(flow, [protocol(endpoint)], own, replay=replay)
        return open_session(listen=[endpoint], replay=replay, more={**more, **links})
    own += [each for machine in site.others for each in launcher_ids(flow, machine)]
    # A router between machines must lose nothing; beside a single one it is a listener like every other.
    router = protocol(site.connect[-1]) if site.router and site.others else ""
    strangers = map(protocol, (endpoint, *site.listen, *(() if site.others else site.connect)))
    links = tool_links(flow, strangers, own, replay=replay, router=router)
    return open_session(
        mode="router",
        listen=[endpoint, *site.listen],
        connect=site.connect,
        replay=replay,
        identity=secrets.choice(launcher_ids(flow, site.name)),
        more={**LINK_SETTINGS, **more, **links},
    )


def reached_at(site: Site, *, alone: bool) -> str:
    """The line that says where other programs attach, and who may; `alone`: all nodes are on this machine."""
    beyond = any(map(is_open, (*site.listen, *site.connect)))
    who = "whoever reaches it" if beyond else "every user of this machine"
    if {"tls"} == set(map(protocol, (*site.listen, *site.connect))):
        who = "who shows a certificate of this flow"
    rights = "read" if alone or who.startswith("who shows") else "read and write"
    where = ", ".join((*site.listen, *filter(None, site.connect[-1:] if site.router else ())))
    return f"other programs attach at {where} (mode client); {who} can {rights} there"
