"""A launcher's session: its nodes, tools and the launchers of other machines reach it there."""

import secrets
from pathlib import Path

import zenoh

from caneflow.runtime.dataflow.topology import is_open
from caneflow.runtime.deployment import Deployment
from caneflow.runtime.hosts.launcher.companions import LINK_SETTINGS
from caneflow.runtime.hosts.launcher.congestion import launcher_ids, node_ids, tool_links
from caneflow.runtime.hosts.links.access import links_between, open_door
from caneflow.runtime.hosts.links.session import open_session, protocol
from caneflow.runtime.site import Site


def open_launcher_session(deployment: Deployment, run: str, endpoint: str, keys: Path | None) -> zenoh.Session:
    """Listen at `endpoint` for this machine's nodes and tools, and where the file says so for others.

    `run`: from which the ids of its nodes' sessions follow. Raises DataflowError when the session cannot be opened.
    """
    flow, replay, site = deployment.flow, deployment.replay, deployment.site
    own = [each for node in filter(deployment.runs_here, deployment.plans) for each in node_ids(run, node)]
    if site is None:
        door, secured = open_door(deployment, keys)
        more = tool_links(flow, map(protocol, (endpoint, *door)), own, replay=replay)
        stamped = {"timestamping/enabled": True} if door else {}  # of what goes to others: when it was put
        return open_session(listen=[endpoint, *door], replay=replay, more={**secured, **more, **stamped})
    site, secured = links_between(deployment, site, keys)
    own += [each for machine in site.others for each in launcher_ids(flow, machine)]
    strangers = map(protocol, (endpoint, *site.listen))
    router = protocol(site.connect[-1]) if site.router else ""
    more = tool_links(flow, strangers, own, replay=replay, router=router)
    return open_session(
        mode="router",
        listen=[endpoint, *site.listen],
        connect=site.connect,
        replay=replay,
        identity=secrets.choice(launcher_ids(flow, site.name)),
        more={**LINK_SETTINGS, **secured, **more},
    )


def listening(door: Site) -> str:
    """The line that says where other programs attach, and who may."""
    beyond = any(map(is_open, door.listen))
    who = "whoever reaches it" if beyond and door.insecure else "every user of this machine"
    who = "who shows a certificate of this flow" if beyond and not door.insecure else who
    return f"other programs attach at {', '.join(door.listen)} (mode client); {who} can read there"
