"""The phone's page as a node of a graph: cues heard, felt and said in a phone's browser.

in   cue : Cue

The page's address is in the log, as a QR code where the extra `phone` is installed. The phone's own motion comes from
drivers.phone.
"""

import contextlib
import logging

from caneflow.messages import Cue, Sample
from caneflow.messages.rig import User
from caneflow.runtime import Context, Sink
from caneflow.runtime.node import run
from caneflow.viewing.phone_page import PhonePageSettings, page_server, squares_of

log = logging.getLogger(__name__)


class PhonePage(Sink):
    """Tells the page every cue; when the process ends, the page says so within a second."""

    Settings = PhonePageSettings

    def __init__(self, settings: PhonePageSettings, context: Context) -> None:
        self._open = contextlib.ExitStack()
        guidance = (context.rig.user or User()).guidance
        self._server = self._open.enter_context(page_server(settings, guidance, hears=True, senses=False))
        log.info("the phone's page is at %s", self._server.address)
        for line in squares_of(self._server):
            log.info("%s", line)

    def take(self, key: str, message: Sample, payload: bytes, time: int) -> None:
        """Tell one cue."""
        if isinstance(message, Cue):
            self._server.tell(message)

    def idle(self, time: int) -> None:
        """The page notices by itself when cues stop."""

    def finish(self) -> None:
        """Close the page's link: it says that it is lost."""
        self._open.close()


if __name__ == "__main__":
    run(PhonePage)
