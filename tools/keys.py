"""`caneflow keys`: a flow's own authority, and a certificate for each machine that may take part."""

import datetime
import json
from pathlib import Path
from typing import Annotated

import typer

from caneflow.errors import not_installed
from caneflow.runtime.dataflow.loading import load
from caneflow.runtime.deployment import deploy
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts.links import certificates
from caneflow.runtime.hosts.links.access import router_settings

Folder = Annotated[Path, typer.Option("--keys", metavar="DIR", help="where they are kept")]
DEFAULT_FOLDER = Path("keys")  # `caneflow run FILE` looks for it beside the file


def init(folder: Folder = DEFAULT_FOLDER) -> None:
    """Start a flow's own authority: a machine without a certificate of it gets no link.

    Keep ca.key to yourself: who has it can let anybody in. It is not needed to run a flow.

    Example: caneflow keys init --keys keys
    """
    _need_library()
    certificate = certificates.make_authority(folder)
    print(f"{certificate}: made; `caneflow keys add NAME` makes the key of each of the flow's machines")


def add(
    name: Annotated[str, typer.Argument(help="of the machine, as in the dataflow file")],
    folder: Folder = DEFAULT_FOLDER,
    observer: Annotated[
        bool, typer.Option("--observer", help="no machine of the flow: may read everything and write nothing")
    ] = False,
    days: Annotated[
        int, typer.Option(metavar="N", min=1, max=3650, help="days that it holds")
    ] = certificates.MACHINE_DAYS,
    anew: Annotated[bool, typer.Option("--anew", help="in the place of one that is there")] = False,
    addresses: Annotated[
        list[str] | None,
        typer.Option("--address", metavar="ADDR", help="IP address or host name that browsers use; repeatable"),
    ] = None,
) -> None:
    """Make the key and certificate of one machine, or of a page for phones: add page --address 192.168.1.5.

    Copy NAME.key, NAME.crt and ca.crt into a folder `keys` beside the dataflow file on that machine, and nothing else.

    Example: caneflow keys add gateway
    """
    _need_library()
    certificate = certificates.make_certificate(
        folder, name, observer=observer, days=days, anew=anew, addresses=addresses or ()
    )
    own = f"{certificate.with_suffix('.key').name}, {certificate.name} and {certificates.AUTHORITY}.crt"
    print(f"{certificate}: made; {name} needs {own}")


def router(
    file: Annotated[Path, typer.Argument(help="the dataflow, with its `router:`")], folder: Folder = DEFAULT_FOLDER
) -> None:
    """Print the configuration of a Zenoh router that passes on between the machines of a flow.

    Each machine may say through it what is its own and hear what its nodes read. The router needs a certificate of
    its own, which `caneflow keys add router` makes; give zenohd the file with --config.

    Example: caneflow keys router dataflow.yaml > router.json5
    """
    graph = load(file)
    if graph.router is None:
        raise DataflowError(f"{file}: names no router; write e.g. `router: tcp/broker.local:7447`")
    own = certificates.credentials(folder, certificates.ROUTER)
    if own is None:
        raise DataflowError(f"{folder}: holds no certificate of the router; `caneflow keys add router` makes it")
    if not graph.machines:
        raise DataflowError(
            f"{file}: names no machine, and the router knows machines by name; write machines: {{here: {{}}}}"
        )
    deployment = deploy(graph, machine=next(iter(graph.machines)))
    site = deployment.site or deployment.door
    assert site is not None, "it has a router"
    print(json.dumps(router_settings(deployment, site, own), indent=2))


def show(folder: Folder = DEFAULT_FOLDER) -> None:
    """Show the certificates of a folder, and until when they hold.

    Example: caneflow keys list --keys keys
    """
    _need_library()
    found = list(certificates.certificates(folder))
    if not found:
        raise DataflowError(f"{folder}: holds no certificate; `caneflow keys init` starts a flow's authority")
    now = datetime.datetime.now(datetime.UTC)
    for each in found:
        days = (each.expires - now).days
        until = f"holds until {each.expires:%Y-%m-%d} ({days} days)" if days >= 0 else "does not hold any more"
        print(f"{each.name}  {each.role}  {until}")


def _need_library() -> None:
    try:
        import cryptography  # noqa: F401 - is it there?
    except ImportError as error:
        raise DataflowError(not_installed("cryptography", "secure")) from error


commands = {"init": init, "add": add, "list": show, "router": router}
