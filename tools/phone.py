"""The phone's page as a node of a graph: cues heard, felt and said in a phone's browser.

in   cue : Cue

The page's address is in the log, as a QR code where the extra `phone` is installed. The phone's own motion comes from
drivers.phone.
"""

import contextlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge, Le

from caneflow.errors import CaneflowError, not_installed
from caneflow.messages import Cue, Sample
from caneflow.messages.rig import Guidance, User
from caneflow.runtime import Context, Sink
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.node import run

if TYPE_CHECKING:
    from caneflow.viewing.phone_server import PhoneServer

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PhonePageSettings:
    """Where the page is."""

    __pydantic_config__ = {"extra": "forbid"}

    listen: str = "127.0.0.1"  # an address of this machine; any other than loopback needs keys/page.crt
    port: Annotated[int, Ge(0), Le(65535)] = 0  # 0: any that is free
    keys: str = "keys"  # the folder with page.crt and page.key


class PhonePage(Sink):
    """Tells the page every cue; when the process ends, the page says so within a second."""

    Settings = PhonePageSettings

    def __init__(self, settings: PhonePageSettings, context: Context) -> None:
        self._open = contextlib.ExitStack()
        guidance = (context.rig.user or User()).guidance
        self._server: PhoneServer = self._open.enter_context(_serving(settings, guidance))
        log.info("the phone's page is at %s", self._server.address)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Tell one cue."""
        if isinstance(message, Cue):
            self._server.tell(message)

    def idle(self, time: int) -> None:
        """The page notices by itself when cues stop."""

    def finish(self) -> None:
        """Close the page's link: it says that it is lost."""
        self._open.close()


def _serving(settings: PhonePageSettings, guidance: Guidance) -> "PhoneServer":
    try:
        from caneflow.viewing.phone_server import PhoneServer, certificate_in, in_squares
    except ModuleNotFoundError as error:
        raise DataflowError(not_installed(str(error.name), "phone")) from error
    tls = certificate_in(Path(settings.keys))
    try:
        server = PhoneServer(guidance, hears=True, senses=False, listen=settings.listen, port=settings.port, tls=tls)
    except CaneflowError as error:
        raise DataflowError(str(error)) from error
    for line in in_squares(server.address).splitlines():
        log.info("%s", line)
    return server


if __name__ == "__main__":
    run(PhonePage)
