"""`caneflow keys`: a flow's own authority, and a certificate for each machine that may take part."""

import datetime
from pathlib import Path
from typing import Annotated

import typer

from caneflow.runtime.errors import DataflowError
from caneflow.runtime.hosts import certificates

Folder = Annotated[Path, typer.Option("--keys", metavar="DIR", help="where they are kept")]
DEFAULT_FOLDER = Path("keys")  # `caneflow run FILE` looks for it beside the file


def init(folder: Folder = DEFAULT_FOLDER) -> None:
    """Start a flow's own authority: whoever has no certificate of it gets no link.

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
) -> None:
    """Make the key and certificate of one machine.

    Copy NAME.key, NAME.crt and ca.crt into a folder `keys` beside the dataflow file on that machine, and nothing else.

    Example: caneflow keys add gateway
    """
    _need_library()
    certificate = certificates.make_certificate(folder, name, observer=observer, days=days, anew=anew)
    own = f"{certificate.with_suffix('.key').name}, {certificate.name} and {certificates.AUTHORITY}.crt"
    print(f"{certificate}: made; {name} needs {own}")


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
        raise DataflowError("needs the package cryptography; pip install 'caneflow[secure]'") from error


commands = {"init": init, "add": add, "list": show}
