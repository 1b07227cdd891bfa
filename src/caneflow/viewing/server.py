"""Serves the page on loopback: whole from this package, and to nobody who does not have its key.

A page in a browser can be reached by other pages. So the websocket wants the key that is in the printed address,
a Host that is this machine (against DNS rebinding), and an Origin that is this very page.
"""

import asyncio
import secrets
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any, Protocol

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from caneflow.viewing.packets import packet
from caneflow.viewing.serving import (
    FORBIDDEN,
    HEADERS,
    LOOPBACK,
    ServerThread,
    file_of,
    is_of_this_page,
    listening_on,
    split_address,
)

BEAT = 0.03  # s between two batches
MOST_WAITING = 33  # batches for one page: 1 s; beyond, the oldest are left out and counted
MOST_ASKED = 4_096  # bytes of a page's request


class Feed(Protocol):
    """What is shown: called on the server's thread, and must not block; only `answer` may take its time."""

    lossless: bool  # whether a slow page is given everything all the same

    def hello(self) -> bytes:
        """What a page is told first."""
        ...

    def so_far(self) -> list[bytes]:
        """What a page is told then: all that was given to others before it."""
        ...

    def batch(self, *, watched: bool) -> bytes | None:
        """What is new since the last one; `watched`: someone looks."""
        ...

    def picture(self) -> bytes | None:
        """What is new and takes long to make; asked for between two batches, when someone looks."""
        ...

    def answer(self, request: dict[str, Any]) -> bytes | None:
        """What a page that asks is answered."""
        ...


class _Client:
    """One open page: what waits to be sent to it."""

    def __init__(self, *, lossless: bool) -> None:
        self._waiting: deque[bytes] = deque()
        self._most = None if lossless else MOST_WAITING
        self._skipped = 0
        self._told = 0
        self._came = asyncio.Event()

    def begin(self, first: list[bytes]) -> None:
        """Send these, whatever their number, and forget what waits."""
        self._waiting = deque(first)
        self._came.set()

    def offer(self, batch: bytes) -> None:
        """Let `batch` wait; drop the oldest one when there are too many."""
        if self._most is not None and len(self._waiting) >= self._most:
            self._waiting.popleft()
            self._skipped += 1
        self._waiting.append(batch)
        self._came.set()

    async def next(self) -> bytes:
        """What to send next, as soon as there is anything."""
        while not self._waiting:
            self._came.clear()
            await self._came.wait()
        if self._told != self._skipped:
            self._told = self._skipped
            return packet("skipped", batches=self._skipped)
        return self._waiting.popleft()


class PageServer(ServerThread):
    """The page's server, on a thread of its own; a context manager."""

    def __init__(self, feed: Feed, *, port: int = 0) -> None:
        """`port` on 127.0.0.1, 0 for any that is free; raises CaneflowError when it is taken."""
        self._feed = feed
        self._clients: set[_Client] = set()
        self._key = secrets.token_urlsafe(18)
        self._loop: asyncio.AbstractEventLoop | None = None
        listening = listening_on("127.0.0.1", port, "give another with --port, or 0")
        self.port: int = listening.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}/#{self._key}"
        config = uvicorn.Config(
            _OnlyHere(self._application()), log_level="warning", ws="wsproto", ws_max_size=MOST_ASKED, access_log=False,
            ws_per_message_deflate=False, timeout_graceful_shutdown=1, lifespan="on",
        )  # fmt: skip
        super().__init__(config, listening, name="page")

    def show(self, feed: Feed) -> None:
        """Show another feed from now on, on the pages that are open as well; from any thread."""

        def change() -> None:
            self._feed = feed
            for client in self._clients:
                client.begin([feed.hello(), *feed.so_far()])

        if self._loop is None:
            self._feed = feed
        else:
            self._loop.call_soon_threadsafe(change)

    def _application(self) -> Starlette:
        pages = [Route("/", self._file), Route("/{name}", self._file)]
        return Starlette(routes=[*pages, WebSocketRoute("/samples", self._samples)], lifespan=self._lifespan)

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        beat = asyncio.create_task(self._beat())
        try:
            yield
        finally:
            beat.cancel()
            with suppress(asyncio.CancelledError):
                await beat

    async def _beat(self) -> None:
        """Offer each page what is new, every BEAT."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = max(due + BEAT, loop.time())  # after a pause there is nothing to catch up with
            await asyncio.sleep(due - loop.time())
            self._offer(self._feed.batch(watched=bool(self._clients)))
            await asyncio.sleep(BEAT / 2)  # the batch is on its way; what takes long holds up neither it nor the next
            if self._clients:
                self._offer(self._feed.picture())

    def _offer(self, batch: bytes | None) -> None:
        if batch is not None:
            for client in self._clients:
                client.offer(batch)

    async def _file(self, request: Request) -> Response:
        return file_of("page", request)

    async def _samples(self, websocket: WebSocket) -> None:
        if not is_of_this_page(websocket, self._key):
            await websocket.close(FORBIDDEN)
            return
        await websocket.accept()
        client = _Client(lossless=self._feed.lossless)
        client.begin([self._feed.hello(), *self._feed.so_far()])
        self._clients.add(client)  # at once: what comes from now on waits behind what was before
        sending = asyncio.create_task(_send(websocket, client))
        try:
            await self._answer(websocket, client)
        finally:
            self._clients.discard(client)
            sending.cancel()
            with suppress(asyncio.CancelledError):
                await sending

    async def _answer(self, websocket: WebSocket, client: _Client) -> None:
        """Answer the page's requests until it is closed."""
        with suppress(WebSocketDisconnect):
            while True:
                try:
                    request = msgspec.json.decode(await websocket.receive_text(), type=dict[str, Any])
                except (msgspec.DecodeError, KeyError):  # KeyError: not a text
                    continue
                answer = await asyncio.to_thread(self._feed.answer, request)
                if answer is not None:
                    client.offer(answer)


async def _send(websocket: WebSocket, client: _Client) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # RuntimeError: closed in between
        while True:
            await websocket.send_bytes(await client.next())


class _OnlyHere:
    """Answers requests that name this machine as their host, and adds the headers that fence the page in."""

    def __init__(self, application: ASGIApp) -> None:
        self._application = application

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._application(scope, receive, send)
            return
        host = split_address(f"//{Headers(scope=scope).get('host', '')}").hostname
        if host not in LOOPBACK:
            if scope["type"] == "http":
                await PlainTextResponse("this page is for this machine only\n", status_code=403)(scope, receive, send)
            else:
                await WebSocket(scope, receive, send).close(FORBIDDEN)
            return

        async def fenced(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(name.lower().encode(), text.encode()) for name, text in HEADERS.items()]
            await send(message)

        await self._application(scope, receive, fenced)
