"""What the servers of both pages share: a socket, a thread, the files of a page, and who may speak to it."""

import secrets
import socket
import threading
from importlib.resources import files
from types import TracebackType
from typing import Self
from urllib.parse import SplitResult, urlsplit

import uvicorn
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.websockets import WebSocket

from caneflow.errors import CaneflowError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
FORBIDDEN = 4403  # close code of a websocket without the key
STOP_PATIENCE = 2.0  # s
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}


class ServerThread:
    """Serves on a socket, on a thread of its own; a context manager."""

    def __init__(self, config: uvicorn.Config, listening: socket.socket, *, name: str) -> None:
        self._socket = listening
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listening]}, name=name, daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.should_exit = True
        self._thread.join(STOP_PATIENCE)
        self._socket.close()


def listening_on(address: str, port: int, advice: str) -> socket.socket:
    """A socket that listens; port 0: any that is free. Raises CaneflowError, with `advice`, when it cannot be had."""
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((address, port))
        listening.listen()  # who comes before the server has started waits
    except OSError as error:
        listening.close()
        raise CaneflowError(f"port {port} on {address}: {error.strerror}; {advice}") from error
    return listening


def file_of(folder: str, request: Request) -> Response:
    """The file of a page that a request names, or that there is none; `folder`: the page's, in this package."""
    name = request.path_params.get("name", "index.html")
    kind = TYPES.get(name.rpartition(".")[2])
    # A stranger's name is compared with those that there are, and never given to the file system.
    page = {file.name: file for file in files("caneflow.viewing").joinpath(folder).iterdir()}
    if kind is None or name not in page:
        return PlainTextResponse("not here\n", status_code=404)
    return Response(page[name].read_bytes(), media_type=kind)


def is_of_this_page(websocket: WebSocket, key: str) -> bool:
    """Whether the one who speaks knows the key, and is a page that came from here."""
    given = websocket.query_params.get("key", "")
    origin = split_address(websocket.headers.get("origin", ""))
    return secrets.compare_digest(given.encode(), key.encode()) and origin.netloc == websocket.headers["host"]


def split_address(address: str) -> SplitResult:
    """The parts of an address that a stranger names; all are empty when it is none."""
    try:
        return urlsplit(address)
    except ValueError:  # e.g. an unclosed bracket
        return urlsplit("")
