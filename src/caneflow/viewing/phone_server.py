"""Serves the phone's page: hears cues from here, and sends the phone's motion; to nobody who does not have its key.

The page is whole in this package and asks nobody else. On another machine than this one it is served over TLS only:
browsers give sensors to secure pages alone.
"""

import asyncio
import io
import queue
import secrets
import ssl
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from caneflow.algorithms.surroundings.cue_texts import CueTexts
from caneflow.errors import CaneflowError
from caneflow.messages import Cue
from caneflow.messages.rig import Guidance
from caneflow.viewing.serving import FORBIDDEN, HEADERS, LOOPBACK, ServerThread, file_of, is_of_this_page, listening_on

BEAT = 0.2  # s between two signs of life for the page
MOST_BYTES = 16_384  # of what a page sends at once
MOST_WAITING = 100  # messages of pages that this process may be behind: seconds, and 100 MB of the worst ones


class Certificate(NamedTuple):
    """What the page is served with."""

    certificate: Path
    key: Path


def certificate_in(folder: Path) -> Certificate | None:
    """`page.crt` and `page.key` of a folder of keys; None when it does not have them."""
    found = Certificate(folder / "page.crt", folder / "page.key")
    return found if found.certificate.is_file() and found.key.is_file() else None


class Readings(NamedTuple):
    """What a phone sent at once."""

    arrival: int  # ns
    said: dict[str, Any]


class PhoneServer(ServerThread):
    """The page's server, on a thread of its own; a context manager."""

    def __init__(
        self, guidance: Guidance, *, hears: bool, senses: bool, listen: str, port: int, tls: Certificate | None
    ) -> None:
        """`hears`: there are cues to tell; `senses`: the phone's motion is wanted.

        `listen`: an address of this machine. Raises CaneflowError when it cannot be had, or needs a certificate.
        """
        if tls is None and listen not in LOOPBACK:
            raise CaneflowError(
                f"listen {listen}: beyond this machine the page needs TLS; "
                f"`caneflow keys add page --address {listen}` makes its certificate"
            )
        self.readings: queue.Queue[Readings] = queue.Queue(MOST_WAITING)
        self.unheard = 0  # messages that this process was too slow for
        self._hello = {"hears": hears, "senses": senses, "guidance": guidance.model_dump()}
        self._texts = CueTexts(guidance.range, frozenset(guidance.levels))
        self._cue: dict[str, Any] | None = None
        self._clients: set[asyncio.Queue[dict[str, Any]]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._key = secrets.token_urlsafe(18)
        listening = listening_on(listen, port, "expected a free port of this machine")
        scheme = "https" if tls else "http"
        self.address = f"{scheme}://{listen}:{listening.getsockname()[1]}/#{self._key}"
        routes = [Route("/", self._file), Route("/{name}", self._file), WebSocketRoute("/phone", self._phone)]
        config = uvicorn.Config(
            Starlette(routes=routes), log_level="warning", ws="wsproto", ws_max_size=MOST_BYTES, access_log=False,
            timeout_graceful_shutdown=1, lifespan="off",
            ssl_certfile=str(tls.certificate) if tls else None, ssl_keyfile=str(tls.key) if tls else None,
        )  # fmt: skip
        try:
            config.load()
        except (OSError, ssl.SSLError) as error:
            listening.close()
            raise CaneflowError(
                f"{tls.certificate if tls else listen}: not a certificate with its key: {error}"
            ) from error
        super().__init__(config, listening, name="phone")

    def tell(self, cue: Cue) -> None:
        """Let the phones hear a cue; from any thread."""
        self._texts.update(cue.stamp, cue.kind, cue.level, cue.distance or 0.0, cue.azimuth or 0.0, cue.reason or "")
        said = {
            "kind": cue.kind, "level": cue.level, "distance": cue.distance, "azimuth": cue.azimuth,
            "text": self._texts.text,
        }  # fmt: skip
        loop = self._loop
        self._cue = said
        if loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._offer, {"cue": said})

    def _offer(self, message: dict[str, Any]) -> None:
        for client in self._clients:
            with suppress(asyncio.QueueFull):  # a page that is slow misses cues, never hears old ones late for long
                client.put_nowait(message)

    async def _file(self, request: Request) -> Response:
        response = file_of("phone", request)
        response.headers.update(HEADERS)
        return response

    async def _phone(self, websocket: WebSocket) -> None:
        if not is_of_this_page(websocket, self._key):
            await websocket.close(FORBIDDEN)
            return
        await websocket.accept()
        self._loop = asyncio.get_running_loop()
        client: asyncio.Queue[dict[str, Any]] = asyncio.Queue(8)
        client.put_nowait({"hello": self._hello})
        if self._cue is not None:
            client.put_nowait({"cue": self._cue})
        self._clients.add(client)
        sending = asyncio.create_task(_send(websocket, client))
        try:
            await self._hear(websocket, client)
        finally:
            self._clients.discard(client)
            sending.cancel()
            with suppress(asyncio.CancelledError):
                await sending

    async def _hear(self, websocket: WebSocket, client: asyncio.Queue[dict[str, Any]]) -> None:
        with suppress(WebSocketDisconnect):
            while True:
                try:
                    said = msgspec.json.decode(await websocket.receive_text(), type=dict[str, Any])
                except (msgspec.DecodeError, KeyError):  # KeyError: not a text
                    continue
                now = time.time_ns()
                if "ping" in said:
                    with suppress(asyncio.QueueFull):
                        client.put_nowait({"pong": said["ping"], "at": now / 1e6})
                elif self._hello["senses"]:
                    try:
                        self.readings.put_nowait(Readings(now, said))
                    except queue.Full:
                        self.unheard += 1


async def _send(websocket: WebSocket, client: asyncio.Queue[dict[str, Any]]) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # RuntimeError: closed in between
        while True:
            try:
                message = await asyncio.wait_for(client.get(), BEAT)
            except TimeoutError:
                message = {"alive": True}
            await websocket.send_text(msgspec.json.encode(message).decode())


def in_squares(address: str) -> str:
    """The address as a QR code for a terminal; empty when the extra `phone` is not installed."""
    try:
        import segno
    except ImportError:
        return ""
    drawn = io.StringIO()
    segno.make(address, error="m").terminal(drawn, compact=True)
    return drawn.getvalue()
