"""Where the phone's page is, and how it is served; needs the extra `phone` only when it is."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge, Le

from caneflow.errors import CaneflowError, not_installed
from caneflow.messages.rig import Guidance

if TYPE_CHECKING:
    from caneflow.viewing.phone_server import PhoneServer


@dataclass(frozen=True, kw_only=True)
class PhonePageSettings:
    """Where the page is."""

    __pydantic_config__ = {"extra": "forbid"}

    listen: str = "127.0.0.1"  # an address of this machine; any other than loopback needs keys/page.crt
    port: Annotated[int, Ge(0), Le(65535)] = 0  # 0: any that is free
    keys: str = "keys"  # the folder with page.crt and page.key


def page_server(settings: PhonePageSettings, guidance: Guidance, *, hears: bool, senses: bool) -> "PhoneServer":
    """The page's server, to be entered; raises CaneflowError where the page cannot be served.

    `hears`: there are cues to tell; `senses`: the phone's motion is wanted.
    """
    try:
        from caneflow.viewing.phone_server import PhoneServer, certificate_in
    except ModuleNotFoundError as error:
        raise CaneflowError(not_installed(str(error.name), "phone")) from error
    tls = certificate_in(Path(settings.keys))
    return PhoneServer(guidance, hears=hears, senses=senses, listen=settings.listen, port=settings.port, tls=tls)


def squares_of(server: "PhoneServer") -> list[str]:
    """The lines of a QR code of the page's address; none where the extra `phone` is not installed."""
    from caneflow.viewing.phone_server import in_squares

    return in_squares(server.address).splitlines()
